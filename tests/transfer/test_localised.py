"""Transfer fitted to the lights' cone: the fit itself, the cone, exact cases, penumbrae; `exact`, `visibility` and the sky."""
import math

import drjit as dr
import numpy as np
import pytest
import reference

mi = pytest.importorskip("mitsuba")

from mi_shlight import bake_transfer, polygon_irradiance
from mi_shlight.scene import aligned, polygon_lights
from mi_shlight.sh.lobes import sh_matrix
from mi_shlight.transfer.cosine import cosine_bands
from mi_shlight.transfer.localised import LARGEST, LEVELS, MAX_FIT_ORDER, SMALLEST, ConeFit, cone_fit, sample_transfer
from mi_shlight.transfer.visibility import BakeLights, Cone, LightSight, Occluders, SkySight

UP = np.array([0, 1.0, 0])


def trace(scene, points, normals, order, samples=256, margin=0.0, cell=0.0, offset=0.5, localised=True, kind="shadowed", sky=False):
    """``Sampled`` as arrays, of the scene's only group of lights or of the sky, at points (P, 3)."""
    points = np.asarray(points, float).reshape(-1, 3)
    normals = np.broadcast_to(np.asarray(normals, float), points.shape)
    p, n = mi.Point3f(*points.T.copy()), mi.Normal3f(*normals.T.copy())
    fit = cone_fit(order, samples) if localised and not sky else None
    if sky:
        sight = SkySight(scene)
    else:
        lights = polygon_lights(scene)
        sight = LightSight(Occluders(scene, lights), BakeLights(lights, margin), (mi.UInt32(0), mi.UInt32(len(lights))))
    found = sample_transfer(sight, p, n, order, samples, aligned(mi.Float, np.full(len(points), offset)), kind=kind,
                            fit=fit, cell=dr.opaque(mi.Float, cell))
    dr.eval(*found)
    coeffs = np.stack([np.array(c) + np.zeros(len(points)) for c in found.coeffs], axis=1)
    return coeffs, np.array(found.visibility), np.array(found.variance)


def shade(coeffs, light, points):
    """Transfer times light; `light`: corners, counter-clockwise as seen from outside the sphere about a point."""
    order = math.isqrt(coeffs.shape[1]) - 1
    return np.array([c @ reference.coefficients_quadrature(light, p, order, 16) for c, p in zip(coeffs, points)])


def lambert(light, points, normal):
    """Unshadowed radiance of a white surface."""
    kind = dr.llvm.ad.Array3f64
    vertices = [kind(*map(float, v)) for v in light]
    return np.array(polygon_irradiance(vertices, kind(*np.asarray(points, float).T.copy()), kind(*map(float, normal)))) / math.pi


def covered(build, height=0.7):
    """A light at y = 1, half hidden by a plate over x > 0, and points on the floor from full light into darkness."""
    plate = np.array([[0, height, 2], [4, height, 2], [4, height, -2], [0, height, -2]], float)
    points = np.stack([np.linspace(-0.9, 0.9, 19), np.zeros(19), np.full(19, 0.1)], axis=1)
    return build.scene(build.quad(plate, "plate"), build.light(build.level(0.8, 1, up=False))), points


def seen_part(points, height=0.7, side=0.8, n=400, power=2, x=0.0):
    """``int V cos^(power - 1) dw / pi`` of that light, shifted by x, by midpoints over its area."""
    u = (np.arange(n) + 0.5) / n * side - side / 2
    q = np.stack([g.ravel() for g in np.meshgrid(u + x, [1.0], u, indexing="ij")], axis=1)
    total = []
    for p in points:
        d = q - p
        r = np.linalg.norm(d, axis=1)
        total.append(((d[:, 1] / r) ** power / r ** 2 / np.pi * (p[0] + d[:, 0] * height < 0)).sum() * (side / n) ** 2)
    return np.array(total)


LIGHT = [[-0.4, 1, 0.4], [0.4, 1, 0.4], [0.4, 1, -0.4], [-0.4, 1, -0.4]]


def brute_force(angle, values, order, eps, n=300):
    """Weighted least squares on directions all over the sphere, 1 inside of the cone about z and eps outside; `values` (z, phi)."""
    node, weight = np.polynomial.legendre.leggauss(n)
    z = np.concatenate([1 + (node - 1) * math.sin(angle / 2) ** 2, math.cos(angle / 2) ** 2 * (node + 1) - 1])
    w = np.concatenate([weight * math.sin(angle / 2) ** 2, eps * weight * math.cos(angle / 2) ** 2])
    phi = 2 * np.pi * np.arange(4 * order + 4) / (4 * order + 4)
    zz, pp = (a.ravel() for a in np.meshgrid(z, phi, indexing="ij"))
    rho = np.sqrt(1 - zz * zz)
    root = np.sqrt(np.repeat(w, len(phi)))
    basis = sh_matrix(np.stack([rho * np.cos(pp), rho * np.sin(pp), zz], axis=1), order)
    target = np.where(zz > math.cos(angle), values(zz, pp), 0)
    moments = 2 * np.pi / len(phi) * (basis * (root ** 2 * np.where(zz > math.cos(angle), 1, 0) * target)[:, None]).sum(axis=0)
    return np.linalg.lstsq(basis * root[:, None], root * target, rcond=None)[0], moments


@pytest.mark.parametrize("order", [1, 4])
@pytest.mark.parametrize("degrees", [3.0, 20.0, 70.0])
def test_fit_against_least_squares(order, degrees):
    """The tables solve (1) as a dense least squares problem does, which knows neither blocks nor Gram matrices."""
    fit = ConeFit(order, 1e-6)
    level = fit.level(mi.Float(math.radians(degrees)))
    angle = math.acos(1 - float(np.array(dr.gather(mi.Float, fit.spread, level))[0]))
    assert math.radians(degrees) <= angle * (1 + 1e-6) <= 1.07 * math.radians(degrees)
    wild = lambda z, phi: np.cos(9 * z / (1 - math.cos(angle))) + np.sin(phi) * z + np.cos(2 * phi)
    truth, moments = brute_force(angle, wild, order, 1e-6)
    found = np.array([np.array(c)[0] for c in fit.solve(level, [mi.Float(float(m)) for m in moments])])
    basis = sh_matrix(np.array([[math.sin(t) * math.cos(f), math.sin(t) * math.sin(f), math.cos(t)]
                                for t in np.linspace(0, angle, 9) for f in np.linspace(0, 6, 7)]), order)
    assert np.abs(basis @ truth).max() > 0.5
    np.testing.assert_allclose(basis @ found, basis @ truth, atol=3e-3)


def test_levels_of_the_half_angle():
    fit = ConeFit(1, 1e-6)
    angle = np.array([0, 1e-9, SMALLEST, 0.3, 1.0, LARGEST * 0.999, LARGEST * 1.001, 3.0, np.pi])
    level = np.array(fit.level(mi.Float(angle)))
    spread = np.array(dr.gather(mi.Float, fit.spread, fit.level(mi.Float(angle))))
    assert level[:2].tolist() == [0, 0] and level[6:].tolist() == [LEVELS] * 3
    assert (np.diff(level.astype(int)) >= 0).all()
    assert (np.arccos(1 - spread[2:6]) >= angle[2:6] * (1 - 1e-4)).all()
    np.testing.assert_array_equal(spread[6:], 1)


@pytest.mark.parametrize("order, there", [(0, False), (1, True), (MAX_FIT_ORDER, True), (MAX_FIT_ORDER + 1, False)])
def test_orders_that_are_fitted(order, there):
    assert (cone_fit(order, 16) is not None) == there


def test_cone_holds_the_lights(build):
    """All corners, grown by margin and cell, lie in it, and it is not much wider than the best one."""
    lights = polygon_lights(build.scene(build.light(build.level(0.5, 1, up=False), "a"),
                                        build.light(build.level(0.3, 0.8, up=False, x=0.6, z=0.3), "b")))
    rng = np.random.default_rng(3)
    x = rng.uniform([-2, -1, -2], [2, 0.5, 2], (60, 3))
    p, n = mi.Point3f(*x.T.copy()), mi.Normal3f(0, 1, 0)
    cone = BakeLights(lights[:1], 0.05).cone((mi.UInt32(0), mi.UInt32(1)), p, n, mi.Float(0.1))
    axis, angle = np.array(cone.axis).T, np.array(cone.angle)
    corners = np.array(LIGHT)[None] * [0.625, 1, 0.625] - x[:, None]
    distance = np.linalg.norm(corners, axis=2)
    omega = corners / distance[..., None]
    need = np.arccos(np.clip((omega * axis[:, None]).sum(axis=2), -1, 1)) + np.arcsin(0.15 / distance)
    np.testing.assert_allclose(need.max(axis=1), angle, atol=1e-4)
    diagonal = np.maximum(*(np.arccos((omega[:, i] * omega[:, i + 2]).sum(axis=1)) for i in (0, 1))) / 2
    assert (angle < 1.12 * diagonal + np.arcsin(0.15 / distance.min(axis=1))).all()
    assert not np.array(cone.dips).any()


def test_cone_around_everything():
    """Where no cone is narrower than a half-space, it says so."""
    edges = np.array([[[s, t, u] for s in (-1, 1) for t in (-1, 1) for u in (-1, 1)]] * 2, float).transpose(1, 0, 2)
    light = type("Light", (), {"polygons": [(edges, UP)]})
    cone = BakeLights([light], 0.0).cone((mi.UInt32(0), mi.UInt32(1)), mi.Point3f(0, 0.1, 0), mi.Normal3f(0, 1, 0), mi.Float(0))
    assert np.array(cone.angle)[0] >= np.pi / 2 and np.array(cone.dips)[0]
    cone = BakeLights([light], 0.0).cone((mi.UInt32(0), mi.UInt32(1)), mi.Point3f(0, 0, 0), mi.Normal3f(0, 1, 0), mi.Float(0))
    assert np.array(cone.angle)[0] >= np.pi / 2


@pytest.mark.parametrize("order", [1, 4])
@pytest.mark.parametrize("margin", [0.0, 0.2])
def test_full_light_is_exact(build, order, margin):
    """Lambert's formula at every order from 1 on: the fit holds the cosine on the light, wherever it is above the horizon."""
    points = np.array([[0, 0, 0], [0.7, 0, -0.5], [3, 0, 1], [0.3, 0.6, 0.2]])
    coeffs, visible, variance = trace(build.scene(build.light(build.level(0.8, 1, up=False))), points, UP, order, 64, margin)
    np.testing.assert_array_equal(visible, 1)
    np.testing.assert_array_equal(variance, 0)
    np.testing.assert_allclose(shade(coeffs, LIGHT, points), lambert(LIGHT, points, UP), rtol=2e-5)


@pytest.mark.parametrize("kind", ["shadowed", "exact"])
@pytest.mark.parametrize("localised", [False, True])
def test_darkness_is_exact(build, kind, localised):
    scene = build.scene(build.quad(build.level(3, 0.5), "plate"), build.light(build.level(0.8, 1, up=False)))
    coeffs, visible, _ = trace(scene, [[0, 0, 0], [0.2, 0, 0.3]], UP, 4, localised=localised, kind=kind)
    assert (coeffs == 0).all() and (visible == 0).all()


def test_exact_transfer_of_full_light_is_nothing(build):
    scene = build.scene(build.light(build.level(0.8, 1, up=False)))
    for localised in (False, True):
        coeffs, visible, _ = trace(scene, [[0, 0, 0], [0.7, 0, -0.5]], UP, 4, localised=localised, kind="exact")
        assert (coeffs == 0).all() and (visible == 1).all()


@pytest.mark.parametrize("order, bound", [(1, 0.065), (4, 0.027), (8, 0.018)])
def test_penumbra(build, order, bound):
    """Bounds: what was measured, times 1.5. Projected over the sphere, order 8 is off by 0.03 and order 4 by 0.09."""
    scene, points = covered(build)
    coeffs, *_ = trace(scene, points, UP, order)
    truth = seen_part(points)
    assert ((truth > 0.1 * truth.max()) & (truth < 0.9 * truth.max())).sum() >= 3
    assert np.abs(shade(coeffs, LIGHT, points) - truth).max() < bound * truth.max()


@pytest.mark.parametrize("localised, bound", [(False, 0.15), (True, 0.03)])
def test_penumbra_of_exact_transfer(build, localised, bound):
    scene, points = covered(build)
    coeffs, visible, _ = trace(scene, points, UP, 4, localised=localised, kind="exact")
    truth = seen_part(points)
    total = visible * lambert(LIGHT, points, UP) + shade(coeffs, LIGHT, points)
    assert np.abs(total - truth).max() < bound * truth.max()


def test_blocked_part_of_the_light(build):
    """`visibility`: 1 - V times the light is the solid angle of what is hidden of it; none where nothing is."""
    scene, points = covered(build)
    points[:, 0] *= 2
    coeffs, visible, _ = trace(scene, points, UP, 4, kind="visibility")
    whole = np.array([reference.coefficients_quadrature(LIGHT, p, 0, 16)[0] for p in points]) * math.sqrt(4 * math.pi)
    hidden = shade(coeffs, LIGHT, points)
    np.testing.assert_allclose(hidden, whole - seen_part(points, power=1) * math.pi, atol=0.03 * whole.max())
    assert (coeffs[visible == 1] == 0).all() and (visible == 1).sum() > 2
    np.testing.assert_allclose(hidden[visible == 0], whole[visible == 0], rtol=1e-4)
    assert (visible == 0).sum() > 2


def test_moved_light(build):
    """A light that has moved by no more than the margin still has its shadow, better than by projection over the sphere."""
    scene, points = covered(build)
    moved, truth = np.array(LIGHT) + [0.15, 0, 0], seen_part(points, x=0.15)
    error = {}
    for localised in (True, False):
        coeffs, *_ = trace(scene, points, UP, 4, 256, 0.16, localised=localised)
        error[localised] = np.abs(shade(coeffs, moved, points) - truth).max() / truth.max()
    assert error[True] < 0.05 < error[False]


def test_neighbours_within_the_cell(build):
    """Transfer of a point serves others within `cell` of it, as where it is interpolated."""
    scene, points = covered(build)
    near = points + [0, 0, 0.05]                      # along the shadow's edge, so the shadow is the same
    coeffs, *_ = trace(scene, points, UP, 4, cell=0.05)
    truth = seen_part(near)
    assert np.abs(shade(coeffs, LIGHT, near) - truth).max() < 0.055 * truth.max()


@pytest.mark.parametrize("x", [-0.2, 0.0, 0.2])
def test_light_across_the_horizon(build, x):
    """A wall sees a part of a light above it: the kink of the cosine at the horizon is fitted, and `exact` has it without error."""
    light = np.array(LIGHT) + [x, 0, 0]
    scene, points, normal = build.scene(build.light(build.level(0.8, 1, up=False, x=x))), np.array([[0, 0, 0.1]]), [1, 0, 0]
    truth = lambert(light, points, normal)
    coeffs, visible, _ = trace(scene, points, normal, 4)
    assert visible == 1
    assert abs(shade(coeffs, light, points) - truth) < 0.01 * lambert(np.array(LIGHT) + [0.6, 0, 0], points, normal)
    coeffs, visible, _ = trace(scene, points, normal, 4, kind="exact")
    assert visible == 1 and (coeffs == 0).all()


def test_light_all_around(build):
    """A light too wide for a cone is treated as without localised transfer."""
    scene = build.scene(build.light(build.level(20, 1, up=False)), build.quad(build.level(0.5, 0.5), "plate"))
    points = [[0.3, 0, 0.1], [0, 0, 0.5]]
    wide, plain = trace(scene, points, UP, 4), trace(scene, points, UP, 4, localised=False)
    assert 0 < wide[1][0] < 1
    np.testing.assert_array_equal(wide[1], plain[1])
    np.testing.assert_allclose(wide[0], plain[0], atol=1e-6)


def test_variance(build):
    """The estimate against the scatter over many shifts of the rays: of the same size, and not too small."""
    scene, points = covered(build)
    offsets = (np.arange(24) + 0.5) / 24
    _, visible, variance = trace(scene, np.repeat(points, 24, axis=0), UP, 1, 64, offset=np.tile(offsets, len(points)))
    visible, estimate = visible.reshape(-1, 24).T, variance.reshape(-1, 24).mean(axis=1)
    partly = (visible.mean(axis=0) > 0.1) & (visible.mean(axis=0) < 0.9)
    assert partly.sum() >= 3
    actual = visible.var(axis=0, ddof=1)[partly].mean()
    assert actual < estimate[partly].mean() < 30 * actual
    assert (estimate[(visible == 1).all(axis=0)] == 0).all()


def test_any_number_of_rays(build):
    """Rings of any size: each ray stands for the same solid angle, which shows in the mean of the cosine."""
    scene = build.scene(build.quad(build.level(1, 5), "far"))
    for samples in (1, 2, 3, 7, 50, 333):
        coeffs, visible, _ = trace(scene, [[0, 6, 0]], UP, 2, samples, sky=True)
        assert visible == 1 and np.isfinite(coeffs).all()
        np.testing.assert_allclose(coeffs[0, [0, 1]], [1 / math.sqrt(4 * math.pi), -math.sqrt(1 / (3 * math.pi))], rtol=1e-5)


def test_sky(build):
    """Beside a high wall half of the sky is left; under a roof, lights included, nothing; elsewhere all of it."""
    wall = np.array([[0, -9e3, 9e3], [0, -9e3, -9e3], [0, 9e3, -9e3], [0, 9e3, 9e3]], float)
    coeffs, visible, _ = trace(build.scene(build.quad(wall, "wall")), [[0.1, 0, 0]], UP, 4, 4096, sky=True)
    node, weight = np.polynomial.legendre.leggauss(60)
    y, phi = (a.ravel() for a in np.meshgrid((node + 1) / 2, (np.arange(200) + 0.5) / 200 * np.pi - np.pi / 2, indexing="ij"))
    rho = np.sqrt(1 - y * y)
    basis = sh_matrix(np.stack([rho * np.cos(phi), y, rho * np.sin(phi)], axis=1), 4)
    truth = (basis * (y / np.pi * np.repeat(weight, 200) / 2 * np.pi / 200)[:, None]).sum(axis=0)
    np.testing.assert_allclose(visible, 0.5, atol=0.01)
    np.testing.assert_allclose(coeffs[0], truth, atol=0.01)
    roof = build.scene(build.light(build.box([-1, -1, -1], [1, 1, 1], inside=True) and build.level(1e4, 1, up=False)))
    assert trace(roof, [[0, 0, 0]], UP, 2, 64, sky=True)[1] < 1e-3


@pytest.mark.filterwarnings("ignore:shprt. emitter 'sky'")
def test_bake_with_a_sky(build):
    """Lights at an infinite distance get the last group, projected whatever the others are."""
    sky = mi.load_dict({"type": "constant", "id": "sky"})
    scene = build.scene(build.quad(build.level(2, 0), "floor"), build.quad(build.level(0.4, 0.3), "plate"),
                        build.light(build.level(0.5, 1, up=False)), sky)
    baked = bake_transfer(scene, 2, samples=64, max_edge=0.5)
    assert baked.distant and baked.localised and baked.groups.tolist() == [0, 1]
    assert baked.coeffs.shape[0] == baked.visibility.shape[0] == 2
    plain = bake_transfer(scene, 2, "exact", samples=64, localised=False, max_edge=0.5)
    np.testing.assert_allclose(plain.coeffs[1], baked.coeffs[1], atol=1e-6)
    assert np.abs(plain.coeffs[0] - baked.coeffs[0]).max() > 0.1 and not plain.localised
    rows = baked.meshes[0].row_count
    assert (baked.visibility[1, :rows] < 1).any(), "plate and light are in the sky's way"


def test_coplanar_and_two_sided_traps(build):
    """[G03]: surfaces in the same plane do not darken each other, and a sheet blocks from either side."""
    lamp = build.light(build.level(0.8, 1, up=False))
    tiles = [build.quad(build.level(0.5, 0, x=x), f"tile_{k}") for k, x in enumerate((-0.5, 0, 0.5))]
    for extra in ([], [build.quad(build.level(3, 0), "below")]):
        baked = bake_transfer(build.scene(*tiles, *extra, lamp), 1, samples=64, max_edge=0.25)
        np.testing.assert_array_equal(baked.visibility, 1)
    for up in (True, False):
        scene = build.scene(build.quad(build.level(3, 0.5, up=up), "sheet"), lamp)
        assert trace(scene, [[0, 0, 0]], UP, 1, 64)[1] == 0


class Edge:
    """Sight of a cone in which all directions beyond a plane are hidden."""

    def __init__(self, axis, angle, normal):
        self.axis, self.angle, self.normal = axis, angle, normal

    def cone(self, p, n, cell):
        return Cone(mi.Vector3f(self.axis), mi.Float(self.angle), mi.Bool(False))

    def look(self, origin, n, d, met, active):
        return active & (dr.dot(mi.Vector3f(self.normal), d) > 0), mi.Bool(False), met


@pytest.mark.parametrize("kind, localised", [("shadowed", True), ("exact", True), ("shadowed", False)])
def test_residual(kind, localised):
    """The norm of what the expansion leaves of visibility times cosine, by directions all over the sphere; not less, a little more."""
    order, samples, axis, normal = 3, 4096, np.array([0.28, 0.96, 0]), np.array([0.8, -0.1, 0.6])
    fit = cone_fit(order, samples) if localised else None
    found = sample_transfer(Edge(axis, 0.4, normal), mi.Point3f(0), mi.Normal3f(UP), order, samples, mi.Float(0.5), kind=kind, fit=fit)
    dr.eval(*found)
    value = lambda v: np.array(v).item()
    coeffs, visible, angle = np.array([value(c) for c in found.coeffs]), value(found.visibility), value(found.angle)
    n = 400
    node, weight = np.polynomial.legendre.leggauss(n)
    phi = 2 * np.pi * (np.arange(2 * n) + 0.5) / (2 * n)
    z, turn = (a.ravel() for a in np.meshgrid(1 + (node - 1) * math.sin(angle / 2) ** 2, phi, indexing="ij"))
    weights = np.repeat(weight * math.sin(angle / 2) ** 2, 2 * n) * np.pi / n
    s = np.cross(UP, axis) / np.linalg.norm(np.cross(UP, axis))
    rho = np.sqrt(1 - z * z)[:, None]
    d = rho * np.cos(turn)[:, None] * s + rho * np.sin(turn)[:, None] * np.cross(axis, s) + z[:, None] * axis
    cosine = np.maximum(d @ UP, 0) / np.pi
    rest = cosine * ((d @ normal > 0) - visible)
    expansion = coeffs @ sh_matrix(d, order).T
    if kind == "shadowed":                            # without the part of the cosine that is known
        bands = [0, 4 / 3, 0, 0] if localised else cosine_bands(order)
        known = sh_matrix(UP[None], order)[0] * np.repeat(bands, 2 * np.arange(order + 1) + 1)
        expansion = expansion - visible * (sh_matrix(d, order) @ known)
    expected = weights @ (rest - expansion) ** 2
    assert 0.3 < visible < 0.7 and expected > 0.02 * (weights @ rest ** 2)
    assert 0.98 * expected < value(found.residual) < 1.2 * expected
    assert abs(angle - (0.4 if localised else np.pi)) < 0.03
    if localised:
        np.testing.assert_allclose(np.ravel(found.axis), axis, atol=1e-6)
