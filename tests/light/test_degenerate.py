"""Degenerate input has a documented value, in every method and precision; what one lane holds does not touch its neighbours."""
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest

from mi_shlight import project_polygon
from mi_shlight.light.project import METHODS
from random_polygons import coefficients, polygons_from, wide

ORDER = 3
ORIGIN = (0, 0, 0)
TRIANGLE = [(0, 0, 1), (1, 0, 1), (0, 1, 1)]
QUAD = [(-0.5, -0.4, 1.2), (0.6, -0.5, 1), (0.7, 0.5, 0.8), (-0.4, 0.6, 1)]
SQUARE = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
TILTED = [(-1, -1, 1), (1, -1, 1), (1, 1, -1), (-1, 1, -1)]

# Nothing is seen of these: the point lies in the plane outside, or there is no area. (corners, x)
NOTHING = {
    "in the plane, outside": (SQUARE, (3, 0.5, 0)),
    "in a tilted plane, outside": (TILTED, (2, 4, -4)),
    "in line with an edge": (SQUARE, (3, 1, 0)),
    "in line with an edge, triangle": ([(1, 0, 0), (2, 0, 0), (2, 1, 0)], ORIGIN),
    "on a line": ([(0, 0, 1), (1, 0, 1), (2, 0, 1)], ORIGIN),
    "there and back": ([(0, 0, 1), (1, 0, 1), (3, 1, 1), (1, 0, 1)], ORIGIN),
    "on a line through the point": ([(-1, -2, 1), (1, 2, -1), (2, 4, -2)], ORIGIN),
    "one point": ([(0, 0, 1)] * 3, ORIGIN),
    "one point, five times": ([(0.3, 0.1, 1)] * 5, ORIGIN),
    "one point, and x there": ([(1, 2, 3)] * 4, (1, 2, 3)),
}
# The same light described differently, seen from the origin.
SAME = {
    "coincident corners": ([TRIANGLE[0], *TRIANGLE], TRIANGLE),
    "coincident corners at the end": ([*QUAD, QUAD[3], QUAD[0]], QUAD),
    "a corner on an edge": ([TRIANGLE[0], (0.5, 0, 1), *TRIANGLE[1:]], TRIANGLE),
    "a spike": ([*TRIANGLE, (0, 2, 1)], [(0, 0, 1), (1, 0, 1), (0, 1, 1)]),
    "corners of the axes, and -0": ([(1, -0.0, 0), (0, 1, -0.0), (-0.0, 0, 1)], [(2, 0, 0), (0, 3, 0), (0, 0, 4)]),
}
# The point is in the light's plane and in the light; its normal looks along the third entry.
INSIDE = {
    "square": (SQUARE, (0.1, 0.2, 0), (0, 0, 1)),
    "centre of the square": (SQUARE, ORIGIN, (0, 0, 1)),
    "tilted": (TILTED, (0.25, 0.5, -0.5), (0, 0.5 ** 0.5, 0.5 ** 0.5)),
    "triangle": ([(-1, 0, -1), (2, 0, -1), (-1, 0, 2)], ORIGIN, (0, -1, 0)),
    "on a diagonal": (SQUARE, (0.5, 0.5, 0), (0, 0, 1)),
    "in the arm of a star": ([(-9, -1, 0), (-1, -1, 0), (0, -9, 0), (1, -1, 0), (9, 1, 0), (0, 9, 0)], (0, -6, 0), (0, 0, 1)),
}
# The point is on edges that do not count.
THROUGH = {
    "on an edge": ([(-1, 0, 0), (1, 0, 0), (0, 1, 1)], ORIGIN),
    "on an edge of a square": (SQUARE, (0.5, -1, 0)),
    "on a corner": ([(0, 0, 0), (1, 0, 1), (0, 1, 1)], ORIGIN),
    "on a corner of a square": (SQUARE, (1, 1, 0)),
    "on a corner of a pentagon": ([*SQUARE, (-3, 0, 0)], (-1, 1, 0)),
}
HUGE = (1e8, 1e12, 1e30)
"""Sizes of squares at height 1."""
LUNE = [(1, 0, 0), (0, 1, 1), (-1, 0, 0), (0, -1, 1)]
DENORMAL = (-1074, -149, -140, -126)
"""Exponents of 2."""

CASES = {
    **NOTHING, **THROUGH, "lune": (LUNE, ORIGIN),
    **{f"{name} {k}": (corners, ORIGIN) for name, pair in SAME.items() for k, corners in enumerate(pair)},
    **{f"inside: {name}": case[:2] for name, case in INSIDE.items()},
    **{f"huge {size}": (np.array(SQUARE) * size + (0, 0, 1), ORIGIN) for size in HUGE},
    **{f"denormal {power}": (np.array([(-3, 0, 3), (3, 0, 3), (0, 5, 3)]) * 2.0 ** power, ORIGIN) for power in DENORMAL},
}

closed = pytest.mark.parametrize("method", ["edge", "recurrence", "auto"])
every = pytest.mark.parametrize("method", METHODS)
COMPUTED = {}
LISTS = (3, 4)


def seen(precision, method, name):
    """Coefficients of one of CASES, which are computed together."""
    key = precision.eps, method
    if key not in COMPUTED:
        values = coefficients(precision, polygons_from(CASES.values()), ORDER, method, LISTS)
        COMPUTED[key] = dict(zip(CASES, values.T))
    return COMPUTED[key][name]


def tolerance(precision, method):
    """Of cubature: what it aims at, with some room."""
    return 60 * precision.eps if method in ("edge", "recurrence") else 2e-5 if precision.eps > 1e-10 else 1e-10


def hemisphere(normal):
    """Coefficients of the hemisphere about a unit vector, to degree 3: 2 pi times the integrals 1, 1/2, 0, -1/8 of P_l over [0, 1]."""
    x, y, z = normal
    first = np.array([-y, z, -x]) * np.sqrt(3 / (4 * np.pi)) * np.pi
    third = np.array([(3 * x * x - y * y) * y * -np.sqrt(10) / 4, np.sqrt(15) * x * y * z, -np.sqrt(6) / 4 * y * (5 * z * z - 1),
                      (5 * z ** 3 - 3 * z) / 2, -np.sqrt(6) / 4 * x * (5 * z * z - 1), np.sqrt(15) / 2 * (x * x - y * y) * z,
                      -np.sqrt(10) / 4 * (x * x - 3 * y * y) * x])
    return np.array([np.sqrt(np.pi), *first, *np.zeros(5), *third * np.sqrt(7 / (4 * np.pi)) * -np.pi / 4])


def boundary_integral(corners, x):
    """Coefficients of degree 1 by Stokes: the integral of the direction is half the sum of arcs times normals; no edges through `x`."""
    v = np.asarray(corners, dtype=float) - x
    total = np.zeros(3)
    for a, b in zip(v, np.roll(v, -1, axis=0)):
        cross = np.cross(a, b)
        if cross.any():
            total += np.arctan2(np.linalg.norm(cross), a @ b) * cross / np.linalg.norm(cross)
    return np.sqrt(3 / (4 * np.pi)) * 0.5 * np.array([-total[1], total[2], -total[0]])


@every
@pytest.mark.parametrize("name", NOTHING)
def test_nothing_seen(precision, method, name):
    assert np.abs(seen(precision, method, name)).max() < max(30 * precision.eps, 1e-12)


@every
@pytest.mark.parametrize("name", SAME)
def test_same_light(precision, method, name):
    value, expected = (seen(precision, method, f"{name} {k}") for k in (0, 1))
    assert np.linalg.norm(value - expected) < tolerance(precision, method) * np.linalg.norm(expected)


@closed
@pytest.mark.parametrize("name", INSIDE)
def test_inside_the_light(precision, method, name):
    """The limits from both sides are the hemispheres on either side, with opposite signs: they differ in degree 0 only."""
    value, expected = seen(precision, method, f"inside: {name}"), hemisphere(INSIDE[name][2])
    assert np.allclose(value[1:], expected[1:], atol=30 * precision.eps)
    assert abs(value[0]) == pytest.approx(expected[0], rel=30 * precision.eps)


@closed
@pytest.mark.parametrize("name", THROUGH)
def test_on_the_outline(precision, method, name):
    value = seen(precision, method, name)
    assert np.isfinite(value).all()
    assert np.allclose(value[1:4], boundary_integral(*THROUGH[name]), atol=30 * precision.eps)
    assert abs(value[0]) <= np.sqrt(np.pi) * (1 + 30 * precision.eps)


@pytest.mark.parametrize("name", [*(f"inside: {name}" for name in INSIDE), *THROUGH])
def test_cubature_in_the_plane(precision, name):
    """A plane through the point has no flux."""
    assert np.abs(seen(precision, "quadrature", name)).max() < (1e-5 if precision.eps > 1e-10 else 1e-13)


@closed
def test_antipodal_corners(precision, method):
    """Two corners in opposite directions, not neighbours: a lune of a right angle."""
    value = seen(precision, method, "lune")
    assert value[0] * np.sqrt(4 * np.pi) == pytest.approx(np.pi, rel=30 * precision.eps)
    assert np.allclose(value[1:4], [0, np.sqrt(3 / (4 * np.pi)) * np.pi * 0.5 ** 0.5, 0], atol=30 * precision.eps)


@closed
@pytest.mark.parametrize("size", HUGE)
def test_hemisphere_filled(precision, method, size):
    assert np.allclose(seen(precision, method, f"huge {size}"), hemisphere((0, 0, 1)), atol=30 * precision.eps + 4 / size)


@every
def test_largest_numbers(precision, method):
    """The light at one end of the range of numbers and the point at the other."""
    largest = 3e38 if precision.eps > 1e-10 else 1.7e308
    corners, x = np.array([(0.2, 0, 1), (1, 0.1, 1), (0.3, 1, 0.9)]), np.array([-0.3, -0.2, -1])
    pair = polygons_from([(corners * largest, x * largest), (corners, x)])
    value, expected = coefficients(precision, pair, ORDER, method, LISTS).T
    assert np.linalg.norm(value - expected) < tolerance(precision, method) * np.linalg.norm(expected)


@every
@pytest.mark.parametrize("power", DENORMAL)
def test_denormal_numbers(precision, method, power):
    """What is left of them is up to the hardware."""
    value = seen(precision, method, f"denormal {power}")
    assert np.isfinite(value).all()
    assert abs(value[0]) * np.sqrt(4 * np.pi) <= 2 * np.pi * (1 + 30 * precision.eps)


@every
def test_lanes_are_apart(precision, method):
    """A coordinate that is infinite or NaN makes its lane NaN and changes no bit of the others."""
    polygons = polygons_from([(np.array(QUAD) + 0.01 * k, (0, 0, -0.1 * k)) for k in range(9)])
    clean = coefficients(precision, polygons, ORDER, method, LISTS)
    polygons.vertices[1, 0, 2], polygons.vertices[4, 6, 0], polygons.x[5, 1] = np.inf, np.nan, -np.inf
    value = coefficients(precision, polygons, ORDER, method, LISTS)
    touched = np.isin(np.arange(9), (1, 4, 5))
    assert np.isnan(value[:, touched]).all()
    assert np.array_equal(value[:, ~touched], clean[:, ~touched])


@closed
def test_python_floats(method):
    """The scalar loops agree with the wide ones."""
    precision = SimpleNamespace(Array3=dr.llvm.ad.Array3f64, Float=dr.llvm.ad.Float64, eps=1.2e-16)
    for name, (corners, x) in CASES.items():
        if name.startswith("denormal"):
            continue
        plain = np.array(project_polygon([tuple(map(float, v)) for v in corners], tuple(map(float, x)), ORDER, method))
        wide_one = seen(precision, method, name)
        assert np.allclose(plain[1:], wide_one[1:], atol=1e-13), name
        assert name in THROUGH or abs(plain[0]) == pytest.approx(abs(wide_one[0]), abs=1e-13), name


@closed
@pytest.mark.parametrize("corners", LISTS)
def test_gradients_are_finite(precision, method, corners):
    """But for coordinates so small that derivatives by them overflow; longer lists are tested on random polygons."""
    cases = [case for name, case in CASES.items() if len(case[0]) == corners and not name.startswith("denormal")]
    rows = np.array([v for v, _ in cases], dtype=float)
    light, x = [wide(precision, rows[:, k]) for k in range(corners)], wide(precision, np.array([x for _, x in cases], dtype=float))
    dr.enable_grad(light, x)
    value = sum(c * w for c, w in zip(project_polygon(light, x, ORDER, method), np.cos(np.arange((ORDER + 1) ** 2)).tolist()))
    dr.backward(value)
    slopes = dr.grad([*light, x])
    dr.eval(slopes)
    assert np.isfinite([np.array(g) for g in slopes]).all()
