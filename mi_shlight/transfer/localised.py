"""Transfer of a point by rays: fitted to the directions that light can come from, or projected over the whole sphere.

The coefficients L of a light are exact and supported on the light alone, so that ``sum_lm T_lm L_lm = int_Q T_n(omega) d omega`` for *any*
band-limited T_n: all that counts is how well T_n follows the transfer T on the light Q. Projection spreads its error over the whole
sphere. Localised transfer is the least-squares fit

    min  int_C (T_n - T)^2 + eps int_{not C} (T_n - T)^2                                                                  (1)

with C a cone that holds the lights, and all places that they may move to. In a frame about the cone's axis the Gram matrix of (1) is block
diagonal in m and depends on the half-angle alone: inverse Cholesky factors are tabulated for a few dozen half-angles, and cones grow to
the next one. Rays go to the cone only.

What is known is left out of the fit: T is ``v n . omega / pi``, v the mean visibility, which the bands up to 1 hold exactly, and a rest
that vanishes where all of the light is seen, above the horizon, or nothing of it. There the fit has no error, from order 1 on. Outside
of the cone the rest is taken as zero.

**What a fit leaves out.** With F the inverse Cholesky factor of the Gram matrix, and b and L the integrals over the cone of the rest and of
a light of unit radiance times the harmonics,

    |int_Q (T_n - T)| <= sqrt(int_C rest^2 - |F b|^2) sqrt(Omega - |F L|^2)                                               (2)

for a light of solid angle Omega in the cone. By the weights of (1) the residual is orthogonal to the harmonics, so that only what they
leave of the light counts, and the factors are the norms of both (Cauchy-Schwarz). For a projection F = 1. The right one
grows with the cone and with eps, so any wider cone will do.

Rays lie on rings about the axis. A ring needs its Fourier series only, 2 order + 1 sums, and one set of Legendre functions. All rays of
a point stand for equal solid angles; rings are turned against each other by the golden ratio and a shift of the point's own.

Derived for this package; not in the papers.
"""
from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene import aligned
from ..sh.basis import sh_basis
from ..sh.lobes import sh_matrix
from ..sh.rotation import rotate_frame
from .cosine import cosine_bands
from .visibility import GOLDEN, lifted

KINDS = ("shadowed", "exact", "visibility")

SMALLEST, LARGEST = math.radians(1.5), math.radians(80)
"""Half-angles of cones. Wider ones gain nothing: transfer towards lights all around is projected."""

LEVELS = 64
"""Half-angles in the tables, in equal ratios: 6.5 % apart."""

MAX_FIT_ORDER = 14
"""Beyond it (1) is not worth the time that its kernels take to compile: 4 does for most shadows."""


ROUNDING = 1e-5
"""Part of a square that may be lost in float32 where it is the difference of two, of sums over a thousand rays."""

SMOOTH_NOISE = 0.02
"""Noise of what is smooth, rays on rings over independent rays: rather too large."""


class ConeFit:
    """Tables of the fit (1) for cones of all half-angles.

    Parameters
    ----------
    order : int
        1 to MAX_FIT_ORDER.
    eps : float
        1e-10 to 1. Coefficients grow as it falls, up to some 100 at 1e-8, and with them the rounding of what is shaded.
    """

    DRJIT_STRUCT = dict.fromkeys(("spread", "gain", "_factors"), object)

    def __init__(self, order: int, eps: float):
        self.order, self.eps = order, eps
        angles = half_angle(np.arange(LEVELS))
        identity = [np.eye(order + 1 - m)[np.tril_indices(order + 1 - m)] for m in range(order + 1)]
        factors = np.stack([*(packed_factors(angle, order, eps) for angle in angles), np.concatenate(identity)])
        self._size = factors.shape[1]
        self._factors = aligned(mi.Float, factors.ravel())
        self.spread = aligned(mi.Float, np.append(2 * np.sin(angles / 2) ** 2, 1))
        """``1 - cos`` of each half-angle; the last entry stands for the hemisphere about the normal, with projection in place of a fit."""
        twice = np.concatenate([np.full(len(block), 1 + (m > 0)) for m, block in enumerate(identity)])
        freedom = ((order + 1) ** 2 - eps * np.square(factors[:-1]) @ twice) / (1 - eps)      # trace of the Gram matrices' quotient
        self.gain = aligned(mi.Float, np.append(freedom / (4 * np.pi * np.sin(angles / 2) ** 2), projection_gain(order)))
        """Mean of ``|F Y|^2`` over the directions looked at: how noise enters (2)."""

    def level(self, angle):
        """Number of the half-angle next above `angle`; LEVELS, which is the hemisphere, if there is none."""
        step = math.log(LARGEST / SMALLEST) / (LEVELS - 1)
        level = dr.ceil(dr.log(dr.maximum(angle, SMALLEST) / SMALLEST) / step)
        return dr.select(angle < LARGEST, mi.UInt32(dr.clip(level, 0, LEVELS - 1)), LEVELS)

    def solve(self, level, moments: list) -> list:
        """Coefficients of the fit, given the integrals over the cone of T times the spherical harmonics; both in the cone's frame."""
        middle, out = self.whitened(level, moments), list(moments)
        for factor, index in self._blocks(level):
            for j, i in enumerate(index):
                out[i] = fused_dot([row[j] for row in factor[j:]], [middle[k] for k in index[j:]])
        return out

    def whitened(self, level, moments: list) -> list:
        """``F b`` of (2) for such integrals b; the sum of their squares is what the fit holds of a function."""
        out = list(moments)
        for factor, index in self._blocks(level):
            for row, i in zip(factor, index):
                out[i] = fused_dot(row, [moments[k] for k in index])
        return out

    def _blocks(self, level):
        """Rows of F for each m, and the coefficients that they belong to."""
        base = level * self._size
        for m in range(self.order + 1):
            rows = self.order + 1 - m
            factor = [[dr.gather(mi.Float, self._factors, base + i * (i + 1) // 2 + j) for j in range(i + 1)] for i in range(rows)]
            for sign in (1, -1)[:1 + (m > 0)]:
                yield factor, [l * (l + 1) + sign * m for l in range(m, self.order + 1)]
            base = base + rows * (rows + 1) // 2


def cone_fit(order: int, samples: int):
    """The `fit` for :py:func:`sample_transfer` with so many rays per point; None for orders that are projected in any case."""
    return ConeFit(order, cone_eps(samples)) if 0 < order <= MAX_FIT_ORDER else None


def cone_eps(samples: int) -> float:
    """``eps`` for so many rays per point: 1e-5 over their number, 1e-8 at least. Few rays say little about the finer shapes that a smaller
    one would let through. A factor of 10 changes the error of a soft shadow by a tenth (validation/soft_shadows.py).
    """
    return max(1e-5 / samples, 1e-8)


def half_angle(level):
    """Half-angle of the cones of a level, 0 to LEVELS - 1, in radians."""
    return SMALLEST * (LARGEST / SMALLEST) ** (level / (LEVELS - 1))


class Sampled(NamedTuple):
    """What the rays of a point have found."""

    coeffs: list
    """``(order + 1)**2`` coefficients."""
    visibility: object
    """Mean of V over the directions looked at, weighted by the cosine: 0 to 1."""
    variance: object
    """Estimated variance of `visibility`, from differences of neighbouring rays; rather too large, as those differ more than rays of
    different points in the same place. Of the coefficients projected over the sphere the sum of variances is about
    ``(order + 1)^2 / (4 pi)`` times it."""
    conflict: object
    """Part of the directions, weighted by the cosine, in which two lights of the group stand behind each other with an occluder between,
    which one V cannot represent."""
    residual: object
    """Square of the left factor of (2), 1/sr: estimated from these rays and, as they are what is fitted, with twice the part added that
    their noise hides."""
    axis: object
    angle: object
    """Cone of the fit; pi where transfer is projected."""


class Quality(NamedTuple):
    """What is known about the errors of a transfer vector."""

    visibility: object
    """As in :py:class:`Sampled`, 0 to 1."""
    residual: object
    """Left factor of (2)."""
    cut: object
    """Part v of the cosine that it holds to the band limit only, 0 to 1: its mean visibility as far as it is projected."""
    axis: object
    angle: object
    """A cone that holds those of all fits that it is made of; pi: the sphere."""
    deviation: object
    """Standard deviation of the visibility by the choice of rays."""
    spread: object
    """Standard deviation of the visibility between the baked points that are interpolated."""
    samples: object
    """Rays of a point."""


def sample_transfer(sight, p, n, order: int, samples: int, offset, active=True, *, kind: str = "shadowed", fit: ConeFit | None = None,
                    cell=0.0) -> Sampled:
    """Transfer from a group of lights to surface points, in spherical harmonics.

    Parameters
    ----------
    sight : LightSight or SkySight
        Tells what is visible.
    p, n : mi.Point3f, mi.Normal3f
        Points and unit normals; rays start at a small offset along `n`.
    samples : int
        Number of rays per point.
    offset : mi.Float
        Where the rings' azimuths begin, in [0, 1): different for each point, or the same.
    kind : str
        ``shadowed``: coefficients of ``V max(0, n . omega) / pi``, in 1/sr. ``exact``: of ``(V - v) max(0, n . omega) / pi``, v being the
        mean visibility returned; to be added to v times the exact unshadowed radiance. ``visibility``: of 1 - V, which goes on below the
        horizon as 1 - v.
    fit : ConeFit, optional
        Fit transfer to the lights' cone. Without it, it is projected over the sphere.
    cell : Float
        Distance from `p` up to which the transfer is going to be used.

    Where all lights of the group are seen, or none, there is no sampling error; with `fit`, and no light at the horizon, no other error
    either.
    """
    rings = max(1, round(math.sqrt(samples) / 2))
    if fit is None:
        axis, spread, below = n, mi.Float(1), mi.Bool(True)
    else:
        cone = sight.cone(p, n, cell)
        level = fit.level(cone.angle)
        narrow = level < LEVELS
        axis, spread, below = dr.select(narrow, cone.axis, n), dr.gather(mi.Float, fit.spread, level), cone.dips | ~narrow
    frame, origin, inverse_pi = mi.Frame3f(axis), lifted(p, n), 1 / math.pi
    zeros = lambda count: [mi.Float(0) for _ in range(count)]
    rays_before = lambda k: (samples * k * k + rings * rings // 2) // (rings * rings)         # rings equally wide

    def ring(k, seen, total, change, conflict, before, met, parts, wholes, sums, known):
        first = rays_before(k)
        count = mi.Float(rays_before(k + 1) - first)
        drop = spread * ((mi.Float(first) + 0.5 * count) / samples)
        z, rho, turn = 1 - drop, dr.sqrt(drop * (2 - drop)), mi.Float(k) * GOLDEN + offset
        turn -= dr.floor(turn)

        def ray(j, seen, total, change, conflict, before, met, parts, wholes, waves, known_waves):
            sin, cos = dr.sincos((j + turn) * (2 * math.pi / count))
            d = frame.to_world(mi.Vector3f(rho * cos, rho * sin, z))
            slope = dr.dot(n, d) * inverse_pi
            above = slope > 0
            weight = dr.select(above, slope, 0)
            visible, hidden, met = sight.look(origin, n, d, met, active & above)
            v = dr.select(visible, mi.Float(1), 0)
            if kind == "visibility":
                part, whole = dr.select(above, 1 - v, 0), dr.select(above, mi.Float(1), 0)
            else:
                part, whole = v * weight, dr.select(above | below, slope, 0) if kind == "shadowed" else weight
            waves, known_waves, c, s = list(waves), list(known_waves), mi.Float(1), mi.Float(0)
            for m in range(order + 1):
                for i, wave in ((order + m, c), (order - m, s))[:1 + (m > 0)]:
                    waves[i], known_waves[i] = dr.fma(part, wave, waves[i]), dr.fma(whole, wave, known_waves[i])
                c, s = dr.fma(c, cos, -(s * sin)), dr.fma(s, cos, c * sin)
            step = dr.select(before >= 0, weight * (v - before), 0)
            return (j + 1, dr.fma(v, weight, seen), total + weight, dr.fma(step, step, change), conflict + dr.select(hidden, weight, 0), v,
                    met, dr.fma(part, part, parts), dr.fma(whole, whole, wholes), waves, known_waves)

        start = (mi.Float(0), seen, total, change, conflict, before, met, parts, wholes, zeros(2 * order + 1), zeros(2 * order + 1))
        *found, waves, known_waves = dr.while_loop(start, lambda j, *_: j < count, ray, mode="symbolic")
        legendre, sums, known = sh_basis(mi.Vector3f(rho, 0, z), order), list(sums), list(known)
        for l in range(order + 1):
            for m in range(-l, l + 1):
                i, p_lm = l * (l + 1) + m, legendre[l * (l + 1) + abs(m)]
                sums[i], known[i] = dr.fma(p_lm, waves[order + m], sums[i]), dr.fma(p_lm, known_waves[order + m], known[i])
        return k + 1, *found[1:], sums, known

    size, last = (order + 1) ** 2, dr.select(active, mi.UInt32(rings), 0)
    start = (mi.UInt32(0), *zeros(4), mi.Float(-1), mi.Vector3f(dr.inf), *zeros(2), zeros(size), zeros(size))
    _, seen, total, change, conflict, _, _, parts, wholes, sums, known = dr.while_loop(start, lambda k, *_: k < last, ring, mode="symbolic")
    whole = dr.select(total > 0, total, 1)
    mean = seen / whole                               # 1 without rounding where all is visible
    constant, solid_angle = 1 - mean if kind == "visibility" else mean, spread * (2 * math.pi / samples)
    rest = [(a - constant * b) * solid_angle for a, b in zip(sums, known)]
    energy = ((1 - 2 * constant) * parts + constant * constant * wholes) * solid_angle      # part * whole is part^2
    gain, angle, held = projection_gain(order), mi.Float(math.pi), rest
    if fit is not None:
        gain, angle = dr.gather(mi.Float, fit.gain, level), dr.select(narrow, 2 * dr.asin(dr.sqrt(spread / 2)), math.pi)
        rest, held = fit.solve(level, rest), fit.whitened(level, rest)
    energy = dr.maximum(energy, 0)
    hidden_noise = gain * solid_angle * (solid_angle * change * 0.5 + SMOOTH_NOISE * energy)
    residual = dr.maximum(energy - fused_dot(held, held), 0) + 2 * hidden_noise + ROUNDING * energy
    coeffs = rotate_frame(rest, frame.s, frame.t, frame.n, order)
    if kind == "visibility":
        coeffs[0] += dr.select(total > 0, constant * math.sqrt(4 * math.pi), 0)
    elif kind == "shadowed":
        bands = cosine_bands(order)
        if fit is not None:
            bands = [dr.select(narrow, 4 / 3 if l == 1 else mi.Float(0), band) for l, band in enumerate(bands)]
        coeffs = [dr.fma(mean * bands[math.isqrt(i)], y, c) for i, (y, c) in enumerate(zip(sh_basis(n, order), coeffs))]
    return Sampled(coeffs, mean, change / (2 * whole * whole), conflict / whole, residual, axis, angle)


def projection_gain(order: int) -> float:
    """:py:attr:`ConeFit.gain` of a projection."""
    return (order + 1) ** 2 / (4 * math.pi)


def fused_dot(a: list, b: list):
    """Sum of the products of two lists."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:]):
        total = dr.fma(x, y, total)
    return total


def packed_factors(angle: float, order: int, eps: float) -> np.ndarray:
    """Inverse Cholesky factors of the Gram matrix of (1), block after block for m = 0 .. order, each its lower triangle by rows."""
    node, weight = np.polynomial.legendre.leggauss(order + 1)        # exact: two harmonics make a polynomial of degree 2 order in z
    drop = (1 + node) * math.sin(angle / 2) ** 2                     # 1 - z
    directions = np.stack([np.sqrt(drop * (2 - drop)), 0 * drop, 1 - drop], axis=1)
    basis = sh_matrix(directions, order) * np.sqrt(weight * math.sin(angle / 2) ** 2)[:, None]
    parts = []
    for m in range(order + 1):
        block = basis[:, [l * (l + 1) + m for l in range(m, order + 1)]] * math.sqrt(math.pi if m else 2 * math.pi)
        gram = (1 - eps) * block.T @ block + eps * np.eye(order + 1 - m)
        parts.append(np.linalg.inv(np.linalg.cholesky(gram))[np.tril_indices(order + 1 - m)])
    return np.concatenate(parts)
