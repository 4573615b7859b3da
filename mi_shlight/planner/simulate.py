"""Shaded values of all orders, kinds of transfer, ray counts and cell sizes at once, from what the probe's rays have seen.

The light and the rays are what a bake and a picture would have; only the fit is computed in numpy. Its inverse Cholesky factors for an
order are the leading blocks of those for a higher one, so ``sum_lm T_lm L_lm`` of order n is the partial sum, over the degrees up to n, of
one sum of order `ORDER`:

    value_n = sum_{l <= n} sum_m (F L)_lm (F M)_lm ,      F F^T the inverse Gram matrix, M the moments of transfer over the cone.       (1)

Derived for this package; see :py:mod:`mi_shlight.transfer.localised` for the fit.
"""
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..sh.lobes import sh_matrix
from ..transfer.cosine import cosine_bands
from ..transfer.localised import LEVELS, cone_eps, half_angle, packed_factors
from ..transfer.visibility import GOLDEN
from .probe import ORDER, Rows, Sight

BLOCK = 2048
"""Rows that are worked on together, to keep memory low."""


class Shaded(NamedTuple):
    """What the rows shade of one light group, by order: white surface, luminance."""

    shadowed: np.ndarray
    """(R, ORDER + 1)"""
    rest: np.ndarray
    """(R, ORDER + 1): what transfer ``exact`` adds to `mean` times the exact light."""
    mean: np.ndarray
    """(R,): mean visibility."""
    open: np.ndarray
    """(R, ORDER + 1): unshadowed transfer."""


def shade(sight: Sight) -> Shaded:
    """Values of all orders at the rows."""
    parts = [_shade_block(*(values[i:i + BLOCK] for values in sight[:-1])) for i in range(0, len(sight.level), BLOCK)]
    return Shaded(*map(np.concatenate, zip(*parts)))


def interpolated(rows: Rows, cells: int, values: np.ndarray, dark: np.ndarray) -> np.ndarray:
    """Values (P, ...) at the points, of (R, ...) at the rows of one set of `rows`. `dark` (R,): nothing of any light is seen, which in
    solid bodies the bake replaces by what is seen nearby.
    """
    corner, weight = rows.corner[cells], rows.weight[cells].copy()
    kept = weight * ~(rows.buried & dark)[corner]
    total = kept.sum(axis=1, keepdims=True)
    weight = np.where(total > 1e-6, kept / np.maximum(total, 1e-6), weight)
    return np.einsum("pc,pc...->p...", weight, values[corner])


def _shade_block(visible, level, dips, normal, light, shift) -> Shaded:
    count, samples = visible.shape
    spread = _spread(level)
    rings = max(1, round(math.sqrt(samples) / 2))
    bounds = [(samples * k * k + rings * rings // 2) // (rings * rings) for k in range(rings + 1)]
    seen = total = 0.0
    slopes = []
    for k, (first, last) in enumerate(zip(bounds, bounds[1:])):
        drop = spread * (0.5 * (first + last) / samples)
        turn = (k * GOLDEN + shift) % 1
        azimuth = (np.arange(last - first) + turn[:, None]) * (2 * math.pi / (last - first))
        rho = np.sqrt(drop * (2 - drop))
        flat = rho[:, None] * (normal[:, :1] * np.cos(azimuth) + normal[:, 1:2] * np.sin(azimuth))
        slope = (flat + (normal[:, 2] * (1 - drop))[:, None]) / math.pi
        weight = np.maximum(slope, 0)
        seen, total = seen + (weight * visible[:, first:last]).sum(axis=1), total + weight.sum(axis=1)
        slopes.append((slope, turn))
    mean = seen / np.where(total > 0, total, 1)
    waves = np.empty((2, count, rings, ORDER + 1), complex)
    for k, ((slope, turn), first, last) in enumerate(zip(slopes, bounds, bounds[1:])):
        weight, m = np.maximum(slope, 0), np.arange(ORDER + 1)
        whole = np.where((slope > 0) | dips[:, None] | (level == LEVELS)[:, None], slope, 0)
        twist = np.exp(-2j * math.pi * turn[:, None] * m / (last - first))
        for i, known in enumerate((whole, weight)):
            rest = weight * visible[:, first:last] - mean[:, None] * known
            waves[i, :, k] = np.fft.fft(rest, axis=1)[:, m % (last - first)] * twist
    coeffs = _complex(light)
    sums = np.zeros((2, count, ORDER + 1))
    for number in np.unique(level):
        at = np.flatnonzero(level == number)
        legendre = _legendre(number, bounds, samples)
        factors = _factors(number, cone_eps(samples))
        fitted = np.einsum("mij,rjm->rim", factors, coeffs[at])
        for i in range(2):
            moments = np.einsum("rkm,klm->rlm", waves[i, at], legendre) * (spread[at[0]] * 2 * math.pi / samples)
            sums[i, at] = (fitted * np.einsum("mij,rjm->rim", factors, moments).conj()).real.sum(axis=2)
    shadowed, rest = np.cumsum(sums, axis=2)
    zones = _zones(light, normal)
    bands = np.array(cosine_bands(ORDER))
    slope = np.where(np.arange(ORDER + 1) == 1, 4 / 3, 0.0)
    held = np.cumsum(zones * np.where((level < LEVELS)[:, None], slope, bands), axis=1)
    return Shaded(shadowed + mean[:, None] * held, rest, mean, np.cumsum(zones * bands, axis=1))


def _spread(level):
    """1 - cos of the half-angles; 1 stands for the hemisphere."""
    return np.where(level < LEVELS, 2 * np.sin(half_angle(np.minimum(level, LEVELS - 1)) / 2) ** 2, 1.0)


def _legendre(level: int, bounds: list, samples: int) -> np.ndarray:
    """Normalised Legendre functions on the rings: (rings, l, m)."""
    drop = _spread(level) * (0.5 * np.add(bounds[1:], bounds[:-1]) / samples)
    return _complex(sh_matrix(np.stack([np.sqrt(drop * (2 - drop)), 0 * drop, 1 - drop], axis=1), ORDER)).real


def _factors(level: int, eps: float) -> np.ndarray:
    """Inverse Cholesky factors (m, l, l') of the fit's Gram matrix."""
    out = np.zeros((ORDER + 1, ORDER + 1, ORDER + 1))
    packed, first = packed_factors(half_angle(level), ORDER, eps) if level < LEVELS else None, 0
    for m in range(ORDER + 1):
        i, j = np.tril_indices(ORDER + 1 - m)
        out[m, i + m, j + m] = np.eye(ORDER + 1)[i, j] if packed is None else packed[first:first + len(i)]
        first += len(i)
    return out


def _complex(coeffs: np.ndarray) -> np.ndarray:
    """Coefficients (R, N) as (R, l, m): cosine terms, less i times sine terms."""
    out = np.zeros((len(coeffs), ORDER + 1, ORDER + 1), complex)
    for l in range(ORDER + 1):
        out[:, l, :l + 1] = coeffs[:, l * (l + 1):(l + 1) ** 2]
        out[:, l, 1:l + 1] -= 1j * coeffs[:, l * l:l * (l + 1)][:, ::-1]
    return out


def _zones(light: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(R, l): part of each degree in what is symmetric about the normals."""
    terms = light * sh_matrix(normal, ORDER)
    return np.add.reduceat(terms, np.arange(ORDER + 1) ** 2, axis=1)
