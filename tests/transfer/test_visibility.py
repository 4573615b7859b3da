"""What a baked point sees of its lights: exact cases, the clamp to the nearest direction, and truth by brute force."""
import math
import warnings
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
import reference

mi = pytest.importorskip("mitsuba")

from mi_shlight import bake_transfer
from mi_shlight.errors import UnsupportedSceneWarning
from mi_shlight.scene import mesh_arrays, polygon_lights
from mi_shlight.transfer.cosine import cosine_transfer
from mi_shlight.transfer.mesh import refine
from mi_shlight.transfer.localised import cone_fit, sample_transfer
from mi_shlight.transfer.visibility import BakeLights, LightSight, Occluders


def transfer_at(scene, points, normals, order, samples, margin=0.0, localised=False):
    """Coefficients (P, N), visibility (P,) of the scene's only group of lights, at points of our own."""
    lights = polygon_lights(scene)
    bake_lights = BakeLights(lights, margin)
    p, n = (np.asarray(a, float).reshape(-1, 3).T.copy() for a in (points, normals))
    group = mi.UInt32(0), mi.UInt32(len(lights))
    sight = LightSight(Occluders(scene, lights), bake_lights, group)
    fit = cone_fit(order, samples) if localised else None
    t, v, *_ = sample_transfer(sight, mi.Point3f(*p), mi.Normal3f(*n), order, samples, mi.Float(0.5), fit=fit)
    dr.eval(t, v)
    return np.stack([np.array(c) for c in t], axis=1), np.array(v)


def cosine(normal, order):
    return np.array(cosine_transfer(dr.scalar.Array3f64(*normal), order))


def seen_by(transfer, scene, order):
    """Unoccluded coefficients of every baked row: the cosine about its normal."""
    rows = []
    for block in transfer.meshes:
        shape = next(s for s in scene.shapes() if s.id() == block.name)
        normals = refine(*mesh_arrays(shape)[:3], transfer.max_edge).normals
        rows += [normals, -normals][:1 + block.two_sided]
    basis = cosine_transfer(mi.Normal3f(*np.concatenate(rows).T.copy()), order)
    dr.eval(basis)
    return np.stack([np.array(b) + np.zeros(sum(map(len, rows))) for b in basis], axis=1)


@pytest.mark.parametrize("gap, margin", [(0.2, 0.0), (1e-3, 0.0), (0.2, 0.1), (1e-3, 0.1)])
def test_closed_room(build, gap, margin):
    """Every ray hits a wall, and the ceiling is right behind the light: still all is visible, without any error. A light with a
    margin looks beyond its rim, where the ceiling must not count either."""
    room = build.box([-1, -1, -1], [1, 1, 1], "room", inside=True)
    scene = build.scene(room, build.light(build.level(0.6, 1 - gap, up=False)))
    transfer = bake_transfer(scene, 3, samples=64, max_edge=0.5, light_margin=margin, localised=False)
    np.testing.assert_array_equal(transfer.visibility, 1)
    np.testing.assert_allclose(transfer.coeffs[0], seen_by(transfer, scene, 3), atol=2e-6)


def test_two_sided_sheet_in_a_room(build):
    """Front and back of a sheet each see their own side: what is below it is lit from below only."""
    scene = build.scene(build.quad(build.level(1, 0), "sheet", bsdf={"type": "twosided", "bsdf": {"type": "diffuse"}}),
                        build.light(build.level(0.5, 1, up=False), "above"), build.light(build.level(0.5, -1, up=True), "below"))
    transfer = bake_transfer(scene, 2, samples=32, max_edge=0.5, localised=False)
    half = transfer.meshes[0].row_count
    assert transfer.meshes[0].two_sided and transfer.coeffs.shape[1] == 2 * half
    visible = np.array([[1, 0], [0, 1]]).repeat(half, axis=1)
    np.testing.assert_array_equal(transfer.visibility, visible)
    np.testing.assert_allclose(transfer.coeffs, seen_by(transfer, scene, 2) * visible[..., None], atol=2e-6)


def test_a_light_blocks_other_lights_but_not_itself(build):
    """A large light in front of a small one hides it, as in a path tracer; its own shape never hides a light."""
    scene = build.scene(build.quad(build.level(1, 0), "floor"), build.light(build.level(2, 0.5, up=False), "near"),
                        build.light(build.level(0.3, 1, up=False), "far"))
    transfer = bake_transfer(scene, 2, samples=32, max_edge=0.5, localised=False)
    np.testing.assert_array_equal(transfer.visibility[0], 1)
    np.testing.assert_array_equal(transfer.visibility[1], 0)


@pytest.mark.parametrize("height", [0.01, 0.5, 0.99])
def test_covered_light_is_exactly_dark(build, height):
    """A plate that covers all of the light, wherever between, leaves exact zeros. The points keep clear of the plate's edge."""
    side = 0.5 + 1.7 * (1 - height)
    scene = build.scene(build.quad(build.level(0.5, 0), "floor"), build.quad(build.level(side + 0.2, height, up=True), "plate"),
                        build.light(build.level(0.5, 1, up=False)))
    transfer = bake_transfer(scene, 4, samples=64, max_edge=0.3)
    rows = transfer.meshes[0].row_count
    assert transfer.meshes[0].name == "floor" and rows > 4
    np.testing.assert_array_equal(transfer.coeffs[0, :rows], 0)
    np.testing.assert_array_equal(transfer.visibility[0, :rows], 0)


@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_light_covered_as_seen_from_the_side(build, margin):
    """A plate near the light hides it from a distant point: also for directions that pass the light's plane sooner than they
    would reach the light, and so do not meet the plate."""
    scene = build.scene(build.quad(build.level(2, 0.9), "plate"), build.light(build.level(0.4, 1, up=False)))
    coeffs, visible = transfer_at(scene, [[4, 0, 0], [0, 0, -4]], [[0, 1, 0], [0, 1, 0]], 4, 256, margin)
    np.testing.assert_array_equal(visible, 0)
    np.testing.assert_array_equal(coeffs, 0)


@pytest.mark.parametrize("plate, visible", [(None, 1), (0.6, 0), (1.35, 1)], ids=["nothing", "below", "above"])
def test_closed_mesh_light(build, plate, visible):
    """A box that shines stands in nobody's way itself, and a plate counts only before the faces that are seen."""
    shapes = [build.box([-0.2, 0.9, -0.2], [0.2, 1.3, 0.2], "lamp", emitter={"type": "area"})]
    if plate:
        shapes.append(build.quad(build.level(6 if plate < 1 else 0.3, plate), "plate"))
    points = [[0, 0, 0], [0.7, 0, 0.5], [0.15, 0.1, 0]]
    coeffs, seen = transfer_at(build.scene(*shapes), points, [[0, 1, 0]] * 3, 3, 64)
    np.testing.assert_array_equal(seen, visible)
    np.testing.assert_allclose(coeffs, visible * np.tile(cosine([0, 1, 0], 3), (3, 1)), atol=2e-6)


def test_what_is_behind_the_light_does_not_matter(build):
    """A plate just above the light blocks nothing; just below, everything."""
    point, up = [[0.1, 0, 0.2]], [[0, 1, 0]]
    light = build.level(0.4, 1, up=False)
    plate = lambda y: build.quad(build.level(3, y), "plate")
    assert transfer_at(build.scene(plate(1.01), build.light(light)), point, up, 2, 64)[1] == 1
    assert transfer_at(build.scene(plate(0.99), build.light(light)), point, up, 2, 64)[1] == 0


def test_light_cut_by_the_horizon(build):
    """A wall at x = 0 sees the light's half at x > 0 only: what stands before the other half is no matter."""
    light = build.level(1.0, 1, up=False)
    left = build.box([-0.6, 0.7, -0.6], [-0.02, 0.75, 0.6], "left")
    right = build.box([0.005, 0.7, -0.6], [0.6, 0.75, 0.6], "right")
    point, normal = [[0, 0, 0]], [[1, 0, 0]]
    coeffs, visible = transfer_at(build.scene(left, build.light(light)), point, normal, 4, 256)
    assert visible == 1
    np.testing.assert_allclose(coeffs[0], cosine([1, 0, 0], 4), atol=2e-6)
    coeffs, visible = transfer_at(build.scene(right, build.light(light)), point, normal, 4, 256)
    assert visible < 0.02, "what is left is the sliver between wall and blocker"


def test_light_below_the_horizon(build):
    """Points that face away from all lights get zeros, with and without anything in the way."""
    ceiling = build.quad(build.level(1, 2, up=True), "ceiling")
    transfer = bake_transfer(build.scene(ceiling, build.light(build.level(1, 1, up=False))), 3, samples=32, max_edge=0.5)
    np.testing.assert_array_equal(transfer.coeffs, 0)
    coeffs, visible = transfer_at(build.scene(build.light(build.level(1, 1, up=False))), [[0, 2, 0]], [[0, 1, 0]], 3, 32)
    assert (coeffs == 0).all() and visible == 0


def half_covered(build, height):
    """A light at y = 1 and a plate below it over x > 0; points on the floor from full light through penumbra to darkness."""
    plate = np.array([[0, height, 2], [4, height, 2], [4, height, -2], [0, height, -2]], float)
    scene = build.scene(build.quad(plate, "plate"), build.light(build.level(0.8, 1, up=False)))
    points = np.stack([np.linspace(-0.9, 0.9, 19), np.zeros(19), np.full(19, 0.1)], axis=1)
    return scene, points


def radiance_by_area(points, height, n=400):
    """Truth: ``int V cos / pi dw`` of the light seen past the plate, by midpoints over the light's area."""
    u = (np.arange(n) + 0.5) / n * 0.8 - 0.4
    q = np.stack([g.ravel() for g in np.meshgrid(u, [1.0], u, indexing="ij")], axis=1)
    truth = []
    for p in points:
        d = q - p
        r = np.linalg.norm(d, axis=1)
        at_plate = p[0] + d[:, 0] * height
        truth.append(((d[:, 1] / r) ** 2 / r ** 2 / np.pi * (at_plate < 0)).sum() * 0.64 / n ** 2)
    return np.array(truth)


@pytest.mark.parametrize("height, order, bound", [(0.3, 8, 0.03), (0.7, 8, 0.045), (0.7, 4, 0.14)])
def test_penumbra(build, height, order, bound):
    """Transfer times light, through the penumbra of a straight edge. The error is the band limit of the shadow's edge, so it falls with
    the order; as a part of the full light's radiance it is bounded by what was measured, times 1.5."""
    scene, points = half_covered(build, height)
    coeffs, _ = transfer_at(scene, points, np.tile([0, 1, 0], (len(points), 1)), order, 8192)
    # corners counter-clockwise as seen from outside the sphere about the point, that is from above
    light = build.level(0.8, 1, up=True).astype(float)
    shaded = np.array([c @ reference.coefficients_quadrature(light, p, order, 16) for c, p in zip(coeffs, points)])
    truth = radiance_by_area(points, height)
    assert truth.min() < 0.01 * truth.max()
    assert ((truth > 0.1 * truth.max()) & (truth < 0.9 * truth.max())).sum() >= 3
    assert np.abs(shaded - truth).max() / truth.max() < bound


OUTLINES = {
    "triangle": [[(-1, -0.5), (0.8, -0.7), (0.1, 0.9)]],
    "concave": [[(-1, -1), (1, -1), (1, 1), (0.6, 1), (0.6, -0.4), (-1, -0.4)]],
    "with a hole": [[(-1, -1), (1, -1), (1, 1), (-1, 1)], [(-0.5, -0.5), (-0.5, 0.6), (0.4, 0.6), (0.4, -0.5)]],
}


def in_plane(points):
    """Plane coordinates (N, 2) as points of the light's tilted plane."""
    points = np.asarray(points, float)
    return np.array([0.1, 1.2, -0.2]) + points[..., :1] * [0.8, 0.6, 0] + points[..., 1:] * [0, 0, 1]


NORMAL = np.cross([0.8, 0.6, 0], [0, 0, 1])


def edges_of(loops):
    return np.concatenate([np.stack([in_plane(loop), np.roll(in_plane(loop), -1, axis=0)], axis=1) for loop in loops])


def inside(loops, points):
    """Even-odd rule for plane coordinates (N, 2)."""
    hits = np.zeros(len(points), int)
    for loop in loops:
        for (ax, ay), (bx, by) in zip(loop, loop[1:] + loop[:1]):
            straddles = (ay > points[:, 1]) != (by > points[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                hits += straddles & (points[:, 0] < ax + (points[:, 1] - ay) * (bx - ax) / (by - ay))
    return hits % 2 == 1


def dense(loops, n=161, m=4000):
    """Points all over the light: a grid inside, and its boundary."""
    u = np.linspace(-1, 1, n)
    grid = np.stack([g.ravel() for g in np.meshgrid(u, u)], axis=1)
    edges = edges_of(loops)
    t = (np.arange(m) / m)[:, None, None]
    return np.concatenate([in_plane(grid[inside(loops, grid)]), (edges[:, 0] + t * (edges[:, 1] - edges[:, 0])).reshape(-1, 3)])


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def nearest_of(lights, x, n, d, met=dr.inf, group=(0, 1)):
    """`BakeLights.nearest` as arrays, for points (3,) or (D, 3), directions (D, 3) and a direction already known."""
    wide = lambda kind, v: kind(*np.broadcast_to(v, d.shape).T.copy())
    group = mi.UInt32(group[0]), mi.UInt32(group[1])
    answer = lights.nearest(group, wide(mi.Point3f, x), wide(mi.Normal3f, n), wide(mi.Vector3f, d), wide(mi.Vector3f, met))
    dr.eval(answer)
    q, distance, farthest, found, met = answer
    return np.array(q).T, np.array(distance), np.array(farthest), np.array(found) & np.ones(len(d), bool), np.array(met).T


def nearest(loops, x, n, d, margin=0.0):
    return nearest_of(BakeLights([SimpleNamespace(polygons=[(edges_of(loops), NORMAL)])], margin), x, n, d)[:4]


def directions(n, count, seed):
    d = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    return d * np.sign(d @ n)[:, None]


@pytest.mark.parametrize("x, n", [((0, 0, 0), (0, 1, 0)), ((0.5, 0.3, 0.4), (-0.6, 0.8, 0)), ((0.2, 0.9, -0.2), (0.9805807, 0.1961161, 0))],
                         ids=["above", "tilted", "cut by the horizon"])
@pytest.mark.parametrize("name", OUTLINES)
def test_nearest_direction(name, x, n):
    """The direction of the light's nearest point on the sphere, by brute force over its area and outline, above the horizon."""
    loops, x, n = OUTLINES[name], np.array(x, float), np.array(n, float)
    d = directions(n, 300, 7)
    q, distance, farthest, found = nearest(loops, x, n, d)
    assert found.all()
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-5)
    points = dense(loops)
    above = (points - x) @ n > 1e-4
    assert above.any()
    truth = unit(points[above] - x)
    angle = lambda a, b: 2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1))
    best = np.array([angle(truth, one).min() for one in d])
    own = angle(q, d)
    # the grid is coarse inside, but what lies inside the light must stay itself; the outline is fine
    plane = NORMAL @ (in_plane([0, 0]) - x) / (d @ NORMAL)
    hit = x + plane[:, None] * d - in_plane([0, 0])
    within = inside(loops, np.stack([hit @ [0.8, 0.6, 0], hit @ [0, 0, 1]], axis=1)) & (plane > 0)
    assert within.any() and not within.all()
    np.testing.assert_allclose(q[within], d[within], atol=1e-6)
    np.testing.assert_allclose(distance[within], plane[within], rtol=1e-4)
    np.testing.assert_allclose(farthest[within], plane[within], rtol=1e-4)
    np.testing.assert_allclose(own[~within], best[~within], atol=3e-3)
    # and the light is where it says
    reached = x + distance[~within, None] * q[~within]
    assert np.abs((reached - in_plane([0, 0])) @ NORMAL).max() < 1e-4
    assert (q @ n > -1e-5).all()


def test_nearest_direction_of_nothing():
    """A light below the horizon leaves no direction."""
    d = directions(np.array([0, 1.0, 0]), 20, 3)
    assert not nearest(OUTLINES["triangle"], np.array([0, 5.0, 0]), np.array([0, 1.0, 0]), d)[3].any()


def test_margin():
    """Directions within the margin of the light stay themselves; farther ones come to its rim, and never past the direction itself."""
    loops, x, n, margin = OUTLINES["concave"], np.zeros(3), np.array([0, 1.0, 0]), 0.2
    d = directions(n, 2000, 11)
    bare, distance, _, _ = nearest(loops, x, n, d)
    grown, _, _, _ = nearest(loops, x, n, d, margin)
    apart = np.arccos(np.clip((bare * d).sum(axis=1), -1, 1))
    reach = np.arctan2(margin, distance)
    within = apart < reach - 1e-3
    outside = apart > reach + 1e-3
    assert ((apart > 0.01) & within).sum() > 20 and outside.sum() > 20
    np.testing.assert_allclose(grown[within], d[within], atol=2e-4)
    moved = np.arccos(np.clip((bare * grown).sum(axis=1), -1, 1))
    np.testing.assert_allclose(moved[outside], reach[outside], atol=2e-3)
    still = np.arccos(np.clip((grown * d).sum(axis=1), -1, 1))
    np.testing.assert_allclose(still[outside], (apart - moved)[outside], atol=2e-3)


def cloud(count, seed):
    """Triangles (count, 3, 3) of all sizes about a point at the origin, some below its horizon."""
    rng = np.random.default_rng(seed)
    size = 5 / np.sqrt(count) * 10 ** rng.uniform(-1, 0, (count, 1, 1))
    return rng.uniform([-2, -0.3, -2], [2, 2, 2], (count, 1, 3)) + rng.normal(size=(count, 3, 3)) * size


def triangle_lights(triangles):
    outlines = [np.stack([t, np.roll(t, -1, axis=0)], axis=1) for t in triangles]
    return [SimpleNamespace(polygons=[(o, unit(np.cross(t[1] - t[0], t[2] - t[0])))]) for o, t in zip(outlines, triangles)]


def nearest_by_force(triangles, n, d, m=100):
    """(angle from the origin's directions `d` to the nearest one of all triangles above the horizon, distances (D, T) of direct hits)."""
    t = np.arange(m)[:, None, None, None] / m
    rim = (triangles + t * (np.roll(triangles, -1, axis=1) - triangles)).reshape(-1, 3)
    angle = 2 * np.arcsin(np.sqrt(np.maximum(2 - 2 * (d @ unit(rim[rim @ n > 0]).T).max(axis=1), 0)) / 2)
    a, b, c = np.moveaxis(triangles, 1, 0)
    volume = lambda u, v: d @ np.cross(u, v).T          # sides of the direction: all of one sign inside the triangle
    sides = np.stack([volume(a, b), volume(b, c), volume(c, a)])
    whole = np.einsum("tc,tc->t", a, np.cross(b, c))
    total = sides.sum(axis=0)
    hit = (np.abs(np.sign(sides).sum(axis=0)) == 3) & (total * whole > 0)
    return np.where(hit.any(axis=1), 0, angle), np.where(hit, whole / np.where(total == 0, 1, total), np.inf)


@pytest.mark.parametrize("count", [12, 200])
def test_nearest_of_many_lights(count):
    """The nearest direction, its distance and the farthest light on it, against a look at all triangles. Lights that have moved, and a
    direction met before, change nothing."""
    n, before, triangles = unit(np.array([0.2, 1, -0.1])), cloud(count, 3), cloud(count, 5)
    d = directions(n, 200, 9)
    angle, hits = nearest_by_force(triangles, n, d)
    first, farthest = hits.min(axis=1), np.where(np.isfinite(hits), hits, 0).max(axis=1)
    assert (angle == 0).sum() > 5 and (angle > 0.02).sum() > 10 and (count < 100 or (farthest > first).any())
    lights, moved = BakeLights(triangle_lights(triangles), 0.0), BakeLights(triangle_lights(before), 0.0)
    answers = [nearest_of(lights, np.zeros(3), n, d), nearest_of(moved.at(lights.edges, lights.normal), np.zeros(3), n, d)]
    answers.append(nearest_of(lights, np.zeros(3), n, d, met=answers[0][4][::-1]))
    for q, distance, far, found, _ in answers:
        assert found.all()
        own = 2 * np.arcsin(np.linalg.norm(q - d, axis=1) / 2)
        np.testing.assert_allclose(own, angle, atol=5e-3)
        direct = (angle == 0) & (own < 1e-6)             # but for a rim, where rounding decides
        assert direct.sum() >= (angle == 0).sum() - 1
        np.testing.assert_allclose(distance[direct], first[direct], rtol=1e-4)
        np.testing.assert_allclose(far[direct], farthest[direct], rtol=1e-4)
        assert (q @ n > -1e-5).all()


def test_lights_of_many_polygons():
    """Each group has its own, whatever their numbers."""
    n = np.array([0, 1.0, 0])
    d = directions(n, 50, 13)
    small, large = cloud(3, 1), cloud(40, 2)
    lights = [SimpleNamespace(polygons=[light.polygons[0] for light in triangle_lights(t)]) for t in (small, large, small[:1])]
    together = BakeLights(lights, 0.1)
    for k, light in enumerate(lights):
        alone = nearest_of(BakeLights([light], 0.1), np.zeros(3), n, d)
        for a, b in zip(nearest_of(together, np.zeros(3), n, d, group=(k, k + 1)), alone):
            np.testing.assert_array_equal(a, b)


def five_lights(build, blocker):
    """Two lights above each other with room for a blocker between, and three to the side."""
    lights = [build.light(build.level(0.4, 1, up=False), "near"), build.light(build.level(0.4, 3, up=False), "far")]
    lights += [build.light(build.level(0.2, 1, up=False, x=x, z=-1), f"side_{x}") for x in (-1, 1, 2)]
    return [build.quad(build.level(1, 0), "floor"), *([build.quad(build.level(1.2, 2), "blocker")] if blocker else []), *lights]


def test_conflict_of_lights_behind_each_other(build):
    """More than four lights share one visibility. If one is hidden where another is not, the bake says so."""
    with pytest.warns(UnsupportedSceneWarning, match="behind each other"):
        transfer = bake_transfer(build.scene(*five_lights(build, True)), 1, samples=256, max_edge=0.5)
    assert transfer.groups.tolist() == [0, 5]
    far_light = 0.4 ** 2 / 3 ** 2 / math.pi            # its part of the hemisphere: one or two of the 256 rays
    assert 0.3 * far_light < transfer.conflict < 3 * far_light


@pytest.mark.parametrize("lights, blocker", [(5, False), (4, True)])
def test_no_conflict(build, lights, blocker):
    """Without a blocker, and with a visibility for each light, there is none."""
    shapes = five_lights(build, blocker)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        transfer = bake_transfer(build.scene(*shapes[:len(shapes) - 5 + lights]), 1, samples=256, max_edge=0.5)
    assert transfer.conflict == 0
    assert len(transfer.groups) == (2 if lights == 5 else 5)


def test_groups_have_their_own_visibility(build):
    transfer = bake_transfer(build.scene(*five_lights(build, True)[:4]), 1, samples=64, max_edge=0.5)
    rows = transfer.meshes[0].row_count
    np.testing.assert_array_equal(transfer.visibility[0, :rows], 1)
    assert transfer.visibility[1, :rows].max() < 1


def test_points_inside_a_body(build):
    """A box that stands on, and a bit in, the floor leaves no dark rim of interpolation around it."""
    scene = build.scene(build.quad(build.level(2, 0), "floor"), build.box([-0.4, -0.2, -0.4], [0.4, 0.01, 0.4], "box"),
                        build.light(build.level(0.5, 4, up=False)))
    transfer = bake_transfer(scene, 2, samples=64, max_edge=0.36, localised=False)
    floor = transfer.meshes[0]
    positions = refine(*mesh_arrays(next(s for s in scene.shapes() if s.id() == "floor"))[:3], 0.36).positions
    reach = np.abs(positions[:, [0, 2]]).max(axis=1)
    under, open_ = reach < 0.39, reach > 0.42
    next_to_open = under & (reach > 0.2)
    assert under.sum() > 4 and next_to_open.any() and (under & ~next_to_open).any()
    visible, coeffs = transfer.visibility[0, :floor.row_count], transfer.coeffs[0, :floor.row_count]
    np.testing.assert_array_equal(visible[open_ | next_to_open], 1)
    np.testing.assert_array_equal(visible[under & ~next_to_open], 0)
    np.testing.assert_allclose(coeffs[next_to_open], coeffs[open_][:1].repeat(next_to_open.sum(), axis=0), atol=1e-5)
    assert (coeffs[under & ~next_to_open] == 0).all()


def test_shadow_is_not_taken_for_the_inside_of_a_body(build):
    """Under a plate, all is dark too, but one can look there: nothing is brightened."""
    scene = build.scene(build.quad(build.level(2, 0), "floor"), build.box([-0.5, 0.1, -0.5], [0.5, 0.12, 0.5], "plate"),
                        build.light(build.level(0.2, 4, up=False)))
    transfer = bake_transfer(scene, 2, samples=64, max_edge=0.36, localised=False)
    dark = transfer.visibility[0] == 0
    assert dark.sum() > 10
    assert (transfer.coeffs[0, dark] == 0).all()
