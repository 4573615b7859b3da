"""Shading as a differentiable operation: against coefficients, other derivatives, and in the places where it may stand."""
import functools
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest

from autodiff import derivative
from mi_shlight import project_polygon, project_polygon_gradient, shade_polygon, shade_polygon_gradient
from mi_shlight.light.polygon import VertexList, interior_direction
from mi_shlight.light.project import METHODS
from mi_shlight.light.recurrence import recurrence_shader
from random_polygons import polygons_from, random_polygons, wide
from test_degenerate import CASES as DEGENERATE

QUAD = np.array([[-0.5, -0.4, 1.2], [0.6, -0.5, 1.0], [0.7, 0.5, 0.8], [-0.4, 0.6, 1.0]])
PENTAGON = np.array([[-0.6, -0.5, 1.1], [0.5, -0.6, 1.1], [0.8, 0.3, 1.1], [0, 0.9, 1.1], [-0.7, 0.4, 1.1]])
POLYGONS = {4: QUAD, 5: PENTAGON}
ORDER = 4
TRANSFER = np.cos(np.arange((ORDER + 1) ** 2))
X = np.array([[0.1, 0.2, -0.1], [-0.3, 0.1, 0.2], [0.2, -0.1, -40]]).T            # the last one by cubature
ad = dr.llvm.ad


def arrays(precision, corners=QUAD):
    """(vertices, x, transfer): single vertices, wide points."""
    x = precision.Array3(*(precision.Float(c.tolist()) for c in X))
    return [precision.vector(v) for v in corners], x, [precision.Float(float(t)) for t in TRANSFER]


@functools.lru_cache(maxsize=None)
def slopes_by_cubature(sides):
    """Derivatives (N, 3, points) of the dot product with TRANSFER, in float64, from those of the coefficients."""
    double = SimpleNamespace(Array3=ad.Array3f64, Float=ad.Float64, vector=lambda v: ad.Array3f64(*map(float, v)))
    vertices, x, _ = arrays(double, POLYGONS[sides])
    slopes = project_polygon_gradient(vertices, x, ORDER, "quadrature")[1]
    dr.eval(slopes)
    return np.einsum("k,ikcl->icl", TRANSFER, np.array([[np.array(v) for v in s] for s in slopes]))


@pytest.mark.parametrize("method, sides", [*((method, 4) for method in METHODS), ("edge", 5), ("auto", 5)])
def test_value_and_gradients(precision, method, sides):
    """The dot product with the coefficients and with their derivatives, which other code computes."""
    vertices, x, transfer = arrays(precision, POLYGONS[sides])
    (value, gradients), coeffs = shade_polygon_gradient(vertices, x, transfer, ORDER, method), project_polygon(vertices, x, ORDER, method)
    dr.eval(value, gradients, coeffs)
    unit = precision.eps * np.linalg.norm(TRANSFER)
    assert np.allclose(value, TRANSFER @ np.array(coeffs), rtol=0, atol=40 * unit)
    assert np.allclose(value, shade_polygon(vertices, x, transfer, ORDER, method), rtol=0, atol=10 * unit)
    atol = max(60 * unit, 1e-11) if precision.eps < 1e-10 else 2e-5
    assert np.allclose(np.array(gradients), slopes_by_cubature(sides), rtol=0, atol=atol)


def test_reverse_and_forward_mode(precision):
    """<J v, w> = <v, J^T w> over vertices, points and transfer together, each mode against the analytic derivatives."""
    vertices, x, transfer = arrays(precision)
    rng = np.random.default_rng(1)
    by_v, by_x, by_t, weight = (rng.normal(size=shape) for shape in ((4, 3), X.shape, TRANSFER.shape, X.shape[1]))
    dr.enable_grad(vertices, x, transfer)
    result = shade_polygon(vertices, x, transfer, ORDER)
    for v, by in zip(vertices, by_v):
        dr.set_grad(v, precision.vector(by))
    dr.set_grad(x, precision.Array3(*(precision.Float(c.tolist()) for c in by_x)))
    for t, by in zip(transfer, by_t):
        dr.set_grad(t, precision.Float(float(by)))
    forward = np.array(dr.forward_to(result), dtype=float)

    coeffs, slopes = (np.array(part, dtype=float) for part in project_numbers(precision))
    by_vertex = np.einsum("k,ikcl->icl", TRANSFER, slopes)
    expected = np.einsum("icl,ic->l", by_vertex, by_v) - np.einsum("icl,cl->l", by_vertex, by_x) + by_t @ coeffs
    scale = np.abs(by_vertex).sum()
    assert np.allclose(forward, expected, rtol=0, atol=30 * precision.eps * scale)

    vertices, x, transfer = arrays(precision)
    dr.enable_grad(vertices, x, transfer)
    dr.backward(shade_polygon(vertices, x, transfer, ORDER) * precision.Float(weight.tolist()))
    dr.eval(dr.grad([vertices, x, transfer]))
    grad_v, grad_x = (np.array(part, dtype=float) for part in ([dr.grad(v) for v in vertices], dr.grad(x)))
    grad_t = np.array([dr.grad(t) for t in transfer], dtype=float)
    assert np.allclose(grad_v[..., 0], by_vertex @ weight, rtol=0, atol=30 * precision.eps * scale)
    assert np.allclose(grad_t[..., 0], coeffs @ weight, rtol=0, atol=60 * precision.eps * np.abs(coeffs).sum())
    both = (grad_v[..., 0] * by_v).sum() + (grad_x * by_x).sum() + grad_t[..., 0] @ by_t
    assert both == pytest.approx(forward @ weight, abs=60 * precision.eps * scale)


def project_numbers(precision):
    vertices, x, _ = arrays(precision)
    coeffs, slopes = project_polygon_gradient(vertices, x, ORDER)
    return [np.array(c) for c in coeffs], [[np.array(v) for v in s] for s in slopes]


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_against_autodiff_through_the_recurrence(precision, mode):
    """The same derivative twice: analytic, and by Dr.Jit through the loops of the papers' recurrence."""
    near = X[:, 0]

    def moved(t):
        motion = [precision.Array3(t, 0.5 * t, -t), precision.Array3(0.2 * t, t, 0), precision.Array3(0, -t, t), precision.Array3(t, t, t)]
        return [precision.vector(v) + m for v, m in zip(QUAD, motion)], precision.vector(near) + precision.Array3(0, t, 0.3 * t)

    transfer = [precision.Float(float(t)) for t in TRANSFER]

    def recurrence(t):
        vertices, x = moved(t)
        return recurrence_shader(transfer, ORDER)(VertexList(vertices), x, interior_direction(vertices, x))

    def analytic(t):
        vertices, x = moved(t)
        return shade_polygon(vertices, x, transfer, ORDER)

    ours, theirs = (derivative(f, precision.Float, mode) for f in (analytic, recurrence))
    assert ours == pytest.approx(theirs, rel=200 * precision.eps)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("distance", [0.5, 30.0, 1e4])
def test_finite_differences(method, distance):
    """Derivatives along a motion of all that can move, at three distances; what `auto` chooses does not show."""
    number, array = ad.Float64, ad.Array3f64
    transfer = [number(float(t)) for t in TRANSFER]

    def value(t, method):
        vertices = [array(*map(float, v)) for v in QUAD]
        vertices[1] = vertices[1] + array(t, -t, 0.5 * t)
        vertices[3] = vertices[3] + array(0, t, t)
        x = array(0.1, 0.2, 1.2 - distance) + array(t, 0, -t)
        return shade_polygon(vertices, x, transfer, ORDER, method)

    t = number(0)
    dr.enable_grad(t)
    dr.backward(value(t, method))
    steps = [(value(number(h), "edge")[0] - value(number(-h), "edge")[0]) / (2 * h) for h in (1e-3, 2e-3)]
    assert dr.grad(t)[0] == pytest.approx((4 * steps[0] - steps[1]) / 3, rel=1e-8 + 3e-14 * distance ** 2)


@pytest.mark.parametrize("precision", ["float32"], indirect=True)
def test_one_kernel_takes_all_derivatives(precision):
    """Sums over the points of twelve coordinates come from one evaluation."""
    def derivatives():
        vertices, x, transfer = arrays(precision)
        dr.enable_grad(vertices)
        dr.make_opaque(x, transfer)
        dr.backward(shade_polygon(vertices, x, transfer, ORDER, "edge"))
        dr.eval([dr.grad(v) for v in vertices])

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        derivatives()
        large = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT and k["operation_count"] > 300]
    assert len(large) == 1


@pytest.mark.parametrize("method", ["edge", "auto"])
def test_in_a_symbolic_loop(precision, method):
    """A user's loop over lights, in reverse mode: attached vertices live outside of it or are its state."""
    transfer = [precision.Float(float(t)) for t in TRANSFER]
    index = dr.uint32_array_t(precision.Float)

    def total(t, mode):
        x = precision.vector(X[:, 0]) + precision.Array3(t, 0, -t)

        def body(i, total, x):
            vertices = [precision.vector(v) + precision.Array3(0, 0, precision.Float(i)) for v in QUAD]
            return i + 1, total + shade_polygon(vertices, x, transfer, ORDER, method), x

        return dr.while_loop((index(0), precision.Float(0), x), lambda i, *_: i < 3, body, mode=mode, max_iterations=-1)[1]

    results = []
    for mode in ("symbolic", "evaluated"):
        for direction in ("forward", "backward"):
            results.append(derivative(lambda t: total(t, mode), precision.Float, direction))
    step = 1e-3
    value = lambda t: sum(shade_polygon((QUAD + (0, 0, i)).tolist(), (X[:, 0] + (t, 0, -t)).tolist(), TRANSFER.tolist(), ORDER)
                          for i in range(3))
    coarse, fine = ((value(h) - value(-h)) / (2 * h) for h in (2 * step, step))
    assert np.allclose(results, (4 * fine - coarse) / 3, rtol=1e-5 if precision.eps > 1e-10 else 1e-8)


def test_vertices_as_loop_state():
    """Vertices with derivatives inside of somebody else's symbolic loop: no unrolling of edges, no local memory in the way."""
    number, array = ad.Float64, ad.Array3f64
    transfer = [number(float(t)) for t in TRANSFER]

    def total(t):
        vertices = [array(*map(float, v)) + array(t, 0, 0.1 * t) for v in QUAD]

        def body(i, total, vertices):
            x = array(0.1, 0.2, -number(i))
            return i + 1, total + shade_polygon(vertices, x, transfer, ORDER), vertices

        return dr.while_loop((ad.UInt32(0), number(0), vertices), lambda i, *_: i < 3, body, mode="symbolic", max_iterations=-1)[1]

    difference = (total(number(1e-4))[0] - total(number(-1e-4))[0]) / 2e-4
    for mode in ("forward", "backward"):
        assert derivative(total, number, mode) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("flow", ["loop", "if"])
def test_single_vertices_and_many_points_in_control_flow(flow):
    number, array = ad.Float, ad.Array3f
    points = np.array([[0.1, -0.2, 0.3], [0.2, 0, -0.1], [0, 0.1, 0]])

    def slopes(symbolic):
        vertices, transfer = [array(*map(float, v)) for v in QUAD], [number(float(t)) for t in TRANSFER]
        x = array(*(number(c.tolist()) for c in points))
        dr.make_opaque(x)
        dr.enable_grad(vertices, transfer)
        shade = lambda x, v, t: shade_polygon(v, x, t, ORDER)
        if not symbolic:
            value = shade(x, vertices, transfer) * number([3, 3, 3] if flow == "loop" else [1, 0, 1])
        elif flow == "loop":
            value = dr.while_loop((ad.UInt32(0), number(0), x, vertices, transfer), lambda i, *_: i < 3,
                                  lambda i, total, x, v, t: (i + 1, total + shade(x, v, t), x, v, t), mode="symbolic", max_iterations=-1)[1]
        else:
            value = dr.if_stmt((x, vertices, transfer), ad.Bool([True, False, True]), shade, lambda *_: number(0), mode="symbolic")
        dr.backward(value)
        dr.eval(dr.grad([vertices, transfer]))
        return np.array([np.array(dr.grad(v)) for v in vertices]), np.array([np.array(dr.grad(t)) for t in transfer])

    for inside, plain in zip(slopes(True), slopes(False)):
        assert np.abs(plain).max() > 0.01 and np.allclose(inside, plain, rtol=1e-5, atol=1e-6)


def test_in_a_symbolic_call():
    number, array = ad.Float, ad.Array3f
    transfers = [[number(float(t) * scale) for t in TRANSFER] for scale in (1, -2)]

    def value(t):
        vertices = [array(*map(float, v)) + array(t, 0, 0.1 * t) for v in QUAD]
        x = array(number([0.1, 0.3]), 0.2, 0)
        index = ad.UInt32([0, 1])
        dr.make_opaque(index)
        branches = [lambda x, v, transfer=transfer: shade_polygon(v, x, transfer, ORDER) for transfer in transfers]
        return dr.sum(dr.switch(index, branches, x, vertices))

    plain = lambda t: sum(scale * shade_polygon((QUAD + (t, 0, 0.1 * t)).tolist(), (x, 0.2, 0.0), TRANSFER.tolist(), ORDER)
                          for x, scale in ((0.1, 1), (0.3, -2)))
    for mode in ("forward", "backward"):
        assert derivative(value, number, mode) == pytest.approx((plain(1e-4) - plain(-1e-4)) / 2e-4, rel=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_frozen(method):
    number, array = ad.Float, ad.Array3f
    transfer = [dr.opaque(number, float(t)) for t in TRANSFER]

    def slope(vertices, x, transfer):
        dr.enable_grad(vertices)
        value = shade_polygon(vertices, x, transfer, ORDER, method)
        dr.backward(value)
        return dr.detach(value), [dr.grad(v) for v in vertices]

    frozen = dr.freeze(slope)
    for shift in (0.0, 0.1, 0.2):
        given = lambda: ([array(*(dr.opaque(number, float(c)) for c in v + shift)) for v in QUAD],
                         array(*(number(c.tolist()) for c in X)), transfer)
        results = slope(*given()), frozen(*given())
        dr.eval(results)
        for plain, replayed in zip(*results):
            assert np.allclose(np.array(plain), np.array(replayed), rtol=1e-5, atol=1e-6)
    assert frozen.n_recordings == 1


def test_a_lane_without_weight_spoils_nothing():
    """Only lanes that are asked for count, whatever the others hold."""
    number, array = ad.Float, ad.Array3f
    vertices, transfer = [array(*map(float, v)) for v in QUAD], [number(float(t)) for t in TRANSFER]
    dr.enable_grad(vertices)
    x = array(number([0.1, np.nan]), 0.2, 0)
    value = shade_polygon(vertices, x, transfer, ORDER)
    assert np.isnan(np.array(value)).tolist() == [False, True]
    dr.backward(dr.select(dr.isfinite(value), value, 0))
    alone = shade_polygon_gradient(vertices, array(0.1, 0.2, 0), transfer, ORDER)[1]
    dr.eval(alone, dr.grad(vertices))
    assert np.allclose([np.array(dr.grad(v)) for v in vertices], [np.array(g) for g in alone], rtol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_degenerate_input_gives_no_nan(precision, method):
    polygons = polygons_from(DEGENERATE.values())
    vertices, x = [wide(precision, polygons.vertices[:, k]) for k in range(12)], wide(precision, polygons.x)
    transfer = [precision.Float(float(t)) for t in TRANSFER]
    dr.enable_grad(vertices, x, transfer)
    value = shade_polygon(vertices, x, transfer, ORDER, method)
    dr.backward(value)
    parts = [value, *dr.grad([*vertices, x, *transfer])]
    dr.eval(parts)
    for part in parts:
        assert np.isfinite(np.array(part)).all()


def test_random_polygons(precision):
    """Every kind of polygon, thousands of times: derivatives are finite, and float32 errs against float64 by its rounding.

    Where the border is seen at an angle T an edge's share grows as 1 / cos(T / 2), and so does what its rounding makes of it.
    """
    polygons, order = random_polygons(20000, seed=7), 3
    weights = np.cos(np.arange((order + 1) ** 2))

    def gradients(number, array):
        kind = type("Kind", (), {"Float": number, "Array3": array, "eps": dr.epsilon(number)})
        vertices, x = [wide(kind, polygons.vertices[:, k]) for k in range(12)], wide(kind, polygons.x)
        value, slopes = shade_polygon_gradient(vertices, x, [number(float(t)) for t in weights], order)
        dr.eval(value, slopes)
        return np.array(value, dtype=float), np.array([np.array(g, dtype=float) for g in slopes])

    value, ours = gradients(precision.Float, precision.Array3)
    assert np.isfinite(value).all() and np.isfinite(ours).all()
    if precision.eps > 1e-10:
        exact = gradients(ad.Float64, ad.Array3f64)[1]
        distance = np.linalg.norm(polygons.vertices - polygons.x[:, None], axis=-1).T
        error = (np.linalg.norm(ours - exact, axis=1) * distance).max(axis=0)
        usual = (polygons.arcs.max(axis=1) < 3) & (distance.min(axis=0) > 1e-25)
        assert usual.mean() > 0.5
        assert (error[usual] / np.abs(weights).sum()).max() < 30 * precision.eps     # measured: 10, and 5 for 99.9 %


@pytest.mark.parametrize("corners", [QUAD, PENTAGON], ids=["quad", "pentagon"])
def test_python_floats(corners):
    value, gradients = shade_polygon_gradient(corners.tolist(), X[:, 0].tolist(), TRANSFER, ORDER)
    assert type(value) is float and value == pytest.approx(shade_polygon(corners.tolist(), X[:, 0].tolist(), TRANSFER.tolist(), ORDER))
    shifted = corners.copy()
    shifted[2, 1] += 1e-6
    difference = (shade_polygon(shifted.tolist(), X[:, 0].tolist(), TRANSFER.tolist(), ORDER) - value) / 1e-6
    assert gradients[2][1] == pytest.approx(difference, rel=1e-4)


@pytest.mark.parametrize("function", [shade_polygon, shade_polygon_gradient])
@pytest.mark.parametrize("arguments, error, text", [
    ({"order": -1}, ValueError, "'order' must be an integer from 0 to 64, got -1"),
    ({"method": 3}, TypeError, "'method' must be one of"),
    ({"vertices": QUAD[:2].tolist()}, ValueError, "'vertices' must have at least three entries"),
    ({"transfer": [0.0] * 8}, ValueError, "'transfer' must be a list of 9 floats, got .* one entry for each l and m up to 'order'"),
    ({"transfer": 0.0}, TypeError, "'transfer' must be a list of 9 floats"),
    ({"transfer": ["a"] * 9}, TypeError, "'transfer' must be a list of 9 floats"),
    ({"transfer": [ad.Float(0)] * 9}, TypeError, "'transfer' must be a list of 9 floats, Dr.Jit floats only together with Dr.Jit vectors"),
])
def test_bad_arguments(function, arguments, error, text):
    with pytest.raises(error, match=rf"{function.__name__}\(\): " + text):
        function(**{"vertices": QUAD.tolist(), "x": (0, 0, 0), "transfer": [0.0] * 9, "order": 2, **arguments})
