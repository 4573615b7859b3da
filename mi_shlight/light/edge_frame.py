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

Neither lobes nor a recurrence over the degree ([W18] needs both), so there is less to compute and less to round.

Derivatives. Only the border of the polygon moves with its corners; where corner i moves, a point of the edge follows by its share of it.
Share over distance is ``w_i = sin(h - s) / (|v_i| sin 2h)`` at the angle s from the edge's middle, and likewise ``w_j`` with
``sin(h + s)`` (the two terms of [W20] eq. 18), so that by Reynolds' theorem

    dL_lm / dv_i = -n_e int w_i Y_lm(omega(s)) ds ,   dL_lm / dv_j = -n_e int w_j Y_lm(omega(s)) ds                          (3)

summed over the edges. On the equator ``Y_lm = N_lm P_l^|m|(0) {cos, sin}(|m| (phi + s))``, non-zero for l + m even only, and with
``sin(h -+ s) / sin 2h = cos s / (2 cos h) -+ sin s / (2 sin h)`` the integrals are

    int cos s cos ms ds = S_{m-1} + S_{m+1} ,   int sin s sin ms ds = S_{m-1} - S_{m+1} ,   S_m = sin(m h) / m ,  S_0 = h .   (4)

The second cancels for short edges; it is taken from ``m h - sin(m h)``, whose second differences in m are positive. For shading the
transfer is rotated to each edge's frame once, for the value and all derivatives.

Derivatives of derivatives. Where x moves all corners move against it, which leaves of (3), as ``w_i + w_j = 1 / r`` at a point of the edge
at the distance r, ``dL_lm / dx = sum_e n_e int Y_lm / r ds``. Where besides that the corners move, and points of the edge by r delta,
``delta = w_i dv_i + w_j dv_j``, the light gains the area that the edge sweeps. Under the integral over that area, as (4) of
:py:mod:`mi_shlight.light.quadrature` has it, the derivative by x becomes

    d(dL_lm / dx) = sum_e int [ Y_lm c x delta + (grad Y_lm - 3 omega Y_lm) (n_e . delta) / r ] ds ,                         (5)

with ``c = (v_j - v_i) / |v_i x v_j| = (1/r) tau - (1/r)' omega``, the same all along the edge. Term by term this is not the derivative of
``n_e int Y_lm / r ds``: at the corners they differ by what the next edge takes away again. But all terms are of the size of the edge's
angle, where the turn of n_e is not, and there is no angle of n_e that would be undefined about the poles. As 1 / r, too, is linear in cos s
and sin s, and the vector in brackets of the neighbouring bands (:py:func:`gradient_rows`), (4) at m - 1 and m + 1 is all it takes.

Derived for this package; not in the papers.
"""
from __future__ import annotations

import functools
import math
import operator
from typing import NamedTuple

import drjit as dr
import numpy as np

from ..sh.lobes import sh_matrix
from ..sh.rotation import add_product, apply_rows, euler_angles, flat_indices, multiples, quarter_turn, rotate_z
from .polygon import EdgeFrame, edge_frame, fan_solid_angle, inverse_length, over_cosine, zeros

BODY_SIZE = 5000
"""Multiplications by X in one loop body: order 20 just fits. Higher degrees get loops of their own, as straight code compiles the slower
the longer it is."""

MONOPOLE = 1 / math.sqrt(4 * math.pi)


class Constants(NamedTuple):
    """What the edge form needs to know of the spherical harmonics up to some order."""

    slope: tuple
    """``2 N_lm P_l^|m|'(0) / (l (l + 1))`` by flat index; 0 for l + m even."""
    level: tuple
    """``N_lm P_l^|m|(0)`` by flat index; 0 for l + m odd."""
    x90: tuple
    """Rows of X; see :py:class:`~mi_shlight.sh.rotation.QuarterTurn`."""
    x90_transposed: tuple


@functools.lru_cache(maxsize=None)
def constants(order: int) -> Constants:
    """Tables of one order, in float64."""
    count = (order + 1) ** 2
    slope, level = [0.0] * count, [0.0] * count
    equator = sh_matrix(np.array([[1.0, 0.0, 0.0]]), order)[0]       # N_lm P_l^m(0) for m >= 0
    for l in range(1, order + 1):
        for m in range(l + 1):
            if (l + m) % 2:                           # P_l^m'(0) = (l + m) P_{l-1}^m(0)
                ratio = math.sqrt((2 * l + 1) / (2 * l - 1) * (l - m) * (l + m))
                value = float(2 * ratio * equator[l * (l - 1) + m] / (l * (l + 1)))
                slope[l * (l + 1) + m] = slope[l * (l + 1) - m] = value
    for l in range(order + 1):
        for m in range(l % 2, l + 1, 2):
            level[l * (l + 1) + m] = level[l * (l + 1) - m] = float(equator[l * (l + 1) + m])
    return Constants(tuple(slope), tuple(level), *quarter_turn(order))


@functools.lru_cache(maxsize=None)
def gradient_rows(order: int) -> tuple:
    """x, y and z component of ``grad Y_lm - 3 omega Y_lm`` as combinations of the neighbouring bands: each rows as in
    :py:class:`Constants`.

    ``omega Y_lm = U + D`` with U in band l + 1 and D in band l - 1, and ``grad Y_lm = (l + 1) D - l U``, as ``r^l Y_lm`` and
    ``Y_lm / r^(l + 1)`` are harmonic.
    """
    z, weights = np.polynomial.legendre.leggauss(order + 2)
    azimuth = np.arange(2 * order + 4) * (math.pi / (order + 2))
    ring = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones_like(azimuth)], axis=1)
    rho = np.sqrt(1 - z * z)
    directions = (np.stack([rho, rho, z], axis=1)[:, None] * ring).reshape(-1, 3)
    basis = sh_matrix(directions, order + 1)
    dual = basis * np.repeat(weights * (math.pi / (order + 2)), len(azimuth))[:, None]       # exact for all products
    axes = []
    for component in directions.T:
        rows = []
        for l in range(order + 1):
            factors = {k * k + i: -l - 3 if k > l else l - 2 for k in (l - 1, l + 1) for i in range(2 * k + 1)}
            shares = (basis[:, l * l:(l + 1) ** 2] * component[:, None]).T @ dual[:, list(factors)]
            rows += [tuple((j, float(v) * factors[j]) for j, v in zip(factors, row) if abs(v) > 1e-9 and factors[j]) for row in shares]
        axes.append(tuple(rows))
    return tuple(axes)


def project_edge(light, x, apex, order: int, active=True) -> list:
    """Coefficients ``L_lm`` of `light` seen from `x`: list of ``(order + 1)**2`` floats; 0 where not `active`."""
    coeffs = []
    for bands in _bodies(order):
        coeffs += light.sum(_differentiable(_values(order, bands), _tangent(order, bands)), x, apex, len(flat_indices(bands)), active)
    return coeffs


def project_edge_spatial(light, x, apex, order: int, active=True) -> tuple:
    """``(coeffs, (dx, dy, dz))``: coefficients of `light` and their derivatives by `x`, in one pass over the edges ([W20] Algorithm 2).

    Both are differentiable with respect to the light's vertices and `x`, by (3) and (5).
    """
    coeffs, gradient = [], ([], [], [])
    for bands in _bodies(order, 2):
        values, lines, width = _values(order, bands), _lines(order, bands), len(flat_indices(bands))

        def term(v_i, v_j, apex, values=values, lines=lines):
            frame = edge_frame(v_i, v_j)
            inverse_i, inverse_j = inverse_length(v_i), inverse_length(v_j)
            line = lines(frame, over_cosine(frame, inverse_i, inverse_j), [inverse_i + inverse_j, inverse_i - inverse_j])
            return values(v_i, v_j, apex) + [(n, value) for n in frame.normal for value in line]

        total = light.sum(_differentiable(term, _spatial_tangent(order, bands)), x, apex, 4 * width, active)
        coeffs += total[:width]
        for k, part in enumerate(gradient):
            part += total[(k + 1) * width:(k + 2) * width]
    return coeffs, gradient


def project_edge_lines(light, x, apex, order: int) -> tuple:
    """``(coeffs, rows)``: coefficients of a :py:class:`~mi_shlight.light.polygon.VertexList` and, of each of its edges, what its corners
    do to them.

    ``rows[e]`` holds ``-int w_i Y_lm ds`` for all lm, ``-int w_j Y_lm ds`` for all lm, and the three components of ``n_e``; (3).
    """
    coeffs, rows = [], []
    for bands in _bodies(order, 3):
        values, lines, width = _values(order, bands), _lines(order, bands), len(flat_indices(bands))

        def term(v_i, v_j, apex, values=values, lines=lines):
            frame = edge_frame(v_i, v_j)
            inverse_i, inverse_j = inverse_length(v_i), inverse_length(v_j)
            over_cos = over_cosine(frame, inverse_i, inverse_j)
            by_i, by_j = lines(frame, over_cos, [-inverse_i, -inverse_i]), lines(frame, over_cos, [-inverse_j, inverse_j])
            return [*values(v_i, v_j, apex), *by_i, *by_j, *frame.normal]

        sums, kept = light.sum_and_keep(term, x, apex, width, 2 * width + 3)
        coeffs += sums
        rows.append([(row[:width], row[width:2 * width], row[2 * width:]) for row in kept])
    joined = lambda parts: [value for part in parts for value in part]
    return coeffs, [[*joined(part[0] for part in edge), *joined(part[1] for part in edge), *edge[0][2]] for edge in zip(*rows)]


def edge_form_shader(transfer: list, order: int):
    """Function ``shade(light, x, apex, active)`` that gives ``sum_lm T_lm L_lm``: takes the transfer to the edges' frames."""
    terms = []
    for bands in _bodies(order):
        gradients = _shading(dr.detach(transfer), order, bands, value=False)

        def tangent(v_i, v_j, apex, by_i, by_j, gradients=gradients):
            g = gradients(v_i, v_j, apex)
            return [dr.dot(type(v_i)(*g[:3]), by_i) + dr.dot(type(v_i)(*g[3:]), by_j)]

        terms.append(_differentiable(_shading(transfer, order, bands, gradients=False), tangent))
    return lambda light, x, apex, active=True: functools.reduce(operator.add, (light.sum(t, x, apex, 1, active)[0] for t in terms))


def shade_edge_lines(light, x, apex, transfer: list, order: int, value: bool = True) -> tuple:
    """``(value, gradients)``: ``sum_lm T_lm L_lm`` of a :py:class:`~mi_shlight.light.polygon.VertexList`, or None unless asked for, and
    its derivatives by each vertex.
    """
    width, count = int(value), len(light.vertices)
    total, gradients = zeros(x, width), [type(x)(0) for _ in range(count)]
    for bands in _bodies(order):
        sums, rows = light.sum_and_keep(_shading(transfer, order, bands, value=value), x, apex, width, 6)
        total = [a + b for a, b in zip(total, sums)]
        gradients = [g + type(x)(*rows[i][:3]) + type(x)(*rows[i - 1][3:]) for i, g in enumerate(gradients)]
    return total[0] if value else None, gradients


def _differentiable(term, tangent):
    """`term` with the analytic derivatives of ``tangent(v_i, v_j, apex, dv_i, dv_j)``, linear in the last two, for Dr.Jit's autodiff.

    Where the apex is 0 there is no solid angle and no derivative of one.
    """
    def both(v_i, v_j, apex):
        if not dr.grad_enabled(v_i, v_j):
            return term(v_i, v_j, apex)
        start, end, apex = dr.detach(v_i), dr.detach(v_j), dr.detach(apex)
        slopes = tangent(start, end, apex, v_i - start, v_j - end)
        slopes = (dr.replace_grad(type(slope)(0), slope) for slope in slopes)
        return [dr.fma(*value, slope) if isinstance(value, tuple) else value + slope
                for value, slope in zip(term(start, end, apex), slopes)]

    return both


def _values(order: int, bands: range):
    """Term of an edge in the coefficients of some bands."""
    table = constants(order)

    def term(v_i, v_j, apex):
        frame = edge_frame(v_i, v_j)
        (alpha, beta, phi), sines = _angles(frame, bands[-1])
        wave = [[f * c[m] for m, f in enumerate(_lengths(frame, sines, bands[-1]))] for c in phi]
        local = [None] * (order + 1) ** 2             # None: zero by symmetry
        for l, m, i, j in _odd(bands):
            local[i] = wave[0][m] * table.slope[i]
            if m:
                local[j] = wave[1][m] * table.slope[i]
        values = _to_world(table, local, alpha, beta, bands)
        if bands[0] == 0:
            values[0] = fan_solid_angle(apex, frame) * MONOPOLE
        return [values[i] for i in flat_indices(bands)]

    return term


def _lines(order: int, bands: range):
    """Function ``(frame, over_cos, (a, b))`` that gives ``int (a cos s / (2 cos h) - b sin s / (2 sin h)) Y_lm ds`` of some bands: ``w_i``
    for a = b, ``w_j`` for a = -b. `over_cos`: ``1 / (2 cos h)``.
    """
    table = constants(order)

    def lines(frame, over_cos, factors):
        angles, sines = _angles(frame, bands[-1])
        values = _along(table, *_line_integrals(frame, sines, over_cos * factors[0], -factors[1], bands[-1]), angles, bands)
        return [values[i] for i in flat_indices(bands)]

    return lines


def _along(table: Constants, even: list, odd: list, angles: list, bands: range) -> list:
    """``int f(s) Y_lm ds`` along an edge, some bands, in the world. ``even[m]``, ``odd[m]``: ``int f cos ms ds`` and ``int f sin ms ds``;
    lists of None where they vanish by symmetry.
    """
    alpha, beta, (cosines, sines) = angles
    local = [None] * len(table.level)
    for l, m, i, j in _even(bands):
        local[i] = add_product(add_product(None, odd[m], -sines[m]), even[m], cosines[m]) * table.level[i]
        if m:
            local[j] = add_product(add_product(None, odd[m], cosines[m]), even[m], sines[m]) * table.level[i]
    return _to_world(table, local, alpha, beta, bands)


def _tangent(order: int, bands: range):
    """Derivatives of :py:func:`_values` along a displacement of the edge's ends."""
    lines = _lines(order, bands)

    def tangent(v_i, v_j, apex, by_i, by_j):
        frame = edge_frame(v_i, v_j)
        inverse_i, inverse_j = inverse_length(v_i), inverse_length(v_j)
        a, b = dr.dot(frame.normal, by_i) * -inverse_i, dr.dot(frame.normal, by_j) * -inverse_j
        slopes = lines(frame, over_cosine(frame, inverse_i, inverse_j), [a + b, a - b])
        if bands[0] == 0:
            slopes[0] = dr.select(dr.squared_norm(apex) > 0, slopes[0], 0)
        return slopes

    return tangent


def _spatial_tangent(order: int, bands: range):
    """Derivatives of the term of :py:func:`project_edge_spatial` along a displacement of the edge's ends: (3) and (5)."""
    around = range(max(bands[0] - 1, 0), bands[-1] + 2)
    nothing = [None] * (order + 3)

    def tangent(v_i, v_j, apex, by_i, by_j):
        table, rows = constants(order + 1), gradient_rows(order)
        frame = edge_frame(v_i, v_j)
        most = 1e15 if dr.epsilon(v_i) > 1e-10 else 1e150                     # its square is finite
        inverse_i, inverse_j = (dr.minimum(inverse_length(v), most) for v in (v_i, v_j))
        over_cos = dr.minimum(over_cosine(frame, inverse_i, inverse_j), most / dr.maximum(inverse_i, inverse_j))
        # A point of the edge moves by its distance times cos s even_shift + sin s / (2 sin h) odd_shift.
        by_i, by_j = by_i * inverse_i, by_j * inverse_j
        even_shift, odd_shift = (by_i + by_j) * over_cos, by_j - by_i
        # 1 / distance = even cos s + odd sin s
        usable = frame.arc > 0
        even, difference = (inverse_i + inverse_j) * over_cos, _inverse_difference(v_i, v_j, inverse_i, inverse_j)
        odd = dr.select(usable, dr.clip(0.5 * difference / dr.select(usable, frame.sin_half, 1), -most, most), 0)
        side = dr.cross(frame.normal, frame.middle) * even - frame.middle * odd

        angles, sines = _angles(frame, around[-1] + 1)
        cosine, sine = _line_integrals(frame, sines, 1, 1, around[-1] + 1)    # f = cos s, f = sin s / (2 sin h)
        cos_cos, cos_sin, sin_sin = [], [], []                                # twice those times cos s, .. and sin s
        for m in range(around[-1] + 1):
            before = sine[m - 1] if m else -sine[1]
            cos_cos.append(cosine[abs(m - 1)] + cosine[m + 1])
            cos_sin.append(before + sine[m + 1])
            sin_sin.append(sine[m + 1] - before)
        times = lambda factor, values: [0.5 * factor * value for value in values]
        by_even, by_odd = (_along(table, *parts, angles, bands) for parts in ((cosine, nothing), (nothing, sine)))
        over_even = _along(table, times(even, cos_cos), times(difference, cos_sin), angles, around)
        over_odd = _along(table, times(odd, sin_sin), times(even, cos_sin), angles, around)

        across = [dr.dot(frame.normal, shift) for shift in (even_shift, odd_shift)]
        turn = [dr.cross(side, shift) for shift in (even_shift, odd_shift)]
        mixed = lambda i, p, q: dr.fma(by_even[i], p, by_odd[i] * q)
        slopes = [-mixed(i, *across) for i in flat_indices(bands)]
        if bands[0] == 0:
            slopes[0] = dr.select(dr.squared_norm(apex) > 0, slopes[0], 0)
        swept = [None if p is None else dr.fma(p, across[0], q * across[1]) for p, q in zip(over_even, over_odd)]
        for k in range(3):
            rest = apply_rows(rows[k], swept, bands)
            slopes += [mixed(i, turn[0][k], turn[1][k]) + rest[i] for i in flat_indices(bands)]
        return slopes

    return tangent


def _inverse_difference(v_i, v_j, inverse_i, inverse_j):
    """``inverse_j - inverse_i`` of vectors of nearly equal length without cancellation: of the difference of the squares."""
    least, most = dr.minimum(inverse_i, inverse_j), dr.maximum(inverse_i, inverse_j)
    return most * dr.dot((v_i - v_j) * least, (v_i + v_j) * least) / (1 + least / most)


def _shading(transfer: list, order: int, bands: range, value=True, gradients=True):
    """Term of an edge in ``sum_lm T_lm L_lm`` of some bands: the value, and the derivatives by the two ends, as far as asked for."""
    table = constants(order)
    wanted = [value and slope != 0 or gradients and level != 0 for slope, level in zip(table.slope, table.level)]
    met = [any(wanted[j] for j, _ in row) for row in table.x90]

    def term(v_i, v_j, apex):
        frame = edge_frame(v_i, v_j)
        (alpha, beta, phi), sines = _angles(frame, bands[-1])
        back = lambda angle: (angle[0], [-s for s in angle[1]])
        values = rotate_z(transfer, *back(alpha), bands)
        values = apply_rows(table.x90, values, bands)
        values = rotate_z(values, *back(beta), bands, met)
        values = apply_rows(table.x90_transposed, values, bands, wanted)
        out = []
        if value:
            total = transfer[0] * fan_solid_angle(apex, frame) * MONOPOLE if bands[0] == 0 else 0
            cosine, sine = _waves(values, table.slope, _odd(bands), order)
            for m, f in enumerate(_lengths(frame, sines, bands[-1])):
                if cosine[m] is not None:
                    total = dr.fma(_wave(cosine[m], phi[0][m], sine[m], phi[1][m]), f, total)
            out.append(total)
        if gradients:
            if bands[0] == 0:
                values[0] = dr.select(dr.squared_norm(apex) > 0, values[0], 0)
            cosine, sine = _waves(values, table.level, _even(bands), order)
            along, across, inverse_i, inverse_j = 0, 0, inverse_length(v_i), inverse_length(v_j)
            over_cos = over_cosine(frame, inverse_i, inverse_j)
            for m, (a, b) in enumerate(zip(*_line_integrals(frame, sines, over_cos, 1, bands[-1]))):
                if cosine[m] is not None:
                    along = dr.fma(_wave(cosine[m], phi[0][m], sine[m], phi[1][m]), a, along)
                    if m:
                        across = dr.fma(dr.fma(cosine[m], phi[1][m], -(sine[m] * phi[0][m])), b, across)
            out += [*(frame.normal * ((along + across) * -inverse_i)), *(frame.normal * ((along - across) * -inverse_j))]
        return out

    return term


def _waves(values: list, factors: tuple, entries, order: int) -> tuple:
    """Cosine and sine waves along the equator, by m, of the `entries` of a vector; None where zero by symmetry."""
    cosine, sine = [None] * (order + 1), [None] * (order + 1)
    for _, m, i, j in entries:
        cosine[m] = add_product(cosine[m], values[i], factors[i])
        if m:
            sine[m] = add_product(sine[m], values[j], factors[j])
    return cosine, sine


def _wave(a, cos, b, sin):
    """``a cos + b sin`` where b may be None for zero."""
    return a * cos if b is None else dr.fma(a, cos, b * sin)


def _line_integrals(frame: EdgeFrame, sines: list, along, across, order: int) -> tuple:
    """The integrals (4) times `along` and times `across` over ``2 sin h``, m = 0 .. order. `sines`: of m h, to order + 1."""
    h = 0.5 * frame.arc
    sums = [h] + [sine * (1 / m) for m, sine in enumerate(sines[1:], 1)]
    # m h - sin(m h)
    square, excess = h * h, 1
    for k in range(13 if dr.epsilon(frame.middle) > 1e-10 else 23, 3, -2):
        excess = dr.fma(square * (-1 / (k * (k - 1))), excess, 1)
    excess = h * square * (1 / 6) * excess
    curve, step = 2 * dr.square(frame.sin_half) / (1 + frame.cos_half), excess
    rest = [type(h)(0), excess]
    for m in range(1, order + 1):
        step = dr.fma(curve, sines[m], step)
        rest.append(rest[m] + step)
    rest = [rest[0]] + [value * (1 / m) for m, value in enumerate(rest[1:], 1)]
    across = dr.select(frame.arc > 0, across * 0.5 / dr.select(frame.arc > 0, frame.sin_half, 1), 0)
    return ([(sums[abs(m - 1)] + sums[m + 1]) * along for m in range(order + 1)],
            [(rest[m + 1] - rest[abs(m - 1)]) * across if m else rest[0] for m in range(order + 1)])


def _to_world(table: Constants, local: list, alpha: tuple, beta: tuple, bands: range) -> list:
    """Some bands of a vector in the edge's frame, rotated to the world."""
    values = apply_rows(table.x90, local, bands)
    values = rotate_z(values, *beta, bands)
    values = apply_rows(table.x90_transposed, values, bands)
    return rotate_z(values, *alpha, bands)


def _bodies(order: int, rotations: int = 1) -> list:
    """Degrees 0 .. order in ranges, each small enough for one loop body; what they share, the edge's frame, is little."""
    bodies, first, size = [], 0, 0
    for l in range(order + 1):
        more = rotations * (2 * l + 1) ** 2 // 2
        if size and size + more > BODY_SIZE:
            bodies.append(range(first, l))
            first, size = l, 0
        size += more
    return [*bodies, range(first, order + 1)]


def _angles(frame: EdgeFrame, order: int) -> tuple:
    """((alpha, beta, phi), sines): multiples of the three angles as (cosines, sines), and ``sin(m h)`` for m = 0 .. order + 1."""
    angles = euler_angles(frame.normal, frame.middle)
    return [multiples(c, s, order) for c, s in angles], multiples(frame.cos_half, frame.sin_half, order + 1)[1]


def _lengths(frame: EdgeFrame, sines: list, order: int) -> list:
    """``sin(m h) / m`` for m = 0 .. order."""
    return [frame.arc * 0.5] + [sines[m] * (1 / m) for m in range(1, order + 1)]


def _odd(bands: range):
    """(l, m, index of +m, index of -m) for all l + m odd, m >= 0."""
    for l in bands:
        for m in range(1 - l % 2, l + 1, 2):
            yield l, m, l * (l + 1) + m, l * (l + 1) - m


def _even(bands: range):
    """As :py:func:`_odd` for l + m even."""
    for l in bands:
        for m in range(l % 2, l + 1, 2):
            yield l, m, l * (l + 1) + m, l * (l + 1) - m
