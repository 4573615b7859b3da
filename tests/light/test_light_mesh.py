"""Lights of many faces: against the sum over the faces; shared edges, one-sided faces, gradients, degenerate input."""
import drjit as dr
import numpy as np
import pytest

import reference
from autodiff import derivative
from mi_shlight import project_mesh, project_polygon
from mi_shlight.light.mesh import (
    MeshLight, mesh_shader, mesh_topology, project_mesh_light, triangle_solid_angle, zonal_mesh_shader)
from mi_shlight.light.topology import MeshTables
from mi_shlight.light.zonal import times_pole_value, zonal_lambert

# A closed skew box of triangles, a quad and pentagons that are not plane; all faces are positive from inside.
BOX = np.array([[-1, -1, -1], [1, -1.2, -1], [1.1, 1, -0.9], [-0.9, 1, -1.1], [-1, -1.1, 1], [1.2, -1, 1], [1, 1.1, 0.8], [-1, 0.9, 1.1],
                [0.1, -1.3, 1.2]])
BOX_FACES = [[2, 1, 0], [3, 2, 0], [4, 8, 5, 6, 7], [1, 5, 8, 4, 0], [6, 2, 3], [7, 6, 3], [4, 7, 3, 0], [6, 5, 1], [2, 6, 1]]
CUBE = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=float)
CUBE_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]      # negative from inside
INSIDE, OUTSIDE, CORNER = (0.2, 0.1, -0.3), (2.5, -0.8, 1.7), (1.05, 1.3, -1.1)
RADIANCE = np.random.default_rng(5).uniform(-1, 2, (len(BOX_FACES), 3))


@pytest.fixture(params=["recurrence", "edge", "quadrature", "auto"])
def method(request):
    return request.param


def textured_quad(n=16):
    """Vertices, faces and radiances of a quad cut into 2 n^2 triangles, positive for points above it."""
    line = np.linspace(-0.5, 0.5, n + 1)
    vertices = np.array([[x, y, 0.1 * x] for y in line for x in line])
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([corner, corner + n + 2, corner + 1], 1), np.stack([corner, corner + n + 1, corner + n + 2], 1)])
    return vertices, faces, np.random.default_rng(1).uniform(0, 1, len(faces))


def projected(precision, vertices, faces, radiance, x, order=6, method="edge", **options):
    """Coefficients as an array (count,) or (count, 3) for one point; (count, [3,] N) for an array (N, 3) of points."""
    x = np.asarray(x, dtype=float)
    point = precision.vector(x) if x.ndim == 1 else precision.Array3(*map(precision.Float, x.T))
    coeffs = project_mesh(vertices, faces, radiance, point, order, method, **options)
    dr.eval(coeffs)
    values = np.array([np.array(c) for c in coeffs], dtype=float)
    return values[..., 0] if x.ndim == 1 else values


def sum_of_faces(vertices, faces, radiance, x, order=6, lit=lambda solid_angle: True):
    """The definition, in double precision."""
    parts = [np.array(project_polygon([tuple(vertices[k]) for k in face], tuple(x), order, "edge")) for face in faces]
    return sum(np.multiply.outer(part, r) for part, r in zip(parts, radiance) if lit(part[0]))


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


@pytest.mark.parametrize("x", [INSIDE, OUTSIDE, CORNER], ids=["inside", "outside", "in the bounding box"])
def test_equals_the_sum_over_the_faces(precision, method, x):
    values = projected(precision, BOX, BOX_FACES, RADIANCE, x, method=method)
    bound = 3e-3 if method == "quadrature" and x == CORNER else 40 * precision.eps + (1e-11 if method == "quadrature" else 0)
    assert relative(values, sum_of_faces(BOX, BOX_FACES, RADIANCE, x)) < bound


def test_one_channel_is_a_float(precision):
    coeffs = project_mesh(BOX, BOX_FACES, RADIANCE[:, 1], precision.vector(OUTSIDE), 3, "edge")
    assert all(type(c) is precision.Float for c in coeffs)
    assert np.array_equal(np.array(coeffs)[:, 0], projected(precision, BOX, BOX_FACES, RADIANCE, OUTSIDE, 3)[:, 1])


def test_independent_oracle():
    vertices, faces, radiance = textured_quad(2)
    expected = sum(r * reference.coefficients_quadrature(vertices[f], (0.1, 0.2, 0.9), 8) for f, r in zip(faces, radiance))
    values = np.array([c[0] for c in project_mesh(vertices, faces, radiance, dr.llvm.ad.Array3f64(0.1, 0.2, 0.9), 8, "edge")])
    assert relative(values, expected) < 1e-13


@pytest.mark.parametrize("method, order, channels", [("edge", 21, 1), ("recurrence", 16, 3)])
def test_high_order(method, order, channels):
    """Beyond the orders at which one loop body does all."""
    vertices, faces, _ = textured_quad(1)
    radiance = RADIANCE[:2, :channels].squeeze()
    coeffs = project_mesh(vertices, faces, radiance, dr.llvm.ad.Array3f64(*OUTSIDE), order, method)
    dr.eval(coeffs)
    assert relative(np.array(coeffs)[..., 0], sum_of_faces(vertices, faces, radiance, OUTSIDE, order)) < 1e-11


def test_wide_points_equal_single_ones(precision):
    points = np.array([INSIDE, OUTSIDE, CORNER, (300, 20, 100)])
    wide = projected(precision, BOX, BOX_FACES, RADIANCE, points, method="auto")
    for k, x in enumerate(points):
        single = projected(precision, BOX, BOX_FACES, RADIANCE, x, method="auto")
        assert np.allclose(wide[..., k], single, rtol=0, atol=20 * precision.eps * np.abs(single).max())


def test_textured_quad(precision):
    """512 triangles: 800 edges in place of 1536, and the same coefficients."""
    vertices, faces, radiance = textured_quad()
    assert len(mesh_topology(list(faces)).edges) == 800
    points = np.array([(0.1, 0.2, 0.7), (1.5, -0.4, 0.9), (-0.2, 0.1, -0.6)])
    shared = projected(precision, vertices, faces, radiance, points, order=8)
    separate = projected(precision, vertices[faces].reshape(-1, 3), np.arange(1536).reshape(-1, 3), radiance, points, order=8)
    scale = np.linalg.norm(separate, axis=0)
    assert (np.linalg.norm(shared - separate, axis=0) < 60 * precision.eps * scale).all()


@pytest.mark.parametrize("order, channels, one_sided", [(0, 3, True), (1, 1, True), (6, 1, False), (6, 3, True)])
def test_shader_equals_dot_product(precision, method, order, channels, one_sided):
    light = MeshLight(precision.Float(BOX.ravel()), mesh_topology([np.array(f) for f in BOX_FACES]), RADIANCE[:, :channels], one_sided)
    x = precision.Array3(*(precision.Float(list(c)) for c in zip(INSIDE, OUTSIDE, (30.0, 2.0, 10.0))))
    transfer = [precision.Float(float(t)) for t in np.cos(np.arange((order + 1) ** 2))]
    shaded = np.array(mesh_shader(transfer, order, method)(light, x)).reshape(channels, 3)
    coeffs = project_mesh_light(light, x, order, method)
    dr.eval(coeffs)
    coeffs = np.array([np.array(c).reshape(channels, 3) for c in coeffs])
    expected = np.tensordot(np.cos(np.arange((order + 1) ** 2)), coeffs, axes=1)
    assert np.abs(shaded - expected).max() < 40 * (order + 1) * precision.eps * np.abs(coeffs).max()


# Shared edges.

def test_equal_radiances_leave_the_outline(precision):
    vertices, faces, _ = textured_quad(4)
    light = MeshLight(precision.Float(vertices.ravel()), mesh_topology(list(faces)), np.full((32, 1), 2.0))
    assert light.edge_count() == 16
    outline = vertices[[0, 20, 24, 4]]
    for x in ((0.3, 0.1, 0.8), (0.1, 0.2, -0.4), (2.0, 0.3, 0.25)):
        expected = 2 * np.array(project_polygon(outline.tolist(), x, 6, "edge"))
        assert relative(projected(precision, vertices, faces, np.full(32, 2.0), x), expected) < 100 * precision.eps


def test_uniform_closed_mesh(precision):
    """The whole sphere from inside, nothing from outside, without a single edge."""
    assert MeshLight(precision.Float(BOX.ravel()), mesh_topology([np.array(f) for f in BOX_FACES]), np.ones((9, 1))).edge_count() == 0
    inside, outside = (projected(precision, BOX, BOX_FACES, np.ones(9), x) for x in (INSIDE, OUTSIDE))
    assert inside[0] == pytest.approx(np.sqrt(4 * np.pi), rel=20 * precision.eps)
    assert not inside[1:].any() and np.abs(outside).max() < 20 * precision.eps


@pytest.mark.parametrize("faces, edges", [
    ([[0, 1, 2], [0, 2, 3]], 5),                      # shared, opposite directions
    ([[0, 1, 2], [0, 3, 2]], 6),                      # one of the two turned round: the edge counts twice
    ([[0, 1, 2], [1, 0, 3], [0, 1, 4]], 8),           # three faces at one edge
    ([[0, 1, 2], [1, 0, 3], [0, 1, 4], [1, 0, 5]], 10),
    ([[0, 1, 2], [0, 1, 2]], 6),                      # the same face twice
    ([[0, 1, 2], [2, 1, 0]], 3),                      # both sides of one face
    ([[0, 0, 1, 2]], 3),                              # an edge without length
])
def test_topology(faces, edges):
    faces = [np.array(face) for face in faces]
    topology = mesh_topology(faces)
    assert len(topology.edges) == edges
    assert sorted(topology.triangles[:, 3]) == [k for k, face in enumerate(faces) for _ in face[2:]]
    sides = {(a, b): [] for face in faces for a, b in zip(face, np.roll(face, -1)) if a != b}
    for start, end, left, right in topology.edges:
        assert left != len(faces) or right != len(faces)
        for key, side in (((start, end), left), ((end, start), right)):
            if side != len(faces):
                sides[key].append(side)
    for (a, b), found in sides.items():
        assert sorted(found) == [k for k, face in enumerate(faces) for p, q in zip(face, np.roll(face, -1)) if (p, q) == (a, b)]


@pytest.mark.parametrize("faces", [[[0, 1, 2], [0, 3, 2]], [[0, 1, 2], [1, 0, 3], [0, 1, 8], [0, 1, 6]], [[0, 1, 2], [2, 1, 0]]])
def test_faces_turned_either_way(precision, faces):
    radiance = np.array([1.0, 0.3, -0.5, 2.0])[:len(faces)]
    values = projected(precision, BOX, faces, radiance, INSIDE)
    assert relative(values, sum_of_faces(BOX, faces, radiance, INSIDE)) < 40 * precision.eps


def test_concave_faces(precision):
    """A U around a quad: fans of the U's triangles leave it, with signs."""
    vertices = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1.2], [0.4, 1, 1.2], [0.4, -0.5, 1.05], [-0.4, -0.5, 1.05], [-0.4, 1, 1.2],
                         [-1, 1, 1.2]])
    faces, radiance = [[0, 1, 2, 3, 4, 5, 6, 7], [3, 6, 5, 4]], np.array([1.0, 3.0])
    for method in ("edge", "quadrature"):
        values = projected(precision, vertices, faces, radiance, (0.1, 0.2, -0.5), method=method)
        assert relative(values, sum_of_faces(vertices, faces, radiance, (0.1, 0.2, -0.5))) < 60 * precision.eps + 1e-11


def test_inside_a_symbolic_loop():
    number, array = dr.llvm.ad.Float, dr.llvm.ad.Array3f
    light = MeshLight(number(BOX.ravel()), mesh_topology([np.array(f) for f in BOX_FACES]), RADIANCE[:, :1], True)
    project = lambda z: sum(project_mesh_light(light, array(2.5, -0.8, z), 3))
    loop = lambda body: dr.while_loop((dr.llvm.ad.UInt32(0), number(0)), lambda i, _: i < 3, body, mode="symbolic")[1]
    total = loop(lambda i, total: (i + 1, total + project(1.7 + number(i))))
    assert total[0] == pytest.approx(sum(project(number(1.7 + i))[0] for i in range(3)), rel=1e-5)
    with pytest.raises(RuntimeError) as error:
        loop(lambda i, total: (i + 1, total + project_mesh(BOX, BOX_FACES, np.ones(9), array(0, 0, number(i)), 0)[0]))
    assert str(error.value.__cause__).startswith("project_mesh(): must be called outside of symbolic loops")


def test_kernels_do_not_grow_with_the_mesh():
    """Meshes of any size run the same kernel, and so compile once."""
    kernels = []
    for n in (2, 5):
        vertices, faces, radiance = textured_quad(n)
        for one_sided in (False, True):
            light = MeshLight(dr.llvm.ad.Float(vertices.ravel()), mesh_topology(list(faces)), radiance[:, None], one_sided)
            x = dr.llvm.ad.Array3f([0.1, 0.2], [0.2, 0.3], [0.7, 0.4])
            dr.make_opaque(x)
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                dr.kernel_history_clear()
                dr.eval(project_mesh_light(light, x, 2))
                kernels.append([k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT])
    assert kernels[0] == kernels[2] and kernels[1] == kernels[3] and kernels[0] != kernels[1]


# One-sided faces.

@pytest.mark.parametrize("x", [INSIDE, OUTSIDE, (0.3, 3.0, 0.1), (0.5, 4.0, 6.0)])
@pytest.mark.parametrize("radiance", ["equal", "different"])
def test_one_sided(precision, method, x, radiance):
    radiance = np.ones(6) if radiance == "equal" else np.arange(1.0, 7.0)
    values = projected(precision, CUBE, CUBE_FACES, radiance, x, method=method, one_sided=True)
    expected = sum_of_faces(CUBE, CUBE_FACES, radiance, x, lit=lambda solid_angle: solid_angle > 0)
    if x == INSIDE:
        assert not values.any()
    else:
        assert relative(values, expected) < 40 * precision.eps + (1e-11 if method == "quadrature" else 0)


def test_one_sided_wide(precision):
    """Each lane has its own outline."""
    points = np.random.default_rng(2).normal(size=(50, 3)) * 2
    points = points[np.abs(points).max(axis=1) > 1.05]
    values = projected(precision, CUBE, CUBE_FACES, np.ones(6), points, one_sided=True)
    for column, x in zip(values.T, points):
        expected = sum_of_faces(CUBE, CUBE_FACES, np.ones(6), x, lit=lambda solid_angle: solid_angle > 0)
        assert relative(column, expected) < 100 * precision.eps


# Accuracy and choice of method.

def test_auto_keeps_accuracy_far_away():
    """Where the edges cancel auto takes cubature; near the light it is the edge form to the last bit."""
    vertices, faces, radiance = textured_quad()
    vertices, topology = np.round(vertices * 512) / 512, mesh_topology(list(faces))     # differences to the points are exact in float32
    points = np.round(np.outer([0.3, 0.2, 0.93], [1.0, 100.0, 1e4]) * 64) / 64

    def project(array, number, method):
        light = MeshLight(number(vertices.ravel()), topology, radiance[:, None])
        coeffs = project_mesh_light(light, array(*map(number, points)), 8, method)
        dr.eval(coeffs)
        return np.array(coeffs, dtype=float)

    edge, auto = (project(dr.llvm.ad.Array3f, dr.llvm.ad.Float, method) for method in ("edge", "auto"))
    exact = project(dr.llvm.ad.Array3f64, dr.llvm.ad.Float64, "quadrature")
    edge_error, auto_error = (np.linalg.norm(values - exact, axis=0) / np.linalg.norm(exact, axis=0) for values in (edge, auto))
    assert (auto_error < 2e-6).all() and (edge_error[1:] > 5e-6).all()
    assert np.array_equal(auto[:, 0], edge[:, 0])


def test_hemisphere_filling_light(precision):
    """A floor of two triangles 1e4 times its distance wide; the diagonal under the point does not cost digits."""
    size, faces = 1e4, [[0, 1, 2], [0, 2, 3]]
    vertices = [(-size, -size, 1), (size, -size, 1), (size, size, 1), (-size, size, 1)]
    expected = 4 * np.arctan(size ** 2 / np.sqrt(2 * size ** 2 + 1))
    for radiance in ([1.0, 1.0], [1.0, 1.0 + 1e-6]):
        value = projected(precision, np.array(vertices), faces, radiance, (0, 0, 0), order=0)[0] * np.sqrt(4 * np.pi)
        assert abs(value) == pytest.approx(expected, rel=40 * precision.eps + 2e-6 * (radiance[1] != 1))


def test_triangle_solid_angle(precision):
    """Any corner first, either winding; beside a side of nearly half a circle the errors of two triangles cancel."""
    rng = np.random.default_rng(8)
    for corners in rng.normal(size=(20, 3, 3)):
        expected = reference.solid_angle(corners)
        rounded = 30 * precision.eps / np.abs(np.linalg.det(corners / np.linalg.norm(corners, axis=1, keepdims=True)))
        for sign, order in ((1, (0, 1, 2)), (1, (1, 2, 0)), (1, (2, 0, 1)), (-1, (2, 1, 0))):
            assert triangle_solid_angle(*(precision.vector(corners[k]) for k in order))[0] == pytest.approx(sign * expected, abs=rounded)
    size = 1e4
    a, b, c, d = map(precision.vector, ((-size, -size, 1), (size, -size, 1), (size, size, 1), (-size, size, 1)))
    expected = 4 * np.arctan(size ** 2 / np.sqrt(2 * size ** 2 + 1))
    for halves in (((a, b, c), (a, c, d)), ((b, c, a), (c, d, a)), ((c, a, b), (d, a, c))):
        assert sum(triangle_solid_angle(*half)[0] for half in halves) == pytest.approx(expected, rel=10 * precision.eps)


# Derivatives.

@pytest.mark.parametrize("one_sided", [False, True])
@pytest.mark.parametrize("moving", ["radiance", "equal radiance", "vertices", "point"])
@pytest.mark.parametrize("x", [INSIDE, OUTSIDE], ids=["inside", "outside"])
def test_autodiff_matches_finite_difference(moving, one_sided, x):
    number, array = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    weight, rng = np.cos(np.arange(25)), np.random.default_rng(4)
    faces = BOX_FACES if x == INSIDE else [face[::-1] for face in BOX_FACES]
    turn, start = rng.normal(size=(9, 3)), np.ones((9, 3)) if moving == "equal radiance" else RADIANCE

    def value(t):
        vertices, emitted, point = number(BOX.ravel()), array(*start.T), array(*x)
        if moving == "vertices":
            vertices = vertices + t * number(turn.ravel())
        elif moving == "point":
            point = point + t * array(0.3, -0.5, 0.8)
        else:
            emitted = emitted + t * array(*turn.T)
        coeffs = project_mesh(vertices, faces, emitted, point, 4, one_sided=one_sided)
        return sum((c * w for c, w in zip(coeffs, weight)), array(0)) @ array(1, -2, 3)

    central = (value(number(1e-5))[0] - value(number(-1e-5))[0]) / 2e-5
    assert abs(central) > 1e-3
    for mode in ("backward", "forward"):
        assert derivative(value, number, mode) == pytest.approx(central, rel=1e-7)


def test_gradient_of_each_radiance_is_the_coefficient_of_its_face():
    number = dr.llvm.ad.Float64
    radiance = number(np.ones(9))
    dr.enable_grad(radiance)
    coeffs = project_mesh(BOX, BOX_FACES, radiance, dr.llvm.ad.Array3f64(*OUTSIDE), 3)
    dr.backward(coeffs[6])
    expected = [project_polygon([tuple(BOX[k]) for k in face], OUTSIDE, 3)[6] for face in BOX_FACES]
    assert np.allclose(np.array(dr.grad(radiance)), expected, atol=1e-13)


# Degenerate input.

@pytest.mark.parametrize("one_sided", [False, True])
@pytest.mark.parametrize("x", [(-1, -1, -1), (1, 0, 1), (0.2, 0.3, 1), (3, 0.2, 1), (1, 1, 1e-20)],
                         ids=["vertex", "edge", "face", "plane of a face", "edge, denormal"])
def test_points_on_the_mesh(precision, method, x, one_sided):
    values = projected(precision, CUBE, CUBE_FACES, np.arange(1.0, 7.0), x, method=method, one_sided=one_sided)
    assert np.isfinite(values).all()
    if x == (3, 0.2, 1):                              # a face seen edge-on counts for nothing
        expected = sum_of_faces(CUBE, CUBE_FACES, np.arange(1.0, 7.0), x, lit=lambda omega: omega > 1e-12 or not one_sided)
        assert relative(values, expected) < 40 * precision.eps + (1e-11 if method == "quadrature" else 0)


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1e30])
def test_scale_changes_nothing(precision, scale):
    for one_sided in (False, True):
        plain, scaled = (projected(precision, BOX * s, BOX_FACES, RADIANCE, np.array(OUTSIDE) * s, one_sided=one_sided) for s in (1, scale))
        assert relative(scaled, plain) < 40 * precision.eps


def test_faces_without_area(precision, method):
    """Zero-area, coincident and collinear faces add nothing; a mesh of nothing else is black."""
    vertices = np.vstack([BOX, [[0, 0, 2], [1, 0, 2], [2, 0, 2], [0, 0, 2]]])
    flat = [[9, 10, 11], [9, 12, 9], [10, 10, 10], [9, 10, 12]]
    for one_sided in (False, True):
        alone = projected(precision, vertices, flat, [1.0, 2.0, 3.0, 4.0], OUTSIDE, method=method, one_sided=one_sided)
        assert np.abs(alone).max() < 40 * precision.eps
        assert not projected(precision, vertices, [[9, 9, 9]], [1.0], OUTSIDE, method=method, one_sided=one_sided).any()
    values = projected(precision, vertices, BOX_FACES + flat, np.vstack([RADIANCE, np.ones((4, 3))]), OUTSIDE, method="edge")
    assert relative(values, projected(precision, BOX, BOX_FACES, RADIANCE, OUTSIDE)) < 60 * precision.eps


def test_infinite_and_nan_coordinates(precision):
    points = np.array([OUTSIDE, (np.nan, 0, 0), (0, np.inf, 0), INSIDE])
    values = projected(precision, BOX, BOX_FACES, RADIANCE, points)
    assert np.isnan(values[..., 1:3]).all() and np.isfinite(values[..., [0, 3]]).all()
    broken = BOX.copy()
    broken[3, 1] = np.inf
    assert np.isnan(projected(precision, broken, BOX_FACES, RADIANCE, OUTSIDE)).all()


# Types.

def test_forms_of_the_vertices(precision):
    x = precision.vector(OUTSIDE)
    wide = precision.Array3(*map(precision.Float, BOX.T))
    forms = {"array": BOX, "wide": wide, "flat": dr.ravel(wide), "list": [precision.vector(v) for v in BOX], "tuples": BOX.tolist(),
             "float32": BOX.astype(np.float32)}
    expected = projected(precision, BOX, BOX_FACES, RADIANCE, OUTSIDE)
    for name, vertices in forms.items():
        for radiance in (RADIANCE, RADIANCE.tolist(), precision.Array3(*map(precision.Float, RADIANCE.T))):
            coeffs = project_mesh(vertices, BOX_FACES, radiance, x, 6, "edge")
            dr.eval(coeffs)
            tolerance = 1e-6 if name == "float32" else 40 * precision.eps
            assert relative(np.array([np.array(c)[:, 0] for c in coeffs]), expected) < tolerance, name


@pytest.mark.parametrize("one_sided", [False, True])
def test_python_floats(one_sided):
    lit = (lambda solid_angle: solid_angle > 0) if one_sided else (lambda solid_angle: True)
    single = project_mesh(BOX.tolist(), BOX_FACES, RADIANCE[:, 0], OUTSIDE, 3, one_sided=one_sided)
    coloured = project_mesh(BOX, BOX_FACES, RADIANCE, OUTSIDE, 3, one_sided=one_sided)
    assert all(type(c) is float for c in single) and all(type(c) is dr.scalar.Array3f64 for c in coloured)
    assert np.allclose(coloured, sum_of_faces(BOX, BOX_FACES, RADIANCE, OUTSIDE, 3, lit), atol=1e-13)
    assert np.allclose(np.array(coloured)[:, 0], single, atol=1e-15)


def test_mitsuba_mesh():
    """Buffers of a Mitsuba mesh go in as they are; its normals point away from where its faces are positive."""
    mi = pytest.importorskip("mitsuba")
    rectangle = mi.load_dict({"type": "rectangle"})
    faces = np.array(rectangle.faces_buffer()).reshape(-1, 3)
    x = mi.Point3f(0.2, 0.3, 2)
    above = project_mesh(rectangle.vertex_positions_buffer(), faces[:, ::-1], [1.0, 1.0], x, 2, one_sided=True)
    expected = project_polygon([(1, -1, 0), (-1, -1, 0), (-1, 1, 0), (1, 1, 0)], (0.2, 0.3, 2.0), 2)
    assert np.allclose(np.array(above)[:, 0], expected, atol=1e-5) and expected[0] > 0
    below = project_mesh(rectangle.vertex_positions_buffer(), faces, [1.0, 1.0], x, 2, one_sided=True)
    assert not np.array(below).any()


@pytest.mark.parametrize("arguments, error, text", [
    ({"order": 65}, ValueError, r"'order' must be an integer from 0 to 64, got 65"),
    ({"method": "magic"}, ValueError, r"'method' must be one of 'auto', 'recurrence', 'edge', 'quadrature', got 'magic'"),
    ({"one_sided": 1}, TypeError, r"'one_sided' must be True or False, got 1"),
    ({"max_error": 2}, ValueError, r"'max_error' must be a number from .* to 1, got 2"),
    ({"x": (0, 0)}, TypeError, r"'x' must be a 3-vector"),
    ({"vertices": BOX[:, :2]}, TypeError, r"'vertices' must be an array \(V, 3\) of numbers"),
    ({"vertices": BOX.astype(str)}, TypeError, r"'vertices' must be an array \(V, 3\) of numbers"),
    ({"vertices": dr.llvm.ad.Float([0.0] * 10)}, ValueError, r"'vertices' must have three numbers for each vertex"),
    ({"vertices": [dr.llvm.ad.Array3f([0, 1], 0, 0)] * 9}, ValueError, r"'vertices' must be single points if they are a list"),
    ({"vertices": 3}, TypeError, r"'vertices' must be a 3-vector"),
    ({"faces": [[0, 1]]}, TypeError, r"'faces' must be integer vertex indices, three or more for each face"),
    ({"faces": [[0.0, 1.0, 2.0]]}, TypeError, r"'faces' must be integer vertex indices"),
    ({"faces": [0, 1, 2]}, TypeError, r"'faces' must be integer vertex indices"),
    ({"faces": []}, TypeError, r"'faces' must be integer vertex indices"),
    ({"faces": [[0, 1, 9]]}, ValueError, r"'faces' must name vertices from 0 to 8, got 9"),
    ({"faces": [[0, 1, -1]]}, ValueError, r"'faces' must name vertices from 0 to 8, got -1"),
    ({"radiance": [1.0]}, ValueError, r"'radiance' must be 9 finite numbers or triples, one for each face"),
    ({"radiance": [np.nan] * 9}, ValueError, r"'radiance' must be 9 finite numbers"),
    ({"radiance": "bright"}, TypeError, r"'radiance' must be 9 finite numbers"),
    ({"radiance": [dr.llvm.ad.Float(1)] * 9}, TypeError, r"'radiance' must be 9 finite numbers"),
    ({"radiance": dr.llvm.ad.Float([1, 2])}, ValueError, r"'radiance' must have the width 9, one value for each face"),
])
def test_bad_arguments(arguments, error, text):
    with pytest.raises(error, match=r"project_mesh\(\): " + text):
        project_mesh(**{"vertices": BOX, "faces": BOX_FACES, "radiance": np.ones(9), "x": (0, 0, 0), "order": 2, **arguments})


# Several lights in one, and what callers in kernels ask for.

def three_lights(number):
    """The box, the cube and a quad with different radiance, with one vertex list, and the part of each face."""
    quad, quad_faces, _ = textured_quad(2)
    vertices = np.concatenate([BOX, CUBE * 0.3 + [4, 0, 0], quad - [0, 3, 0]])
    faces = [np.array(face) for face in BOX_FACES]
    faces += [np.array(face) + len(BOX) for face in CUBE_FACES] + list(quad_faces + len(BOX) + len(CUBE))
    part = np.repeat([0, 1, 2], [len(BOX_FACES), len(CUBE_FACES), len(quad_faces)])
    return number(vertices.ravel()), vertices, faces, part, np.random.default_rng(3).uniform(0.2, 2, (len(faces), 3))


@pytest.mark.parametrize("method", ["auto", "edge"])
def test_parts(precision, method):
    """Each part alone is the light alone; they are told apart in one kernel."""
    positions, vertices, faces, part, radiance = three_lights(precision.Float)
    light = MeshLight(positions, mesh_topology(faces, part), [precision.Float(channel) for channel in radiance.T], True)
    points = np.array([OUTSIDE, (2.5, 0.4, 0.3), (0.3, -2.8, 1), (200.0, -30.0, 90.0)])
    x = precision.Array3(*map(precision.Float, points.T))
    for k in range(3):
        index = dr.opaque(dr.uint32_array_t(precision.Float), k)
        coeffs = project_mesh_light(light.part(index), x, 4, method)
        dr.eval(coeffs)
        own = [face for face, p in zip(faces, part) if p == k]
        found = np.array([np.array(c) for c in coeffs], dtype=float)
        expected = projected(precision, vertices, own, radiance[part == k], points, 4, method, one_sided=True)
        assert np.abs(found - expected).max() < 100 * precision.eps * max(1, np.abs(expected).max())
        assert np.abs(expected).max() > 1e-3


@pytest.mark.parametrize("method", ["auto", "edge", "quadrature"])
def test_flat_parts(precision, method):
    """Two sheets back to back, on one list of vertices: the test by part finds what the test by face does, from either side."""
    vertices, faces, radiance = textured_quad(2)
    faces, radiance = np.concatenate([faces, faces[:, ::-1]]), np.concatenate([radiance, 3 * radiance])
    topology, index = mesh_topology(list(faces), np.repeat([0, 1], len(faces) // 2)), dr.uint32_array_t(precision.Float)
    above = np.array([(0.1, 0.2, 0.9), (-0.7, 0.1, 0.2), (3.0, 40.0, 20.0)])
    x = precision.Array3(*map(precision.Float, np.concatenate([above, above - [0, 0, 50]]).T))
    found = []
    for flat in (False, True):
        tables = MeshTables(index, topology, flat=flat)
        light = MeshLight(precision.Float(vertices.ravel()), tables, [precision.Float(radiance)], True)
        coeffs = [c for k in range(2) for c in project_mesh_light(light.part(dr.opaque(index, k)), x, 3, method)]
        dr.eval(coeffs)
        found.append(np.array([np.array(c) for c in coeffs], dtype=float))
    front, back = np.split(found[1], 2)
    assert np.abs(found[1] - found[0]).max() < 20 * precision.eps
    assert (front[0, :3] > 1e-5).all() and not front[:, 3:].any() and (back[0, 3:] > 1e-5).all() and not back[:, :3].any()


def test_radiance_as_a_function(precision):
    """Of the faces' numbers, with four channels: as gathered where it is needed from tables of the caller's."""
    positions, _, faces, part, radiance = three_lights(precision.Float)
    tables = [precision.Float(channel) for channel in (*radiance.T, radiance.sum(axis=1))]
    topology = mesh_topology(faces, part)
    x = precision.vector(OUTSIDE)
    by_function = MeshLight(positions, topology, lambda face: [dr.gather(precision.Float, table, face) for table in tables], True)
    by_table = MeshLight(positions, topology, tables[:3], True)
    transfer = [precision.Float(float(t)) for t in np.cos(np.arange(16))]
    four, three = (np.array(mesh_shader(transfer, 3, "edge")(light.part(0), x)).ravel() for light in (by_function, by_table))
    assert np.allclose(four[:3], three, rtol=20 * precision.eps) and four[3] == pytest.approx(three.sum(), rel=100 * precision.eps)


@pytest.mark.parametrize("method", ["auto", "edge"])
def test_zonal_shader(precision, method):
    """Transfer that is symmetric about an axis: as the full one, from inside, outside and afar."""
    axis = np.array([0.6, 0.0, 0.8])
    weights = zonal_lambert(4)
    light = MeshLight(precision.Float(BOX.ravel()), mesh_topology([np.array(f) for f in BOX_FACES]), RADIANCE)
    points = precision.Array3(*(precision.Float(list(c)) for c in zip(INSIDE, OUTSIDE, (300.0, 20.0, 100.0))))
    found = np.array(zonal_mesh_shader(times_pole_value(weights), method)(light, points, precision.vector(axis)))
    basis = reference.sh_basis(axis, 4)
    l = np.repeat(np.arange(5), 2 * np.arange(5) + 1)
    transfer = np.array(weights)[l] * np.sqrt(4 * np.pi / (2 * l + 1)) * basis
    expected = np.array(mesh_shader([precision.Float(t) for t in transfer.tolist()], 4, method)(light, points))
    assert np.abs(found - expected).max() < 200 * precision.eps * np.abs(expected).max()


def test_pairs_stand_for_their_product(precision):
    light = MeshLight(precision.Float(BOX.ravel()), mesh_topology([np.array(f) for f in BOX_FACES]), RADIANCE)
    x, apex = precision.vector(OUTSIDE), precision.vector((0, 0, 1))
    pair, product = (light.sum(term, x, apex, 1)[0] for term in (lambda a, b, _: [(a[0], b[1])], lambda a, b, _: [a[0] * b[1]]))
    assert np.allclose(np.array(pair), np.array(product), rtol=40 * precision.eps) and np.abs(np.array(pair)).min() > 1e-3
