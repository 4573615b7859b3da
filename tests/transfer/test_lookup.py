"""From a ray hit to three baked points: baked positions, put in place of coefficients, must come back as the hit's own position."""
import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from mi_shlight import bake_transfer
from mi_shlight.scene import mesh_arrays, receivers
from mi_shlight.transfer.mesh import RIM, refine

BACK = 100.0
"""Added to the x of back points, to tell them from front points."""


@pytest.fixture(scope="module")
def room(build):
    """Four receivers of different size and kind, one of them two-sided, and an unbaked sphere."""
    rng = np.random.default_rng(5)
    y = rng.uniform(0, 0.3, 4)
    grid = np.array([[x, 0, z] for z in range(4) for x in range(4)], float) * 0.5 + [-3, 0, -1]
    grid[:, 1] = rng.uniform(0, 0.3, 16)
    cells = [(r * 4 + c) for r in range(3) for c in range(3)]
    faces = [t for a in cells for t in ([a, a + 4, a + 5], [a, a + 5, a + 1])]
    sheet = build.level(1.4, 1, x=2.5)
    sheet[:, 1] += y
    shapes = [build.light(build.level(0.5, 4, up=False)),
              build.box([-1, -0.5, -0.5], [0, 0.5, 0.5], "box"),
              build.mesh(grid, faces, normals=np.tile([0, 1, 0], (16, 1)), name="hills"),
              build.quad(sheet, "sheet", bsdf={"type": "twosided", "bsdf": {"type": "diffuse"}}),
              mi.load_dict({"type": "rectangle", "id": "floor", "to_world": mi.ScalarTransform4f().translate([0, -1, 0]).rotate(
                  [1, 0, 0], -90).scale(5)}),
              mi.load_dict({"type": "sphere", "id": "ball", "center": [0, 0, 3], "radius": 0.5})]
    return build.scene(*shapes)


@pytest.fixture(scope="module")
def lookup(room):
    """Tables of a bake of two groups that hold (x, y, z, 1) and twice that in place of coefficients."""
    transfer = bake_transfer(room, 1, samples=16, max_edge=0.6)
    shapes = {shape.id(): shape for shape in room.shapes()}
    rows = []
    for block in transfer.meshes:
        positions = refine(*mesh_arrays(shapes[block.name])[:3], 0.6).positions
        assert len(positions) == block.row_count
        rows.append(positions)
        if block.two_sided:
            rows.append(positions + [BACK, 0, 0])
    rows = np.concatenate(rows)
    assert len(rows) == transfer.coeffs.shape[1]
    rows = np.concatenate([rows, np.ones((len(rows), 1))], axis=1).astype(np.float32)
    transfer.coeffs = np.stack([rows, 2 * rows])
    transfer.visibility = transfer.coeffs[:, :, 2]
    return transfer.look_up(receivers(room))


def test_visibility_is_interpolated_alike(room, lookup):
    """With z in its place: that of the hit, for each group."""
    aim = targets([-1, -0.5, -0.5], [0, 0.5, 0.5], 500, 3)
    ray = mi.Ray3f(mi.Point3f(*(4 * aim).T.copy()), dr.normalize(mi.Vector3f(*(-3 * aim).T.copy())))
    pi = room.ray_intersect_preliminary(ray)
    si = pi.compute_surface_interaction(ray)
    hit = lookup.rows_at(pi, si.shape, mi.Bool(False), si.is_valid())
    for group in (0, 1):
        value, coeffs = lookup.visibility(*hit, mi.UInt32(group)), lookup.coefficients(*hit, mi.UInt32(group), 1)
        dr.eval(value, coeffs)
        np.testing.assert_allclose(np.array(value), np.array(coeffs[2]), atol=1e-5)
        assert np.ptp(np.array(value)) > 0.3


def shoot(room, lookup, origins, directions, back_side, group=0):
    """Hit positions (N, 3), looked-up vectors (N, 4), names of the shapes hit, and where there was a bake."""
    origins, directions = np.broadcast_arrays(np.asarray(origins, float), np.asarray(directions, float))
    ray = mi.Ray3f(mi.Point3f(*origins.T.copy()), dr.normalize(mi.Vector3f(*directions.T.copy())))
    pi = room.ray_intersect_preliminary(ray)
    si = pi.compute_surface_interaction(ray)
    rows, weights, valid = lookup.rows_at(pi, si.shape, mi.Bool(back_side), si.is_valid())
    value = lookup.coefficients(rows, weights, valid, mi.UInt32(group), 1)
    index = dr.reinterpret_array(mi.UInt32, si.shape)
    dr.eval(si.p, value, valid, index, weights)
    assert min(np.array(w).min() for w in weights) >= 0
    names = {dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s))[0]: s.id() for s in room.shapes()}
    return np.array(si.p).T, np.array(value).T, np.array([names.get(i) for i in np.array(index)]), np.array(valid)


def targets(low, high, count, seed):
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def test_positions_come_back(room, lookup):
    """Rays from all sides onto the room: the error is the rim's pull, 5 % of the cell, at most 0.6 long."""
    aim = targets([-3, -1, -1], [3, 1.2, 1], 4000, 0)
    origin = targets([-1, -1, -1], [1, 1, 1], 4000, 1)
    origin = aim + 8 * origin / np.linalg.norm(origin, axis=1, keepdims=True)
    p, value, names, valid = shoot(room, lookup, origin, aim - origin, False)
    assert {"box", "hills", "sheet", "floor"} <= set(names[valid])
    for name in ("box", "hills", "sheet", "floor"):
        assert (names[valid] == name).sum() > 20
    np.testing.assert_allclose(value[valid, 3], 1, atol=1e-6)
    error = np.linalg.norm(value[valid, :3] - p[valid], axis=1)
    assert error.max() <= RIM * 0.6 + 1e-5
    assert np.median(error) < 1e-5, "away from the rim there is no pull"


def test_group(room, lookup):
    _, value, _, valid = shoot(room, lookup, targets([-4, 3, -4], [4, 3, 4], 50, 2), [0, -1, 0], False, group=1)
    assert valid.sum() > 30
    np.testing.assert_allclose(value[valid, 3], 2, atol=1e-6)


def test_corners_and_edges(room, lookup):
    """Hits on the very corners and edges of faces, where rounding leaves the cell."""
    line = np.linspace(-5, 5, 33)
    x, z = np.meshgrid(line, line)
    aim = np.stack([x.ravel(), np.full(x.size, -1.0), z.ravel()], axis=1)
    p, value, names, valid = shoot(room, lookup, aim - [0, 1, 0], [0, 1, 0], False)
    on_floor = names == "floor"
    assert on_floor.sum() > 900
    assert valid[on_floor].all()
    np.testing.assert_allclose(value[on_floor, 3], 1, atol=1e-6)
    assert np.linalg.norm(value[on_floor, :3] - p[on_floor], axis=1).max() <= RIM * 0.6 + 1e-5


def test_back_rows(room, lookup):
    """The two-sided sheet has points of its own on its back; one-sided meshes have front points only."""
    below = targets([2, 0.5, -0.5], [3, 0.5, 0.5], 200, 3)
    p, value, names, valid = shoot(room, lookup, below, [0, 1, 0], True)
    assert (names == "sheet").all() and valid.all()
    assert np.linalg.norm(value[:, :3] - p - [BACK, 0, 0], axis=1).max() <= RIM * 0.6 + 1e-4
    p, value, names, valid = shoot(room, lookup, below - [3, 1.2, 0], [0, 1, 0], True)
    assert (names == "box").all() and valid.all()
    assert np.linalg.norm(value[:, :3] - p, axis=1).max() <= RIM * 0.6 + 1e-5


def test_what_is_not_baked(room, lookup):
    """Lights, shapes that are not meshes, and rays that miss everything have no row."""
    _, value, names, valid = shoot(room, lookup, [[0, 0, 6], [0, 2, 0.1], [0, 9, 30]], [[0, 0, -1], [0, 1, 0], [0, 1, 0]], False)
    assert names.tolist() == ["ball", "light", None]
    assert not valid.any()
    assert (value == 0).all()


def test_misses_with_garbage_coordinates(room, lookup):
    """The ray tracer leaves the barycentric coordinates of a miss undefined. They must not reach the weights: a NaN there would
    come through the mask of the picture into the gradients."""
    pi = room.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(0, 9, 30), mi.Vector3f(0, 1, mi.Float([0, 0.1]))))
    pi.prim_uv = mi.Point2f(mi.Float([dr.nan, 1e30]), mi.Float([-dr.inf, dr.nan]))
    rows, weights, valid = lookup.rows_at(pi, pi.shape, mi.Bool(False), pi.is_valid())
    value = lookup.coefficients(rows, weights, valid, mi.UInt32(0), 1)
    dr.eval(valid, weights, value)
    assert not np.array(valid).any()
    assert np.isfinite(np.array(weights)).all()
    assert (np.array(value) == 0).all()
