"""The measurement of bounds: what is due, by its own rays; how violations and ratios are counted; points of a bake."""
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
pytest.importorskip("matplotlib")

import drjit as dr

from mi_shlight import bake_transfer
from validation import bounds
from validation.bounds import Plan, Truth
from validation.soft_shadows import ball_scene, exact_radiance

SMALL = Plan(size=12, strata=12, repeats=4, points=50)


def test_what_is_due():
    """Below the ball as from its equation; within the error that is claimed, and that small."""
    scene = ball_scene()
    x = np.linspace(-1, 1, 21)
    origin = mi.Point3f(mi.Float(x.tolist()), 0.1, -0.1)
    points = bounds.seen_by(scene, mi.Ray3f(origin, mi.Vector3f(0, -1, 0)))
    truth, unshadowed = bounds.truth_of(scene, points, SMALL)
    exact, visible = exact_radiance(np.stack([x, 0 * x, 0 * x - 0.1], axis=1))
    exact *= 0.5 * 10                                 # reflectance and radiance
    assert visible.min() == 0 and visible.max() == 1 and ((visible > 0.05) & (visible < 0.95)).sum() > 2
    assert (abs(truth.value - exact) <= truth.error + 1e-3 * exact.max()).all()
    assert truth.error.max() < 0.05 * exact.max()
    lit = visible == 1
    np.testing.assert_allclose(unshadowed.value[lit], exact[lit], rtol=2e-3)
    assert (truth.facing >= unshadowed.value).all()


def test_what_is_due_under_a_sky():
    """A floor under a constant sky, half of which is behind a wall."""
    transform = mi.ScalarTransform4f()
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    floor = {"type": "rectangle", "to_world": transform.rotate([1, 0, 0], -90), "bsdf": grey}
    wall = {"type": "rectangle", "to_world": transform.scale(1e3)}                  # the plane z = 0: half of the sky behind it
    scene = mi.load_dict({"type": "scene", "floor": floor, "wall": wall,
                          "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 2.0}}})
    points = bounds.seen_by(scene, mi.Ray3f(mi.Point3f(mi.Float([0.0, 0.3]), 0.1, 0.2), mi.Vector3f(0, -1, 0)))
    truth, unshadowed = bounds.truth_of(scene, points, SMALL)
    np.testing.assert_allclose(unshadowed.value, 1, rtol=1e-4)
    np.testing.assert_allclose(truth.value, 0.5, atol=0.01)
    assert (abs(truth.value - 0.5) <= truth.error).all()


def test_violations_and_ratios():
    truth = Truth(np.ones(6), np.full(6, 0.01), np.ones(6))
    found = {"value": np.array([1.0, 1.05, 1.1, 0.8, 1.5, 9.0]), "truncation_bound": np.array([0.0, 0.1, 0.08, 0.4, 0.2, 0.0]),
             "transfer_error": np.array([0, 0, 0.01, 0, 0.05, 0])}
    row = bounds.compared(found, truth, np.array([True] * 5 + [False]))
    assert (row["points"], row["told"]) == (5, 4)
    assert (row["violations"], row["with 3 transfer_error"]) == (2, 1)
    assert row["median ratio"] == pytest.approx((2 + 0.8) / 2)
    assert row["error"] == pytest.approx((0.05 + 0.1 + 0.2 + 0.5) / 5) and row["bound"] == pytest.approx(0.78 / 5)
    sums = bounds.covered({**found, "total_error": np.array([0.1, 0.2, 0.05, 0.3, 0.6, 0])}, truth, np.array([True] * 5 + [False]))
    assert sums["covered"] == 0.8 and sums["rank correlation"] == pytest.approx(0.7)


def test_targets():
    row = {"points": 10, "violations": 0, "with 3 transfer_error": 0, "with 32 times the rays": 0, "told": 10, "median ratio": 2.0}
    rows = [{**row, "transfer": kind} for kind in bounds.KINDS]
    assert all(line["met"] for line in bounds.targets(rows, rows[:1]))
    rows[1]["violations"] = 1
    missed = [line["target"] for line in bounds.targets(rows, []) if not line["met"]]
    assert len(missed) == 1 and "projected, of 10" in missed[0]


def test_points_of_a_bake():
    """Rays meet baked points, each but for a thousandth, and not those inside of bodies."""
    scene = ball_scene()
    transfer = bake_transfer(scene, 1, samples=1, max_edge=0.5)
    points = bounds.baked_points(scene, transfer, SMALL.points)
    assert points.lit.sum() > 30
    pi = scene.ray_intersect_preliminary(points.rays)
    rows, weights, _ = transfer.look_up(bounds.receivers(scene)).rows_at(pi, scene.ray_intersect(points.rays).shape, mi.Bool(False),
                                                                         mi.Bool(points.lit))
    largest = np.array(dr.maximum(dr.maximum(*weights[:2]), weights[2]))
    assert largest[points.lit].min() > 0.998
    few = bounds.some_of(points, np.flatnonzero(points.lit)[:3])
    np.testing.assert_allclose(np.array(few.p).T, np.array(points.p).T[np.flatnonzero(points.lit)[:3]])
