"""Projection of polygons: reference values, independent oracles, invariants, types."""
import drjit as dr
import numpy as np
import pytest

import reference
from autodiff import derivative
from mi_shlight import project_polygon, sh_basis
from mi_shlight.light import recurrence
from mi_shlight.light.polygon import EdgeBuffer, VertexList, interior_direction
from mi_shlight.light.project import default_error, light_shader, prefers_cubature
from mi_shlight.light.quadrature import demand
from random_polygons import wide

QUAD = np.array([[-0.5, -0.4, 1.2], [0.6, -0.5, 1.0], [0.7, 0.5, 0.8], [-0.4, 0.6, 1.0]])
CONCAVE = np.array([[-1, -1, 1.5], [1, -1, 1.5], [1, 1, 1.5], [0, -0.2, 1.5], [-1, 1, 1.5]], dtype=float)

# Relative L2 error at order 14 by class of the reference set, the first key that fits: (float32, float64).
GENERIC = ("triangle", "quad", "heptagon", "star", "axis-aligned")
PROMISED = {
    "auto": {"grazing 1e-06": (1e-5, 1e-9), "sliver 1e-06": (1e-5, 1e-9), "grazing": (1e-5, 1e-9), "sliver": (1e-5, 1e-9),
             "distance": (1e-5, 1e-9), "near": (4e-6, 1e-9), "huge": (4e-6, 1e-9), "": (4e-6, 1e-12)},
    "edge": dict.fromkeys(GENERIC, (5e-6, 1e-12)) | {"near": (5e-6, 1e-12), "huge": (5e-6, 1e-12)},
    "recurrence": dict.fromkeys(GENERIC, (5e-6, 1e-12)),
    "quadrature": dict.fromkeys(GENERIC, (4e-6, 1e-10)) | dict.fromkeys(("distance", "grazing", "sliver"), (4e-6, 1e-12)),
}


def tolerance(precision, method, units):
    """Invariants hold to some rounding units; cubature to the error that it aims at, within a factor."""
    return max(units * precision.eps, (2e-5 if precision.eps > 1e-10 else 2e-11) if method == "quadrature" else 0)


@pytest.fixture(params=["recurrence", "edge", "quadrature", "auto"])
def method(request):
    return request.param


def project(precision, vertices, x=(0, 0, 0), order=8, method="auto"):
    coeffs = project_polygon([precision.vector(v) for v in vertices], precision.vector(x), order, method)
    return np.array([c[0] for c in coeffs], dtype=float)


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


REFERENCE = {}


def reference_coefficients(precision, method):
    """Coefficients of order 14 of all reference polygons, many at once."""
    key = precision.eps, method
    if key not in REFERENCE:
        REFERENCE[key] = {}
        for cases, stacked in reference.reference_stacks(*((3, 4) if method == "quadrature" else ())):       # which loses by repetition
            vertices = [wide(precision, corner) for corner in np.swapaxes(stacked, 0, 1)]
            coeffs = project_polygon(vertices, precision.vector((0, 0, 0)), 14, method)
            dr.eval(coeffs)
            REFERENCE[key].update(zip(cases, np.array([np.array(c) for c in coeffs], dtype=float).T))
    return REFERENCE[key]


@pytest.mark.parametrize("case", reference.reference_cases(), ids=lambda c: c.name)
def test_reference(precision, method, case):
    error = relative(reference_coefficients(precision, method)[case], case.coefficients)
    promised = next((limits for name, limits in PROMISED[method].items() if case.name.startswith(name)), None)
    if promised:
        assert error <= promised[precision.eps < 1e-10]
    elif method == "quadrature":
        pytest.skip("near and huge lights are not for cubature")
    else:
        # A boundary form subtracts edge terms of the size of the perimeter to get the solid angle, and the frame of an edge of
        # length t has an error of eps / t.
        omega = case.coefficients[0] * np.sqrt(4 * np.pi)
        unit = case.vertices / np.linalg.norm(case.vertices, axis=1, keepdims=True)
        edges = np.linalg.norm(unit - np.roll(unit, 1, axis=0), axis=1)
        assert error <= 30 * precision.eps * max(edges.sum() / omega, 1) / min(edges.min(), 1)


@pytest.mark.parametrize("polygon, order", [(QUAD, order) for order in (0, 1, 2, 3, 8, 13)] + [(CONCAVE, 2), (CONCAVE, 24)])
def test_quadrature(polygon, method, order):
    """In Python floats, which compile nothing."""
    ours = np.array(project_polygon(polygon.tolist(), (0.1, 0.2, -0.1), order, method))
    assert relative(ours, reference.coefficients_quadrature(polygon, (0.1, 0.2, -0.1), order, n=48)) < 1e-11


@pytest.mark.parametrize("order", [8, 15])
def test_quadrature_of_compiled_code(method, order):
    p = [dr.llvm.ad.Array3f64(*map(float, v)) for v in CONCAVE]
    ours = np.array([c[0] for c in project_polygon(p, dr.llvm.ad.Array3f64(0.1, 0.2, -0.1), order, method)])
    assert relative(ours, reference.coefficients_quadrature(CONCAVE, (0.1, 0.2, -0.1), order, n=48)) < 1e-11


@pytest.mark.parametrize("order", [17, 24])
def test_lobe_loop_equals_unrolled(order):
    v, x = [dr.llvm.ad.Array3f64(*map(float, p)) for p in QUAD], dr.llvm.ad.Array3f64(0, 0, 0)
    looped = np.array([c[0] for c in project_polygon(v, x, order, "recurrence")])
    scalar = np.array(project_polygon(QUAD.tolist(), [0.0, 0.0, 0.0], order, "recurrence"))
    assert relative(looped, scalar) < 1e-12


def test_whole_sphere(precision, method):
    """Eight octants as lanes, with the corners that test_reference has compiled for."""
    signs = 1.0 - 2 * np.array(list(np.ndindex(2, 2, 2)))
    octants = np.array([(np.eye(3) * s)[:: int(np.prod(s))] for s in signs])
    count = 3 if method == "quadrature" else reference.reference_stacks()[0][1].shape[1]
    corners = octants[:, np.arange(count) * 3 // count]
    coeffs = project_polygon([wide(precision, corner) for corner in np.swapaxes(corners, 0, 1)], precision.vector((0, 0, 0)), 14, method)
    dr.eval(coeffs)
    coeffs = np.array([np.array(c) for c in coeffs], dtype=float)
    assert coeffs[0] * np.sqrt(4 * np.pi) == pytest.approx(np.pi / 2, rel=20 * precision.eps)
    expected = np.zeros(225)
    expected[0] = np.sqrt(4 * np.pi)
    assert np.abs(coeffs.sum(axis=1) - expected).max() < 100 * precision.eps


@pytest.mark.parametrize("vertices, solid_angle", [
    ([(0, 1, 0), (0, 1, 1), (1, 0, 1), (1, 0, 0)], np.arccos(1 / 3)),
    ([(-1e4, -1e4, 1), (1e4, -1e4, 1), (1e4, 1e4, 1), (-1e4, 1e4, 1)], 4 * np.arctan(1e8 / np.sqrt(2e8 + 1))),
])
def test_solid_angle(precision, vertices, solid_angle):
    value = project(precision, vertices, order=0)[0] * np.sqrt(4 * np.pi)
    assert value == pytest.approx(solid_angle, rel=40 * precision.eps)


def test_subdivision_adds(precision):
    middle = QUAD.mean(axis=0)
    parts = sum(project(precision, [QUAD[i], QUAD[(i + 1) % 4], middle], order=8) for i in range(4))
    whole = sum(project(precision, t, order=8) for t in (QUAD[[0, 1, 2]], QUAD[[0, 2, 3]]))
    assert relative(parts, whole) < 300 * precision.eps


def test_concave_equals_triangles(precision, method):
    parts = sum(project(precision, CONCAVE[list(t)], order=8, method=method) for t in ((0, 1, 3), (1, 2, 3), (0, 3, 4)))
    assert relative(project(precision, CONCAVE, order=8, method=method), parts) < tolerance(precision, method, 100)


def test_winding_and_start_vertex(precision):
    forward = project(precision, QUAD)
    assert relative(-project(precision, QUAD[::-1]), forward) < 60 * precision.eps
    assert relative(project(precision, np.roll(QUAD, 1, axis=0)), forward) < 60 * precision.eps


@pytest.mark.parametrize("scale", [1e-12, 1e-3, 1e6, 1e12])
def test_scale_about_x_changes_nothing(precision, scale):
    assert relative(project(precision, QUAD * scale), project(precision, QUAD)) < 100 * precision.eps


def test_rotation_equivariance():
    rng = np.random.default_rng(3)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    p = [dr.llvm.ad.Array3f64(*map(float, v)) for v in QUAD]
    turned = [dr.llvm.ad.Array3f64(*map(float, rotation @ v)) for v in QUAD]
    x = dr.llvm.ad.Array3f64(0, 0, 0)
    a, b = (np.array([c[0] for c in project_polygon(v, x, 8)]) for v in (p, turned))
    assert np.allclose(reference.sh_basis(directions, 8) @ a, reference.sh_basis(directions @ rotation.T, 8) @ b, atol=1e-13)


def test_far_light_is_a_point_light():
    d = np.array([0.36, 0.48, 0.8])
    u, v = np.array([0.8, -0.6, 0]), np.array([0.48, 0.64, -0.6])
    light = [1e3 * d + s * u + t * v for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    p = [dr.llvm.ad.Array3f64(*map(float, w)) for w in light]
    coeffs = np.array([c[0] for c in project_polygon(p, dr.llvm.ad.Array3f64(0, 0, 0), 8)])
    expected = np.array(sh_basis(d.tolist(), 8)) * 4 / 1e6
    assert relative(np.sign(coeffs[0]) * coeffs, expected) < 1e-4


@pytest.mark.parametrize("order", [0, 1, 8, 15])
def test_shader_equals_dot_product(precision, method, order):
    transfer = [precision.Float(float(t)) for t in np.cos(np.arange((order + 1) ** 2))]
    v, x = [precision.vector(p) for p in QUAD], precision.vector((0.1, 0.2, 0.1))
    shaded = light_shader(transfer, order, method)(VertexList(v), x, interior_direction(v, x))[0]
    same_points = default_error(precision.Float(0))                             # of cubature
    coeffs = np.array(project_polygon(QUAD.tolist(), (0.1, 0.2, 0.1), order, method, max_error=same_points))
    expected = np.cos(np.arange((order + 1) ** 2)) @ coeffs
    assert shaded == pytest.approx(expected, abs=30 * (order + 1) * precision.eps * np.abs(coeffs).max())


def test_wide_points_equal_single_ones(precision):
    points = np.array([(0, 0, 0), (0.3, -0.2, 0.1), (0, 0, 3)])
    coeffs = project_polygon([precision.vector(v) for v in QUAD], wide(precision, points), 4)
    dr.eval(coeffs)
    together = np.array([np.array(c) for c in coeffs]).T
    for row, point in zip(together, points):
        assert np.allclose(row, project_polygon(QUAD.tolist(), point.tolist(), 4), rtol=0, atol=10 * precision.eps)


def test_inside_a_symbolic_loop():
    """The engine can be called from a user's own loop, on values that exist only while it is recorded."""
    number, array = dr.llvm.ad.Float, dr.llvm.ad.Array3f
    v = [array(*map(float, p)) for p in QUAD]

    def body(i, total, x):
        return i + 1, total + sum(project_polygon(v, array(x.x, x.y, x.z - number(i)), 3)), x

    x = array(0.1, 0.2, 0.0)
    dr.make_opaque(x)
    total = dr.while_loop((dr.llvm.ad.UInt32(0), number(0), x), lambda i, *_: i < 3, body, mode="symbolic")[1]
    precise = sum(np.sum(project_polygon(QUAD.tolist(), [0.1, 0.2, -float(i)], 3)) for i in range(3))
    assert total[0] == pytest.approx(precise, rel=1e-5)


@pytest.mark.parametrize("moving", ["vertex", "point"])
def test_autodiff_matches_finite_difference(moving, method):
    number, array = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    weight = np.cos(np.arange(81))

    def value(t):
        vertices = [array(*map(float, p)) for p in QUAD]
        x = array(0.0, 0.1, 0.0)
        if moving == "vertex":
            vertices[2] = vertices[2] + array(t, 0.5 * t, -t)
        else:
            x = x + array(t, 0.5 * t, -t)
        return sum(c * w for c, w in zip(project_polygon(vertices, x, 8, method), weight))

    t = number(0.05)
    dr.enable_grad(t)
    dr.backward(value(t))
    central = (value(number(0.05 + 1e-5))[0] - value(number(0.05 - 1e-5))[0]) / 2e-5
    assert dr.grad(t)[0] == pytest.approx(central, rel=1e-7)


def along_a_ray(number, array, distance):
    direction = np.array([0.36, 0.48, -0.8])
    # on a grid, so that vertex minus point is exact in float32, too
    return array(*(number((np.round((0.1 + c * distance) * 256) / 256).tolist()) for c in direction))


def test_auto_has_no_seam():
    """From 0.05 to 5e4 sizes both forms are in use, and a change from one to the other is no larger than rounding."""
    distance = np.geomspace(0.05, 5e4, 3000)
    results = []
    for number, array in ((dr.llvm.ad.Float, dr.llvm.ad.Array3f), (dr.llvm.ad.Float64, dr.llvm.ad.Array3f64)):
        vertices = [array(*map(float, np.round(v * 64) / 64)) for v in QUAD]
        x = along_a_ray(number, array, distance)
        coeffs = project_polygon(vertices, x, 8)
        cubature = prefers_cubature(VertexList(vertices), x, 8, 4e-6 if number is dr.llvm.ad.Float else 1e-12)
        dr.eval(coeffs, cubature)
        results.append(np.array([np.array(c, dtype=float) for c in coeffs]))
        assert 0 < np.mean(np.array(cubature)) < 1
    error = np.linalg.norm(results[0] - results[1], axis=0) / np.linalg.norm(results[1], axis=0)
    assert error.max() < 1e-5


@pytest.mark.parametrize("distance", [0.5, 8.0, 30.0, 1e3, 1e5])
@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_auto_is_differentiable_on_both_sides(mode, distance):
    number, array = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    weight = np.cos(np.arange(25))

    def value(t):
        x = along_a_ray(number, array, np.array([distance])) + array(t, 0.5 * t, -t) * distance
        return sum(c * w for c, w in zip(project_polygon([array(*map(float, p)) for p in QUAD], x, 4), weight))

    assert derivative(value, number, mode) == pytest.approx((value(number(1e-5))[0] - value(number(-1e-5))[0]) / 2e-5, rel=1e-5)


def test_requested_error_saves_points():
    vertices, x = [dr.llvm.ad.Array3f64(*map(float, p)) for p in QUAD], dr.llvm.ad.Array3f64(-12, 3, -8)
    exact = np.array([c[0] for c in project_polygon(vertices, x, 8, "edge")])
    points = []
    for max_error in (1e-1, 1e-3, 1e-6, 1e-12):
        coeffs = np.array([c[0] for c in project_polygon(vertices, x, 8, "quadrature", max_error=max_error)])
        assert relative(coeffs, exact) < 2 * max_error
        points.append(demand(VertexList(vertices), x, 8, max_error).points[0])
    assert points == sorted(set(points))


@pytest.mark.parametrize("axis", range(3))
def test_edges_in_coordinate_planes(precision, method, axis):
    """An edge whose plane is upright, level or tilted: the edge's frame has a pole, the result has not."""
    square = np.roll(np.array([[-0.5, 0, 1], [0.5, 0, 1], [0.5, 0.7, 1], [-0.5, 0.7, 1]]), axis, axis=1)
    exact = reference.coefficients_quadrature(square, (0, 0, 0), 8, n=48)
    assert relative(project(precision, square, method=method), exact) < max(40 * precision.eps, 1e-14)  # of the cubature itself


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("height", [0, 1e-9, -1e-7, 1e-5, 1e-3])
def test_gradients_of_edges_in_coordinate_planes(precision, axis, height):
    """As above, for derivatives: a wall light that stands on the floor, seen from a point on the floor or just off it."""
    square = np.roll(np.array([[-0.5, 0, 1], [0.5, 0, 1], [0.5, 0.7, 1], [-0.5, 0.7, 1]]), axis, axis=1)
    up = np.roll([0.3, 1, 0.2], axis)
    weight = np.cos(np.arange(25))

    def value(t, method, Float=precision.Float, Array3=precision.Array3):
        x = Array3(*(Float(float(c)) * t for c in up))
        vertices = [Array3(*map(float, v)) for v in square]
        return sum(c * w for c, w in zip(project_polygon(vertices, x, 4, method), weight))

    t = precision.Float(height)
    dr.enable_grad(t)
    dr.backward(value(t, "edge"))
    double = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    difference = value(double[0](height + 1e-5), "recurrence", *double)[0] - value(double[0](height - 1e-5), "recurrence", *double)[0]
    assert dr.grad(t)[0] == pytest.approx(difference / 2e-5, rel=5e-5 if precision.eps > 1e-10 else 1e-8)


def test_wide_literals_stay_wide():
    x = dr.llvm.ad.Array3f(dr.zeros(dr.llvm.ad.Float, 5), 0, 0)
    assert all(dr.width(c) == 5 for c in project_polygon([dr.llvm.ad.Array3f(*map(float, v)) for v in QUAD], x, 1))


def test_python_floats_and_mixed_types():
    plain = project_polygon(QUAD.tolist(), (0, 0, 0), 3)
    assert all(type(c) is float for c in plain)
    mixed = project_polygon(QUAD.tolist(), dr.llvm.ad.Array3f64(0, 0, 0), 3)
    assert all(type(c) is dr.llvm.ad.Float64 for c in mixed)
    assert np.allclose(plain, [c[0] for c in mixed], atol=1e-15)


def test_many_vertices_share_one_kernel_size():
    """A polygon of 200 corners is one symbolic loop; unrolled it would take minutes to compile."""
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    circle = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.ones(200)], axis=1)
    p = [dr.llvm.ad.Array3f(*map(float, v)) for v in circle]
    coeffs = project_polygon(p, dr.llvm.ad.Array3f(0, 0, 0), 4)
    assert coeffs[0][0] * np.sqrt(4 * np.pi) == pytest.approx(2 * np.pi * (1 - 1 / np.sqrt(1.25)), rel=1e-3)
    assert max(abs(coeffs[i][0]) for i in (1, 3, 5, 7)) < 1e-6


def polygons_in_buffers(number, polygons):
    """Function (light number, lanes) -> EdgeBuffer, as an integrator has it."""
    index, sizes = dr.uint32_array_t(number), [len(p) for p in polygons]
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    start = np.arange(offsets[-1])
    end = np.concatenate([o + np.roll(np.arange(n), -1) for o, n in zip(offsets, sizes)])
    strips = [[o + i, o + i + 1, o + n - 2 - i, o + n - 1 - i] for o, n in zip(offsets, sizes) for i in range((n - 1) // 2)]
    positions = number(np.concatenate(polygons).ravel().tolist())
    start, end, strips, edges, patches = (index(np.ravel(t).astype(int).tolist()) for t in (
        start, end, strips, offsets, np.concatenate([[0], np.cumsum([(n - 1) // 2 for n in sizes])])))
    owned = lambda table, k: (dr.gather(index, table, k), dr.gather(index, table, k + 1))
    return lambda k: EdgeBuffer(positions, start, end, *owned(edges, k), (strips, *owned(patches, k)), max(sizes) <= 4)


def regular(corners, height):
    angle = 2 * np.pi * np.arange(corners) / corners + height
    return np.stack([np.cos(angle), np.sin(angle), np.full(corners, 1 + height)], axis=1)


@pytest.mark.parametrize("corners", [(3, 4), range(3, 13)])
def test_lights_in_buffers(precision, method, corners):
    """A loop over lights gives the sum of the lights, and a hundred lights run the kernel that two lights had compiled."""
    polygons = [regular(n, 0.1 * k) for k, n in enumerate(corners)]
    number, order = precision.Float, 3
    transfer = [number(float(t)) for t in np.cos(np.arange((order + 1) ** 2))]
    x = precision.Array3(number([0.0, 0.1, 40.0]), 0.2, -0.3)
    dr.make_opaque(x, transfer)

    def shade_all(polygons):
        light_of, index = polygons_in_buffers(number, polygons), dr.uint32_array_t(number)
        shade, apex = light_shader(transfer, order, method), precision.vector((0, 0, 1))
        dr.make_opaque(apex)
        count = dr.opaque(index, len(polygons))

        def body(k, total, x):
            return k + 1, total + shade(light_of(k), x, apex), x

        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            total = dr.while_loop((index(0), number(0), x), lambda k, *_: k < count, body, mode="symbolic", max_iterations=-1)[1]
            dr.eval(total)
            kernels = [kernel["hash"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
        return np.array(total), kernels

    total, kernels = shade_all(polygons)
    points = np.array(x, dtype=float).T.tolist()
    expected = np.array([sum(np.cos(np.arange(16)) @ project_polygon(polygon.tolist(), point, order) for polygon in polygons)
                         for point in points])
    near = slice(0, 2) if method != "quadrature" else slice(2, 3)
    assert np.allclose(total[near], expected[near], rtol=2e-5 if precision.eps > 1e-10 else 1e-10, atol=0)
    assert kernels[-1] == shade_all([regular(corners[k % len(corners)], 0.01 * k) for k in range(100)])[1][-1]


@pytest.mark.parametrize("arguments, error, text", [
    ({"order": -1}, ValueError, r"'order' must be an integer from 0 to 64, got -1"),
    ({"order": 3.5}, ValueError, r"'order' must be .*, got 3.5"),
    ({"method": "magic"}, ValueError, r"'method' must be one of 'auto', 'recurrence', 'edge', 'quadrature', got 'magic'"),
    ({"method": 3}, TypeError, r"'method' must be one of"),
    ({"max_error": 0}, ValueError, r"'max_error' must be a number from 1.11022e-16 to 1, got 0"),
    ({"max_error": "small"}, TypeError, r"'max_error' must be a number from"),
    ({"vertices": QUAD[:2].tolist()}, ValueError, r"'vertices' must have at least three entries"),
    ({"vertices": "abc"}, TypeError, r"'vertices' must be a list of 3-vectors"),
    ({"vertices": [(0, 0), (1, 0), (0, 1)]}, TypeError, r"'vertices' must be a 3-vector"),
    ({"x": (0, 0)}, TypeError, r"'x' must be a 3-vector"),
])
def test_bad_arguments(arguments, error, text):
    with pytest.raises(error, match=r"project_polygon\(\): " + text):
        project_polygon(**{"vertices": QUAD.tolist(), "x": (0, 0, 0), "order": 2, **arguments})


def test_unroll_limit_is_covered():
    """The loop over lobes is tested above only if it starts below the orders used there."""
    assert recurrence.UNROLL_ORDER < 17
