"""Windows that tame the ringing of functions cut off at some degree."""
from __future__ import annotations

import math

import numpy as np

from ..errors import check_choice, check_number
from .arguments import check_coefficients
from .basis import check_order

KINDS = ("none", "hann", "lanczos", "gauss")


def window_factors(kind: str, order: int, width: float = None) -> list:
    """Factors of the degrees 0 .. order of a window.

    With ``t = l / width``: ``hann``: ``(1 + cos(pi t)) / 2``, 0 beyond t = 1; ``lanczos``: ``sin(pi t) / (pi t)``, 0 beyond t = 1;
    ``gauss``: ``exp(-2 l (l + 1) / width^2)``, which spreads the function over the sphere as diffusion does, by ``2 / width`` radians
    (G03 advises to "window by pre-filtering with a Gaussian"); ``none``: 1.

    Parameters
    ----------
    kind : str
        ``none``, ``hann``, ``lanczos`` or ``gauss``.
    order : int
        Highest degree, 0 to 64.
    width : float
        Degree at which hann and lanczos vanish and gauss is 0.13; at least 0.1. Default: ``order + 1``.

    Returns
    -------
    list of order + 1 floats, the first 1: the mean over the sphere stays.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of its range.
    """
    kind, order = check_choice("window_factors", "kind", kind, KINDS), check_order("window_factors", order)
    width = order + 1 if width is None else check_number("window_factors", "width", width, 0.1)
    degrees = range(order + 1)
    if kind == "none":
        return [1.0] * (order + 1)
    if kind == "gauss":
        return [math.exp(-2 * l * (l + 1) / width ** 2) for l in degrees]
    inside = [min(l / width, 1.0) for l in degrees]
    if kind == "hann":
        return [0.5 + 0.5 * math.cos(math.pi * t) for t in inside]
    return [float(np.sinc(t)) if t < 1 else 0.0 for t in inside]


def window(coeffs, kind: str, width: float = None):
    """Coefficients times a window: the function is smoothed alike everywhere and rings less.

    Parameters
    ----------
    coeffs : sequence of (n + 1)**2 floats, or ndarray (..., (n + 1)**2)
        Coefficients: Dr.Jit or Python floats, or a numpy array, real or complex.
    kind, width
        As for :py:func:`window_factors`.

    Returns
    -------
    list, or ndarray.

    Raises
    ------
    TypeError, ValueError
        If `coeffs` does not have (n + 1)**2 numbers, or another argument is out of its range.

    Notes
    -----
    The price is sharpness. A cap of half-angle 30 degrees and height 1, at order 8:

    ========  =========  ==========  =================
    window    overshoot  undershoot  relative L2 error
    ========  =========  ==========  =================
    none      26 %       7.5 %       38 %
    lanczos   7.5 %      1.5 %       43 %
    hann      none       1.0 %       47 %
    gauss     none       1.0 %       46 %
    ========  =========  ==========  =================

    Measured by ``validation/green.py``.
    """
    coeffs, order = check_coefficients("window", "coeffs", coeffs)
    factors = [factor for l, factor in enumerate(window_factors(kind, order, width)) for _ in range(2 * l + 1)]
    if isinstance(coeffs, np.ndarray):
        return coeffs * np.array(factors)
    return [coefficient * factor for coefficient, factor in zip(coeffs, factors)]
