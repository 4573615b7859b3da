"""Coefficients in the conventions of other programs, and back.

Ours: real orthonormal harmonics with the Condon-Shortley sign (-1)^m (that of ``dr.sh_eval``), by flat index ``l (l + 1) + m``, cosines for
m > 0 and sines for m < 0. The others differ in up to four ways:

- sign: with or without (-1)^m;
- norm, the mean square of ``Y_lm`` over the sphere times 4 pi: ``orthonormal`` 1; ``4pi`` 4 pi; ``schmidt`` (semi-normalised, SN3D)
  ``4 pi / (2l + 1)``;
- complex: coefficients of ``Y_l^m = N P_l^|m| e^(i m phi)``, with ``Y_l^-m = (-1)^m conj(Y_l^m)`` if signed, without the factor otherwise;
- layout: ``flat`` as ours; ``descending`` with m from l to -l; ``square`` (n + 1, 2n + 1) by [l, m], negative m from the end as Python
  indexes; ``halves`` (2, n + 1, n + 1) by [0, l, m] for cosines and [1, l, m] for sines, or for m and -m.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..errors import check_choice, message
from .arguments import coefficients_order, numeric_array
from .lobes import MAX_ORDER

NORMS = ("orthonormal", "4pi", "schmidt")
LAYOUTS = ("flat", "descending", "square", "halves")


@dataclass(frozen=True)
class Convention:
    """How a program writes coefficients; the default is ours.

    Attributes
    ----------
    condon_shortley : bool
        Whether the harmonics have the sign (-1)^m.
    norm : str
        ``orthonormal``, ``4pi`` or ``schmidt``.
    complex : bool
        Whether they are complex.
    layout : str
        ``flat``, ``descending``, ``square`` or ``halves``.

    Raises
    ------
    TypeError, ValueError
        If `norm` or `layout` is none of these, or a flag is not a bool.
    """

    condon_shortley: bool = True
    norm: str = "orthonormal"
    complex: bool = False
    layout: str = "flat"

    def __post_init__(self):
        check_choice("Convention", "norm", self.norm, NORMS)
        check_choice("Convention", "layout", self.layout, LAYOUTS)
        for name in ("condon_shortley", "complex"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(message("Convention", name, "be True or False", getattr(self, name)))


CONVENTIONS = {
    "mi_shlight": Convention(),
    "scipy": Convention(complex=True, layout="square"),
    "pyshtools": Convention(condon_shortley=False, norm="4pi", layout="halves"),
    "ambix": Convention(condon_shortley=False, norm="schmidt"),
    "unsigned": Convention(condon_shortley=False),
}
"""By name: ours, which is also [G03]'s code and ``dr.sh_eval``; ``scipy.special.sph_harm_y_all``; pyshtools' default, geodesy; ambisonics
(ACN/SN3D); ours without the sign, as [G03] equation 10 and most of the literature on irradiance maps."""


def to_convention(coeffs, convention) -> np.ndarray:
    """Coefficients of ours in another convention, of the same function.

    Parameters
    ----------
    coeffs : array_like ((n + 1)**2,)
        Our coefficients, real; complex if the function is and the `convention` is complex, too.
    convention : Convention or str
        One, or the name of one in ``CONVENTIONS``.

    Returns
    -------
    ndarray of float64 or complex128, shaped as the layout says, 0 where there is no harmonic.

    Raises
    ------
    TypeError, ValueError
        If `coeffs` is of another form, or `convention` none.

    Notes
    -----
    Exact to rounding. The inverse of :py:func:`from_convention`.
    """
    convention = _convention("to_convention", convention)
    values = numeric_array("to_convention", "coeffs", "hold numbers", coeffs, allow_complex=True)
    order = coefficients_order("to_convention", "coeffs", values)
    if values.ndim != 1:
        raise ValueError(message("to_convention", "coeffs", "be an array ((n + 1)**2,)", f"an array {values.shape}"))
    l, m = _degrees(order)
    values = values / _factors(convention, l, m)
    if convention.complex:
        minus = values[l * (l + 1) - m]                # f = p sqrt2 Re Y + q sqrt2 Im Y = (p - i q) / sqrt2 Y + (p + i q) / sqrt2 conj(Y)
        joined = np.where(m >= 0, values - 1j * minus, minus + 1j * values) / math.sqrt(2)
        values = np.where(m == 0, values, joined * _conjugation(convention, m))
    elif np.iscomplexobj(values):
        raise ValueError(message("to_convention", "coeffs", "be real for a convention with real harmonics", coeffs))
    out = np.zeros(_shape(convention, order), dtype=values.dtype)
    out[_positions(convention, l, m)] = values
    return out


def from_convention(coeffs, convention) -> np.ndarray:
    """Coefficients of another convention in ours, of the same function.

    Parameters
    ----------
    coeffs : array_like
        Coefficients, shaped as the layout of `convention` says.
    convention : Convention or str
        One, or the name of one in ``CONVENTIONS``.

    Returns
    -------
    ndarray ((n + 1)**2,)
        float64; complex128 if the coefficients are those of a function that is not real.

    Raises
    ------
    TypeError, ValueError
        If `coeffs` is of another form, or `convention` none.

    Notes
    -----
    Exact to rounding. Whether a function given by complex harmonics is real is decided at 1e-9 of its largest coefficient.
    """
    convention = _convention("from_convention", convention)
    values = numeric_array("from_convention", "coeffs", "hold numbers", coeffs, allow_complex=True)
    order = values.shape[1] - 1 if convention.layout == "halves" and values.ndim == 3 else (
        len(values) - 1 if convention.layout == "square" and values.ndim == 2 else math.isqrt(max(values.size, 1)) - 1)
    if values.shape != _shape(convention, order) or not 0 <= order <= MAX_ORDER:
        shape = {"square": "(n + 1, 2n + 1)", "halves": "(2, n + 1, n + 1)"}.get(convention.layout, "((n + 1)**2,)")
        raise ValueError(message("from_convention", "coeffs", f"be an array {shape}, n from 0 to {MAX_ORDER}", f"an array {values.shape}"))
    l, m = _degrees(order)
    values = values[_positions(convention, l, m)]
    if convention.complex:
        values = values * _conjugation(convention, m)
        minus = values[l * (l + 1) - m]
        joined = np.where(m > 0, values + minus, 1j * (minus - values)) / math.sqrt(2)
        values = np.where(m == 0, values, joined)
        if abs(values.imag).max() <= 1e-9 * abs(values).max():
            values = values.real
    return values * _factors(convention, l, m)


def _convention(function: str, convention) -> Convention:
    if isinstance(convention, Convention):
        return convention
    return CONVENTIONS[check_choice(function, "convention", convention, CONVENTIONS, "Or pass a Convention.")]


def _degrees(order: int) -> tuple:
    """l and m by flat index."""
    l = np.repeat(np.arange(order + 1), 2 * np.arange(order + 1) + 1)
    return l, np.arange(len(l)) - l * (l + 1)


def _factors(convention: Convention, l, m):
    """Their real harmonics over ours."""
    norm = {"orthonormal": 1.0, "4pi": math.sqrt(4 * math.pi), "schmidt": np.sqrt(4 * math.pi / (2 * l + 1))}[convention.norm]
    return norm * (1.0 if convention.condon_shortley else np.where(m % 2, -1.0, 1.0))


def _conjugation(convention: Convention, m):
    """``Y_l^m`` over ``conj(Y_l^-m)`` for m < 0."""
    return np.where((m < 0) & (m % 2 == 1), -1.0, 1.0) if convention.condon_shortley else np.ones_like(m, dtype=float)


def _shape(convention: Convention, order: int) -> tuple:
    return {"square": (order + 1, 2 * order + 1), "halves": (2, order + 1, order + 1)}.get(convention.layout, ((order + 1) ** 2,))


def _positions(convention: Convention, l, m) -> tuple:
    """Index of each coefficient in their array."""
    if convention.layout == "square":
        return l, m
    if convention.layout == "halves":
        return np.where(m < 0, 1, 0), l, abs(m)
    return (l * (l + 1) + (m if convention.layout == "flat" else -m),)
