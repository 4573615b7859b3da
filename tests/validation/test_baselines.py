"""The baselines are right, so that comparing with them means something."""
import drjit as dr
import numpy as np
import pytest
from scipy.special import eval_legendre

import reference
from mi_shlight.light.polygon import VertexList, interior_direction
from validation.baselines import MAX_MONOMIAL_ORDER, legendre_coefficients, monomial_shader, project_monomial, project_monte_carlo

POLYGONS = {
    "triangle": np.array([[0.3, -0.2, 1.0], [0.9, 0.4, 0.8], [-0.5, 0.7, 1.1]]),
    "quad": np.array([[-0.5, -0.4, 1.2], [0.6, -0.5, 1.0], [0.7, 0.5, 0.8], [-0.4, 0.6, 1.0]]),
    "concave": np.array([[-1, -1, 1.5], [1, -1, 1.5], [1, 1, 1.5], [0, -0.2, 1.5], [-1, 1, 1.5]]),
}
POINT = (0.1, 0.2, -0.1)


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def test_legendre_coefficients():
    z = np.linspace(-1, 1, 41)
    for l, series in enumerate(legendre_coefficients(MAX_MONOMIAL_ORDER)):
        assert [k for k, _ in series] == list(range(l % 2, l + 1, 2))
        assert np.allclose(sum(p * z ** k for k, p in series), eval_legendre(l, z), atol=1e-16 * 10 * 2.5 ** l)


@pytest.mark.parametrize("name, order", [*(("quad", order) for order in (0, 1, 2, 8)), *((name, 3) for name in POLYGONS)])
def test_monomials(precision, name, order):
    vertices, x = [precision.vector(v) for v in POLYGONS[name]], precision.vector(POINT)
    apex, exact = interior_direction(vertices, x), reference.coefficients_quadrature(POLYGONS[name], POINT, order, n=40)
    coeffs = project_monomial(VertexList(vertices), x, apex, order)
    dr.eval(coeffs)
    tolerance = 30 * precision.eps * 1.5 ** order     # some of the 2.4^order that equation (3) can cost
    assert relative(np.array([c[0] for c in coeffs], dtype=float), exact) < max(tolerance, 1e-14)
    weights = np.cos(np.arange((order + 1) ** 2))
    shaded = monomial_shader([precision.Float(float(w)) for w in weights], order)(VertexList(vertices), x, apex)
    assert abs(shaded[0] - weights @ exact) < tolerance * np.linalg.norm(weights) * np.linalg.norm(exact)


def test_monomials_lose_digits_with_the_order(precision):
    """Why nobody should use them: the zonal recurrence stays at rounding error (tests/light)."""
    vertices, x = [precision.vector(v) for v in POLYGONS["quad"]], precision.vector(POINT)
    coeffs = project_monomial(VertexList(vertices), x, interior_direction(vertices, x), 14)
    dr.eval(coeffs)
    error = relative(np.array([c[0] for c in coeffs], dtype=float), reference.coefficients_quadrature(POLYGONS["quad"], POINT, 14, n=40))
    assert 1e3 < error / precision.eps < 1e6


@pytest.mark.parametrize("function", [
    lambda vertices, x, order: project_monomial(VertexList(vertices), x, x, order),
    lambda vertices, x, order: monomial_shader([dr.llvm.ad.Float(0)] * (order + 1) ** 2, order),
])
def test_monomials_have_a_limit(function):
    vertices = [dr.llvm.ad.Array3f(*map(float, v)) for v in POLYGONS["triangle"]]
    with pytest.raises(ValueError, match=r"'order' must be at most 14, got 15"):
        function(vertices, dr.llvm.ad.Array3f(0, 0, 0), 15)


def monte_carlo(precision, polygon, order, side, runs=4096, **options):
    """Independent estimates (runs, C) and the exact coefficients."""
    vertices, x = [precision.vector(v) for v in polygon], precision.vector(POINT)
    x[0] = x[0] + dr.zeros(precision.Float, runs)
    coeffs = project_monte_carlo(vertices, x, order, side, **options)
    dr.eval(coeffs)
    return np.array([np.array(c) for c in coeffs], dtype=float).T, reference.coefficients_quadrature(polygon, POINT, order, n=40)


@pytest.mark.parametrize("name", POLYGONS)
@pytest.mark.parametrize("stratified", [False, True])
def test_monte_carlo_is_unbiased(precision, name, stratified):
    values, exact = monte_carlo(precision, POLYGONS[name], 3, 4, stratified=stratified)
    deviation = np.abs(values.mean(axis=0) - exact) / (values.std(axis=0) / np.sqrt(len(values)))
    assert deviation.max() < 4.5                      # sixteen values from equal seeds: it either holds or does not


def test_monte_carlo_above_the_order_of_dr_sh_eval(precision):
    values, exact = monte_carlo(precision, POLYGONS["triangle"], 11, 4)
    assert relative(values.mean(axis=0), exact) < 0.01


@pytest.mark.parametrize("stratified, gain", [(False, 4), (True, 16)])
def test_monte_carlo_converges(precision, stratified, gain):
    """Four times the side: error down by 4, of strata by 16."""
    coarse, fine = (monte_carlo(precision, POLYGONS["quad"], 2, side, stratified=stratified) for side in (4, 16))
    errors = [np.sqrt(np.mean((values - exact) ** 2)) for values, exact in (coarse, fine)]
    assert errors[0] / errors[1] == pytest.approx(gain, rel=0.1)


def test_monte_carlo_seeds(precision):
    run = lambda seed: monte_carlo(precision, POLYGONS["quad"], 1, 2, runs=64, seed=seed)[0]
    assert np.array_equal(run(5), run(5))
    assert np.abs(np.corrcoef(run(5)[:, 0], run(6)[:, 0])[0, 1]) < 0.5


def test_monte_carlo_triangles_are_independent(precision):
    """A square of two equal triangles: with common random numbers the variance would be twice as large."""
    square = np.array([[-1, -1, 3], [1, -1, 3], [1, 1, 3], [-1, 1, 3]]) + np.array(POINT)
    variance = lambda polygon: monte_carlo(precision, polygon, 0, 1, stratified=False)[0].var()
    assert variance(square) == pytest.approx(variance(square[[0, 1, 2]]) + variance(square[[0, 2, 3]]), rel=0.15)
