"""Lobe directions and weights: they reproduce the spherical harmonics, and are as well conditioned as recorded."""
import json
import math
import pathlib

import numpy as np
import pytest
from scipy.special import eval_legendre

from mi_shlight.sh.lobes import MAX_ORDER, STORED_ORDER, fibonacci_hemisphere, lobes, sh_matrix, solve_weights
from tests.reference import sh_basis
from validation.lobe_directions import SCORE_TIE, misfit, snap_to_float32

RESULTS = pathlib.Path(__file__).parents[2] / "validation" / "results" / "lobe_directions.json"

# Largest error of a harmonic of magnitude up to 2 at order 20, 4 at order 64: rounding times condition (7, 21) times degree.
RECONSTRUCTION_TOLERANCE = {"stored": 1e-13, "fibonacci": 1e-12}


def sphere_directions():
    """Unit vectors in all octants, with the poles, the axes and the horizon."""
    random = np.random.default_rng(3).normal(size=(60, 3))
    special = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [1, 1, 0], [1e-9, 0, 1], [1, -1, -1e-9]]
    d = np.concatenate([random, special])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("order, tolerance", [(0, 1e-15), (1, 1e-15), (8, 1e-14), (20, 3e-14), (64, 1e-13)])
def test_sh_matrix_equals_scipy(order, tolerance):
    d = sphere_directions()
    assert sh_matrix(d, order).shape == (len(d), (order + 1) ** 2)
    np.testing.assert_allclose(sh_matrix(d, order), sh_basis(d, order), rtol=0, atol=tolerance)


@pytest.mark.parametrize("order", [*range(STORED_ORDER + 1), 21, 40, MAX_ORDER])
def test_weighted_lobes_are_the_harmonics(order):
    table, d = lobes(order), sphere_directions()[::3 if order > STORED_ORDER + 1 else 1]     # thousands of lobes
    cosine, exact = np.clip(d @ table.directions.T, -1, 1), sh_basis(d, order)
    assert len(table.weights) == order + 1
    worst = 0.0
    for l, weights in enumerate(table.weights):
        assert weights.shape[0] == 2 * l + 1 and 2 * l + 1 <= weights.shape[1] <= len(table.directions)
        values = eval_legendre(l, cosine[:, :weights.shape[1]]) @ weights.T
        worst = max(worst, np.abs(values - exact[:, l * l:(l + 1) ** 2]).max())
    assert worst <= RECONSTRUCTION_TOLERANCE["stored" if order <= STORED_ORDER else "fibonacci"]


@pytest.mark.parametrize("order", [0, 1, 8, 14, 20, 21, 64])
def test_condition_numbers_are_those_of_the_lobe_matrices(order):
    table = lobes(order)
    basis = sh_basis(table.directions, order)
    for l, condition in enumerate(table.condition):
        np.testing.assert_allclose(condition, np.linalg.cond(basis[:, l * l:(l + 1) ** 2]), rtol=1e-9)


@pytest.mark.parametrize("order, bound", [(order, 7) for order in range(STORED_ORDER + 1)] + [(21, 21), (44, 21), (64, 21)])
def test_well_conditioned(order, bound):
    assert lobes(order).condition.max() < bound


@pytest.mark.parametrize("order", range(STORED_ORDER + 1))
def test_stored_directions_are_exact_in_float32(order):
    table = lobes(order)
    assert 2 * order + 1 <= len(table.directions) <= 2 * order + 5
    assert (table.directions[:, 2] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(table.directions, axis=1), 1, rtol=0, atol=4e-16)
    rounded = table.directions.astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(table.directions, rounded, rtol=0, atol=1e-10)


@pytest.mark.parametrize("order", [1, 8, 14, 20])
def test_stored_weights_have_minimum_norm(order):
    table = lobes(order)
    for stored, solved in zip(table.weights, solve_weights(table.directions, order)[0]):
        np.testing.assert_allclose(stored, solved, rtol=0, atol=1e-13 * np.abs(solved).max())


def test_results_of_the_optimisation_describe_the_stored_lobes():
    rows = json.loads(RESULTS.read_text())["orders"]
    assert [row["order"] for row in rows] == list(range(1, STORED_ORDER + 1))
    for row in rows:
        table, chosen = lobes(row["order"]), row["chosen"]
        assert len(table.directions) == chosen["lobes"]
        np.testing.assert_allclose(table.condition.max(), chosen["condition_max"], rtol=1e-3)
        assert chosen["score"] <= SCORE_TIE * min(candidate["score"] for candidate in row["candidates"])
        assert chosen["float32_reference_max"] <= 5e-6


def test_cached_and_read_only():
    table = lobes(3)
    assert lobes(3) is table
    for array in (table.directions, table.condition, *table.weights):
        assert array.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    with pytest.raises(AttributeError):
        table.directions = None


@pytest.mark.parametrize("order, error", [(-1, ValueError), (3.5, ValueError), (65, ValueError), (10_000, ValueError),
                                          (math.nan, ValueError), ("8", TypeError), (None, TypeError)])
def test_bad_order(order, error):
    with pytest.raises(error, match=r"lobes\(\): 'order' must be an integer from 0 to 64, got "):
        lobes(order)


@pytest.mark.parametrize("count", [1, 2, 50])
def test_fibonacci_hemisphere(count):
    d = fibonacci_hemisphere(count)
    assert d.shape == (count, 3) and (d[:, 2] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=0, atol=4e-16)
    np.testing.assert_allclose(d[:, 2].mean(), 0.5, rtol=1e-14)      # the mean height of a hemisphere, by equal areas


@pytest.mark.parametrize("sizes", [[13] * 6, [3, 5, 7, 9, 11, 13]], ids=["shared", "nested"])
def test_gradient_of_the_optimised_measure(sizes):
    rng = np.random.default_rng(5)
    flat = 1.3 * (fibonacci_hemisphere(13)[rng.permutation(13)] + 0.1 * rng.normal(size=(13, 3))).ravel()
    gradient = misfit(flat, 5, sizes)[1]
    direction = rng.normal(size=flat.shape)
    h = 1e-6
    difference = (misfit(flat + h * direction, 5, sizes)[0] - misfit(flat - h * direction, 5, sizes)[0]) / (2 * h)
    np.testing.assert_allclose(gradient @ direction, difference, rtol=1e-5)


def test_optimised_measure_is_one_for_an_orthonormal_frame():
    value, gradient = misfit(np.eye(3).ravel(), 1, [3, 3])
    np.testing.assert_allclose(value, 1, rtol=1e-14)
    np.testing.assert_allclose(gradient, 0, atol=1e-13)


def test_snapping_moves_little_and_makes_float32_exact():
    d = sphere_directions()
    snapped = snap_to_float32(d)
    assert np.abs(snapped - d).max() < 1e-3
    np.testing.assert_allclose(np.linalg.norm(snapped, axis=1), 1, rtol=0, atol=4e-16)
    np.testing.assert_allclose(snapped, snapped.astype(np.float32), rtol=0, atol=1e-9)
    np.testing.assert_allclose(snapped[:60], snapped[:60].astype(np.float32), rtol=0, atol=1e-10)
    np.testing.assert_array_equal(snapped[d == 0], 0)
