"""The gather between baked points: a linear operator known in full, in rooms whose answer is known."""
import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from mi_shlight import bake_transfer, polygon_irradiance
from mi_shlight.scene import receivers
from mi_shlight.transfer.bounce import BakedPoints, Gather, solve_bounces, trace_bounces

SAMPLES = 64


def baked(scene, max_edge=0.5, samples=SAMPLES):
    transfer = bake_transfer(scene, 1, samples=16, max_edge=max_edge)
    points = BakedPoints(transfer, receivers(scene))
    return transfer, points, trace_bounces(scene, transfer.look_up(receivers(scene)), points, samples)


def rows_of(transfer, name):
    """Rows of the front of a mesh, and of its back if it has one."""
    block = next(b for b in transfer.meshes if b.name == name)
    first = [block.first_row, block.first_row + block.row_count][:1 + block.two_sided]
    return [np.arange(start, start + block.row_count) for start in first]


def floats(values):
    return mi.Float(np.ravel(values).tolist())


def grey(value):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


@pytest.fixture(scope="module")
def room(build):
    """A closed room with a block sunk into its floor; the light is outside."""
    room = build.box([-1, 0, -1], [1, 2, 1], "room", inside=True)
    block = build.box([-0.35, -0.1, -0.35], [0.35, 0.6, 0.35], "block")
    return baked(build.scene(room, block, build.light(build.level(1, 9, up=False))), 0.25)


def in_block(points):
    x, y, z = np.array(points.positions)
    return (abs(x) < 0.35) & (abs(z) < 0.35) & (y > -0.1) & (y < 0.6)


@pytest.fixture(scope="module")
def table():
    """A gather of random hits, and its matrix."""
    rng, count, samples = np.random.default_rng(3), 40, 6
    hits = rng.integers(0, count + 1, (samples, count))
    matrix = np.zeros((count, count + 1))
    np.add.at(matrix, (np.arange(count), hits), 1 / samples)
    return Gather(mi.UInt32(hits.ravel().tolist()), dr.arange(mi.UInt32, count), samples), matrix[:, :count]


def test_positions_and_normals(build):
    """Those of both sides of all meshes, in the order of the bake, whatever the order of the shapes."""
    sheet = build.quad(build.level(1, 0.5), "sheet", bsdf={"type": "twosided", "bsdf": grey(0.5)})
    parts = [build.quad(build.level(2, 0), "floor"), sheet, build.light(build.level(1, 3, up=False))]
    transfer = bake_transfer(build.scene(*parts), 0, samples=4, max_edge=1.0)
    points = BakedPoints(transfer, receivers(build.scene(*parts[::-1])))
    positions, normals = np.array(points.positions).T, np.array(points.normals).T
    for name, heights, ups in (("floor", [0], [1]), ("sheet", [0.5, 0.5], [1, -1])):
        for rows, height, up in zip(rows_of(transfer, name), heights, ups):
            np.testing.assert_allclose(positions[rows, 1], height, atol=1e-6)
            np.testing.assert_allclose(normals[rows], np.tile([0, up, 0], (len(rows), 1)), atol=1e-6)
            assert np.ptp(positions[rows, 0]) > 0.8


def test_closed_room_keeps_all_light(room):
    """Rows whose rays cannot escape sum to one; bounces of constant light then are a geometric series."""
    transfer, points, gather = room
    walls = rows_of(transfer, "room")[0]
    walls = walls[~in_block(points)[walls]]
    sums = np.array(gather.apply(dr.ones(mi.Float, gather.count)))
    assert sums.max() <= 1 + 1e-6
    np.testing.assert_allclose(sums[walls], 1, atol=1e-6)
    ones = dr.ones(mi.Float, gather.count)
    total, last, count, converged = solve_bounces(gather, ones, 0.6 * ones, 1, 4, 0)
    assert count == 4 and converged
    np.testing.assert_allclose(np.array(total)[walls], 0.6 + 0.6 ** 2 + 0.6 ** 3 + 0.6 ** 4, rtol=1e-5)
    np.testing.assert_allclose(np.array(last)[walls], 0.6 ** 4, rtol=1e-5)


def test_points_inside_bodies_are_not_met(room):
    """Neighbours stand in for the floor inside the block and for the block below the floor; no ray ends there."""
    transfer, points, gather = room
    position, shown = np.array(points.positions).T, np.array(gather.stand_in)
    replaced = np.flatnonzero(shown != np.arange(gather.count))
    inside = in_block(points) | (position[:, 1] < -0.01)
    for name in ("room", "block"):
        assert np.isin(replaced, rows_of(transfer, name)[0]).sum() > 4
    assert inside[replaced].all() and not inside[shown[replaced]].any()
    assert np.linalg.norm(position[shown[replaced]] - position[replaced], axis=1).max() < 0.25 * 1.5, "a neighbour"
    assert not np.isin(np.array(gather.table), replaced).any()


def test_form_factors(build):
    """Part of a floor's hemisphere that a ceiling fills, against the closed form."""
    floor, ceiling = build.quad(build.level(2, 0), "floor"), build.quad(build.level(1.2, 0.8, up=False, x=0.3), "ceiling")
    transfer, points, gather = baked(build.scene(floor, ceiling, build.light(build.level(1, 9, up=False))), 0.25, 256)
    on_ceiling = np.zeros(gather.count)
    on_ceiling[rows_of(transfer, "ceiling")[0]] = 1
    rows = rows_of(transfer, "floor")[0]
    found = np.array(gather.apply(floats(on_ceiling)))[rows]
    x = dr.gather(mi.Point3f, dr.ravel(points.positions), mi.UInt32(rows.tolist()))
    outline = [mi.Point3f(*corner.tolist()) for corner in build.level(1.2, 0.8, up=False, x=0.3)]
    truth = np.abs(np.array(polygon_irradiance(outline, x, mi.Normal3f(0, 1, 0)))) / np.pi
    assert np.ptp(truth) > 0.3
    assert np.abs(found - truth).mean() < 0.01, "0.0055 measured; plain random rays have 0.02"
    assert abs((found - truth).mean()) < 0.002


def test_hits_are_interpolated(build):
    """The mean of a linear function over a ceiling comes out with the points' weights, not those of the nearest point."""
    ceiling = build.quad(build.level(2, 0.5, up=False), "ceiling")
    parts = build.quad(build.level(0.4, 0), "floor"), ceiling, build.light(build.level(1, 9, up=False))
    coarse, fine = (baked(build.scene(*parts), edge, 1024) for edge in (2.0, 0.125))
    means = []
    for transfer, points, gather in (coarse, fine):
        x = np.where(np.isin(np.arange(gather.count), rows_of(transfer, "ceiling")[0]), np.array(points.positions)[0], 0)
        rows = rows_of(transfer, "floor")[0]
        corner = rows[np.argmax(np.array(points.positions)[0, rows])]
        means.append(np.array(gather.apply(floats(x)))[corner])
    assert means[1] > 0.05
    np.testing.assert_allclose(means[0], means[1] * 0.95, rtol=0.06)       # corners are pulled inwards by 5 %


def test_sides(build):
    """The back of a one-sided sheet swallows rays; that of a two-sided one returns them to points of its back."""
    for bsdf, reflects in ((grey(0.5), False), ({"type": "twosided", "bsdf": grey(0.5)}, True)):
        floor, sheet = build.quad(build.level(0.5, 0), "floor"), build.quad(build.level(9, 0.1), "sheet", bsdf=bsdf)
        transfer, _, gather = baked(build.scene(floor, sheet, build.light(build.level(1, 9, up=False))), 2.0)
        met = np.array(gather.table).reshape(SAMPLES, -1)[:, rows_of(transfer, "floor")[0]]
        hit = met < gather.count
        assert hit.mean() > 0.9 if reflects else not hit.any()
        assert np.isin(met[hit], rows_of(transfer, "sheet")[-1]).all()


def test_reflectance(build):
    """Front and back of a sheet with two materials, and the two halves of a board with a border through some cells."""
    sheet = build.quad(build.level(2, 1), "sheet", bsdf={"type": "twosided", "front": grey(0.2), "back": grey(0.7)})
    board = mi.load_dict({"type": "rectangle", "id": "board", "bsdf": {"type": "diffuse", "reflectance": {
        "type": "checkerboard", "color0": {"type": "rgb", "value": 0.1}, "color1": {"type": "rgb", "value": [0.6, 0.5, 0.4]},
        "to_uv": mi.ScalarTransform4f().scale([1, 0.5, 1])}}})
    scene = build.scene(sheet, board, build.light(build.level(1, 9, up=False)))
    transfer = bake_transfer(scene, 0, samples=4, max_edge=0.36)
    points = BakedPoints(transfer, receivers(scene))
    value = np.array(points.reflectance(dr.arange(mi.UInt32, points.count), mi.Color0f()))
    for rows, expected in zip(rows_of(transfer, "sheet"), (0.2, 0.7)):
        np.testing.assert_allclose(value[:, rows], expected, rtol=1e-5)
    rows = rows_of(transfer, "board")[0]
    x, red = np.array(points.positions)[0, rows], value[0, rows]
    left, right, border = (red[where] for where in (x < -0.3, x > 0.3, np.abs(x) < 0.05))
    ends = sorted([left.mean(), right.mean()])
    np.testing.assert_allclose(ends, [0.1, 0.6], rtol=1e-4)
    assert np.ptp(left) < 1e-5 and np.ptp(right) < 1e-5
    assert len(border) > 5 and abs(border.mean() - 0.35) < 0.03


@pytest.mark.parametrize("channels", [1, 3, 40])
def test_operator(table, channels):
    """Against the matrix, with its transpose and derivatives; 40 channels take two launches."""
    gather, matrix = table
    rng = np.random.default_rng(channels)
    x, y = rng.normal(size=(2, gather.count, channels))
    field = floats(x)
    dr.enable_grad(field)
    out = gather.apply(field, channels)
    np.testing.assert_allclose(np.array(dr.detach(out)).reshape(x.shape), matrix @ x, atol=1e-5)
    dr.backward(dr.sum(out * floats(y)))
    np.testing.assert_allclose(np.array(dr.grad(field)).reshape(x.shape), matrix.T @ y, atol=1e-5)
    out = gather.apply(field, channels)
    dr.set_grad(field, floats(y))
    dr.forward_to(out)
    np.testing.assert_allclose(np.array(dr.grad(out)).reshape(x.shape), matrix @ y, atol=1e-5)


def test_series(table):
    """Against the dense inverse; what is left out is below the tolerance."""
    gather, matrix = table
    rng = np.random.default_rng(7)
    direct, rho = rng.random((2, gather.count))
    truth = np.linalg.inv(np.eye(gather.count) - matrix * rho) @ direct - direct
    for tolerance in (1e-2, 1e-4):
        total, _, count, converged = solve_bounces(gather, floats(direct), floats(rho), 1, 100, tolerance)
        assert converged and count < 40
        missing = (truth - np.array(total)).sum() / (truth + direct).sum()
        assert 0.05 * tolerance < missing < 1.2 * tolerance, "not too few bounces, nor needless ones"
    total, last, count, converged = solve_bounces(gather, floats(direct), floats(rho), 1, 2, 1e-6)
    assert count == 2 and not converged
    second = matrix @ (rho * (matrix @ (rho * direct)))
    np.testing.assert_allclose(np.array(last), second, rtol=1e-4)
    np.testing.assert_allclose(np.array(total), matrix @ (rho * direct) + second, rtol=1e-4)


def test_series_of_transfer_vectors(table):
    """Bounces of transfer vectors, lit afterwards, are bounces of the light they give: the operator is linear."""
    gather, _ = table
    rng = np.random.default_rng(8)
    transfer, light, rho = rng.normal(size=(gather.count, 9)), rng.normal(size=9), rng.random(gather.count)
    vectors = solve_bounces(gather, floats(transfer), floats(np.repeat(rho, 9)), 9, 5, 0).total
    lit = solve_bounces(gather, floats(transfer @ light), floats(rho), 1, 5, 0).total
    np.testing.assert_allclose(np.array(vectors).reshape(-1, 9) @ light, np.array(lit), atol=1e-5)


def test_series_that_does_not_end(room):
    """A closed white room never loses light."""
    _, _, gather = room
    ones = dr.ones(mi.Float, gather.count)
    assert not solve_bounces(gather, ones, ones, 1, 30, 1e-3).converged


def test_too_many_rays(build):
    scene = build.scene(build.quad(build.level(2, 0), "floor"), build.light(build.level(1, 9, up=False)))
    transfer = bake_transfer(scene, 0, samples=4, max_edge=0.1)
    with pytest.raises(ValueError, match=r"trace_bounces\(\): 'samples' must leave less than 2\^32 rays to store, got 16777216.*max_edge"):
        trace_bounces(scene, None, BakedPoints(transfer, receivers(scene)), 2 ** 24)
