"""Cap lights and proxy shadows: against [G03]'s printed coefficients and quadrature with scipy's harmonics."""
import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight.environment.cap import project_cap, proxy_shadow

DIRECTIONS = [(0, 0, 1), (0, 0, -1), (0.6, 0, -0.8), (-0.48, 0.6, 0.64), (2, -3, 0)]


def numbers(values):
    """Width-1 results of one kernel as an array."""
    dr.eval(values)
    return np.array([float(v[0]) if dr.is_array_v(v) else v for v in values])


def cap_points(direction, half_angle, heights=48, turns=64):
    """Directions (N, 3) in a cap and weights (N,) that integrate polynomials over it."""
    d = np.array(direction) / np.linalg.norm(direction)
    z, weights = np.polynomial.legendre.leggauss(heights)
    half = (1 - np.cos(half_angle)) / 2
    z, weights = 1 - half * (1 - z), weights * half
    s = np.cross(d, np.eye(3)[np.argmin(abs(d))])
    s /= np.linalg.norm(s)
    phi = 2 * np.pi * np.arange(turns) / turns
    around = np.cos(phi)[:, None] * s + np.sin(phi)[:, None] * np.cross(d, s)
    points = z[:, None, None] * d + np.sqrt(1 - z * z)[:, None, None] * around
    return points.reshape(-1, 3), np.repeat(weights * 2 * np.pi / turns, turns)


def synth_light(cutoff):
    """[G03] "synth_light" for 0 < cutoff < pi, with its printed constants: the four coefficients that are not zero."""
    c, s2 = np.cos(cutoff), np.sin(cutoff) ** 2
    return {0: 3.544907702 - 1.772453851 - 1.772453851 * c, 2: 1.534990062 * s2, 6: -1.98166365 * c ** 3 + 1.98166365 * c,
            12: 2.930920062 - 2.930920062 * c ** 4 - 3.517104075 * s2}


@pytest.mark.parametrize("cutoff", [0.3, 1.2, 2.5])
def test_printed_coefficients(cutoff):
    """Ten digits are printed."""
    coeffs, printed = project_cap(cutoff, 3), synth_light(cutoff)
    for i, value in enumerate(coeffs):
        assert value == pytest.approx(printed.get(i, 0), abs=1e-9)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("half_angle", [0.02, 1.0, 3.0])
def test_cap_by_quadrature(direction, half_angle):
    points, weights = cap_points(direction, half_angle)
    expected = weights @ reference.sh_basis(points, 12)
    np.testing.assert_allclose(project_cap(half_angle, 12, direction), expected, atol=1e-13 * weights.sum())


def test_nothing_and_everything():
    assert project_cap(0, 4) == [0] * 25
    np.testing.assert_allclose(project_cap(np.pi, 4, (1, 2, 3)), [np.sqrt(4 * np.pi)] + [0] * 24, atol=1e-15)


def test_small_caps_keep_their_digits(precision):
    """Degree l of a cap of 1e-3 rad is its solid angle times Y_lm to (l theta)^2: no difference of large numbers."""
    d = np.array([0.48, -0.6, 0.64])
    coeffs = numbers(project_cap(precision.Float(1e-3), 8, precision.vector(d)))
    expected = np.pi * 1e-6 * reference.sh_basis(d, 8)
    np.testing.assert_allclose(coeffs, expected, rtol=1e-4, atol=1e-11)


def test_angles_and_directions_per_point(precision):
    angles, d = [0.1, 0.9, 2.0], np.array([(0, 0, 1.0), (0.6, 0, 0.8), (0, -2, 0)])
    coeffs = project_cap(precision.Float(angles), 5, precision.Array3(d.T))
    dr.eval(coeffs)
    for i in range(3):
        one = project_cap(angles[i], 5, d[i].tolist())
        np.testing.assert_allclose([c.numpy()[i] for c in coeffs], one, atol=40 * precision.eps)


def test_derivatives_of_a_cap():
    number, array = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    weights = np.random.default_rng(0).normal(size=25).tolist()

    def value(angle, x):
        return sum(w * c for w, c in zip(weights, project_cap(angle, 4, array(x, number(0.5), number(-0.3)))))

    for angle, x in ((0.7, 0.2), (0.0, 0.2), (3.0, -1.0)):
        inputs = dr.opaque(number, angle), dr.opaque(number, x)
        dr.enable_grad(inputs)
        dr.backward(value(*inputs))
        h = 1e-5
        for k, entry in enumerate(inputs):
            at = lambda step: value(*(number(v + step * (j == k)) for j, v in enumerate((angle, x))))[0]
            assert dr.grad(entry)[0] == pytest.approx((at(h) - at(-h)) / (2 * h), abs=1e-8)


# --- proxy shadows --------------------------------------------------------------------------------------------------------------

def expected_shadow(coeffs, direction, half_angle, order):
    """Light times the complement of the cap, projected: the rest after quadrature over the cap."""
    n = int(np.sqrt(len(coeffs))) - 1
    points, weights = cap_points(direction, half_angle)
    taken = (weights * (reference.sh_basis(points, n) @ coeffs)) @ reference.sh_basis(points, order)
    rest = np.zeros((order + 1) ** 2)
    kept = min(len(rest), len(coeffs))
    rest[:kept] = coeffs[:kept]
    return rest - taken


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("half_angle,order", [(0.3, None), (1.4, 3), (2.8, 7)])
def test_shadow_by_quadrature(direction, half_angle, order):
    coeffs = np.random.default_rng(1).normal(size=36)
    expected = expected_shadow(coeffs, direction, half_angle, 5 if order is None else order)
    np.testing.assert_allclose(proxy_shadow(coeffs.tolist(), direction, half_angle, order), expected, atol=1e-13)


def test_shadow_in_either_precision(precision):
    coeffs, d = np.random.default_rng(2).normal(size=25), np.array([(0.1, -0.9, 0.2), (0, 0.3, -1.0)])
    shadow = proxy_shadow([precision.Float(c) for c in coeffs.tolist()], precision.Array3(d.T), precision.Float(0.4, 1.1))
    dr.eval(shadow)
    for i, angle in enumerate((0.4, 1.1)):
        np.testing.assert_allclose([s.numpy()[i] for s in shadow], expected_shadow(coeffs, d[i], angle, 4), atol=60 * precision.eps)


def test_shadow_of_nothing_and_of_everything():
    coeffs = np.random.default_rng(3).normal(size=16).tolist()
    assert proxy_shadow(coeffs, (0, 1, 0), 0) == coeffs
    np.testing.assert_allclose(proxy_shadow(coeffs, (1, 1, 0), np.pi), np.zeros(16), atol=1e-14)


def test_shadow_of_a_constant_light_is_the_rest_of_a_cap():
    """The product with a constant is exact at any order, so this closed form has to come out."""
    rest = proxy_shadow([np.sqrt(4 * np.pi)], (0.3, -0.2, 0.5), 0.6, order=6)
    cap = project_cap(0.6, 6, (0.3, -0.2, 0.5))
    np.testing.assert_allclose(rest, [np.sqrt(4 * np.pi) - cap[0]] + [-c for c in cap[1:]], atol=1e-14)


def test_derivatives_of_a_shadow():
    number, array = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    rng = np.random.default_rng(4)
    start, weights = rng.normal(size=16).tolist(), rng.normal(size=16).tolist()

    def value(angle, x, first):
        shadow = proxy_shadow([first, *(number(c) for c in start[1:])], array(x, number(0.5), number(-0.3)), angle)
        return sum(w * c for w, c in zip(weights, shadow))

    at = 0.7, 0.2, start[0]
    inputs = tuple(dr.opaque(number, v) for v in at)
    dr.enable_grad(inputs)
    dr.backward(value(*inputs))
    for k, entry in enumerate(inputs):
        moved = lambda step: value(*(number(v + step * (j == k)) for j, v in enumerate(at)))[0]
        assert dr.grad(entry)[0] == pytest.approx((moved(1e-5) - moved(-1e-5)) / 2e-5, abs=1e-8)


@pytest.mark.parametrize("call,error,text", [
    (lambda: project_cap(-0.1, 3), ValueError, "'half_angle' must be a number from 0 to 3.14159, got -0.1"),
    (lambda: project_cap("wide", 3), TypeError, "'half_angle' must be a number"),
    (lambda: project_cap(0.5, 65), ValueError, "'order' must be an integer from 0 to 64"),
    (lambda: project_cap(0.5, 3, "up"), TypeError, "'direction' must be a 3-vector"),
    (lambda: project_cap(0.5, 2, (0, np.inf, 1)), ValueError, "'direction' must be a 3-vector of finite length other than 0, got .0.0, i"),
    (lambda: project_cap(0.5, 2, dr.llvm.Array3f(0, 0, 0)), ValueError, "'direction' must be a 3-vector of finite length"),
    (lambda: project_cap(dr.llvm.Float(0.5, 1), 2, (0, 0, 0)), ValueError, "'direction' must be a 3-vector of finite length"),
    (lambda: project_cap(0.5, 2, [(0, 0, 1)]), TypeError, "'direction' must be a single 3-vector"),
    (lambda: project_cap(0.5, 2, np.array([0, 0, 1j])), TypeError, "'direction' must be a 3-vector of floating"),
    (lambda: proxy_shadow([1.0], (0, 0, 0), 0.3), ValueError, "'direction' must be a 3-vector of finite length"),
    (lambda: proxy_shadow(np.ones((2, 4)), (0, 0, 1), 0.3), TypeError, "'coeffs' must be a list of 4 floats"),
    (lambda: proxy_shadow([1.0, 2.0], (0, 0, 1), 0.3), ValueError, "'coeffs' must"),
    (lambda: proxy_shadow(3.0, (0, 0, 1), 0.3), TypeError, "'coeffs' must"),
    (lambda: proxy_shadow([1.0], (0, 0, 1), 0.3, order=-1), ValueError, "'order' must"),
])
def test_errors(call, error, text):
    with pytest.raises(error, match=r"\(\): " + text):
        call()
