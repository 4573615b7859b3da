"""Transfer symmetric about an axis: against reference coefficients times scipy's harmonics, and Phong against quadrature."""
import drjit as dr
import mpmath as mp
import numpy as np
import pytest

import reference
from mi_shlight.light.polygon import VertexList, interior_direction
from mi_shlight.light.zonal import shade_zonal, times_pole_value, zonal_lambert, zonal_phong, zonal_shader
from mi_shlight.transfer.cosine import cosine_transfer

QUAD = np.array([[-0.5, -0.4, 1.2], [0.6, -0.5, 1.0], [0.7, 0.5, 0.8], [-0.4, 0.6, 1.0]])
CONCAVE = np.array([[-1, -1, 1.5], [1, -1, 1.5], [1, 1, 1.5], [0, -0.2, 1.5], [-1, 1, 1.5]], dtype=float)
AXES = np.array([(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.48, -0.6, 0.64), (-0.36, 0.48, -0.8), (1, 1, 1)], dtype=float)


def shade(precision, vertices, axis, zonal, x=(0, 0, 0)):
    return shade_zonal([precision.vector(v) for v in vertices], precision.vector(x), precision.vector(axis), zonal)[0]


def transfer_vector(axis, zonal):
    """``T_lm = zonal_l sqrt(4 pi / (2 l + 1)) Y_lm(axis)`` by scipy's harmonics."""
    l = np.arange(len(zonal))
    factor = np.repeat(np.array(zonal) * np.sqrt(4 * np.pi / (2 * l + 1)), 2 * l + 1)
    return factor * reference.sh_basis(np.array(axis) / np.linalg.norm(axis), len(zonal) - 1)


def expected(vertices, axis, zonal, x=(0, 0, 0)):
    return transfer_vector(axis, zonal) @ reference.coefficients_quadrature(vertices, x, len(zonal) - 1, n=48)


# --- the transfers --------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("exponent", [0, 0.5, 1, 2, 3, 7.25, 64, 1000.0, 1e6])
def test_phong_by_quadrature(exponent):
    """``2 pi int_0^1 f(z) Y_l0(z) dz``; the lobe's weight as variable, u = z^(s + 1), takes its peak away."""
    ours = zonal_phong(exponent, 64)
    assert all(type(value) is float for value in ours)
    for l in (0, 1, 2, 3, 8, 21, 64):
        with mp.workdps(30):
            bands = mp.quad(lambda u: mp.legendre(l, u ** (1 / (mp.mpf(exponent) + 1))), [0, 0.5, 1])
            value = float(bands * mp.sqrt((2 * l + 1) / (4 * mp.pi)))
        assert ours[l] == pytest.approx(value, rel=1e-13, abs=1e-16)


def test_lambert_is_the_clamped_cosine():
    """Funk-Hecke factors of max(0, cos) / pi: 1, 2/3, 1/4, 0, -1/24, 0, 1/64 (Ramamoorthi and Hanrahan 2001, over pi)."""
    bands = np.array(zonal_lambert(6)) * np.sqrt(4 * np.pi / (2 * np.arange(7) + 1))
    np.testing.assert_allclose(bands, [1, 2 / 3, 1 / 4, 0, -1 / 24, 0, 1 / 64], rtol=1e-15)


def test_exponent_per_point():
    number = dr.llvm.ad.Float64
    exponents = [0.0, 1.0, 2.5, 300.0]
    wide = zonal_phong(number(exponents), 5)
    for i, exponent in enumerate(exponents):
        np.testing.assert_allclose([value.numpy()[i] for value in wide], zonal_phong(exponent, 5), rtol=1e-14)


# --- shading --------------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("case", reference.reference_cases(), ids=lambda c: c.name)
def test_reference(precision, case):
    """Order 14, two transfers, six axes: eps times the perimeter seen from x, however distant, grazing or slim the light."""
    omega = abs(case.coefficients[0]) * np.sqrt(4 * np.pi)
    unit = case.vertices / np.linalg.norm(case.vertices, axis=1, keepdims=True)
    perimeter = np.linalg.norm(unit - np.roll(unit, 1, axis=0), axis=1).sum()
    vertices = [precision.vector(v) for v in case.vertices]
    axes = precision.Array3(*(precision.Float(list(c)) for c in AXES.T))
    for zonal in (zonal_lambert(14), zonal_phong(20, 14)):
        truth = np.array([transfer_vector(axis, zonal) @ case.coefficients for axis in AXES])
        ours = np.array(shade_zonal(vertices, precision.vector((0, 0, 0)), axes, zonal))
        assert np.abs(ours - truth).max() <= 15 * precision.eps * max(perimeter, omega) * max(np.abs(zonal))


@pytest.mark.parametrize("order", [0, 1, 2, 3, 5, 8, 20, 33])
@pytest.mark.parametrize("polygon", [QUAD, CONCAVE], ids=["quad", "concave"])
def test_quadrature(polygon, order):
    """All degrees, odd and even, with coefficients of either sign."""
    zonal = np.cos(1.0 + np.arange(order + 1)).tolist()
    x, axis = (0.1, 0.2, -0.1), (0.3, -0.5, 0.9)
    ours = shade_zonal(polygon.tolist(), x, axis, zonal)
    assert ours == pytest.approx(expected(polygon, axis, zonal, x), rel=1e-11)


def test_highest_order():
    """Compiled in float32, and in Python floats."""
    zonal, vector = zonal_phong(300, 64), lambda v: dr.llvm.ad.Array3f(*map(float, v))
    axes = dr.llvm.ad.Array3f(*(dr.llvm.ad.Float(c.tolist()) for c in AXES.T))
    single = shade_zonal([vector(v) for v in QUAD], vector((0, 0, 0)), axes, zonal)
    double = [shade_zonal(QUAD.tolist(), (0, 0, 0), axis.tolist(), zonal) for axis in AXES]
    coeffs = reference.coefficients_quadrature(QUAD, (0, 0, 0), 64, n=48)
    truth = [transfer_vector(axis, zonal) @ coeffs for axis in AXES]
    assert max(truth) > 1e-3
    np.testing.assert_allclose(single, truth, atol=60 * 6e-8)
    np.testing.assert_allclose(double, truth, atol=60 * 1.2e-16)


def test_shader_equals_full_transfer(precision):
    """Same number as the dot product of the (order + 1)^2 coefficients with the clamped cosine's vector."""
    normal = precision.vector((0.48, -0.6, 0.64))
    vertices, x = [precision.vector(v) for v in QUAD], precision.vector((0.1, 0.2, 0.1))
    shaded = zonal_shader(normal, times_pole_value(zonal_lambert(8)))(VertexList(vertices), x, interior_direction(vertices, x))[0]
    transfer = [t[0] for t in cosine_transfer(normal, 8)]
    assert shaded == pytest.approx(transfer @ reference.coefficients_quadrature(QUAD, (0.1, 0.2, 0.1), 8), rel=20 * precision.eps)


def test_whole_sphere(precision):
    """A light all around sees only the mean of the transfer."""
    zonal, total = zonal_phong(4, 10), 0.0
    for signs in np.ndindex(2, 2, 2):
        s = 1 - 2 * np.array(signs)
        triangle = np.eye(3) * s[:, None]
        total += shade(precision, triangle if np.prod(s) > 0 else triangle[::-1], (0.3, -0.2, 0.7), zonal)
    assert total == pytest.approx(1, abs=60 * precision.eps)


def test_small_light(precision):
    """A light of 1e-3 rad, whose edges the papers' recurrence takes to two digits in float32, tends to the transfer at its centre."""
    zonal, l = zonal_lambert(8), np.arange(9)
    axis = np.array([0.3, -0.5, 0.9]) / np.linalg.norm([0.3, -0.5, 0.9])
    small = [(0.0005 * a, 0.0005 * b, 1) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    centre = np.polynomial.legendre.legval(axis[2], np.array(zonal) * np.sqrt((2 * l + 1) / (4 * np.pi)))
    assert shade(precision, small, axis, zonal) / 1e-6 == pytest.approx(centre, rel=1e-3)


def test_winding_and_length_of_the_axis(precision):
    zonal, axis = zonal_phong(3, 6), np.array([0.3, -0.2, 0.9])
    value = shade(precision, QUAD, axis, zonal)
    assert value > 0.1
    assert shade(precision, QUAD[::-1], axis, zonal) == pytest.approx(-value, rel=20 * precision.eps)
    assert shade(precision, QUAD, 1e6 * axis, zonal) == pytest.approx(value, rel=20 * precision.eps)


DEGENERATE = {
    "point at a vertex": ([(0, 0, 0), (1, 0, 1), (0, 1, 1)], (0, 0, 1)),
    "point on an edge": ([(-1, 0, 0), (1, 0, 0), (0, 1, 1)], (0, 0, 1)),
    "point on the plane": ([(1, 0, 0), (2, 0, 0), (2, 1, 0)], (1, 0, 0)),
    "point inside the light": ([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], (0, 0, 1)),
    "coincident vertices": ([(0, 0, 1), (0, 0, 1), (1, 0, 1), (0, 1, 1)], (0, 0, 1)),
    "all vertices equal": ([(0, 0, 1)] * 3, (0, 1, 0)),
    "zero area": ([(0, 0, 1), (1, 0, 1), (2, 0, 1)], (0, 0, 1)),
    "axis in an edge's plane": ([(1, 0, 0), (0, 1, 0), (0, 0, 1)], (1, 1, 0)),
    "no axis": ([(1, 0, 1), (0, 1, 1), (-1, -1, 1)], (0, 0, 0)),
    "huge coordinates": ([(-1e30, -1e30, 1e30), (1e30, -1e30, 1e30), (0, 1e30, 1e30)], (0, 0, 1)),
    "tiny coordinates": ([(-1e-30, -1e-30, 1e-30), (1e-30, -1e-30, 1e-30), (0, 1e-30, 1e-30)], (0, 0, 1)),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_input(precision, name):
    vertices, axis = DEGENERATE[name]
    value = shade(precision, vertices, axis, zonal_phong(2, 8))
    assert np.isfinite(value)
    if name in ("all vertices equal", "zero area", "point on the plane"):
        assert abs(value) < 40 * precision.eps
    if name == "coincident vertices":
        assert value == pytest.approx(shade(precision, vertices[1:], axis, zonal_phong(2, 8)), rel=40 * precision.eps)
    if name.startswith(("huge", "tiny")):
        assert value == pytest.approx(shade(precision, np.array(vertices) / vertices[0][2], axis, zonal_phong(2, 8)), rel=1e-5)


def test_wide_values_equal_single_ones(precision):
    """Points, axes and coefficients may all differ between lanes."""
    points = np.array([(0, 0, 0), (0.3, -0.2, 0.1), (0, 0, 3)])
    exponents = [1.0, 4.0, 9.5]
    wide = lambda rows: precision.Array3(*(precision.Float(list(map(float, c))) for c in np.transpose(rows)))
    together = shade_zonal([precision.vector(v) for v in QUAD], wide(points), wide(AXES[3:]), zonal_phong(precision.Float(exponents), 6))
    alone = [shade(precision, QUAD, a, zonal_phong(s, 6), p) for p, a, s in zip(points, AXES[3:], exponents)]
    np.testing.assert_allclose(together, alone, atol=20 * precision.eps)


def test_types():
    zonal = zonal_lambert(3)
    assert type(shade_zonal(QUAD.tolist(), (0, 0, 0), (0, 0, 1), zonal)) is float
    assert type(shade_zonal(QUAD.tolist(), dr.llvm.Array3f64(0, 0, 0), (0, 0, 1), zonal)) is dr.llvm.Float64
    mixed = [dr.llvm.ad.Float(1.0), 2, np.float32(3)]
    assert type(shade_zonal(QUAD.tolist(), (0, 0, 0), dr.llvm.ad.Array3f(0, 0, 1), mixed)) is dr.llvm.ad.Float


@pytest.mark.parametrize("moving", ["vertex", "point", "axis", "exponent"])
def test_autodiff_matches_finite_difference(moving):
    number, array = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64

    def value(t):
        vertices, x, axis = [array(*map(float, p)) for p in QUAD], array(0.0, 0.1, 0.0), array(0.3, -0.5, 0.9)
        exponent = number(3.0)
        if moving == "vertex":
            vertices[2] = vertices[2] + array(t, 0.5 * t, -t)
        elif moving == "point":
            x = x + array(t, 0.5 * t, -t)
        elif moving == "axis":
            axis = axis + array(t, 0.5 * t, -t)
        else:
            exponent = exponent + t
        return shade_zonal(vertices, x, axis, zonal_phong(exponent, 7))

    t = number(0.05)
    dr.enable_grad(t)
    dr.backward(value(t))
    central = (value(number(0.05 + 1e-5))[0] - value(number(0.05 - 1e-5))[0]) / 2e-5
    assert abs(central) > 1e-3
    assert dr.grad(t)[0] == pytest.approx(central, rel=1e-7)


@pytest.mark.parametrize("arguments, error, text", [
    ({"vertices": QUAD[:2].tolist()}, ValueError, r"'vertices' must have at least three entries"),
    ({"vertices": "abc"}, TypeError, r"'vertices' must be a list of 3-vectors"),
    ({"x": (0, 0)}, TypeError, r"'x' must be a 3-vector"),
    ({"axis": 1.0}, TypeError, r"'axis' must be a 3-vector"),
    ({"zonal": []}, ValueError, r"'zonal' must be a list of 1 to 65 floats, got \[\]"),
    ({"zonal": [0.0] * 66}, ValueError, r"'zonal' must be a list of 1 to 65 floats"),
    ({"zonal": 0.3}, TypeError, r"'zonal' must be a list .* got 0.3.*zonal_lambert"),
    ({"zonal": [0.3, "1"]}, TypeError, r"'zonal' must be a list .* got '1'"),
    ({"zonal": [dr.llvm.Float(1)]}, TypeError, r"'zonal' must be .* Dr.Jit floats only together with Dr.Jit vectors"),
])
def test_bad_arguments(arguments, error, text):
    with pytest.raises(error, match=r"shade_zonal\(\): " + text):
        shade_zonal(**{"vertices": QUAD.tolist(), "x": (0, 0, 0), "axis": (0, 0, 1), "zonal": [1.0], **arguments})


@pytest.mark.parametrize("call, error, text", [
    (lambda: zonal_phong(-1, 3), ValueError, r"zonal_phong\(\): 'exponent' must be a finite number >= 0, got -1"),
    (lambda: zonal_phong("1", 3), TypeError, r"zonal_phong\(\): 'exponent' must be"),
    (lambda: zonal_phong(1, 65), ValueError, r"zonal_phong\(\): 'order' must be an integer from 0 to 64, got 65"),
    (lambda: zonal_lambert(-1), ValueError, r"zonal_lambert\(\): 'order' must be an integer from 0 to 64, got -1"),
])
def test_bad_transfer(call, error, text):
    with pytest.raises(error, match=text):
        call()
