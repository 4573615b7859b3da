"""Legendre lobes that span the spherical harmonics of every band: the directions and weights behind the zonal recurrence.

Any spherical harmonic is a weighted sum of Legendre polynomials about fixed directions w_d ([W18] eqs. 9, 33),

    Y_lm(w) = sum_d  weights[l][l + m, d] * P_l(w . w_d).

By the addition theorem ``P_l(w . w_d) = sum_m A_l[d, m] Y_lm(w)`` with ``A_l[d, m] = 4 pi / (2l + 1) Y_lm(w_d)``, so the
weights of band l are a left inverse of ``A_l``. The condition number of ``A_l`` says how much of the rounding error of
the lobes' integrals reaches the coefficients.

Deviations from the papers: [W20] appendix B lets band l use the first ``2l + 1`` of ``2n + 1`` shared directions and inverts a
square matrix. Here every band uses all directions, of which there may be more, by the pseudo-inverse (the smallest weights): the
lower bands, which carry most of the light, become over-determined and well conditioned at no more recurrences. Up to order 20
the directions were optimised for this by ``validation/lobe_directions.py`` (condition below 7); above, a Fibonacci lattice with
n/2 extra lobes keeps the condition below 21.
"""
from __future__ import annotations

import functools
import math
import pathlib
from dataclasses import dataclass

import numpy as np

from ..errors import check_integer

MAX_ORDER = 64
"""Highest order that has lobes."""

STORED_ORDER = 20
"""Up to this order the lobes are read from data/lobes.npz."""

_DATA = pathlib.Path(__file__).parent / "data" / "lobes.npz"


@dataclass(frozen=True, eq=False)
class Lobes:
    """Lobe directions and weights of one order; all arrays are read-only.

    Attributes
    ----------
    directions : ndarray (D, 3), float64
        Unit vectors with z >= 0 (-w_d is the same lobe up to the sign (-1)^l). Up to order 20 their float32 rounding is a unit vector
        to 1e-10, so single precision evaluates the very lobes that the weights were made for.
    weights : tuple of ``order + 1`` ndarrays (2l + 1, D_l), float64
        Band l uses the first ``D_l <= D`` directions; row ``l + m`` belongs to ``Y_lm``.
    condition : ndarray (order + 1,), float64
        Condition number (2-norm) of each band's matrix ``A_l``.
    """

    directions: np.ndarray
    weights: tuple
    condition: np.ndarray


@functools.lru_cache(maxsize=None)
def lobes(order: int) -> Lobes:
    """Lobes for all bands up to `order`.

    Parameters
    ----------
    order : int
        Highest degree n, 0 to 64. Up to 20 there are 2n + 1 to 2n + 5 optimised lobes, above 2n + 1 + n // 2.

    Returns
    -------
    Lobes
        Cached: equal orders return the same object.

    Raises
    ------
    TypeError, ValueError
        If `order` is not an integer from 0 to 64.

    Notes
    -----
    In float64 the weighted lobes reproduce ``Y_lm`` to 1e-13 up to order 20 and to 1e-12 up to order 64.
    """
    order = check_integer("lobes", "order", order, 0, MAX_ORDER)
    if order <= STORED_ORDER:
        with np.load(_DATA) as data:
            directions, weights, condition = (data[f"{key}_{order}"] for key in ("directions", "weights", "condition"))
        weights = tuple(weights[l * l:(l + 1) ** 2] for l in range(order + 1))
    else:
        directions = fibonacci_hemisphere(2 * order + 1 + order // 2)
        weights, condition = solve_weights(directions, order)
    for array in (directions, condition, *weights):
        array.setflags(write=False)
    return Lobes(directions, weights, condition)


def fibonacci_hemisphere(count: int) -> np.ndarray:
    """`count` nearly uniform unit vectors with z > 0: rings of equal area, turned by the golden angle each. Shape (count, 3)."""
    index = np.arange(count)
    z = (index + 0.5) / count
    azimuth = index * (math.pi * (3 - math.sqrt(5)))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def solve_weights(directions: np.ndarray, order: int) -> tuple:
    """Minimum-norm weights of each band over all `directions` (D, 3), and the bands' condition numbers.

    Returns a tuple of ``order + 1`` arrays (2l + 1, D) and an array (order + 1,). D must be at least ``2 * order + 1`` and the
    directions in general position, otherwise the condition is huge and the weights are meaningless.
    """
    basis, weights, condition = sh_matrix(directions, order), [], []
    for l in range(order + 1):
        lobe_matrix = 4 * math.pi / (2 * l + 1) * basis[:, l * l:(l + 1) ** 2]
        u, s, vt = np.linalg.svd(lobe_matrix, full_matrices=False)
        weights.append((vt.T / s) @ u.T)
        condition.append(s[0] / s[-1])
    return tuple(weights), np.array(condition)


def sh_matrix(directions: np.ndarray, order: int) -> np.ndarray:
    """Spherical harmonics of unit vectors (D, 3) in float64: array (D, (order + 1)**2), sign and index as ``sh_basis``.

    The numpy counterpart of :py:func:`mi_shlight.sh.basis.sh_basis` for set-up work that must not need a Dr.Jit backend.
    """
    x, y, z = np.asarray(directions, dtype=np.float64).T
    basis = np.empty((len(x), (order + 1) ** 2))
    cos_m, sin_m = np.ones_like(x), np.zeros_like(x)             # sin^m(theta) {cos, sin}(m phi)
    sectoral = np.full_like(x, math.sqrt(1 / (4 * math.pi)))
    for m in range(order + 1):
        if m:
            cos_m, sin_m = x * cos_m - y * sin_m, x * sin_m + y * cos_m
            sectoral = -math.sqrt((2 * m + 1) / (2 * m)) * sectoral
        scale = math.sqrt(2) if m else 1.0
        previous, current = np.zeros_like(x), sectoral
        for l in range(m, order + 1):
            if l > m:
                a = math.sqrt((4 * l * l - 1) / (l * l - m * m))
                b = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
                previous, current = current, a * (z * current - b * previous)
            basis[:, l * (l + 1) + m] = scale * current * cos_m
            if m:
                basis[:, l * (l + 1) - m] = scale * current * sin_m
    return basis
