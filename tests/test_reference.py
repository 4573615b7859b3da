"""The oracles against exact values, against each other and against Dr.Jit's own harmonics; the stored reference data."""
import math

import drjit as dr
import numpy as np
import pytest

from tests.reference import (coefficients_mp, coefficients_quadrature, edge_moments_mp, expand_gradients, gradients_mp, irradiance_clipped,
                             reference_cases, sh_basis, solid_angle)

ORIGIN = (0.0, 0.0, 0.0)
OCTANT = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
SQUARE = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1.0]])


def first(name):
    return next(case for case in reference_cases() if case.name == name)


def random_directions(count, seed=0):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_sh_basis_low_degrees_in_closed_form():
    d = random_directions(20)
    x, y, z = d.T
    a, b, c = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi)), math.sqrt(5 / (16 * math.pi))
    exact = np.stack([np.full(20, math.sqrt(1 / (4 * math.pi))), -a * y, a * z, -a * x,
                      b * x * y, -b * y * z, c * (3 * z * z - 1), -b * x * z, b / 2 * (x * x - y * y)], axis=1)
    np.testing.assert_allclose(sh_basis(d, 2), exact, rtol=0, atol=1e-15)


def test_sh_basis_has_the_sign_and_index_of_drjit():
    for d in np.concatenate([random_directions(20), np.eye(3), -np.eye(3)]):
        expected = [float(v) for v in dr.sh_eval(dr.scalar.Array3f64(*d.tolist()), 9)]
        np.testing.assert_allclose(sh_basis(d, 9), expected, rtol=0, atol=1e-13)


def test_sh_basis_is_orthonormal():
    z, weight = np.polynomial.legendre.leggauss(20)
    azimuth = np.arange(40) * (2 * math.pi / 40)
    radius = np.sqrt(1 - z * z)[:, None]
    d = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.broadcast_to(z[:, None], (20, 40))], axis=-1)
    y = sh_basis(d, 14)
    gram = np.einsum("i,ijk,ijl->kl", weight * (2 * math.pi / 40), y, y)
    np.testing.assert_allclose(gram, np.eye(225), rtol=0, atol=1e-13)


@pytest.mark.parametrize("vertices, exact", [
    (OCTANT, math.pi / 2), (OCTANT[::-1], -math.pi / 2), (SQUARE, 2 * math.pi / 3),
    ([[0, 1, 0], [0, 1, 1], [1, 0, 1], [1, 0, 0]], math.acos(1 / 3)),
], ids=["octant", "octant reversed", "cube face", "arccos(1/3)"])
def test_solid_angle_exact(vertices, exact):
    assert solid_angle(vertices) == pytest.approx(exact, rel=1e-14)
    moved = np.array(vertices) + [1, 2, -3]
    assert solid_angle(moved, (1, 2, -3)) == pytest.approx(exact, rel=1e-14)
    assert coefficients_mp(moved, (1, 2, -3), 1)[0] * math.sqrt(4 * math.pi) == pytest.approx(exact, rel=1e-14)


@pytest.mark.parametrize("name", ["triangle", "quad", "heptagon", "star", "axis-aligned", "distance 10"])
def test_quadrature_agrees_with_line_integrals(name):
    case = first(name)
    values = coefficients_quadrature(case.vertices, ORIGIN, 14, n=40)
    np.testing.assert_allclose(values, case.coefficients, rtol=0, atol=1e-12 * np.abs(case.coefficients).max())


@pytest.mark.parametrize("name", ["triangle", "star", "axis-aligned", "distance 1e+06", "sliver 1e-06", "grazing 1e-06", "near 0.0001",
                                  "huge"])
def test_stored_values_recomputed(name):
    case, order = first(name), 5
    count = (order + 1) ** 2
    coeffs, normals, moments = edge_moments_mp(case.vertices, ORIGIN, order)
    for fresh, stored in ((coeffs, case.coefficients[:count]), (normals, case.normals), (moments, case.moments[..., :count]),
                          (expand_gradients(normals, moments), case.gradients[..., :count])):
        np.testing.assert_allclose(fresh, stored, rtol=0, atol=1e-13 * np.abs(stored).max())


def test_line_integrals_need_no_more_digits():
    case = first("distance 1e+06")
    fewer, more = (coefficients_mp(case.vertices, ORIGIN, 3, digits) for digits in (40, 80))
    np.testing.assert_array_equal(fewer, more)


@pytest.mark.parametrize("name", ["triangle", "star", "sliver 0.01"])
def test_gradients_are_derivatives_of_the_coefficients(name):
    case, order, h = first(name), 3, 1e-5
    direction = np.random.default_rng(1).normal(size=case.vertices.shape)
    x = np.array([0.01, -0.02, 0.03])
    ahead, behind = (coefficients_mp(case.vertices + step * direction, x, order) for step in (h, -h))
    exact = np.tensordot(direction, gradients_mp(case.vertices, x, order), axes=2)
    np.testing.assert_allclose(exact, (ahead - behind) / (2 * h), rtol=0, atol=1e-6 * np.abs(exact).max())


def test_moving_a_vertex_along_its_ray_changes_nothing():
    for case in reference_cases():
        slope = np.einsum("ik,ikc->ic", case.vertices, case.gradients)
        scale = np.abs(case.gradients).max() * np.abs(case.vertices).max()
        assert np.abs(slope).max() <= 1e-14 * scale


@pytest.mark.parametrize("normal", [[0, 0, 1], [0.6, 0, 0.8], [0.1, -0.3, math.sqrt(0.9)]])
def test_irradiance_above_the_horizon_is_degree_one(normal):
    square = SQUARE * [0.4, 0.5, 1]
    coeffs, scale = coefficients_quadrature(square, ORIGIN, 1, n=40), math.sqrt(4 * math.pi / 3)
    vector = scale * np.array([-coeffs[3], -coeffs[1], coeffs[2]])           # integral of omega
    assert irradiance_clipped(square, ORIGIN, normal) == pytest.approx(vector @ normal, rel=1e-13)
    assert irradiance_clipped(square[::-1], ORIGIN, normal) == pytest.approx(-vector @ normal, rel=1e-13)


def test_irradiance_is_clipped_at_the_horizon():
    right_half = SQUARE * [0.5, 1, 1] + [0.5, 0, 0]
    expected = irradiance_clipped(right_half, ORIGIN, [1, 0, 0])
    assert expected > 0.1
    assert irradiance_clipped(SQUARE, ORIGIN, [1, 0, 0]) == pytest.approx(expected, rel=1e-14)
    assert irradiance_clipped(SQUARE, ORIGIN, [0, 0, -1]) == 0
    huge = SQUARE * [1e6, 1e6, 1]
    assert irradiance_clipped(huge, ORIGIN, [0, 0, 1]) == pytest.approx(math.pi, rel=1e-5)
    assert irradiance_clipped(huge, ORIGIN, [1, 0, 0]) == pytest.approx(math.pi / 2, rel=1e-5)


def test_irradiance_of_a_clipped_non_convex_polygon_is_the_sum_of_its_fan():
    star = first("star").vertices
    normal = np.cross(star.mean(axis=0), [0.3, 0.2, 0.9])
    normal /= np.linalg.norm(normal)
    assert (star @ normal).min() < -0.1 and (star @ normal).max() > 0.1
    fan = sum(irradiance_clipped(star[[0, i, i + 1]], ORIGIN, normal) for i in range(1, len(star) - 1))
    assert irradiance_clipped(star, ORIGIN, normal) == pytest.approx(fan, rel=1e-13)


def test_stored_polygons():
    cases = reference_cases()
    assert len(cases) == 62 and len({case.name for case in cases}) == 21
    for case in cases:
        n = len(case.vertices)
        assert case.coefficients.shape == (225,) and case.gradients.shape == (n, 3, 225)
        np.testing.assert_array_equal(case.vertices, case.vertices.astype(np.float32))
        assert case.coefficients[0] > 0
        np.testing.assert_allclose(solid_angle(case.vertices), case.coefficients[0] * math.sqrt(4 * math.pi), rtol=2e-8)
