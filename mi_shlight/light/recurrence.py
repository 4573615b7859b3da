"""SH coefficients of a polygonal light by the papers' zonal recurrence ([W18] sections 4 and 5).

Every Y_lm is a weighted sum of Legendre lobes about fixed directions ([W18] eq. 9). The integral of one lobe over the
polygon follows from integrals over its edges, built up degree by degree at constant cost ([W18] eqs. 25-32).

Deviations from [W18]: Algorithm 1 line 22 lacks the division of ``(l - 1) B_{l-2}`` by l (eq. 30 has it);
``a_e^2 + b_e^2 - 1``, which cancels, is written as ``-c_e^2``; the solid angle and the arcs use atan2; the lobes are our own
(see :py:mod:`mi_shlight.sh.lobes`). Arcs run from -h to h about their middle, ``omega(s) = middle cos s + tangent sin s``, and of ``P_l``
at their ends the mean and the difference over ``2 sin h`` are kept, for then all terms of a short edge are as small as their sum.

Derivatives ([W20] section 5). A displacement of the edge moves the border by shares that are linear in cos s and sin s, so they need
``K_l = int u . omega(s) P_l(w . omega(s)) ds`` for vectors u in the plane of the edge, with the arc's tangent tau(s) and
``F_l = int u . omega P_l'(w . omega) ds``

    (l + 1) K_l = u . w D_l - [u . tau P_l]_{-h}^{h} - F_{l-1} ,    F_{l+1} = F_{l-1} + (2 l + 1) K_l .                       (1)

The first is integration by parts (omega = -tau') with ``z P_l' = P'_{l-1} + l P_l``, the second ``(2 l + 1) P_l = P'_{l+1} - P'_{l-1}``.
[W20] eq. 23 gets the same integrals from its C_l and E_l by a rotation divided by ``A = sqrt(a_e^2 + b_e^2)``, which is 0 for a lobe along
the edge's normal, and by sin T; here D_l, which the coefficients need too, takes their place, and nothing is divided by A.
"""
from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr

from ..sh.lobes import lobes
from .polygon import EdgeFrame, VertexList, edge_frame, fan_solid_angle, inverse_length, over_cosine, zeros

UNROLL_ORDER = 14
"""Up to this order all lobes stand in one kernel body. Above, a symbolic loop runs over the lobes: four times slower per point,
but compile time stays in bounds (unrolled, order 14 takes 2 s in float32 and 4 s in float64, and more than quadratically longer
beyond)."""

BODY_SIZE, ARC_SIZE = 8000, 25
"""Operations in one loop body of the gradients, which compile the slower the longer they are; those per lobe and degree besides [W18]
eq. 33."""

ODD_ERROR = 100
"""Rounding units by which :py:func:`share_integrals` errs, over ``h^4 l^3``, where it changes to the limit of short edges."""


class ArcSeries(NamedTuple):
    """One lobe w along one edge ``omega(s) = middle cos s + tangent sin s``, -h <= s <= h; lists over l = 0 .. order."""

    a: object
    b: object
    c: object
    """Components of w along the edge's middle, tangent and normal ([W18] eq. 20)."""
    mean: list
    """Mean of ``P_l(w . omega)`` at the two ends."""
    slope: list
    """Its difference between the ends over ``2 sin h``."""
    edge_b: list
    """``int P_l(w . omega) ds`` ([W18] eq. 21)."""
    edge_d: list
    """``int P_l'(w . omega) ds``."""


def arc_series(frame: EdgeFrame, order: int, w) -> ArcSeries:
    """Integrals of the lobe about `w`, a triple of Python or Dr.Jit floats, along an edge ([W18] eqs. 26-32)."""
    project = lambda v: dr.fma(v[0], w[0], dr.fma(v[1], w[1], v[2] * w[2]))
    a, b, c = project(frame.middle), project(dr.cross(frame.normal, frame.middle)), project(frame.normal)
    z, step = a * frame.cos_half, b * dr.square(frame.sin_half)        # w . omega at the ends is z -+ b sin h
    mean, slope = [type(a)(1), z], [type(a)(0), b]
    at_mean, at_slope, minus_c2 = 2 * frame.sin_half * a, -frame.sin * b, -c * c
    edge_b, edge_d = [frame.arc, at_mean], [type(a)(0), frame.arc]     # [W18] eqs. 26-28
    for l in range(2, order + 1):
        edge_c = dr.fma(at_mean, mean[l - 1], dr.fma(at_slope, slope[l - 1], minus_c2 * edge_d[l - 1]))
        edge_b.append(dr.fma(edge_c, (2 * l - 1) / l ** 2, ((l - 1) / l) ** 2 * edge_b[l - 2]))       # eqs. 30, 31
        edge_d.append(dr.fma(edge_b[l - 1], 2 * l - 1, edge_d[l - 2]))                                # eq. 32
        new_mean, new_slope = dr.fma(z, mean[l - 1], step * slope[l - 1]), dr.fma(z, slope[l - 1], b * mean[l - 1])
        mean.append(dr.fma(new_mean, (2 * l - 1) / l, -(l - 1) / l * mean[l - 2]))                    # eq. 11 at both ends
        slope.append(dr.fma(new_slope, (2 * l - 1) / l, -(l - 1) / l * slope[l - 2]))
    return ArcSeries(a, b, c, *(values[:order + 1] for values in (mean, slope, edge_b, edge_d)))


def edge_integrals(frame: EdgeFrame, order: int, directions) -> list:
    """``c_e B_{l,e}`` ([W18] eqs. 14, 21) of one edge: for each lobe direction a list over l = 0 .. order - 1.

    ``directions``: lobe directions, triples of Python floats or Dr.Jit floats. Sums of these over the edges of a polygon are
    the boundary integrals ``B_l``.
    """
    return [boundary_terms(arc_series(frame, order, w)) for w in directions]


def boundary_terms(arc: ArcSeries) -> list:
    """``c_e B_{l,e}``, l = 0 .. order - 1."""
    return [arc.c * value for value in arc.edge_b[:-1]]


class Shares(NamedTuple):
    """Factors of one edge for the two ways in which it can move: even in s, ``cos s / (2 cos h)``, and odd, ``sin s / (2 sin h)``.

    ``w_i = (even - odd) / |v_i|`` and ``w_j = (even + odd) / |v_j|`` are the shares of the edge's ends ([W20] eq. 18).
    """

    over_cos: object
    """``1 / (2 cos h)``; like the next 0 for an edge without a plane."""
    over_sin: object
    tan: object
    """``tan h``."""
    cos: object
    """``cos h``."""


def edge_shares(frame: EdgeFrame, *inverses) -> Shares:
    """:py:class:`Shares` of an edge whose ends have the :py:func:`~mi_shlight.light.polygon.inverse_length` `inverses`."""
    usable = frame.arc > 0
    half, over_cos = dr.select(usable, 0.5, type(frame.arc)(0)), over_cosine(frame, *inverses)
    return Shares(over_cos, half / dr.select(usable, frame.sin_half, 1), 2 * frame.sin_half * over_cos, 2 * frame.cos_half * half)


def line_integrals(arc: ArcSeries, shares: Shares, a, b) -> list:
    """``int (a even - b odd) P_l ds``, l = 0 .. order, of an edge with the `shares` even and odd."""
    along, at_mean, at_slope = dr.fma(a * shares.over_cos, arc.a, -b * shares.over_sin * arc.b), a * shares.tan, b * shares.cos
    return _from_parts(dr.fma(along, d, dr.fma(at_mean, p, at_slope * q)) for d, p, q in zip(arc.edge_d, arc.mean, arc.slope))


def share_integrals(arc: ArcSeries, shares: Shares, frame: EdgeFrame) -> tuple:
    """``int even P_l ds`` and ``int odd P_l ds``, l = 0 .. order.

    The second is as small as h^2 on a short edge while (1) sums terms of order 1: below some h the odd part of ``P_l`` is taken as linear
    in s.
    """
    along, across = arc.a * shares.over_cos, arc.b * shares.over_sin
    even = _from_parts(dr.fma(along, d, shares.tan * p) for d, p in zip(arc.edge_d, arc.mean))
    odd = _from_parts(dr.fma(across, d, -shares.cos * q) for d, q in zip(arc.edge_d, arc.slope))
    third = dr.square(frame.sin_half) * (1 / 3)
    limit = lambda l: (ODD_ERROR * dr.epsilon(frame.normal) / max(l, 1) ** 3) ** 0.25
    return even, [dr.select(frame.sin_half < limit(l), third * q, value) for l, (value, q) in enumerate(zip(odd, arc.slope))]


def _from_parts(terms) -> list:
    """``K_l`` of (1) from what stands there before ``F_{l-1}``, l = 0 .. order."""
    integrals, slopes = [], [0, 0]                    # F_{-1}, F_0, ..
    for l, term in enumerate(terms):
        integrals.append((term - slopes[l]) * (1 / (l + 1)))
        slopes.append(dr.fma(integrals[l], 2 * l + 1, slopes[l]))
    return integrals


def zonal_integrals(solid_angle, boundary, order: int) -> list:
    """``S_l``, the integral of ``P_l`` over the polygon, l = 0 .. order, from the sums ``B_l`` ([W18] eqs. 25, 29)."""
    zonal_s = [solid_angle]
    if order >= 1:
        zonal_s.append(boundary[0] * 0.5)
    for l in range(2, order + 1):
        value = boundary[l - 1] * ((2 * l - 1) / (l * (l + 1)))
        if l > 2:
            value = dr.fma(zonal_s[l - 2], (l - 2) * (l - 1) / (l * (l + 1)), value)
        zonal_s.append(value)
    return zonal_s


def zonal_adjoint(weights) -> list:
    """Transpose of :py:func:`zonal_integrals`: weights of ``S_l`` -> weights of ``[solid angle, B_0, .., B_{order-1}]``."""
    w, order = list(weights), len(weights) - 1
    for l in range(order, 2, -1):
        w[l - 2] = dr.fma(w[l], (l - 2) * (l - 1) / (l * (l + 1)), w[l - 2])
    scale = [1, 0.5] + [(2 * l - 1) / (l * (l + 1)) for l in range(2, order + 1)]
    return [value * s for value, s in zip(w, scale)]


def project_recurrence(light, x, apex, order: int, active=True) -> list:
    """Coefficients ``L_lm`` of `light` seen from `x`: list of ``(order + 1)**2`` floats; 0 where not `active`."""
    if _looped(order, x):
        return _project_lobe_loop(light, x, apex, order, active)
    every = range(len(lobes(order).directions))

    def term(v_i, v_j, apex):
        frame = edge_frame(v_i, v_j)
        return _sums(frame, apex, _arcs(frame, order, every), every)

    return _coefficients(light.sum(term, x, apex, 1 + order * len(every), active), order)


def project_recurrence_spatial(light, x, apex, order: int, active=True) -> tuple:
    """``(coeffs, (dx, dy, dz))``: coefficients of `light` and their derivatives by `x`, in one pass over the edges ([W20] Algorithm 2)."""
    count = (order + 1) ** 2
    if _looped(order, x):
        coeffs = _spatial_lobe_loop(light, x, apex, order, active)
        return coeffs[:count], tuple(coeffs[k * count:(k + 1) * count] for k in (1, 2, 3))
    sums, slopes = [], zeros(x, 3 * count)
    for group in _groups(order, 1):
        def term(v_i, v_j, apex, group=group):
            frame = edge_frame(v_i, v_j)
            arcs, (shares, *factors) = _arcs(frame, order, group), _spatial_factors(frame, v_i, v_j)
            lines = _to_harmonics([line_integrals(arc, shares, *factors) for arc in arcs], order, group)
            return _sums(frame, apex, arcs, group) + [n * value for n in frame.normal for value in lines]

        width = (group[0] == 0) + order * len(group)
        total = light.sum(term, x, apex, width + 3 * count, active)
        sums += total[:width]
        slopes = [a + b for a, b in zip(slopes, total[width:])]
    return _coefficients(sums, order), tuple(slopes[k * count:(k + 1) * count] for k in range(3))


def project_recurrence_lines(light, x, apex, order: int) -> tuple:
    """``(coeffs, rows)``: coefficients of a :py:class:`~mi_shlight.light.polygon.VertexList` and, of each of its edges, what its corners
    do to them.

    ``rows[e]`` holds ``-int w_i Y_lm ds`` for all lm, ``-int w_j Y_lm ds`` for all lm, and the three components of ``n_e``;
    :py:class:`Shares`.
    """
    count = (order + 1) ** 2

    def ends(inverse_i, inverse_j, even, odd):
        return [*((o - e) * inverse_i for e, o in zip(even, odd)), *((-e - o) * inverse_j for e, o in zip(even, odd))]

    if _looped(order, x):
        def term(v_i, v_j, apex):
            frame = edge_frame(v_i, v_j)
            inverses = inverse_length(v_i), inverse_length(v_j)
            shares = edge_shares(frame, *inverses)
            lines = _over_lobes(order, zeros(v_i, 2), type(v_i[0]), lambda w: share_integrals(arc_series(frame, order, w), shares, frame))
            return [*ends(*inverses, lines[:count], lines[count:]), *frame.normal]

        return project_recurrence(light, x, apex, order), light.sum_and_keep(term, x, apex, 0, 2 * count + 3)[1]

    sums, parts = [], []
    for group in _groups(order, 2):
        def term(v_i, v_j, apex, group=group):
            frame = edge_frame(v_i, v_j)
            inverses = inverse_length(v_i), inverse_length(v_j)
            arcs, shares = _arcs(frame, order, group), edge_shares(frame, *inverses)
            lines = (_to_harmonics(part, order, group) for part in zip(*(share_integrals(arc, shares, frame) for arc in arcs)))
            return [*_sums(frame, apex, arcs, group), *ends(*inverses, *lines), *frame.normal]

        total, rows = light.sum_and_keep(term, x, apex, (group[0] == 0) + order * len(group), 2 * count + 3)
        sums += total
        parts.append(rows)
    rows = [[*(sum(values) for values in zip(*(row[:-3] for row in edge))), *edge[0][-3:]] for edge in zip(*parts)]
    return _coefficients(sums, order), rows


def recurrence_shader(transfer: list, order: int):
    """Function ``shade(light, x, apex, active)`` that gives ``sum_lm T_lm L_lm`` without forming the coefficients.

    The transfer is taken to the lobes and through the transposed recurrence of ``S_l`` once, before all lights; each edge then
    costs one running sum instead of ``(order + 1)**2``. Same numbers as the dot product with :py:func:`project_recurrence`.
    """
    number = type(transfer[0])
    if _looped(order, transfer):
        def shade(light, x, apex, active=True):
            value = number(0)
            for t, c in zip(transfer, project_recurrence(light, x, apex, order, active)):
                value = dr.fma(t, c, value)
            return value
        return shade

    table = lobes(order)
    directions = [[float(c) for c in d] for d in table.directions]
    solid_weight, edge_weights = number(0), []
    for d in range(len(directions)):
        lobe = []
        for l, band in enumerate(table.weights):
            value = number(0)
            for m in range(2 * l + 1):
                if d < band.shape[1] and band[m, d]:
                    value = dr.fma(transfer[l * l + m], float(band[m, d]), value)
            lobe.append(value)
        adjoint = zonal_adjoint(lobe)
        solid_weight = solid_weight + adjoint[0]
        edge_weights.append(adjoint[1:])

    def term(v_i, v_j, apex):
        frame = edge_frame(v_i, v_j)
        value = solid_weight * fan_solid_angle(apex, frame)
        if order:
            for weights, integrals in zip(edge_weights, edge_integrals(frame, order, directions)):
                for w, b in zip(weights, integrals):
                    value = dr.fma(w, b, value)
        return [value]

    return lambda light, x, apex, active=True: light.sum(term, x, apex, 1, active)[0]


def _looped(order: int, x) -> bool:
    """Whether the lobes are run through by a symbolic loop."""
    return order > UNROLL_ORDER and dr.is_jit_v(x)


def _groups(order: int, lines: int) -> list:
    """The lobes in ranges, each small enough for one loop body with so many `lines` of each lobe."""
    size = (order + 1) * (ARC_SIZE + lines * (order + 1))
    count = len(lobes(order).directions)
    bodies = -(-count * size // BODY_SIZE)
    cuts = [count * k // bodies for k in range(bodies + 1)]
    return [range(first, last) for first, last in zip(cuts, cuts[1:])]


def _arcs(frame: EdgeFrame, order: int, group: range) -> list:
    """:py:class:`ArcSeries` of some lobes."""
    directions = lobes(order).directions
    return [arc_series(frame, order, [float(c) for c in directions[d]]) for d in group]


def _sums(frame: EdgeFrame, apex, arcs: list, group: range) -> list:
    """What one edge adds to the boundary integrals ``B_l`` of some lobes and, with the first one, to the solid angle before them."""
    solid_angle = [fan_solid_angle(apex, frame)] if group[0] == 0 else []
    return solid_angle + [value for arc in arcs for value in boundary_terms(arc)]


def _coefficients(total: list, order: int) -> list:
    """Coefficients from the :py:func:`_sums` of all lobes over all edges."""
    every = range(len(lobes(order).directions))
    return _to_harmonics([zonal_integrals(total[0], total[1 + d * order:1 + (d + 1) * order], order) for d in every], order, every)


def _to_harmonics(zonal, order: int, group: range) -> list:
    """What integrals of ``P_l`` about some lobes, ``zonal[k][l]`` about ``group[k]``, give to those of ``Y_lm`` ([W18] eq. 33)."""
    out = []
    for l, band in enumerate(lobes(order).weights):
        for row in band:
            value = type(zonal[0][l])(0)
            for d, lobe in zip(group, zonal):
                if d < len(row) and row[d]:
                    value = dr.fma(lobe[l], float(row[d]), value)
            out.append(value)
    return out


def _spatial_factors(frame: EdgeFrame, v_i, v_j) -> tuple:
    """Arguments (shares, a, b) of :py:func:`line_integrals` for one over the distance: what a displacement of `x` does to the edge."""
    inverse_i, inverse_j = inverse_length(v_i), inverse_length(v_j)
    return edge_shares(frame, inverse_i, inverse_j), inverse_i + inverse_j, inverse_i - inverse_j


def _project_lobe_loop(light, x, apex, order: int, active) -> list:
    """:py:func:`project_recurrence` with a symbolic loop over the lobes: slower per point, compiles in O(order^2)."""
    total = light.sum(lambda v_i, v_j, apex: [fan_solid_angle(apex, edge_frame(v_i, v_j))], x, apex, 1, active)[0]
    corners, rebuilt = _loop_state(light)

    def zonal(lobe, x, apex, total, corners):
        term = lambda v_i, v_j, apex: edge_integrals(edge_frame(v_i, v_j), order, [lobe])[0]
        return [zonal_integrals(total, rebuilt(corners).sum(term, x, apex, order, active), order)]

    return _over_lobes(order, [type(total)(0)], type(x[0]), zonal, x, apex, total, corners)


def _spatial_lobe_loop(light, x, apex, order: int, active) -> list:
    """:py:func:`project_recurrence_spatial` as :py:func:`_project_lobe_loop`: coefficients and their derivatives in one list."""
    total = light.sum(lambda v_i, v_j, apex: [fan_solid_angle(apex, edge_frame(v_i, v_j))], x, apex, 1, active)[0]
    corners, rebuilt = _loop_state(light)

    def zonal(lobe, x, apex, total, corners):
        def term(v_i, v_j, apex):
            frame = edge_frame(v_i, v_j)
            arc = arc_series(frame, order, lobe)
            lines = line_integrals(arc, *_spatial_factors(frame, v_i, v_j))
            return boundary_terms(arc) + [n * value for n in frame.normal for value in lines]

        sums = rebuilt(corners).sum(term, x, apex, order + 3 * (order + 1), active)
        return [zonal_integrals(total, sums[:order], order)] + [sums[order + k * (order + 1):][:order + 1] for k in range(3)]

    return _over_lobes(order, zeros(x, 4), type(x[0]), zonal, x, apex, total, corners)


def _loop_state(light) -> tuple:
    """(corners, function that makes the light of them): what of a light has to go through a loop's state for derivatives to come back."""
    if isinstance(light, VertexList):
        return light.vertices, VertexList
    return [], lambda corners: light                  # buffers: what is gathered of them in a loop is differentiable as it is


def _over_lobes(order: int, start: list, number, zonal, *others) -> list:
    """Integrals of ``Y_lm`` from those of ``P_l`` by a symbolic loop over the lobes.

    ``zonal(w, *others)`` gives a list over l for each of the zeros in `start`, which are of its type; the result is the harmonics of the
    first, then of the second, ..; `others`: what may carry derivatives.
    """
    table, index = lobes(order), dr.uint32_array_t(number)
    count = (order + 1) ** 2
    directions = number(table.directions.ravel().tolist())
    padded = [[float(band[m, d]) if d < band.shape[1] else 0.0 for band in table.weights for m in range(len(band))]
              for d in range(len(table.directions))]
    weights = number([w for row in padded for w in row])

    def body(d, coeffs, *others):
        values = zonal([dr.gather(number, directions, 3 * d + k) for k in range(3)], *others)
        row = [dr.gather(number, weights, d * count + i) for i in range(count)]
        coeffs = [dr.fma(row[i % count], values[i // count][math.isqrt(i % count)], c) for i, c in enumerate(coeffs)]
        return d + 1, coeffs, *others

    coeffs = [type(zero)(0) for zero in start for _ in range(count)]
    return dr.while_loop((index(0), coeffs, *others), lambda d, *_: d < len(padded), body, mode="symbolic", max_iterations=-1)[1]
