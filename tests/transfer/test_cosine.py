"""The clamped cosine in spherical harmonics, against quadrature and against Lambert's polygon formula."""
import drjit as dr
import numpy as np
import pytest
import reference

from mi_shlight.transfer.cosine import cosine_bands, cosine_transfer

NORMALS = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0), (0.48, -0.6, 0.64), (-0.36, 0.48, -0.8)]


def cosine_by_quadrature(normal, order):
    """Integral of ``max(0, n . w) / pi Y_lm`` over the hemisphere about `normal`: exact for polynomials of degree order + 1."""
    node, weight = np.polynomial.legendre.leggauss(order // 2 + 2)
    z, wz = (node + 1) / 2, weight / 2
    phi = 2 * np.pi * np.arange(order + 2) / (order + 2)
    tangent = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    tangent /= np.linalg.norm(tangent)
    radius = np.sqrt(1 - z ** 2)[:, None, None]
    d = radius * (np.cos(phi)[:, None] * tangent + np.sin(phi)[:, None] * np.cross(normal, tangent)) + z[:, None, None] * np.asarray(normal)
    return np.einsum("i,i,ijk->k", wz, z, reference.sh_basis(d, order)) * 2 / len(phi)


@pytest.mark.parametrize("order", [0, 1, 2, 7, 20])
@pytest.mark.parametrize("normal", NORMALS)
def test_quadrature(precision, order, normal):
    coeffs = cosine_transfer(precision.vector(normal), order)
    assert len(coeffs) == (order + 1) ** 2
    dr.eval(coeffs)
    # rounding of the basis grows with the degree; the given normals are unit to float64
    tolerance = precision.eps * 4 * (order + 2)
    np.testing.assert_allclose([c[0] for c in coeffs], cosine_by_quadrature(normal, order), atol=tolerance)


def test_bands_sum_to_the_cosine():
    """``sum_l (2 l + 1) / (4 pi) A_l / pi P_l(z)`` converges to max(0, z) / pi, slowest at the kink z = 0 (like 1 / order)."""
    bands = np.array(cosine_bands(60))
    series = (2 * np.arange(61) + 1) / (4 * np.pi) * bands
    z = np.linspace(-1, 1, 201)
    error = np.abs(np.polynomial.legendre.legval(z, series) - np.maximum(z, 0) / np.pi)
    assert error.max() < 0.5 / 60
    assert error[np.abs(z) > 0.3].max() < 3e-4


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.48, 0, 0.8771545)])
def test_lambert(normal):
    """For a light above the horizon the band-limited product converges to Lambert's irradiance / pi."""
    light = np.array([[-0.5, -0.4, 1.5], [0.6, -0.4, 1.6], [0.5, 0.7, 1.4]])
    normal = np.array(normal) / np.linalg.norm(normal)
    exact = reference.irradiance_clipped(light, (0, 0, 0), normal) / np.pi
    coeffs = reference.coefficients_quadrature(light, (0, 0, 0), 20)
    transfer = np.array(cosine_transfer(dr.scalar.Array3f64(*normal), 20))
    error = [abs(transfer[:(n + 1) ** 2] @ coeffs[:(n + 1) ** 2] / exact - 1) for n in (2, 8, 20)]
    assert error[0] > error[1], "the tail of the cosine should matter at order 2"
    assert error[1] < 5e-3 and error[2] < 5e-4
