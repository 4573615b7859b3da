"""Derivatives by Dr.Jit of coefficients and spatial gradients together: second derivatives against numpy, differences, limits."""
import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight import project_polygon_spatial_gradient
from mi_shlight.light import edge_frame, recurrence
from mi_shlight.light.edge_frame import project_edge_spatial
from mi_shlight.light.gradient import project_light_spatial
from mi_shlight.light.mesh import MeshLight, mesh_topology
from mi_shlight.light.polygon import EdgeBuffer, VertexList, direction, interior_direction
from mi_shlight.light.recurrence import project_recurrence_spatial
from random_polygons import polygons_from, wide
from test_degenerate import CASES as DEGENERATE

CASES = reference.reference_cases()
LARGEST = max(len(case.vertices) for case in CASES)
RECTANGLE = np.array([[-0.5, -0.4, 1.0], [0.5, -0.4, 1.0], [0.5, 0.4, 1.0], [-0.5, 0.4, 1.0]])
# Edges with normals along the axes, where the rotation to the edge's frame has a pole, and a polygon without.
POSITIONS = {
    "overhead": (RECTANGLE, (0, 0, 0)), "off the axis": (RECTANGLE, (0.5, 0.4, -0.1)), "grazing": (RECTANGLE, (2, 0, 0.9)),
    "wall": (RECTANGLE[:, [2, 0, 1]], (0, 0, 0)), "corner over the point": (RECTANGLE[:, [2, 0, 1]], (0.1, 0.5, 0.4)),
    "generic": (np.array([[-0.5, -0.4, 1.2], [0.6, -0.5, 1.0], [0.7, 0.5, 0.8], [-0.4, 0.6, 1.0]]), (0.1, 0.2, -0.1)),
}


TINY = [([(-g * s, -s, 0), (g * s, -s, 0), (2 * s, s, s), (-2 * s, s, s)], (0, 0, 0)) for s in (1e-44, 1e-30, 1e-15, 1e-6, 1e30)
        for g in (1e-20, 1e-8, 1)]
"""Squares of one over their lengths, or of one over the distance of an edge, are beyond float32."""


class PRECISE:
    """float64, for tests that need no float32."""

    Float, Array3, eps = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64, 1.2e-16


class SINGLE:
    """float32, for tests that need no float64."""

    Float, Array3, eps = dr.llvm.ad.Float, dr.llvm.ad.Array3f, 6e-8


def flat(result):
    coeffs, gradient = result
    return [*coeffs, *(value for part in gradient for value in part)]


def components(result):
    """As :py:func:`flat` of gradients that are vectors."""
    coeffs, gradient = result
    return [*coeffs, *(slope[k] for k in range(3) for slope in gradient)]


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def numbers(values):
    """Floats of one width as an array, that of the lanes last."""
    dr.eval(values)
    return np.array([np.array(value) for value in values], dtype=float)


def along(precision, function, vertices, x, by_vertices, by_x):
    """Derivative of ``function(list of vertices, x)``, a list of floats, along a motion, by forward and by reverse mode.

    `vertices`, `by_vertices`: (lanes, N, 3); `x`, `by_x`: (lanes, 3). Forward: array (values, lanes). Reverse: for fixed random weights of
    the values, the derivative of the weighted sum in each lane, and what forward mode has for it.
    """
    def moved():
        t = dr.zeros(precision.Float, len(x))
        dr.make_opaque(t)
        dr.enable_grad(t)
        v = [wide(precision, vertices[:, i]) + wide(precision, by_vertices[:, i]) * t for i in range(vertices.shape[1])]
        return t, function(v, wide(precision, x) + wide(precision, by_x) * t)

    t, values = moved()
    dr.forward(t)
    forward = numbers([dr.grad(value) for value in values])
    weights = np.random.default_rng(4).normal(size=len(forward))
    t, values = moved()
    dr.backward(sum(float(w) * value for w, value in zip(weights, values)))
    return forward, np.array(dr.grad(t)), weights @ forward


def harmonics(p, order):
    """Spherical harmonics of the directions of vectors (n, 3): (n, count). Analytic in p, for complex steps."""
    x, y, z = (p / np.sqrt((p * p).sum(axis=1, keepdims=True))).T
    out = np.empty((len(p), (order + 1) ** 2), dtype=p.dtype)
    cos, sin, sectoral = np.ones_like(x), np.zeros_like(x), np.sqrt(1 / (4 * np.pi))
    for m in range(order + 1):
        if m:
            cos, sin = x * cos - y * sin, x * sin + y * cos
            sectoral *= -np.sqrt((2 * m + 1) / (2 * m) * (2 if m == 1 else 1))
        before, now = 0, sectoral
        for l in range(m, order + 1):
            if l > m:
                a, b = np.sqrt((4 * l * l - 1) / (l * l - m * m)), np.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
                before, now = now, a * (z * now - b * before)
            out[:, l * (l + 1) + m] = now * cos
            if m:
                out[:, l * (l + 1) - m] = now * sin
    return out


def derivative_of_the_spatial_gradient(vertices, motion, order):
    """Along a motion of the vertices seen from the origin, (3 count,): a complex step through ``sum_e int (v_i x v_j) Y_lm / |p|^3 du``,
    ``p = (1 - u) v_i + u v_j``, with nodes along the angle.
    """
    step, total = 1e-30, 0
    node, weight = np.polynomial.legendre.leggauss(60)
    for k in range(len(vertices)):
        pair = [k, (k + 1) % len(vertices)]
        start, end = vertices[pair]
        area = np.linalg.norm(np.cross(start, end))
        arc = np.arctan2(area, start @ end)
        shares = np.sin(arc * (1 - node) / 2) / np.linalg.norm(start), np.sin(arc * (1 + node) / 2) / np.linalg.norm(end)
        u = (shares[1] / (shares[0] + shares[1]))[:, None]
        start, end = vertices[pair] + 1j * step * motion[pair]
        p = (1 - u) * start + u * end
        squared = (p * p).sum(axis=1)
        factors = weight * arc / 2 * squared.real / area / squared ** 1.5
        total += np.outer(np.cross(start, end), factors @ harmonics(p, order)).imag / step
    return total.ravel()


LIMITS = {"distance 1e+06": (4e-6, 2e-9), "distance": (4e-6, 2e-11), "": (4e-6, 3e-14)}
"""Relative L2 error by class of the reference set, the first key that fits: (float32, float64). Measured: 8e-7 and 6e-15, except that the
oracle loses digits of distant lights in float64: its edges, unlike ours, have terms of size 1 in a sum of size theta."""


def test_reference(precision):
    """One corner moves; errors are relative to what its motions along all axes do. Fewer corners are repeated in place: edges without
    length add nothing.
    """
    order, count, rng = 4, 25, np.random.default_rng(7)
    rows = [np.arange(LARGEST) * len(case.vertices) // LARGEST for case in CASES]
    one = [np.arange(len(case.vertices))[:, None] == 1 for case in CASES]
    motions = rng.normal(size=(len(CASES), 3))
    vertices, moves = (np.array([a[r] for a, r in zip(arrays, rows)]) for arrays in
                       ([case.vertices for case in CASES], [move * corner for move, corner in zip(motions, one)]))
    function = lambda v, x: flat(project_edge_spatial(VertexList(v), x, interior_direction(v, x), order))
    forward, reverse, weighted = along(precision, function, vertices, np.zeros((len(CASES), 3)), moves, np.zeros((len(CASES), 3)))
    errors, sizes = [], np.zeros(len(CASES))
    for k, (case, corner) in enumerate(zip(CASES, one)):
        second = [derivative_of_the_spatial_gradient(case.vertices, axis * corner, order) for axis in np.eye(3)]
        limit = next(limits for name, limits in LIMITS.items() if case.name.startswith(name))[precision.eps < 1e-10]
        for ours, slopes in ((forward[:count, k], case.gradients[1, :, :count]), (forward[count:, k], second)):
            size = np.linalg.norm(slopes) * np.linalg.norm(motions[k])
            error = np.linalg.norm(ours - motions[k] @ slopes) / size
            sizes[k] += size
            if not error <= limit:
                errors.append((case.name, error))
    assert not errors
    assert np.all(abs(reverse - weighted) <= 50 * precision.eps * sizes)


def test_finite_differences(precision):
    """Of the public function, at positions where the rotation to an edge's frame has its poles."""
    vertices, x = (np.array(part, dtype=float) for part in zip(*POSITIONS.values()))
    rng, step = np.random.default_rng(3), 1e-4
    by_vertices, by_x = rng.normal(size=vertices.shape), rng.normal(size=x.shape)
    function = lambda v, x: components(project_polygon_spatial_gradient(v, x, 4, "edge"))
    at = lambda t: numbers(function([wide(PRECISE, v) for v in (vertices + t * by_vertices).transpose(1, 0, 2)],
                                    wide(PRECISE, x + t * by_x)))
    expected = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
    forward, reverse, weighted = along(precision, function, vertices, x, by_vertices, by_x)
    for k, name in enumerate(POSITIONS):
        assert relative(forward[:, k], expected[:, k]) < (1e-5 if precision.eps > 1e-10 else 1e-9), name
    assert np.all(abs(reverse - weighted) <= 20 * precision.eps * np.linalg.norm(forward, axis=0))


@pytest.mark.parametrize("method", ["auto", "recurrence", "quadrature"])
def test_every_method_has_the_derivatives_of_the_edge_form(method):
    """The light is so far away that `auto` takes the cubature."""
    vertices, x = POSITIONS["generic"][0][None], np.array([[0.1, 0.2, -100]])
    moves, values = np.random.default_rng(6).normal(size=vertices.shape), []

    def function(v, x, method=method):
        result = components(project_polygon_spatial_gradient(v, x, 1, method))
        values.append(numbers(result))
        return result

    slopes = along(SINGLE, function, vertices, x, moves, -x)[0]
    function([wide(SINGLE, v) for v in vertices.transpose(1, 0, 2)], wide(SINGLE, x))
    assert np.array_equal(values[0], values[-1])
    assert np.array_equal(slopes, along(SINGLE, lambda v, x: function(v, x, "edge"), vertices, x, moves, -x)[0])
    assert not np.array_equal(values[0], values[-1])              # the last ones are those of the edge form


def test_loop_over_facets():
    """Inside of a symbolic loop over lights in a flat buffer, by vertices, radiance and point: reverse mode and differences."""
    number, vector, index = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64, dr.llvm.ad.UInt32
    count, order, rng = 3, 2, np.random.default_rng(8)
    triangles = RECTANGLE[:3] + rng.normal(size=(count, 3, 3)) * 0.2
    start, end = index(range(3 * count)), index([3 * k + (i + 1) % 3 for k in range(count) for i in range(3)])
    patches = index([3 * k + i for k in range(count) for i in (0, 1, 1, 2)])
    weights = [number(row.tolist()) for row in rng.normal(size=(4 * (order + 1) ** 2, 4))]

    def weighted(positions, radiance, x):
        def body(k, total, x):
            light = EdgeBuffer(positions, start, end, 3 * k, 3 * k + 3, (patches, k, k + 1), True)
            corners = [dr.gather(vector, dr.detach(positions), 3 * k + i) for i in range(3)]
            values = flat(project_light_spatial(light, x, direction(sum(corners) - 3 * dr.detach(x)), order, "edge"))
            factor = dr.gather(number, radiance, k)
            return k + 1, [dr.fma(factor, value, t) for value, t in zip(values, total)], x

        state = index(0), [number(0) for _ in weights], vector(x)
        total = dr.while_loop(state, lambda k, *_: k < count, body, mode="symbolic", max_iterations=-1)[1]
        return sum(dr.sum(w * t) for w, t in zip(weights, total))

    inputs = [triangles.ravel(), rng.uniform(1, 2, count), rng.normal(size=(3, 4)) * 0.1]
    motions = [rng.normal(size=np.shape(a)) for a in inputs]
    types = number, number, vector
    given = [kind(a.tolist()) for kind, a in zip(types, inputs)]
    dr.enable_grad(given)
    dr.backward(weighted(*given))
    slope = sum((np.array(dr.grad(a)) * motion).sum() for a, motion in zip(given, motions))
    at = lambda t: weighted(*(kind((a + t * motion).tolist()) for kind, a, motion in zip(types, inputs, motions)))[0]
    step = 1e-4
    assert slope == pytest.approx((8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step), rel=1e-9)


def test_mesh():
    """A light of two faces that share an edge has the derivatives of both, weighted by their radiance."""
    vertices, moves, x = POSITIONS["generic"][0][None], np.random.default_rng(2).normal(size=(1, 4, 3)), np.array([[0.1, 0.2, -0.1]])
    faces, radiance = [np.array([0, 1, 2]), np.array([0, 2, 3])], np.array([[2.0], [-0.5]])

    def mesh(v, x):
        light = MeshLight(dr.concat([c for p in v for c in p]), mesh_topology(faces), radiance)
        return flat(project_edge_spatial(light, x, light.apex(x)[0], 2))

    def separate(v, x):
        parts = [flat(project_edge_spatial(VertexList([v[i] for i in face]), x, interior_direction(v, x), 2)) for face in faces]
        return [2.0 * a - 0.5 * b for a, b in zip(*parts)]

    ours, expected = (along(PRECISE, function, vertices, x, moves, 0 * x) for function in (mesh, separate))
    assert relative(ours[0], expected[0]) < 1e-13 and ours[1] == pytest.approx(expected[1][0], rel=1e-12)


def test_degenerate_input_gives_no_nan(precision):
    polygons = polygons_from([*DEGENERATE.values(), *TINY])
    moves = np.random.default_rng(5).normal(size=polygons.vertices.shape)
    function = lambda v, x: components(project_polygon_spatial_gradient(v, x, 3, "edge"))
    forward, reverse, _ = along(precision, function, polygons.vertices, polygons.x, moves, 0 * polygons.x)
    for slopes in (forward, reverse[None]):
        assert np.isfinite(slopes).all(), np.array([*DEGENERATE, *TINY])[~np.isfinite(slopes).all(axis=0)]


def test_forms_agree(monkeypatch):
    """One body, several bodies, recurrences unrolled and in a loop over the lobes."""
    vertices, x = (np.array(part, dtype=float) for part in zip(*POSITIONS.values()))
    rng = np.random.default_rng(9)
    arguments = vertices, x, rng.normal(size=vertices.shape), rng.normal(size=x.shape)

    def both(form):
        forward, reverse, _ = along(PRECISE, lambda v, x: flat(form(VertexList(v), x, interior_direction(v, x), 2)), *arguments)
        return np.vstack([forward, reverse])

    whole, unrolled = both(project_edge_spatial), both(project_recurrence_spatial)
    monkeypatch.setattr(edge_frame, "BODY_SIZE", 20)
    monkeypatch.setattr(recurrence, "UNROLL_ORDER", 1)
    assert len(edge_frame._bodies(2, 2)) > 1
    for form in (unrolled, both(project_edge_spatial), both(project_recurrence_spatial)):
        assert relative(form, whole) < 1e-13
