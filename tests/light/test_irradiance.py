"""Irradiance by Lambert's formula with clipping at the horizon: closed forms, clipped polygons, cubature of the hemisphere, invariants."""
import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight.light.irradiance import polygon_irradiance

QUAD = np.array([[-0.5, -0.4, 1.2], [0.6, -0.5, 1.0], [0.7, 0.5, 0.8], [-0.4, 0.6, 1.0]])
ARROW = np.array([[-1, -1, 0.3], [0.4, -0.2, 0.3], [1, -1, 0.3], [0.2, 1, 0.3]])
"""Concave at its second corner."""
UNIT = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float)


def irradiance(precision, vertices, normal, x=(0, 0, 0)):
    return polygon_irradiance([precision.vector(v) for v in vertices], precision.vector(x), precision.vector(normal))[0]


def many(precision, vertices, normals, points):
    """Irradiance of arrays (count, N, 3), (count, 3), (count, 3) in one call."""
    wide = lambda rows: precision.Array3(*(precision.Float(list(map(float, c))) for c in np.transpose(rows)))
    return np.array(polygon_irradiance([wide(v) for v in np.swapaxes(vertices, 0, 1)], wide(points), wide(normals)))


def clipped(vertices, normals, points):
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.array([reference.irradiance_clipped(*case) for case in zip(vertices, points, normals)])


def as_float32(a):
    return np.asarray(a, dtype=np.float32).astype(np.float64)


def random_rotations(rng, count):
    q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return q * np.linalg.det(q)[:, None, None]


@pytest.mark.parametrize("corners", [3, 4, 7])
def test_clipped_polygon(precision, corners):
    """Random star-shaped polygons, seen from all distances down to 0.01 and lit from all sides; normals into, along and off the light."""
    rng, count = np.random.default_rng(corners), 400
    angle = (np.arange(corners) + rng.uniform(0, 0.8, (count, corners))) * 2 * np.pi / corners
    radius = rng.uniform(0.3, 1, (count, corners))
    frame = random_rotations(rng, count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=2)
    points = np.concatenate([rng.normal(size=(count, 2)) * 0.7, -10 ** rng.uniform(-2, 0.5, (count, 1))], axis=1)
    vertices, points = (as_float32(v @ np.swapaxes(frame, 1, 2)) for v in (flat, points[:, None]))
    normals = rng.normal(size=(count, 3))
    normals[::7], normals[1::7], normals[2::7] = frame[::7, :, 2], -frame[1::7, :, 2], frame[2::7, :, 0]
    truth = clipped(vertices, normals, points[:, 0])
    assert (truth == 0).any() and truth.max() > 2.9
    error = np.abs(many(precision, vertices, normals, points[:, 0]) - truth)
    assert error.max() < 60 * precision.eps
    assert error.mean() < 3 * precision.eps


def test_every_special_position(precision):
    """Corners and normals on a coarse grid: corners in the zenith, the nadir and the horizon, edges through and along them."""
    rng = np.random.default_rng(1)
    vertices = rng.integers(-2, 3, (6000, 3, 3)).astype(float)
    normals = rng.integers(-1, 2, (6000, 3)).astype(float)
    keep = (np.abs(np.linalg.det(vertices)) > 0.5) & normals.any(axis=1)
    vertices, normals = vertices[keep], normals[keep]
    vertices[::3] += rng.normal(size=vertices[::3].shape) * 10.0 ** rng.integers(-20, -6, (len(vertices[::3]), 1, 1))
    for frame in (np.eye(3), random_rotations(rng, 1)[0]):
        turned, up = vertices @ frame.T, normals @ frame.T
        truth = clipped(turned, up, np.zeros_like(up))
        assert np.ptp(truth) > 5
        assert np.abs(many(precision, turned, up, np.zeros_like(up)) - truth).max() < 60 * precision.eps


@pytest.mark.parametrize("case", reference.reference_cases(), ids=lambda c: c.name)
def test_reference_polygons(precision, case):
    """Distant, grazing and slim lights, above, below and across the horizon: the error stays at eps times the perimeter seen from x."""
    unit = case.vertices / np.linalg.norm(case.vertices, axis=1, keepdims=True)
    perimeter = np.linalg.norm(unit - np.roll(unit, 1, axis=0), axis=1).sum()
    middle = unit.sum(axis=0)
    normals = as_float32([middle, *np.random.default_rng(4).normal(size=(11, 3)), *(np.cross(middle, axis) + 1e-3 for axis in np.eye(3))])
    truth = clipped(np.tile(case.vertices, (15, 1, 1)), normals, np.zeros((15, 3)))
    ours = many(precision, np.tile(case.vertices, (15, 1, 1)), normals, np.zeros((15, 3)))
    assert np.abs(ours - truth).max() <= 30 * precision.eps * perimeter + 1e-16            # of the oracle


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.48, -0.6, 0.64), (0.96, 0, -0.28), (0, -1, 0)])
@pytest.mark.parametrize("polygon", [QUAD, ARROW], ids=["quad", "concave"])
def test_cubature_of_the_hemisphere(polygon, normal):
    """Points spread evenly over the unit disc, lifted to the hemisphere: each that meets the polygon stands for an equal part of pi."""
    count = 400_000
    index = np.arange(count)
    radius, azimuth = np.sqrt((index + 0.5) / count), index * np.pi * (3 - np.sqrt(5))
    tangent = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    tangent /= np.linalg.norm(tangent)
    d = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1 - radius ** 2)], axis=1)
    d = d @ np.stack([tangent, np.cross(normal, tangent), normal])
    side = np.cross(polygon[1] - polygon[0], polygon[-1] - polygon[0])
    u = (polygon[1] - polygon[0]) / np.linalg.norm(polygon[1] - polygon[0])
    v = np.cross(side / np.linalg.norm(side), u)
    t = (side @ polygon[0]) / np.where(d @ side == 0, 1e-300, d @ side)
    hit = np.stack([d @ u, d @ v], axis=1) * t[:, None]
    inside = np.zeros(count, bool)
    corners = np.stack([polygon @ u, polygon @ v], axis=1)
    for a, b in zip(corners, np.roll(corners, -1, axis=0)):                    # even-odd rule
        spans = (a[1] > hit[:, 1]) != (b[1] > hit[:, 1])
        inside ^= spans & (hit[:, 0] < a[0] + (hit[:, 1] - a[1]) * (b[0] - a[0]) / (b[1] - a[1] if b[1] != a[1] else 1))
    estimate = np.pi * np.mean(inside & (t > 0))
    assert polygon_irradiance(polygon.tolist(), (0, 0, 0), normal) == pytest.approx(estimate, abs=2e-4)


@pytest.mark.parametrize("vertices, normal, value", [
    (np.eye(3), (0, 0, 1), np.pi / 4),                                         # an octant
    (np.eye(3), (0, 0, -1), 0),
    (np.eye(3), (1, 1, 1), np.pi / 4 * np.sqrt(3)),
    (UNIT * (1e4, 1e4, 1), (0, 0, 1), np.pi),                                  # a ceiling
    (UNIT * (1e4, 1e4, 1), (1, 0, 0), np.pi / 2),                              # lights the upper half of a wall
    (UNIT * (1e4, 1e4, 1), (0.6, 0, -0.8), np.pi * 0.1),                       # and a lune of what looks down: pi (1 - 0.8) / 2
    (UNIT, (0, 0, 1), np.sqrt(2) * np.arccos(1 / 3)),                          # square parallel to the surface: four equal edges
    (UNIT, (1, 0, 0), np.pi / 4 - np.arccos(1 / 3) / np.sqrt(8)),              # perpendicular to it, half hidden: two edges
    (-UNIT, (0, 0, 1), 0),
])
def test_known_values(precision, vertices, normal, value):
    """To rounding; the ceiling ends 1e-4 rad above the horizon."""
    known_to = 2e-4 if vertices[0][0] < -9 else 0
    assert irradiance(precision, vertices, normal) == pytest.approx(value, rel=40 * precision.eps, abs=known_to)


def test_light_below_the_horizon_gives_exactly_nothing(precision):
    rng = np.random.default_rng(7)
    vertices = rng.normal(size=(500, 3, 3))
    vertices[:, :, 2] = -abs(vertices[:, :, 2])
    assert (many(precision, vertices, np.tile([0, 0, 1.0], (500, 1)), np.zeros((500, 3))) == 0).all()


@pytest.mark.parametrize("gap", [1e-1, 1e-3, 1e-5, 1e-7])
def test_close_to_the_light(precision, gap):
    """In front of a square it fills the upper hemisphere about its axis, whatever the normal; beside it, it is seen edge-on."""
    for x, inside in (((0.3, -0.8, 1 - gap), True), ((1.5, 0.2, 1 - gap), False)):
        x = as_float32(x)
        for normal in ((0, 0, 1), (0.6, 0, 0.8), (-0.6, 0, 0.8), (-1, 0, 0), (0, 0.6, -0.8)):
            value = irradiance(precision, UNIT, normal, x)
            assert value == pytest.approx(clipped(UNIT[None], np.array([normal]), x[None])[0], abs=40 * precision.eps)
            if inside and gap < 1e-4:
                assert value == pytest.approx(np.pi * (1 + normal[2]) / 2, abs=40 * gap)


def test_both_sides_of_the_surface(precision):
    """E(n) - E(-n) is what Lambert's formula gives without clipping."""
    normal = np.array([0.96, 0, -0.28])
    unit = QUAD / np.linalg.norm(QUAD, axis=1, keepdims=True)
    cross = np.cross(unit, np.roll(unit, -1, axis=0))
    sine = np.linalg.norm(cross, axis=1)
    whole = 0.5 * np.sum(np.arcsin(sine) * (cross @ normal) / sine)            # all edges are shorter than pi / 2
    above, below = irradiance(precision, QUAD, normal), irradiance(precision, QUAD, -normal)
    assert min(above, below) > 0.01
    assert above - below == pytest.approx(whole, abs=10 * precision.eps)


def test_parts_add(precision):
    normal = (0.96, 0, -0.28)
    parts = [irradiance(precision, QUAD[[i, (i + 1) % 4]].tolist() + [QUAD.mean(axis=0)], normal) for i in range(4)]
    whole = [irradiance(precision, QUAD[[0, i, i + 1]], normal) for i in (1, 2)]
    assert sum(parts) == pytest.approx(sum(whole), abs=20 * precision.eps)
    concave = [irradiance(precision, ARROW[list(t)], normal) for t in ((0, 1, 3), (1, 2, 3))]
    assert irradiance(precision, ARROW, normal) == pytest.approx(sum(concave), abs=20 * precision.eps)


def test_winding_start_and_scale(precision):
    normal = (0.96, 0, -0.28)
    value = irradiance(precision, QUAD, normal)
    assert value > 0.01
    assert irradiance(precision, QUAD[::-1], normal) == pytest.approx(-value, abs=10 * precision.eps)
    assert irradiance(precision, np.roll(QUAD, 1, axis=0), normal) == pytest.approx(value, abs=10 * precision.eps)
    for scale in (1e-12, 1e6, 1e12):
        assert irradiance(precision, QUAD * scale, np.array(normal) * scale) == pytest.approx(value, abs=20 * precision.eps)


def test_small_light(precision):
    """Far away a square is a point light: cosine over distance squared."""
    far = 100 * np.array([0, 0.6, 0.8]) + 0.5 * UNIT @ np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0, 0]])
    assert irradiance(precision, far, (0, 0, 1)) == pytest.approx(0.8e-4, rel=1e-3)


DEGENERATE = {
    "point at a vertex": ([(0, 0, 0), (1, 0, 1), (0, 1, 1)], (0, 0, 0)),
    "point on an edge": ([(-1, 0, 0), (1, 0, 0), (0, 1, 1)], (0, 0, 0)),
    "point on the plane, outside": ([(1, 0, 0), (2, 0, 0), (2, 1, 0)], (0, 0, 0)),
    "point inside the light": ([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], (0.1, 0.2, 0)),
    "centre of the light": ([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], (0, 0, 0)),
    "coincident vertices": ([(0, 0, 1), (0, 0, 1), (1, 0, 1), (0, 1, 1)], (0, 0, 0)),
    "all vertices equal": ([(0, 0, 1)] * 3, (0, 0, 0)),
    "zero area": ([(0, 0, 1), (1, 0, 1), (2, 0, 1)], (0, 0, 0)),
    "edge in the horizon": ([(1, 0, 0), (0, 1, 0), (0, 0, 1)], (0, 0, 0)),
    "huge coordinates": ([(-1e30, -1e30, 1e30), (1e30, -1e30, 1e30), (0, 1e30, 1e30)], (0, 0, 0)),
    "tiny coordinates": ([(-1e-30, -1e-30, 1e-30), (1e-30, -1e-30, 1e-30), (0, 1e-30, 1e-30)], (0, 0, 0)),
    "denormal coordinates": ([(-1e-42, 0, 1e-42), (1e-42, 0, 1e-42), (0, 1e-42, 1e-42)], (0, 0, 0)),
}
NORMALS = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0), (0, 0.6, 0.8), (0, 0, 0)]


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_input(precision, name):
    vertices, x = DEGENERATE[name]
    for normal in NORMALS:
        value, up = irradiance(precision, vertices, normal, x), normal[2]
        assert np.isfinite(value)
        if name in ("all vertices equal", "zero area", "point on the plane, outside") or normal == (0, 0, 0):
            assert abs(value) < 4 * precision.eps
        elif name in ("point inside the light", "centre of the light"):
            assert min(abs(value - np.pi * (1 + up) / 2), abs(value + np.pi * (1 - up) / 2)) < 20 * precision.eps
        elif name == "coincident vertices":
            assert value == pytest.approx(irradiance(precision, vertices[1:], normal), abs=10 * precision.eps)
        elif name.startswith(("huge", "tiny")):
            assert value == pytest.approx(irradiance(precision, np.array(vertices) / vertices[0][2], normal), abs=20 * precision.eps)


def test_coordinates_that_are_not_finite(precision):
    for bad in (np.inf, np.nan):
        assert np.isnan(irradiance(precision, [(0, 0, 1), (bad, 0, 1), (0, 1, 1)], (0, 0, 1)))


def test_wide_values_equal_single_ones(precision):
    points, normals = np.array([(0, 0, 0), (0.3, -0.2, 0.1), (0, 0, 3)]), np.array([(0, 0, 1), (0.96, 0, -0.28), (0, 1, 0)])
    together = many(precision, np.tile(QUAD, (3, 1, 1)), normals, points)
    alone = [irradiance(precision, QUAD, n, p) for n, p in zip(normals, points)]
    assert together[0] > 0.5
    np.testing.assert_allclose(together, alone, atol=10 * precision.eps)


def test_types():
    assert type(polygon_irradiance(QUAD.tolist(), (0, 0, 0), (0, 0, 1))) is float
    assert type(polygon_irradiance(QUAD.tolist(), dr.llvm.Array3f64(0, 0, 0), (0, 0, 1))) is dr.llvm.Float64
    assert type(polygon_irradiance(QUAD.tolist(), (0, 0, 0), dr.llvm.ad.Array3f(0, 0, 1))) is dr.llvm.ad.Float


@pytest.mark.parametrize("forward", [False, True], ids=["backward", "forward"])
@pytest.mark.parametrize("moving", ["vertex", "point", "normal"])
def test_autodiff_matches_finite_difference(moving, forward):
    """Five normals: the light above, cut by the horizon with its centre above and below, with a corner in the zenith, and all below."""
    number, array = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    normals = np.array([(0.1, 0, 1), (0.9, 0.1, 0.1), (0.9, 0.1, -0.5), QUAD[0], (0, 0.1, -1)])

    def value(t):
        vertices, x = [array(*map(float, p)) for p in QUAD], array(0.0)
        normal = array(*(number(list(c)) for c in normals.T))
        if moving == "vertex":
            vertices[1] = vertices[1] + array(t, 0.5 * t, -t)
        elif moving == "point":
            x = x + array(t, 0.5 * t, -t)
        else:
            normal = normal + array(t, 0.5 * t, -t)
        return polygon_irradiance(vertices, x, normal)

    t = dr.zeros(number, 5)
    dr.enable_grad(t)
    result = value(t)
    if forward:
        dr.set_grad(t, 1)
        gradient = np.array(dr.forward_to(result))
    else:
        dr.backward(result)
        gradient = np.array(dr.grad(t))
    central = (np.array(value(number(1e-5))) - np.array(value(number(-1e-5)))) / 2e-5
    assert abs(central[:4]).min() > 1e-3 and central[4] == 0
    np.testing.assert_allclose(gradient, central, atol=1e-8)


@pytest.mark.parametrize("arguments, error, text", [
    ({"vertices": QUAD[:2].tolist()}, ValueError, r"'vertices' must have at least three entries"),
    ({"vertices": 7}, TypeError, r"'vertices' must be a list of 3-vectors"),
    ({"x": (0, 0)}, TypeError, r"'x' must be a 3-vector"),
    ({"normal": "up"}, TypeError, r"'normal' must be a 3-vector"),
])
def test_bad_arguments(arguments, error, text):
    with pytest.raises(error, match=r"polygon_irradiance\(\): " + text):
        polygon_irradiance(**{"vertices": QUAD.tolist(), "x": (0, 0, 0), "normal": (0, 0, 1), **arguments})
