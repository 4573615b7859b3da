"""What numpy makes of the probe's rays is what the bake makes of its own."""
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins"))
from shprt_scenes import block, camera, floor, light, scene  # noqa: E402

from mi_shlight import project_polygon  # noqa: E402
from mi_shlight.planner.probe import Probe  # noqa: E402
from mi_shlight.planner.simulate import interpolated, shade  # noqa: E402
from mi_shlight.scene import aligned  # noqa: E402
from mi_shlight.shading.state import SceneState  # noqa: E402
from mi_shlight.transfer.cosine import cosine_transfer  # noqa: E402
from mi_shlight.transfer.localised import cone_fit, sample_transfer  # noqa: E402
from mi_shlight.transfer.mesh import refine  # noqa: E402
from mi_shlight.transfer.visibility import BakeLights, LightSight, Occluders  # noqa: E402

RAYS, ORDER = 64, 3


@pytest.fixture(scope="module")
def shadow():
    """(probe, rows, sight) of a light behind a block."""
    mi.set_variant("llvm_ad_rgb")
    what = scene(camera(origin=(0.5, 2.4, 3)), floor=floor(), block=block((-0.4, 0.2, -0.3), (0.3, 0.6, 0.4)), light=light())
    probe = Probe(what, what.sensors()[0], 0.0, 0)
    rows = probe.rows([0.6, 0.2])
    return probe, rows, probe.sights(rows, RAYS)[0]


def numbers(rows):
    return [aligned(mi.Float, c) for c in np.asarray(rows).T]


@pytest.mark.parametrize("kind", ["shadowed", "exact"])
def test_values_are_those_of_the_baked_transfer(shadow, kind):
    probe, rows, sight = shadow
    assert 0.1 < np.mean(sight.visible) < 0.9 and len(np.unique(sight.level)) > 3
    p, n = mi.Point3f(*numbers(rows.position)), mi.Normal3f(*numbers(rows.normal))
    lights = probe.state.lights
    group = mi.UInt32(0), mi.UInt32(1)
    dr.make_opaque(group)
    found = sample_transfer(LightSight(Occluders(probe.scene, lights), BakeLights(lights, 0.0), group), p, n, ORDER, RAYS,
                            aligned(mi.Float, sight.shift), kind=kind, fit=cone_fit(ORDER, RAYS), cell=aligned(mi.Float, rows.cell))
    corners = [mi.Point3f(x, 1.5, z) for x, z in ((-0.4, -0.4), (0.4, -0.4), (0.4, 0.4), (-0.4, 0.4))]
    x = mi.Point3f(*numbers(probe.hits.p[rows.owner]))
    coeffs = project_polygon(corners, x, ORDER)
    coeffs = [c * dr.sign(coeffs[0]) for c in coeffs]
    luminance = float(mi.luminance(mi.Color3f(3, 2, 1))[0])
    expected = sum(a * b for a, b in zip(found.coeffs, coeffs)) * luminance
    open_light = sum(a * b for a, b in zip(cosine_transfer(n, ORDER), coeffs)) * luminance
    dr.eval(expected, open_light, found.visibility)
    values = shade(sight)
    got = (values.shadowed if kind == "shadowed" else values.rest)[:, ORDER]
    scale = np.abs(np.array(open_light)).mean()
    assert 1e-2 < scale
    np.testing.assert_allclose(got, np.array(expected), atol=1e-4 * scale)
    np.testing.assert_allclose(values.open[:, ORDER], np.array(open_light), atol=1e-4 * scale)
    np.testing.assert_allclose(values.mean, np.array(found.visibility), atol=1e-5)


def test_rows_are_points_of_the_bake(shadow):
    """Corners of cells lie where `refine` puts points, to the 5 % that those on a rim are drawn in, and interpolate the hit."""
    probe, rows, _ = shadow
    hits = probe.hits
    for cells, edge in enumerate((0.6, 0.2)):
        meshes = [refine(*arrays[:3], edge, arrays[3]) for arrays in map(mesh_of, probe.state.receivers)]
        baked = np.concatenate([mesh.positions for mesh in meshes])
        corner = rows.position[rows.corner[cells]]
        distance = np.sqrt(((corner.reshape(-1, 1, 3) - baked) ** 2).sum(axis=2).min(axis=1))
        assert distance.max() < 0.11 * edge
        middle = (rows.weight[cells][..., None] * corner).sum(axis=1)
        assert np.abs(middle - hits.p).max() < 0.06 * edge and np.abs(rows.weight[cells].sum(axis=1) - 1).max() < 1e-6
    np.testing.assert_allclose(interpolated(rows, 2, rows.position, np.zeros(len(rows.cell), bool)), hits.p, atol=1e-6)


def mesh_of(receiver):
    from mi_shlight.scene import mesh_arrays
    return mesh_arrays(receiver.shape)


def test_truth_is_exact_in_the_light_and_in_the_dark(shadow):
    probe, _, _ = shadow
    truth = probe.truth(False)
    assert set(np.unique(truth.seen == 1)) == {False, True} and (truth.seen == 0).any()
    assert (truth.noise[(truth.seen == 1) | (truth.seen == 0)] == 0).all()
    white = truth.open[0] * truth.seen[0]
    by_path = probe.shaded_by({"type": "direct", "emitter_samples": 16, "bsdf_samples": 0}, 64)
    lit = probe.hits.albedo > 0
    assert np.abs(white * probe.hits.albedo - by_path)[lit].mean() < 0.03 * by_path[lit].mean()


def test_light_from_surfaces_arrives_at_the_points_as_paths_have_it():
    what = scene(camera(origin=(0.5, 2.4, 3)), floor=floor(), wall=block((-2, 0, -1), (2, 2, -0.9)), light=light())
    probe = Probe(what, what.sensors()[0], 0.0, 0)
    rows = probe.rows([0.6, 0.2])
    found = probe.arriving(rows, None)
    at_points = probe.hits.albedo * found[:, -len(probe.hits.p):]
    expected = probe.radiance(-1) - probe.radiance(2)
    assert abs(at_points.mean() / expected.mean() - 1) < 0.1 and abs(at_points.mean() / probe.radiance(2).mean()) > 0.01
    off = interpolated(rows, 1, found.T, np.zeros(len(rows.cell), bool)) - found[:, -len(probe.hits.p):].T
    assert 0 < abs(off).mean() < 0.25 * abs(found[0] - found[1]).mean()           # what rows share in noise is not taken for a difference


def test_only_surfaces_that_are_no_light_are_looked_at(shadow):
    probe, _, _ = shadow
    assert isinstance(probe.state, SceneState) and len(probe.hits.p) == 96
    assert (np.abs(probe.hits.n).max(axis=1) > 0.99).all()          # floor and block, no other normals
