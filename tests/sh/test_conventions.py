"""Coefficients in other conventions stand for the same function: summed with the others' harmonics, made from scipy's."""
import itertools
import math

import numpy as np
import pytest
from scipy.special import sph_harm_y, sph_harm_y_all

import reference
from mi_shlight.sh import CONVENTIONS, Convention, from_convention, to_convention
from mi_shlight.sh.conventions import LAYOUTS, NORMS

ORDER = 4
RNG = np.random.default_rng(8)
COEFFS = RNG.normal(size=(ORDER + 1) ** 2)
THETA, PHI = np.arccos(RNG.uniform(-1, 1, 40)), RNG.uniform(0, 2 * np.pi, 40)
DIRECTIONS = np.stack([np.sin(THETA) * np.cos(PHI), np.sin(THETA) * np.sin(PHI), np.cos(THETA)], axis=1)
ALL = [Convention(*fields) for fields in itertools.product((True, False), NORMS, (True, False), LAYOUTS)]


def harmonic(convention, l, m):
    """``Y_lm`` of a convention at the test directions, by its definition."""
    signed = sph_harm_y(l, abs(m), THETA, PHI)                                # orthonormal, with (-1)^m
    norm = {"orthonormal": 1, "4pi": math.sqrt(4 * math.pi), "schmidt": math.sqrt(4 * math.pi / (2 * l + 1))}[convention.norm]
    value = norm * signed * (1 if convention.condon_shortley else (-1) ** m)
    if convention.complex:
        return value if m >= 0 else np.conj(value) * ((-1) ** m if convention.condon_shortley else 1)
    return value.real if m == 0 else math.sqrt(2) * (value.real if m > 0 else value.imag)


def entry(convention, coeffs, l, m):
    if convention.layout == "square":
        return coeffs[l, m]
    if convention.layout == "halves":
        return coeffs[int(m < 0), l, abs(m)]
    return coeffs[l * l + (l + m if convention.layout == "flat" else l - m)]


@pytest.mark.parametrize("convention", ALL, ids=str)
def test_same_function(convention):
    theirs = to_convention(COEFFS, convention)
    values = sum(entry(convention, theirs, l, m) * harmonic(convention, l, m) for l in range(ORDER + 1) for m in range(-l, l + 1))
    np.testing.assert_allclose(values, reference.sh_basis(DIRECTIONS, ORDER) @ COEFFS, atol=1e-13)
    back = from_convention(theirs, convention)
    assert back.dtype == np.float64
    np.testing.assert_allclose(back, COEFFS, atol=1e-14)


def test_scipy_takes_its_array():
    values = (to_convention(COEFFS, "scipy")[..., None] * sph_harm_y_all(ORDER, ORDER, THETA, PHI)).sum(axis=(0, 1))
    np.testing.assert_allclose(values, reference.sh_basis(DIRECTIONS, ORDER) @ COEFFS, atol=1e-13)


def test_names():
    assert CONVENTIONS["mi_shlight"] == Convention()
    np.testing.assert_array_equal(to_convention(COEFFS, "mi_shlight"), COEFFS)
    # The direction x: ours has -sqrt(3 / 4 pi) x; ambisonics' component X is x itself, its W is 1; geodesy's sqrt(3) x.
    x = np.array([1, 0, 0, -1 / math.sqrt(3)]) * math.sqrt(4 * math.pi)                    # 1 + x
    np.testing.assert_allclose(to_convention(x, "ambix"), [1, 0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(to_convention(x, "pyshtools"), [[[1, 0], [0, 1 / math.sqrt(3)]], np.zeros((2, 2))], atol=1e-15)
    np.testing.assert_allclose(to_convention(x, "unsigned"), x * [1, 1, 1, -1])


@pytest.mark.parametrize("convention", [c for c in ALL if c.complex and c.layout == "flat"], ids=str)
def test_complex_function(convention):
    """A function with complex values survives, where the harmonics are complex."""
    function = COEFFS + 1j * RNG.normal(size=COEFFS.shape)
    np.testing.assert_allclose(from_convention(to_convention(function, convention), convention), function, atol=1e-14)
    with pytest.raises(ValueError, match=r"to_convention\(\): 'coeffs' must be real"):
        to_convention(function, "ambix")


@pytest.mark.parametrize("call, error, argument", [
    (lambda: to_convention(np.ones(5), "ambix"), ValueError, "coeffs"),
    (lambda: to_convention(np.ones((2, 2)), "ambix"), ValueError, "coeffs"),
    (lambda: from_convention(np.ones(4), "scipy"), ValueError, "coeffs"),
    (lambda: from_convention(np.ones((2, 2)), "scipy"), ValueError, "coeffs"),
    (lambda: from_convention(np.ones((2, 2, 3)), "pyshtools"), ValueError, "coeffs"),
    (lambda: from_convention(np.ones((2, 3)), "ambix"), ValueError, "coeffs"),
    (lambda: to_convention(["a"] * 4, "ambix"), TypeError, "coeffs"), (lambda: to_convention(None, "ambix"), TypeError, "coeffs"),
    (lambda: to_convention([[1], [1, 2]], "ambix"), TypeError, "coeffs"),
    (lambda: from_convention(["a"] * 4, "ambix"), TypeError, "coeffs"),
    (lambda: to_convention(np.ones(66 ** 2), "ambix"), ValueError, "coeffs"),
    (lambda: from_convention(np.ones((2, 66, 66)), "pyshtools"), ValueError, "coeffs"),
    (lambda: from_convention(np.ones((2, 0, 0)), "pyshtools"), ValueError, "coeffs"),
    (lambda: to_convention(np.ones(4), "ambisonic"), ValueError, "convention"),
    (lambda: to_convention(np.ones(4), 3), TypeError, "convention"),
    (lambda: Convention(norm="4 pi"), ValueError, "norm"), (lambda: Convention(complex=1), TypeError, "complex")])
def test_bad_arguments(call, error, argument):
    with pytest.raises(error, match=rf"\(\): '{argument}' must "):
        call()
