"""Derivatives by vertices and by the shading point: reference values, finite differences, invariants, limits."""
import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight import project_polygon, project_polygon_gradient, project_polygon_spatial_gradient
from mi_shlight.light.project import METHODS
from random_polygons import polygons_from, wide
from test_degenerate import CASES as DEGENERATE

QUAD = np.array([[-0.5, -0.4, 1.2], [0.6, -0.5, 1.0], [0.7, 0.5, 0.8], [-0.4, 0.6, 1.0]])
X = np.array([0.1, 0.2, -0.1])
DOUBLE = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
GENERIC = ("triangle", "quad", "heptagon", "star", "axis-aligned")
CASES = reference.reference_cases()

ORDERS = {"auto": 14, "edge": 8, "recurrence": 8, "quadrature": 8}
"""Of the reference tests: kernels with all derivatives of order 14 take long to compile."""

# Relative L2 error by class of the reference set, the first key that fits: (float32, float64). Measured, with a factor of two to five of
# room.
BY_VERTEX = {
    "auto": {"": (5e-6, 2e-14)},
    "edge": {"": (5e-6, 2e-14)},
    "quadrature": {"": (1e-5, 1e-11)},
    "recurrence": dict.fromkeys(GENERIC, (1e-5, 1e-12)),
}
# The stored derivatives are float64: for the farthest lights their sum over the vertices keeps no more than this.
BY_POINT = {
    "auto": {"distance 1e+06": (2e-5, 3e-8), "distance": (2e-5, 1e-9), "sliver": (2e-5, 1e-9), "": (2e-5, 1e-12)},
    "edge": dict.fromkeys((*GENERIC, "near", "huge"), (5e-6, 1e-13)) | {"grazing": (2e-5, 1e-13)},
    "quadrature": dict.fromkeys((*GENERIC, "grazing", "sliver"), (2e-5, 1e-9)) | {"distance 1e+06": (2e-5, 3e-8), "distance": (2e-5, 1e-9)},
    "recurrence": dict.fromkeys(GENERIC, (1e-5, 1e-12)),
}


def numbers(values):
    """Nested lists of Dr.Jit values as an array; the last axis is that of the lanes."""
    dr.eval(values)
    plain = lambda v: [plain(c) for c in v] if isinstance(v, list) else np.array(v, dtype=np.float64)
    return np.array(plain(values))


def by_vertex(precision, vertices, x=(0, 0, 0), order=8, method="auto"):
    """(coefficients (K,), gradients (N, 3, K)) of one polygon."""
    values, gradients = project_polygon_gradient([precision.vector(v) for v in vertices], precision.vector(x), order, method)
    return numbers(values)[:, 0], numbers(gradients)[..., 0].transpose(0, 2, 1)


def by_point(precision, vertices, x=(0, 0, 0), order=8, method="auto"):
    """(coefficients (K,), gradient (3, K)) of one polygon."""
    values, gradient = project_polygon_spatial_gradient([precision.vector(v) for v in vertices], precision.vector(x), order, method)
    return numbers(values)[:, 0], numbers(gradient)[..., 0].T


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def promised(table, method, name, precision):
    limits = next((limits for start, limits in table[method].items() if name.startswith(start)), None)
    return limits and limits[precision.eps < 1e-10]


SEEN = {}


def reference_gradients(precision, method, function, order):
    """Results for all reference polygons, many at once."""
    key = precision.eps, method, function.__name__, order
    if key not in SEEN:
        SEEN[key] = {}
        for cases, stacked in reference.reference_stacks():
            vertices = [wide(precision, corner) for corner in np.swapaxes(stacked, 0, 1)]
            values, gradients = map(numbers, function(vertices, precision.vector((0, 0, 0)), order, method))
            for k, case in enumerate(cases):
                of_corners = gradients[..., k]
                if function is project_polygon_gradient:
                    of_corners = reference.merge_repeated(of_corners, len(case.vertices))
                SEEN[key][case] = values[..., k], of_corners
    return SEEN[key]


@pytest.mark.parametrize("method", METHODS)
def test_reference_by_vertex(precision, method):
    results = reference_gradients(precision, method, project_polygon_gradient, ORDERS[method])
    for case, (values, gradients) in results.items():
        assert np.isfinite(gradients).all()
        limit = promised(BY_VERTEX, method, case.name, precision)
        if limit:
            error = relative(gradients.transpose(0, 2, 1), case.gradients[..., :len(values)])
            assert error <= limit, case.name


@pytest.mark.parametrize("method", METHODS)
def test_reference_by_point(precision, method):
    results = reference_gradients(precision, method, project_polygon_spatial_gradient, 8)
    for case, (values, gradient) in results.items():
        limit = promised(BY_POINT, method, case.name, precision)
        if limit:
            error = relative(gradient.T, -case.gradients[..., :81].sum(axis=0))
            assert error <= limit, case.name


def test_every_class_has_a_promise():
    """The default method covers all of the reference set, and names in the tables are those of the set."""
    for table in (BY_VERTEX, BY_POINT):
        assert "" in table["auto"]
        for limits in table.values():
            assert all(any(case.name.startswith(name) for case in CASES) for name in limits)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("function", [project_polygon_gradient, project_polygon_spatial_gradient])
def test_coefficients_are_those_of_the_projection(precision, method, function):
    for distance in (0, 30):                          # `auto` takes the cubature at the second
        vertices, x = [precision.vector(v) for v in QUAD], precision.vector(X - (0, 0, distance))
        ours, expected = numbers(function(vertices, x, 6, method)[0]), numbers(project_polygon(vertices, x, 6, method))
        assert relative(ours, expected) < (2e-6 if precision.eps > 1e-10 else 1e-12) * (1 + distance)


@pytest.mark.parametrize("corners", [QUAD, reference.reference_cases()[9].vertices], ids=["quad", "star"])
def test_finite_differences(corners):
    """Central differences come nearer as the step shrinks, with its square, until they lose digits."""
    steps, shape = np.array([1e-1, 1e-2, 1e-3, 1e-4, 1e-5]), (len(corners), 3, 2, 5)
    moved = np.broadcast_to(corners, (*shape, *corners.shape)).copy()
    for i, k in np.ndindex(shape[:2]):
        moved[i, k, :, :, i, k] += [steps, -steps]
    moved = moved.reshape(-1, *corners.shape)
    vertices = [wide(PRECISE, moved[:, i]) for i in range(len(corners))]
    values = numbers(project_polygon(vertices, PRECISE.vector(X), 8, "edge")).reshape(81, *shape)
    expected = np.moveaxis(values[..., 0, :] - values[..., 1, :], 0, 2) / (2 * steps)
    ours = by_vertex(PRECISE, corners, X)[1]
    errors = [relative(expected[..., s], ours) for s in range(5)]
    assert errors[1] / errors[2] == pytest.approx(100, rel=0.05) and errors[2] / errors[3] == pytest.approx(100, rel=0.2)
    assert min(errors) < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_finite_differences_by_point(method):
    number, array = DOUBLE
    steps = np.array([1e-3, -1e-3, 1e-4, -1e-4])
    ours = by_point(PRECISE, QUAD, X, 8, method)[1]
    for k in range(3):
        x = array(*map(float, X))
        x[k] += number(steps)
        values = numbers(project_polygon([array(*map(float, v)) for v in QUAD], x, 8, "edge"))
        coarse, fine = (values[:, 0] - values[:, 1]) / 2e-3, (values[:, 2] - values[:, 3]) / 2e-4
        assert relative(ours[k], (100 * fine - coarse) / 99) < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_point_and_vertices_agree(precision, method):
    vertices, x = QUAD, X
    total = by_vertex(precision, vertices, x, 8, method)[1].sum(axis=0)
    assert relative(-total, by_point(precision, vertices, x, 8, method)[1]) < (2e-5 if precision.eps > 1e-10 else 1e-10)


@pytest.mark.parametrize("method", METHODS)
def test_scale_about_the_point_changes_nothing(precision, method):
    gradients = by_vertex(precision, QUAD, (0, 0, 0), 8, method)[1]
    assert np.linalg.norm(np.einsum("ik,ikl->l", QUAD, gradients)) < (1e-4 if precision.eps > 1e-10 else 1e-10) * np.linalg.norm(gradients)


@pytest.mark.parametrize("scale", [1e-12, 1e6, 1e12])
def test_derivatives_scale_like_one_over_length(precision, scale):
    gradients = by_vertex(precision, QUAD * scale, X * scale)[1] * scale
    assert relative(gradients, by_vertex(precision, QUAD, X)[1]) < 200 * precision.eps


@pytest.mark.parametrize("method", ["edge", "quadrature"])
def test_rotation_about_the_axis(method):
    """About z the coefficients m and -m turn into each other: dL_lm = -m L_l-m."""
    coeffs, gradients = by_vertex(PRECISE, QUAD, (0, 0, 0), 8, method)
    motion = np.stack([-QUAD[:, 1], QUAD[:, 0], np.zeros(4)], axis=1)
    turned = np.einsum("ik,ikl->l", motion, gradients)
    for l in range(9):
        for m in range(-l, l + 1):
            assert turned[l * (l + 1) + m] == pytest.approx(-m * coeffs[l * (l + 1) - m], abs=1e-10)


def test_border_of_a_hemisphere_moves_like_a_circle():
    """Solid angle of a regular cone of many corners: 2 pi (1 - cos a) with tan a = radius, by radius."""
    count, radius = 96, 0.7
    angle = 2 * np.pi * np.arange(count) / count
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    scale = np.sqrt(2 * np.pi / count / np.sin(2 * np.pi / count))            # of equal area
    gradients = by_vertex(PRECISE, scale * radius * outward + (0, 0, 1), (0, 0, 0), 0)[1][:, :, 0]
    slope = np.sqrt(4 * np.pi) * scale * (gradients * outward).sum()
    assert slope == pytest.approx(2 * np.pi * radius / (1 + radius ** 2) ** 1.5, rel=1e-5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("function", [project_polygon_gradient, project_polygon_spatial_gradient])
def test_degenerate_input_gives_no_nan(precision, method, function):
    polygons = polygons_from(DEGENERATE.values())
    values, gradients = function([wide(precision, polygons.vertices[:, k]) for k in range(12)], wide(precision, polygons.x), 3, method)
    assert not np.isnan(numbers(values)).any()
    if function is project_polygon_gradient or method != "quadrature":        # cubature alone says nothing about points on the light
        unbounded = ~np.isfinite(numbers(gradients))
        assert not unbounded.any(), np.array(list(DEGENERATE))[unbounded.reshape(-1, len(polygons)).any(axis=0)]


@pytest.mark.parametrize("method", METHODS)
def test_lanes_do_not_touch_each_other(precision, method):
    x = np.array([X, [np.nan, 0, 0], [0, np.inf, 0]])
    values, gradients = project_polygon_gradient([precision.vector(v) for v in QUAD], wide(precision, x), 2, method)
    alone = by_vertex(precision, QUAD, X, 2, method)[1]
    gradients = numbers(gradients)
    assert relative(gradients[..., 0].transpose(0, 2, 1), alone) < 10 * precision.eps
    assert np.isnan(gradients[..., 1:]).all()


@pytest.mark.parametrize("method", METHODS)
def test_python_floats(method):
    plain = project_polygon_gradient(QUAD.tolist(), X.tolist(), 3, method)
    assert all(type(c) is float for c in plain[0]) and type(plain[1][0][0]) is dr.scalar.Array3f64
    expected = by_vertex(PRECISE, QUAD, X, 3)
    assert relative(np.array(plain[1]).transpose(0, 2, 1), expected[1]) < 1e-10
    coeffs, gradient = project_polygon_spatial_gradient(QUAD.tolist(), X.tolist(), 3, method)
    assert relative(np.array(gradient).T, -expected[1].sum(axis=0)) < 1e-9


@pytest.mark.parametrize("order", [0, 1, 17, 22])
def test_other_orders(order):
    arguments = QUAD.tolist(), X.tolist(), order
    ours = np.array(project_polygon_gradient(*arguments)[1])
    assert relative(np.array(project_polygon_gradient(*arguments, "quadrature")[1]), ours) < 1e-10
    assert relative(np.array(project_polygon_spatial_gradient(*arguments)[1]), -ours.sum(axis=0)) < 1e-10


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("order", [0, 1])
def test_lowest_orders(precision, method, order):
    expected = np.array(project_polygon_gradient(QUAD.tolist(), X.tolist(), order)[1]).transpose(0, 2, 1)
    tolerance = 2e-5 if precision.eps > 1e-10 else 1e-11
    assert relative(by_vertex(precision, QUAD, X, order, method)[1], expected) < tolerance
    assert relative(by_point(precision, QUAD, X, order, method)[1], -expected.sum(axis=0)) < tolerance


def test_inside_a_symbolic_loop():
    number, array = dr.llvm.ad.Float, dr.llvm.ad.Array3f
    v = [array(*map(float, p)) for p in QUAD]
    weights = np.random.default_rng(2).normal(size=(6, 9))
    mixed = lambda parts, row: sum(w * part for w, part in zip(weights[row].tolist(), parts))

    def step(v, x):
        coeffs, gradients = project_polygon_gradient(v, x, 2)
        slopes = project_polygon_spatial_gradient(v, x, 2)[1]
        return mixed(coeffs, 0) + sum(mixed(g, 1 + i) for i, g in enumerate(gradients)) + mixed(slopes, 5)

    def body(i, total, x):
        return i + 1, total + step(v, array(x.x, x.y, x.z - number(i))), x

    x = array(0.1, 0.2, 0.0)
    dr.make_opaque(x)
    total = dr.while_loop((dr.llvm.ad.UInt32(0), array(0), x), lambda i, *_: i < 3, body, mode="symbolic")[1]
    expected = sum(np.array(step(QUAD.tolist(), [0.1, 0.2, -float(i)])) for i in range(3))
    assert np.allclose(numbers([total])[0, :, 0], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("method", ["edge", "auto", "recurrence"])
@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-10])
def test_close_to_an_edge(method, distance):
    """Derivatives by the point grow as one over its distance from the border; order 2, where the solid angle's jump does not count."""
    corners = [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (-2.0, 1.0, 0.0), (-2.0, -1.0, 0.0)]
    direction, motion = np.array([1, 0, 0.3]), [-0.3, 0, 1]
    gradient = np.array(project_polygon_spatial_gradient(corners, (distance * direction).tolist(), 2, method)[1]) @ motion
    step = distance * 1e-2
    at = lambda k: np.array(project_polygon(corners, (distance * direction + k * step * np.array(motion)).tolist(), 2, "edge"))
    assert relative((at(-2) - 8 * at(-1) + 8 * at(1) - at(2)) / (12 * step), gradient) < 1e-6
    assert np.linalg.norm(gradient) > 0.1 / distance


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("function", [project_polygon_gradient, project_polygon_spatial_gradient])
def test_tiny_lights_with_close_edges(precision, method, function):
    size, gap = (np.ravel(part) for part in np.meshgrid(10.0 ** np.arange(-44, 31, 3), 10.0 ** np.arange(-20, 0, 2)))
    near, far = size * gap, 2 * size
    corners = [(near, -size, 0 * size), (near, size, 0 * size), (-far, size, size), (-far, -size, size)]
    with np.errstate(over="ignore", under="ignore"):
        vertices = [wide(precision, np.stack(corner, axis=1)) for corner in corners]
    values, gradients = function(vertices, precision.vector((0, 0, 0)), 3, method)
    assert np.isfinite(numbers(values)).all() and np.isfinite(numbers(gradients)).all()


@pytest.mark.parametrize("function", [project_polygon_gradient, project_polygon_spatial_gradient])
@pytest.mark.parametrize("arguments, error, text", [
    ({"order": 65}, ValueError, "'order' must be an integer from 0 to 64, got 65"),
    ({"method": "fast"}, ValueError, "'method' must be one of 'auto', 'recurrence', 'edge', 'quadrature', got 'fast'"),
    ({"vertices": QUAD[:2].tolist()}, ValueError, "'vertices' must have at least three entries"),
    ({"x": (0, 0)}, TypeError, "'x' must be a 3-vector"),
    ({"vertices": [1, 2, 3]}, TypeError, "'vertices' must be a list of 3-vectors, got .* coordinates of a single one"),
])
def test_bad_arguments(function, arguments, error, text):
    with pytest.raises(error, match=rf"{function.__name__}\(\): " + text):
        function(**{"vertices": QUAD.tolist(), "x": (0, 0, 0), "order": 2, **arguments})


class PRECISE:
    """float64, for tests that need no float32."""

    Float, Array3, eps = *DOUBLE, 1.2e-16
    vector = staticmethod(lambda v: DOUBLE[1](*map(float, v)))
