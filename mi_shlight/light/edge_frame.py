"""SH coefficients of a polygonal light in closed form, each edge integrated in its own frame.

For l >= 1, ``Y_lm = -Laplacian Y_lm / (l (l + 1))``, and the divergence theorem on the sphere turns the integral over the polygon into
one over its edges,

    L_lm = 1 / (l (l + 1)) * sum_e  int_0^{T_e}  n_e . grad Y_lm(omega(t)) dt .                                           (1)

In a frame with ``n_e`` as z axis the edge lies on the equator, where the integrand is a constant times a cosine or sine of the
azimuth, non-zero for l + m odd only. With ``h = T_e / 2`` and the azimuth ``phi`` of the edge's middle,

    int = N_lm P_l^|m|'(0) * 2 sin(m h) / m * {cos, sin}(|m| phi)         (m = 0: 2 h in place of 2 sin(m h) / m).          (2)

The local vector is rotated to the world by ``Rz(alpha) Ry(beta)``, (alpha, beta) the spherical angles of ``n_e``, with
``Ry(beta) = X^T Rz(beta) X`` and X the constant rotation by 90 degrees about x. X turns the parity in z into that in y and keeps the
one in x, so three quarters of it are zero; the local vector, odd in z, meets a quarter of the rest.

Neither lobes nor a recurrence over the degree ([W18] needs both), so there is less to compute and less to round. Derived for this
package; not in the papers.
"""
from __future__ import annotations

import functools
import math
import operator
from typing import NamedTuple

import drjit as dr
import numpy as np

from ..sh.lobes import fibonacci_hemisphere, sh_matrix
from .polygon import EdgeFrame, edge_frame, fan_solid_angle

BODY_SIZE = 5000
"""Multiplications by X in one loop body: order 20 just fits. Higher degrees get loops of their own, as straight code compiles the slower
the longer it is."""

MONOPOLE = 1 / math.sqrt(4 * math.pi)


class Constants(NamedTuple):
    """What the edge form needs to know of the spherical harmonics up to some order."""

    slope: tuple
    """``2 N_lm P_l^|m|'(0) / (l (l + 1))`` by flat index; 0 for l + m even."""
    x90: tuple
    """X, by rows: for each flat index the pairs (column, value) of its non-zero entries."""
    x90_transposed: tuple


@functools.lru_cache(maxsize=None)
def constants(order: int) -> Constants:
    """Tables of one order, in float64."""
    count = (order + 1) ** 2
    slope = [0.0] * count
    equator = sh_matrix(np.array([[1.0, 0.0, 0.0]]), order)[0]       # N_lm P_l^m(0) for m >= 0
    for l in range(1, order + 1):
        for m in range(l + 1):
            if (l + m) % 2:                           # P_l^m'(0) = (l + m) P_{l-1}^m(0)
                ratio = math.sqrt((2 * l + 1) / (2 * l - 1) * (l - m) * (l + m))
                value = float(2 * ratio * equator[l * (l - 1) + m] / (l * (l + 1)))
                slope[l * (l + 1) + m] = slope[l * (l + 1) - m] = value
    half = fibonacci_hemisphere(3 * (2 * order + 1))
    directions = np.concatenate([half, -half])
    before, after = sh_matrix(directions, order), sh_matrix(directions[:, [0, 2, 1]] * [1, -1, 1], order)
    rows, columns = [[] for _ in range(count)], [[] for _ in range(count)]
    for l in range(order + 1):
        band = slice(l * l, (l + 1) ** 2)
        x90 = np.linalg.lstsq(before[:, band], after[:, band], rcond=None)[0].T
        for i, j in zip(*np.nonzero(abs(x90) > 1e-9)):
            rows[l * l + i].append((l * l + j, float(x90[i, j])))
            columns[l * l + j].append((l * l + i, float(x90[i, j])))
    return Constants(tuple(slope), tuple(map(tuple, rows)), tuple(map(tuple, columns)))


def project_edge(light, x, apex, order: int, active=True) -> list:
    """Coefficients ``L_lm`` of `light` seen from `x`: list of ``(order + 1)**2`` floats; 0 where not `active`."""
    table, coeffs = constants(order), []
    for bands in _bodies(order):
        @_steady
        def term(v_i, v_j, apex, bands=bands):
            frame = edge_frame(v_i, v_j)
            (alpha, beta, phi), length = _angles(frame, bands[-1])
            wave = [[f * c[m] for m, f in enumerate(length)] for c in phi]
            local = [None] * (order + 1) ** 2         # None: zero by symmetry
            for l, m, i, j in _odd(bands):
                local[i] = wave[0][m] * table.slope[i]
                if m:
                    local[j] = wave[1][m] * table.slope[i]
            values = _product(table.x90, local, bands)
            values = _rotate_z(values, *beta, bands)
            values = _product(table.x90_transposed, values, bands)
            values = _rotate_z(values, *alpha, bands)
            if bands[0] == 0:
                values[0] = fan_solid_angle(apex, frame) * MONOPOLE
            return [values[i] for i in _flat(bands)]

        coeffs += light.sum(term, x, apex, len(_flat(bands)), active)
    return coeffs


def edge_form_shader(transfer: list, order: int):
    """Function ``shade(light, x, apex, active)`` that gives ``sum_lm T_lm L_lm``: takes the transfer to the edges' frames."""
    table = constants(order)
    odd = [value != 0 for value in table.slope]
    met = [any(odd[j] for j, _ in row) for row in table.x90]

    def term_of(bands):
        @_steady
        def term(v_i, v_j, apex):
            frame = edge_frame(v_i, v_j)
            (alpha, beta, phi), length = _angles(frame, bands[-1])
            back = lambda angle: (angle[0], [-s for s in angle[1]])
            values = _rotate_z(transfer, *back(alpha), bands)
            values = _product(table.x90, values, bands)
            values = _rotate_z(values, *back(beta), bands, met)
            values = _product(table.x90_transposed, values, bands, odd)
            cosine, sine = [None] * (order + 1), [None] * (order + 1)
            for l, m, i, j in _odd(bands):
                cosine[m] = _add(cosine[m], values[i], table.slope[i])
                if m:
                    sine[m] = _add(sine[m], values[j], table.slope[i])
            total = transfer[0] * fan_solid_angle(apex, frame) * MONOPOLE if bands[0] == 0 else 0
            for m, f in enumerate(length):
                if cosine[m] is not None:
                    wave = cosine[m] * phi[0][m] if sine[m] is None else dr.fma(cosine[m], phi[0][m], sine[m] * phi[1][m])
                    total = dr.fma(wave, f, total)
            return [total]

        return term

    terms = [term_of(bands) for bands in _bodies(order)]
    return lambda light, x, apex, active=True: functools.reduce(operator.add, (light.sum(t, x, apex, 1, active)[0] for t in terms))


def _steady(term):
    """`term` with derivatives also where the edge's normal is near the z axis and its azimuth turns arbitrarily fast.

    There they are taken in a frame that is tilted by a small angle, which changes them by about that angle.
    """
    def steady(v_i, v_j, apex):
        if not dr.grad_enabled(v_i, v_j):
            return term(v_i, v_j, apex)
        tilt = math.sqrt(dr.epsilon(v_i)) * 4
        start, end, apex = dr.detach(v_i), dr.detach(v_j), dr.detach(apex)
        normal = edge_frame(start, end).normal
        near = dr.square(normal[0]) + dr.square(normal[1]) < dr.square(tilt / 2)
        cos, sin = dr.select(near, math.cos(tilt), type(v_i[0])(1)), dr.select(near, math.sin(tilt), type(v_i[0])(0))
        tilted = lambda v: type(v)(dr.fma(v[0], cos, v[2] * sin), v[1], dr.fma(v[2], cos, -(v[0] * sin)))
        slopes = term(tilted(v_i), tilted(v_j), tilted(apex))
        return [dr.replace_grad(value, slope) for value, slope in zip(term(start, end, apex), slopes)]

    return steady


def _bodies(order: int) -> list:
    """Degrees 0 .. order in ranges, each small enough for one loop body; what they share, the edge's frame, is little."""
    bodies, first, size = [], 0, 0
    for l in range(order + 1):
        more = (2 * l + 1) ** 2 // 2
        if size and size + more > BODY_SIZE:
            bodies.append(range(first, l))
            first, size = l, 0
        size += more
    return [*bodies, range(first, order + 1)]


def _flat(bands: range) -> range:
    """Flat indices of whole bands."""
    return range(bands[0] ** 2, (bands[-1] + 1) ** 2)


def _angles(frame: EdgeFrame, order: int) -> tuple:
    """((alpha, beta, phi), length): multiples of the three angles as (cosines, sines), and ``sin(m h) / m`` for m = 0 .. order."""
    n = frame.normal
    squared = n[0] * n[0] + n[1] * n[1]
    tilted = squared > 1e-30                          # else n is the z axis, and any alpha will do
    rho = dr.sqrt(dr.select(tilted, squared, 1))
    inverse = 1 / rho
    rho = dr.select(tilted, rho, 0)
    cos_alpha, sin_alpha = dr.select(tilted, n[0] * inverse, 1), dr.select(tilted, n[1] * inverse, 0)
    middle = frame.middle
    cos_phi = dr.fma(cos_alpha, middle[0], sin_alpha * middle[1]) * n[2] - rho * middle[2]
    sin_phi = dr.fma(cos_alpha, middle[1], -(sin_alpha * middle[0]))
    half = _multiples(frame.cos_half, frame.sin_half, order)[1]
    length = [frame.arc * 0.5] + [half[m] * (1 / m) for m in range(1, order + 1)]
    angles = ((cos_alpha, sin_alpha), (n[2], rho), (cos_phi, sin_phi))
    return [_multiples(c, s, order) for c, s in angles], length


def _multiples(cos, sin, order: int) -> tuple:
    """Cosines and sines of 0, 1, .., `order` times an angle."""
    cosines, sines = [type(cos)(1)], [type(cos)(0)]
    for _ in range(order):
        c, s = cosines[-1], sines[-1]
        cosines.append(dr.fma(c, cos, -(s * sin)))
        sines.append(dr.fma(s, cos, c * sin))
    return cosines, sines


def _odd(bands: range):
    """(l, m, index of +m, index of -m) for all l + m odd, m >= 0."""
    for l in bands:
        for m in range(1 - l % 2, l + 1, 2):
            yield l, m, l * (l + 1) + m, l * (l + 1) - m


def _add(total, value, factor):
    """``total + value * factor`` where None is zero."""
    if value is None:
        return total
    return value * factor if total is None else dr.fma(value, factor, total)


def _product(matrix: tuple, vector: list, bands: range, wanted=None) -> list:
    """Some bands of a sparse matrix times a vector; only the `wanted` entries."""
    out = [None] * len(matrix)
    for i in _flat(bands):
        if wanted is None or wanted[i]:
            for j, value in matrix[i]:
                out[i] = _add(out[i], vector[j], value)
    return out


def _rotate_z(vector: list, cosines: list, sines: list, bands: range, wanted=None) -> list:
    """Rotation about z: (p, q) of (m, -m) becomes (p cos - q sin, p sin + q cos) of m times the angle; only the `wanted` entries."""
    out = list(vector)
    for l in bands:
        for m in range(1, l + 1):
            i, j = l * (l + 1) + m, l * (l + 1) - m
            p, q = vector[i], vector[j]
            out[i] = _add(_add(None, p, cosines[m]), q, -sines[m]) if wanted is None or wanted[i] else None
            out[j] = _add(_add(None, p, sines[m]), q, cosines[m]) if wanted is None or wanted[j] else None
    return out
