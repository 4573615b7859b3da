"""A million random polygons of every kind, degenerate ones included: finite, bounded, accurate, and true to the symmetries.

The yardstick is the reach of a polygon, ``K = sum_e 2 tan(T_e / 2)`` over the arcs T_e of its edges: how far its coefficients can move when
the directions of its corners move by 1. It is the perimeter as seen from x, with more weight on edges that span nearly half a circle. A
closed form errs by some eps K, whatever the polygon.
"""
import dataclasses
import functools
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight import project_polygon
from random_polygons import AXIS, CORNERS, NAMES, coefficients, random_polygons, wide

COUNT = 130_000
"""Polygons at order 2; times two precisions and four methods that makes a million."""

# Error = first * eps K + second * eps + third or fourth * size of the coefficients, in float32 or float64. Measured over the million:
# 4 eps K by `edge`, 6 by `auto` in float32. [W18]'s recurrence starts from differences of numbers near 1, so that short edges cost an eps
# each. In float64 `auto` may use cubature whose error is only estimated. Cubature alone is asked only for the kinds of COMPACT.
TOLERANCE = {"edge": (20, 0, 0, 0), "auto": (20, 0, 0, 1e-5), "recurrence": (20, 20, 0, 0), "quadrature": (0, 0, 1e-4, 1e-7)}
COMPACT = ("convex", "non-convex", "star", "uneven", "tiny", "distant", "grazing", "scaled")

# Relative error of `auto` in float32, where a closed form may have none of its digits left. Its aim is 4e-6. Measured 1e-5.
DIGITS = dict.fromkeys((*COMPACT, "coincident corners", "collinear corners"), 3e-5)

SIMPLE = ("convex", "non-convex", "star", "tiny", "distant", "huge", "grazing", "close above", "sliver", "scaled")
"""No direction is covered twice."""
OVERLAPS = ("axis-aligned", "antipodal corners", "spikes", "whole numbers")
"""Some direction may be covered twice, with opposite signs: cubature errs by a part of what cancels, not of what is left."""
JUMPS = ("in its plane, inside", "on an edge", "in line with an edge", "on a corner", "antipodal corners", "on a line", "whole numbers",
         "hemisphere")
"""The point may be in the light, up to the rounding of its corners: the solid angle jumps there. The other coefficients do not."""
UNCERTAIN = ("denormal",)
"""What is left of such coordinates depends on the hardware, even on the thread."""

DOUBLE = SimpleNamespace(Array3=dr.llvm.ad.Array3f64, Float=dr.llvm.ad.Float64, eps=1.2e-16)

methods = pytest.mark.parametrize("method", TOLERANCE)
exact_methods = pytest.mark.parametrize("method", ["edge", "recurrence", "auto"])


@functools.lru_cache(maxsize=None)
def everything(order):
    return random_polygons(COUNT if order == 2 else COUNT // 4, seed=order)


@functools.lru_cache(maxsize=None)
def few():
    """For the symmetries: coordinates that can be scaled and moved exactly are among them."""
    polygons = random_polygons(9000, seed=0)
    return polygons[~polygons.of(*UNCERTAIN)]


COMPUTED = {}
SHORT = (3, 4)
"""Lists of so many corners are one strip, which has code of its own."""


def computed(precision, method, order):
    """Coefficients of `everything`, once."""
    lists = SHORT if order == 2 else ()
    return once((precision.eps, method, order), lambda: coefficients(precision, everything(order), order, method, lists))


def unchanged(precision, method):
    """Coefficients of `few` at order 2, once."""
    return once((precision.eps, method), lambda: coefficients(precision, few(), 2, method, ()))


def once(key, compute):
    if key not in COMPUTED:
        COMPUTED[key] = compute()
    return COMPUTED[key]


def allowed(precision, method, polygons, coeffs):
    """Norm of the error that `method` may have."""
    reaches, floor, single, double = TOLERANCE[method]
    size = np.where(polygons.of(*OVERLAPS), polygons.arcs.sum(axis=1), norms(coeffs))
    return precision.eps * (reaches * polygons.reach + floor) + (single if precision.eps > 1e-10 else double) * size


def norms(coeffs):
    return np.linalg.norm(coeffs, axis=0)


def distance(a, b, polygons):
    """Norm of the difference of coefficients, but for solid angles that jump."""
    difference = a - b
    difference[0, polygons.of(*JUMPS)] = 0
    return norms(difference)


def assert_within(error, limit, polygons):
    worst = [(name, (error / np.maximum(limit, 1e-300))[polygons.of(name)].max()) for name in NAMES if polygons.of(name).any()]
    assert (error <= limit + 1e-300).all(), sorted(worst, key=lambda pair: -pair[1])[:3]


@methods
def test_never_nan(precision, method):
    assert np.isfinite(computed(precision, method, 2)).all()


@exact_methods
@pytest.mark.parametrize("order", [2, 8])
def test_bounds(precision, method, order):
    """``|L_l| <= sqrt((2 l + 1) / (8 pi l (l + 1))) * perimeter`` of every polygon, from the boundary integral of a degree;
    ``|L_l| <= sqrt((2 l + 1) / (4 pi)) * solid angle`` of one that covers no direction twice, and its solid angle is at most 2 pi."""
    polygons = everything(order)
    coeffs = computed(precision, method, order)
    slack = allowed(precision, method, polygons, coeffs)
    overlap = 20 * 6e-8 * polygons.reach              # by the rounding of the corners to float32
    certain, simple = ~polygons.of(*UNCERTAIN), polygons.of(*SIMPLE)
    solid_angle, perimeter = np.abs(coeffs[0]) * np.sqrt(4 * np.pi), polygons.arcs.sum(axis=1)
    assert (solid_angle <= 2 * np.pi + 4 * (slack + overlap))[simple].all()
    for l in range(1, order + 1):
        band = norms(coeffs[l * l:(l + 1) ** 2])
        assert (band <= np.sqrt((2 * l + 1) / (8 * np.pi * l * (l + 1))) * perimeter + slack)[certain].all()
        assert (band <= np.sqrt((2 * l + 1) / (4 * np.pi)) * solid_angle + (2 * l + 1) * (slack + overlap))[simple].all()


@pytest.mark.parametrize("method, order", [*((method, order) for method in TOLERANCE for order in (2, 8))][:-1])
def test_accuracy(precision, method, order):
    """Against the closed form in float64, which :py:func:`test_truth` judges. Cubature at order 8 is what auto does with small lights."""
    polygons = everything(order)
    chosen = polygons.of(*COMPACT) if method == "quadrature" else ~polygons.of(*UNCERTAIN)
    truth = computed(DOUBLE, "edge", order)
    error = distance(computed(precision, method, order), truth, polygons)
    limit = allowed(precision, method, polygons, truth) + allowed(DOUBLE, "edge", polygons, truth)
    assert_within(error[chosen], limit[chosen], polygons[chosen])


@pytest.mark.parametrize("order", [2, 8])
def test_relative_accuracy(order):
    single = SimpleNamespace(eps=6e-8, Array3=dr.llvm.ad.Array3f, Float=dr.llvm.ad.Float)
    polygons = everything(order)
    truth = computed(DOUBLE, "edge", order)
    size = norms(truth)
    certain = allowed(DOUBLE, "edge", polygons, truth) < 1e-6 * size
    error = norms(computed(single, "auto", order) - truth)
    for name, limit in DIGITS.items():
        chosen = polygons.of(name) & certain
        assert chosen.sum() > 0.8 * polygons.of(name).sum()
        assert_within(error[chosen], limit * size[chosen], polygons[chosen])


def test_truth():
    """The closed form in float64 against 50 digits: one polygon of each kind with corners apart and a solid angle that does not jump."""
    polygons = random_polygons(600, seed=5)
    polygons = polygons[~polygons.of(*JUMPS, *UNCERTAIN, "coincident corners", "collinear corners", "spikes", "one point", "axis-aligned")]
    polygons = polygons[np.unique(polygons.kind, return_index=True)[1]]
    ours = coefficients(DOUBLE, polygons, 2, "edge", ())
    truth = np.array([reference.coefficients_mp(polygons.outline(k), polygons.x[k], 2) for k in range(len(polygons))]).T
    assert len(polygons) > 15
    assert_within(norms(ours - truth), 10 * DOUBLE.eps * polygons.reach, polygons)


FIRST, SECOND = np.minimum(AXIS, 6), np.where(AXIS < 6, AXIS + 6, 0)           # entries on the two sides of the diagonal from 6 to 0

# Name -> function of (vertices, x) that gives parts (sign, vertices, x) with the coefficients of the whole together.
SYMMETRIES = {
    "start corner": lambda v, x: [(1, np.roll(v, 5, axis=1), x)],
    "winding": lambda v, x: [(-1, v[:, ::-1], x)],
    "diagonal": lambda v, x: [(1, v[:, FIRST], x), (1, v[:, SECOND], x)],
}
TURN = np.array([(0, -1, 0), (0, 0, 1), (-1, 0, 0)])
"""A rotation that is exact in floating point."""


def changed(polygons, vertices, x):
    return dataclasses.replace(polygons, vertices=np.asarray(vertices, dtype=np.float64), x=np.asarray(x, dtype=np.float64))


def unturned(coeffs):
    """Coefficients of a function that was turned by TURN, turned back."""
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.linalg.lstsq(reference.sh_basis(directions, 2), reference.sh_basis(directions @ TURN.T, 2) @ coeffs, rcond=None)[0]


def assert_same(precision, method, rows, parts, back=lambda coeffs: coeffs):
    """The sum of `parts`, pairs (sign, polygons), are these rows of `few`; each may have its own error."""
    polygons, whole = few()[rows], unchanged(precision, method)[:, rows]
    limit, total = allowed(precision, method, polygons, whole), 0
    for sign, part in parts:
        coeffs = coefficients(precision, part, 2, method, ())
        limit = limit + allowed(precision, method, part, coeffs)
        total = total + sign * back(coeffs)
    assert_within(distance(total, whole, polygons), limit, polygons)


ALL = slice(None)


@exact_methods
@pytest.mark.parametrize("name", SYMMETRIES)
def test_symmetry(precision, method, name):
    polygons = few()
    parts = [(sign, changed(polygons, v, x)) for sign, v, x in SYMMETRIES[name](polygons.vertices, polygons.x)]
    assert_same(precision, method, ALL, parts)


@exact_methods
def test_rotation(precision, method):
    turned = changed(few(), few().vertices @ TURN.T, few().x @ TURN.T)
    assert_same(precision, method, ALL, [(1, turned)], back=unturned)


@exact_methods
def test_translation(precision, method):
    """Of light and point together by whole numbers, where that is exact."""
    shift, polygons = np.array([64.0, -32.0, 16.0]), few()
    exact = lambda a: (np.float32(a + shift).astype(np.float64) - shift == a).reshape(len(polygons), -1).all(axis=1)
    rows = exact(polygons.vertices) & exact(polygons.x)
    polygons = polygons[rows]
    assert len(np.unique(polygons.kind)) > 12
    assert_same(precision, method, rows, [(1, changed(polygons, polygons.vertices + shift, polygons.x + shift))])


@methods
def test_scale_by_powers_of_two(precision, method):
    """Changes not a single bit."""
    rows = ~few().of("scaled")
    polygons = few()[rows]
    scale = 2.0 ** np.where(np.arange(len(polygons)) % 2, -20, 20)
    scaled = changed(polygons, polygons.vertices * scale[:, None, None], polygons.x * scale[:, None])
    assert np.array_equal(coefficients(precision, scaled, 2, method, ()), unchanged(precision, method)[:, rows])


@exact_methods
def test_coincident_corners(precision, method):
    """Triangles and quads as lists of 3 and 4 corners, and of 12 some of which coincide."""
    rows = np.isin(few().corners, SHORT)
    polygons, stretched = few()[rows], unchanged(precision, method)[:, rows]
    plain = coefficients(precision, polygons, 2, method, SHORT)
    assert_within(distance(plain, stretched, polygons), 2 * allowed(precision, method, polygons, plain), polygons)


@methods
def test_gradients(precision, method):
    """Finite, backward and forward; and a change of scale about x, which changes nothing, has the derivative 0.

    Cubature has nothing to give where the point is in the light, and is asked for COMPACT.
    """
    polygons = random_polygons(3000, seed=3)
    polygons = polygons[polygons.of(*COMPACT) if method == "quadrature" else ~polygons.of(*UNCERTAIN)]
    weights = np.cos(np.arange(9)).tolist()
    x, light = wide(precision, polygons.x), [wide(precision, polygons.vertices[:, k]) for k in range(CORNERS)]
    shade = lambda light, x: sum(c * w for c, w in zip(project_polygon(light, x, 2, method), weights))
    arguments = [*light, x]
    dr.enable_grad(arguments)
    dr.backward(shade(light, x))
    slopes = dr.grad(arguments)
    dr.eval(slopes)
    slopes = np.array([np.array(g) for g in slopes], dtype=float).transpose(2, 0, 1)     # (count, 13, 3)
    assert np.isfinite(slopes).all()

    parts = (polygons.vertices - polygons.x[:, None]) * slopes[:, :-1]
    generic = polygons.of("convex", "non-convex", "star", "uneven", "scaled")
    assert (np.abs(parts.sum(axis=(1, 2))) <= 300 * precision.eps * (1 + np.abs(parts).sum(axis=(1, 2))))[generic].all()

    t = precision.Float(0)
    dr.enable_grad(t)
    step = lambda k: precision.Array3(*np.cos([k, 2 * k, 3 * k]).tolist()) * t
    slope = dr.forward_to(shade([dr.detach(v) + step(k) for k, v in enumerate(light)], dr.detach(x) + step(20)))
    assert np.isfinite(np.array(slope)).all()
