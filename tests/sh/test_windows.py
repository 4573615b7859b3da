"""Windows: their formulas, and that they do what they are for."""
import math

import drjit as dr
import numpy as np
import pytest
from numpy.polynomial import Legendre

from mi_shlight.sh import reconstruct, window, window_factors

SMOOTHING = ("hann", "lanczos", "gauss")


def test_formulas():
    assert window_factors("none", 3) == [1.0] * 4
    assert window_factors("hann", 4, 4) == pytest.approx([1, 0.5 + math.sqrt(0.125), 0.5, 0.5 - math.sqrt(0.125), 0], abs=1e-15)
    assert window_factors("lanczos", 4, 4) == pytest.approx([1, math.sqrt(8) / math.pi, 2 / math.pi, math.sqrt(8) / (3 * math.pi), 0])
    assert window_factors("gauss", 2, 2) == pytest.approx([1, math.exp(-1), math.exp(-3)])


@pytest.mark.parametrize("kind", SMOOTHING)
@pytest.mark.parametrize("order", [0, 1, 8, 64])
def test_falls_from_one_to_nothing_beyond_the_order(kind, order):
    factors = window_factors(kind, order)
    assert factors[0] == 1 and len(factors) == order + 1
    assert all(a > b > 0 for a, b in zip(factors, factors[1:]))
    assert window_factors(kind, order) == window_factors(kind, order, order + 1)
    narrow = window_factors(kind, 8, 2.5)
    assert narrow[3:] == [0.0] * 6 if kind != "gauss" else max(narrow[4:]) < 2e-3


@pytest.mark.parametrize("kind", SMOOTHING)
def test_less_ringing(kind):
    """A cap of 30 degrees at order 8: what lies far outside of it, and below 0."""
    coeffs = np.zeros(81)
    for l in range(9):
        integral = Legendre.basis(l).integ()
        coeffs[l * (l + 1)] = math.sqrt(math.pi * (2 * l + 1)) * (integral(1) - integral(math.cos(math.pi / 6)))
    theta = np.radians(np.arange(0, 180, 0.5))
    directions = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=1)
    plain, smooth = (reconstruct(c, directions) for c in (coeffs, window(coeffs, kind)))
    assert plain.min() < -0.07 and smooth.min() > -0.016
    assert abs(smooth[theta > 1.2]).max() < 0.25 * abs(plain[theta > 1.2]).max()
    assert smooth.max() < 1.08 < 1.2 < plain.max()


def test_gauss_composes_as_diffusion():
    coeffs = np.random.default_rng(0).normal(size=49)
    np.testing.assert_allclose(window(window(coeffs, "gauss", 6), "gauss", 8), window(coeffs, "gauss", 4.8), atol=1e-14)


def test_types_follow():
    factors = np.repeat(window_factors("hann", 2), [1, 3, 5])
    np.testing.assert_allclose(window(np.ones((2, 9)), "hann"), [factors] * 2)
    assert window([1.0] * 9, "hann") == pytest.approx(factors.tolist())
    assert all(type(c) is dr.llvm.ad.Float for c in window([dr.llvm.ad.Float(1, 2)] * 9, "hann"))


@pytest.mark.parametrize("call, error, argument", [
    (lambda: window([1.0] * 3, "hann"), ValueError, "coeffs"), (lambda: window([1.0], "box"), ValueError, "kind"),
    (lambda: window([1.0], 3), TypeError, "kind"), (lambda: window([1.0], "hann", 0), ValueError, "width"),
    (lambda: window_factors("hann", -1), ValueError, "order"),
    (lambda: window("a", "hann"), TypeError, "coeffs"), (lambda: window([None], "hann"), TypeError, "coeffs"),
    (lambda: window(np.array(["a"]), "hann"), TypeError, "coeffs"), (lambda: window([1.0], "hann", "1"), TypeError, "width")])
def test_bad_arguments(call, error, argument):
    with pytest.raises(error, match=rf"\(\): '{argument}' must "):
        call()
