"""Oracles in plain numpy, scipy and mpmath: nothing here is imported from, or shared with, the package under test.

Conventions: real orthonormal spherical harmonics with the sign (-1)^m of ``drjit.sh_eval``; flat index l(l+1)+m, m > 0 cosine, m < 0 sine;
`order` is the highest degree; a polygon is an (N, 3) array seen from the point `x`, counter-clockwise from outside the unit sphere
about x for a positive result; unit radiance.
"""
from __future__ import annotations

import functools
import math
import pathlib
from dataclasses import dataclass

import mpmath as mp
import numpy as np
from scipy.special import sph_harm_y_all

DATA = pathlib.Path(__file__).parent / "data" / "reference.npz"


def sh_basis(d, order):
    """Spherical harmonics of unit vectors (..., 3) from scipy's complex ones: (..., (order + 1)**2)."""
    x, y, z = np.moveaxis(np.asarray(d, dtype=np.float64), -1, 0)
    harmonics = sph_harm_y_all(order, order, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))   # [l, m], sign (-1)^m included
    out = np.empty(x.shape + ((order + 1) ** 2,))
    for l in range(order + 1):
        out[..., l * (l + 1)] = harmonics[l, 0].real
        for m in range(1, l + 1):
            out[..., l * (l + 1) + m] = math.sqrt(2) * harmonics[l, m].real
            out[..., l * (l + 1) - m] = math.sqrt(2) * harmonics[l, m].imag
    return out


def solid_angle(vertices, x=(0, 0, 0)):
    """Signed solid angle of a polygon: triangle fan about the first vertex (Van Oosterom and Strackee 1983)."""
    v = np.asarray(vertices, dtype=np.float64) - x
    r = np.linalg.norm(v, axis=1)
    total = 0.0
    for i, j in zip(range(1, len(v) - 1), range(2, len(v))):
        numerator = v[0] @ np.cross(v[i], v[j])
        denominator = r[0] * r[i] * r[j] + (v[0] @ v[i]) * r[j] + (v[i] @ v[j]) * r[0] + (v[j] @ v[0]) * r[i]
        total += 2 * math.atan2(numerator, denominator)
    return total


def coefficients_quadrature(vertices, x, order, n=32):
    """Coefficients by cubature over the area of a planar polygon, n x n Gauss-Legendre points per triangle of a signed fan.

    ``d omega = (v . N) / |v|^3 dA``; a fan triangle (p, q, r) has the constant ``v . N dA = p . (q x r) s ds dt`` in Duffy coordinates
    v = p + s ((1 - t)(q - p) + t (r - p)). Converges geometrically, slowly where x is close to the polygon.
    """
    v = np.asarray(vertices, dtype=np.float64) - x
    node, weight = np.polynomial.legendre.leggauss(n)
    s, t = np.meshgrid((node + 1) / 2, (node + 1) / 2, indexing="ij")
    area = np.outer(weight, weight) / 4 * s
    coeffs = np.zeros((order + 1) ** 2)
    p = v[0]
    for q, r in zip(v[1:-1], v[2:]):
        points = p + s[..., None] * ((1 - t)[..., None] * (q - p) + t[..., None] * (r - p))
        distance = np.linalg.norm(points, axis=-1)
        measure = area * (p @ np.cross(q, r)) / distance ** 3
        coeffs += np.tensordot(measure, sh_basis(points / distance[..., None], order), axes=2)
    return coeffs


def irradiance_clipped(vertices, x, normal):
    """Irradiance at x on a surface with unit `normal`: Lambert's polygon formula after clipping at the horizon.

    ``E = 1/2 sum_e T_e n_e . normal``, T_e the arc and n_e the unit normal of the plane through x and edge e. Non-convex polygons may be
    cut into parts joined along the horizon: these joints are run through in both directions and cancel.
    """
    v, normal = np.asarray(vertices, dtype=np.float64) - x, np.asarray(normal, dtype=np.float64)
    height, above = v @ normal, []
    for i in range(len(v)):
        j = (i + 1) % len(v)
        if height[i] >= 0:
            above.append(v[i])
        if height[i] * height[j] < 0:
            above.append((height[i] * v[j] - height[j] * v[i]) / (height[i] - height[j]))
    total = 0.0
    for a, b in zip(above, above[1:] + above[:1]):
        cross = np.cross(a, b)
        length = np.linalg.norm(cross)
        if length > 0:
            total += 0.5 * math.atan2(length, a @ b) * (cross @ normal) / length
    return total


def coefficients_mp(vertices, x, order, digits=50):
    """Coefficients by line integrals in `digits`-digit arithmetic, rounded to float64 at the very end.

    For l >= 1 the divergence theorem on the sphere gives ``L_lm = 1/(l(l+1)) sum_e int_arc n_e . grad Y_lm dt``; L_00 is the solid
    angle over sqrt(4 pi). Exact to double rounding also for tiny, distant, grazing and sliver polygons.
    """
    return _project_mp(vertices, x, order, digits)[0]


def gradients_mp(vertices, x, order, digits=50):
    """Derivatives of the coefficients with respect to the vertices, (N, 3, (order + 1)**2), as :py:func:`coefficients_mp`."""
    return expand_gradients(*_project_mp(vertices, x, order, digits)[1:])


def edge_moments_mp(vertices, x, order, digits=50):
    """Coefficients, edge normals (N, 3) and edge moments (N, 2, (order + 1)**2); see :py:func:`expand_gradients`."""
    return _project_mp(vertices, x, order, digits)


def expand_gradients(normals, moments):
    """Gradients (N, 3, C) from what the two edges at each vertex contribute.

    Moving vertex i moves the arcs of edges i - 1 and i along their normals: ``dL/dp_i = - n_{i-1} moments[i-1, 1] - n_i moments[i, 0]``,
    where ``moments[e, k] = int_arc w_k(t) Y_lm(omega(t)) dt`` with ``w_0 = sin(T - t) / (|p_start| sin T)``,
    ``w_1 = sin t / (|p_end| sin T)``.
    """
    return -(normals[:, :, None] * moments[:, :1] + np.roll(normals[:, :, None] * moments[:, 1:], 1, axis=0))


@dataclass(frozen=True, eq=False)
class ReferenceCase:
    """One stored polygon, seen from the origin, with its coefficients and gradients to order 14."""

    name: str
    vertices: np.ndarray
    coefficients: np.ndarray
    normals: np.ndarray
    moments: np.ndarray

    @property
    def gradients(self):
        """Derivatives of the coefficients with respect to the vertices, (N, 3, 225)."""
        return expand_gradients(self.normals, self.moments)


@functools.lru_cache(maxsize=1)
def reference_cases():
    """All cases of data/reference.npz, in 50-digit arithmetic; provenance in data/generate_reference.py."""
    with np.load(DATA) as data:
        return tuple(ReferenceCase(str(name), *(data[f"{key}_{k}"] for key in ("vertices", "coefficients", "normals", "moments")))
                     for k, name in enumerate(data["names"]))


@functools.lru_cache(maxsize=None)
def reference_stacks(*short):
    """All reference cases as pairs (cases, vertices (count, N, 3)) for few N: those in `short`, and the largest number of corners.

    Each case is where it needs the fewest. Corner i of N is the polygon's corner ``i * n // N``; repeated, it is the same polygon.
    """
    cases = reference_cases()
    sizes = [*short, max(len(case.vertices) for case in cases)]
    groups = [(n, [case for case in cases if low < len(case.vertices) <= n]) for low, n in zip([0, *sizes], sizes)]
    return tuple((group, np.array([case.vertices[np.arange(n) * len(case.vertices) // n] for case in group])) for n, group in groups)


def merge_repeated(values, corners):
    """Sums over the repetitions of each corner: (N, ...) of a polygon of reference_stacks to (corners, ...)."""
    return np.add.reduceat(values, -(-np.arange(corners) * len(values) // corners), axis=0)


def _project_mp(vertices, x, order, digits):
    """Float64 coefficients, edge normals and edge moments of a polygon, computed in `digits` digits."""
    with mp.workdps(digits + 10):
        points = [[mp.mpf(float(c)) - mp.mpf(float(o)) for c, o in zip(p, x)] for p in vertices]
        length = [mp.sqrt(_dot(p, p)) for p in points]
        omega = [[c / r for c in p] for p, r in zip(points, length)]
        recurrence, rule = _legendre_factors(order, mp.mp.dps), _gauss_legendre(order + 30, mp.mp.dps)
        coeffs = [mp.mpf(0)] * (order + 1) ** 2
        normals, moments = [], []
        for i, start in enumerate(omega):
            j = (i + 1) % len(omega)
            end = omega[j]
            cross = _cross(start, end)
            sin, cos = mp.sqrt(_dot(cross, cross)), _dot(start, end)
            normal = [c / sin for c in cross]
            tangent, arc = _cross(normal, start), mp.atan2(sin, cos)
            integrals = [_Moments(order) for _ in range(3)]                   # of Y_lm times 1, w_0, w_1
            for node, weight in rule:
                t = arc * (node + 1) / 2
                cos_t, sin_t = mp.cos(t), mp.sin(t)
                scaled = weight * arc / 2
                factors = scaled, scaled * mp.sin(arc - t) / (sin * length[i]), scaled * sin_t / (sin * length[j])
                values = _complex_sh([a * cos_t + b * sin_t for a, b in zip(start, tangent)], order, recurrence)
                for integral, factor in zip(integrals, factors):
                    integral.add(values, factor)
            for l in range(1, order + 1):
                for m in range(l + 1):
                    value = integrals[0].slope(l, m, normal) / (l * (l + 1)) * (mp.sqrt(2) if m else 1)
                    coeffs[l * (l + 1) + m] += value.real
                    if m:
                        coeffs[l * (l + 1) - m] += value.imag
            normals.append([float(c) for c in normal])
            moments.append([integral.real_basis() for integral in integrals[1:]])
        for a, b in zip(omega[1:-1], omega[2:]):
            o = omega[0]
            angle = 2 * mp.atan2(_dot(o, _cross(a, b)), 1 + _dot(o, a) + _dot(a, b) + _dot(b, o))
            coeffs[0] += angle / mp.sqrt(4 * mp.pi)
        return np.array([float(c) for c in coeffs]), np.array(normals), np.array(moments)


class _Moments:
    """Integral over an arc of the complex harmonics Y_l^m, m >= 0: real and imaginary parts by (l, m)."""

    def __init__(self, order):
        self.order = order
        self.parts = {(l, m): [mp.mpf(0), mp.mpf(0)] for l in range(order + 1) for m in range(l + 1)}

    def add(self, values, factor):
        for key, (re, im) in values.items():
            part = self.parts[key]
            part[0] += factor * re
            part[1] += factor * im

    def complex(self, l, m):
        """Integral of Y_l^m, any sign of m, with Y_l^-m = (-1)^m conj(Y_l^m); zero for |m| > l."""
        if abs(m) > l:
            return mp.mpc(0)
        value = mp.mpc(*self.parts[l, abs(m)])
        return value if m >= 0 else (-1) ** m * mp.conj(value)

    def slope(self, l, m, n):
        """Integral of n . grad Y_l^m: derivatives of solid harmonics are solid harmonics of degree l - 1 (ladder operators)."""
        scale = mp.sqrt(mp.mpf(2 * l + 1) / (2 * l - 1))
        along_z = mp.sqrt(l * l - m * m) * self.complex(l - 1, m)                             # d/dz
        raised = mp.sqrt((l - m) * (l - m - 1)) * self.complex(l - 1, m + 1)                  # d/dx + i d/dy
        lowered = -mp.sqrt((l + m) * (l + m - 1)) * self.complex(l - 1, m - 1)                # d/dx - i d/dy
        return scale * (n[2] * along_z + (mp.mpc(n[0], -n[1]) * raised + mp.mpc(n[0], n[1]) * lowered) / 2)

    def real_basis(self):
        """Integrals of the real harmonics by flat index, as floats."""
        out = [0.0] * (self.order + 1) ** 2
        for (l, m), (re, im) in self.parts.items():
            out[l * (l + 1) + m] = float(re * mp.sqrt(2) if m else re)
            if m:
                out[l * (l + 1) - m] = float(im * mp.sqrt(2))
        return out


def _complex_sh(d, order, factors):
    """Complex harmonics Y_l^m(d), 0 <= m <= l <= order, Condon-Shortley sign: (l, m) -> (real, imaginary)."""
    x, y, z = d
    values, re, im = {}, mp.mpf(1), mp.mpf(0)                                 # (x + i y)^m
    for m in range(order + 1):
        if m:
            re, im = x * re - y * im, x * im + y * re
        before, legendre = mp.mpf(0), factors[m, m]
        for l in range(m, order + 1):
            if l > m:
                a, b = factors[l, m]
                before, legendre = legendre, a * z * legendre - b * before
            values[l, m] = legendre * re, legendre * im
    return values


@functools.lru_cache(maxsize=8)
def _legendre_factors(order, dps):
    """(m, m) -> Y_m^m / (x + i y)^m; (l, m) -> a, b of ``P_l^m = a z P_{l-1}^m - b P_{l-2}^m``, orthonormal."""
    factors = {}
    with mp.workdps(dps):
        for m in range(order + 1):
            factors[m, m] = (-1) ** m * mp.sqrt(mp.mpf(2 * m + 1) / (4 * mp.pi) * mp.factorial(2 * m)) / (2 ** m * mp.factorial(m))
            for l in range(m + 1, order + 1):
                a = mp.sqrt(mp.mpf(4 * l * l - 1) / (l * l - m * m))
                b = a * mp.sqrt(mp.mpf((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1)) if l > m + 1 else mp.mpf(0)
                factors[l, m] = a, b
    return factors


@functools.lru_cache(maxsize=8)
def _gauss_legendre(count, dps):
    """Nodes and weights on [-1, 1]: numpy's nodes polished by Newton steps to `dps` digits."""
    rule = []
    with mp.workdps(dps + 10):
        for guess in np.polynomial.legendre.leggauss(count)[0]:
            node, step = mp.mpf(float(guess)), mp.mpf(1)
            while abs(step) > mp.mpf(10) ** -(dps // 2 + 5):                  # the step just taken: its square is the error left
                before, value = mp.mpf(1), node
                for l in range(2, count + 1):
                    before, value = value, ((2 * l - 1) * node * value - (l - 1) * before) / l
                slope = count * (node * value - before) / (node * node - 1)
                step = value / slope
                node -= step
            before, value = mp.mpf(1), node
            for l in range(2, count + 1):
                before, value = value, ((2 * l - 1) * node * value - (l - 1) * before) / l
            slope = count * (node * value - before) / (node * node - 1)
            rule.append((node, 2 / ((1 - node * node) * slope * slope)))
    return tuple(rule)


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
