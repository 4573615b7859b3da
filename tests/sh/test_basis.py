"""SH basis: sign and index of dr.sh_eval, any order, both precisions, all octants."""
import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight import sh_basis

# Every octant, the poles, the horizon, the axes.
DIRECTIONS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)]
                      + [(0.3, -0.2, 0.933), (-0.9, 0.1, -0.42), (1e-6, 2e-6, 1)], dtype=float)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def evaluate(array, number, directions, order):
    """(count, (order + 1)**2). Harmonics of one order m after the other: a kernel of all thousands would take half a minute to compile."""
    basis = sh_basis(array(*(number(list(c)) for c in directions.T)), order)
    for m in range(order + 1):
        dr.eval([basis[l * (l + 1) + sign * m] for l in range(m, order + 1) for sign in (-1, 1)])
    return np.array([np.broadcast_to(np.array(v), len(directions)) for v in basis]).T


@pytest.mark.parametrize("order", [0, 1, 2, 5, 8, 20, 64])
def test_matches_oracle(precision, order):
    # Coordinates as the engine sees them: rounding a direction moves Y by its slope, which grows with the order.
    seen = DIRECTIONS.astype(np.float32).astype(float) if precision.eps > 1e-10 else DIRECTIONS
    expected = reference.sh_basis(seen / np.linalg.norm(seen, axis=1, keepdims=True), order)
    error = np.abs(evaluate(precision.Array3, precision.Float, DIRECTIONS, order) - expected).max() / np.abs(expected).max()
    assert error < 12 * (order + 1) * precision.eps


def test_matches_drjit(precision):
    d = precision.Array3(*(precision.Float(list(c)) for c in DIRECTIONS.T))
    for ours, theirs in zip(sh_basis(d, 9), dr.sh_eval(d, 9), strict=True):
        assert np.allclose(np.array(ours), np.array(theirs), atol=60 * precision.eps)


def test_orthonormal():
    nodes, weights = np.polynomial.legendre.leggauss(24)
    azimuth = 2 * np.pi * np.arange(48) / 48
    z, phi = (g.ravel() for g in np.meshgrid(nodes, azimuth, indexing="ij"))
    r = np.sqrt(1 - z * z)
    d = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    y = evaluate(dr.llvm.ad.Array3f64, dr.llvm.ad.Float64, d, 20)
    gram = (y.T * np.repeat(weights, 48) * (2 * np.pi / 48)) @ y
    assert np.abs(gram - np.eye(441)).max() < 1e-13


@pytest.mark.parametrize("kind", [dr.scalar.Array3f64, dr.llvm.Array3f, dr.llvm.ad.Array3f64, list])
def test_type_follows_argument(kind):
    d = [0.0, 0.6, 0.8] if kind is list else kind(0, 0.6, 0.8)
    values = sh_basis(d, 2)
    expected = float if kind is list else type(d[1])
    assert all(type(v) is expected for v in values)
    assert abs(values[1] - -0.6 * np.sqrt(3 / (4 * np.pi))) < 1e-6 if expected is float else True


def test_derivative_matches_finite_difference():
    array, number = dr.llvm.ad.Array3f64, dr.llvm.ad.Float64
    x = number(0.4)
    dr.enable_grad(x)
    value = sum(c * (0.1 + i) for i, c in enumerate(sh_basis(array(x, 0.3, -0.5), 6)))
    dr.backward(value)
    f = lambda t: sum(c[0] * (0.1 + i) for i, c in enumerate(sh_basis(array(number(t), 0.3, -0.5), 6)))
    assert dr.grad(x)[0] == pytest.approx((f(0.4 + 1e-5) - f(0.4 - 1e-5)) / 2e-5, rel=1e-8)


@pytest.mark.parametrize("order, error", [(-1, ValueError), (3.5, ValueError), (10_000, ValueError), ("8", TypeError), (None, TypeError),
                                          (True, TypeError), (float("nan"), ValueError)])
def test_bad_order(order, error):
    with pytest.raises(error, match=r"sh_basis\(\): 'order' must be an integer from 0 to 64, got "):
        sh_basis([0.0, 0.0, 1.0], order)


@pytest.mark.parametrize("d", [3.0, [1.0, 2.0], "abc", None, dr.llvm.ad.Array2f(1, 2), dr.llvm.ad.Array3u(1, 2, 3)])
def test_bad_direction(d):
    with pytest.raises(TypeError, match=r"sh_basis\(\): 'd' must be a 3-vector"):
        sh_basis(d, 2)
