"""SH coefficients of a polygonal light by the papers' zonal recurrence ([W18] sections 4 and 5).

Every Y_lm is a weighted sum of Legendre lobes about fixed directions ([W18] eq. 9). The integral of one lobe over the
polygon follows from integrals over its edges, built up degree by degree at constant cost ([W18] eqs. 25-32).

Deviations from the paper: Algorithm 1 line 22 lacks the division of ``(l - 1) B_{l-2}`` by l (eq. 30 has it);
``a_e^2 + b_e^2 - 1``, which cancels, is written as ``-c_e^2``; the solid angle and the arcs use atan2; the lobes are our own
(see :py:mod:`mi_shlight.sh.lobes`).
"""
from __future__ import annotations

import math

import drjit as dr

from ..sh.lobes import lobes
from .polygon import EdgeFrame, edge_frame, fan_solid_angle, legendre_p

UNROLL_ORDER = 14
"""Up to this order all lobes stand in one kernel body. Above, a symbolic loop runs over the lobes: four times slower per point,
but compile time stays in bounds (unrolled, order 14 takes 2 s in float32 and 4 s in float64, and more than quadratically longer
beyond)."""


def edge_integrals(frame: EdgeFrame, order: int, directions) -> list:
    """``c_e B_{l,e}`` ([W18] eqs. 14, 21) of one edge: for each lobe direction a list over l = 0 .. order - 1.

    ``directions``: lobe directions, triples of Python floats or Dr.Jit floats. Sums of these over the edges of a polygon are
    the boundary integrals ``B_l``.
    """
    omega_i, omega_j, normal, sin, cos, arc = frame.omega_i, frame.omega_j, frame.normal, frame.sin, frame.cos, frame.arc
    tangent = dr.cross(normal, omega_i)              # lambda_e, [W18] eq. 16
    out = []
    for w in directions:
        project = lambda v: dr.fma(v[0], w[0], dr.fma(v[1], w[1], v[2] * w[2]))
        a, b, c = project(omega_i), project(tangent), project(normal)   # [W18] eq. 20
        slope = dr.fma(a, sin, -b * cos)             # minus the derivative of z_e at the arc's end
        p_start, p_end = legendre_p(a, order - 1), legendre_p(project(omega_j), order - 1)
        minus_c2 = -c * c
        edge_b = [arc, slope + b]                    # [W18] eqs. 26, 27
        edge_d = [type(a)(0), arc]                   # [W18] eq. 28
        for l in range(2, order):
            edge_c = dr.fma(slope, p_end[l - 1], dr.fma(b, p_start[l - 1], dr.fma(
                minus_c2, edge_d[l - 1], (l - 1) * edge_b[l - 2])))                       # l * C_{l-1,e}, eq. 31
            edge_b.append(dr.fma(edge_c, (2 * l - 1) / l ** 2, -(l - 1) / l * edge_b[l - 2]))   # eq. 30
            edge_d.append(dr.fma(edge_b[l - 1], 2 * l - 1, edge_d[l - 2]))                # eq. 32
        out.append([c * value for value in edge_b[:order]])
    return out


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
    table, number = lobes(order), type(x[0])
    if order > UNROLL_ORDER and dr.is_jit_v(number):
        return _project_lobe_loop(light, x, apex, order, table, active)
    directions = [[float(c) for c in d] for d in table.directions]

    def term(v_i, v_j, apex):
        frame = edge_frame(v_i, v_j)
        flat = [fan_solid_angle(apex, frame)]
        if order:
            for values in edge_integrals(frame, order, directions):
                flat += values
        return flat

    total = light.sum(term, x, apex, 1 + order * len(directions), active)
    coeffs = [None] * (order + 1) ** 2
    zonal = [zonal_integrals(total[0], total[1 + d * order:1 + (d + 1) * order], order) for d in range(len(directions))]
    for l, band in enumerate(table.weights):
        for m, row in enumerate(band):                # [W18] eq. 33
            value = number(0)
            for d, weight in enumerate(row):
                if weight:
                    value = dr.fma(zonal[d][l], float(weight), value)
            coeffs[l * l + m] = value
    return coeffs


def recurrence_shader(transfer: list, order: int):
    """Function ``shade(light, x, apex, active)`` that gives ``sum_lm T_lm L_lm`` without forming the coefficients.

    The transfer is taken to the lobes and through the transposed recurrence of ``S_l`` once, before all lights; each edge then
    costs one running sum instead of ``(order + 1)**2``. Same numbers as the dot product with :py:func:`project_recurrence`.
    """
    number = type(transfer[0])
    if order > UNROLL_ORDER and dr.is_jit_v(number):
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


def _project_lobe_loop(light, x, apex, order: int, table, active) -> list:
    """:py:func:`project_recurrence` with a symbolic loop over the lobes: slower per point, compiles in O(order^2)."""
    number = type(x[0])
    index = dr.uint32_array_t(number)
    directions = number(table.directions.ravel().tolist())
    padded = [[float(band[m, d]) if d < band.shape[1] else 0.0 for band in table.weights for m in range(len(band))]
              for d in range(len(table.directions))]
    weights = number([w for row in padded for w in row])
    total = light.sum(lambda v_i, v_j, apex: [fan_solid_angle(apex, edge_frame(v_i, v_j))], x, apex, 1, active)[0]

    def body(d, coeffs, x, apex, total):
        lobe = [dr.gather(number, directions, 3 * d + k) for k in range(3)]
        term = lambda v_i, v_j, apex: edge_integrals(edge_frame(v_i, v_j), order, [lobe])[0]
        zonal = zonal_integrals(total, light.sum(term, x, apex, order, active), order)
        row = d * len(coeffs)
        coeffs = [dr.fma(dr.gather(number, weights, row + i), zonal[math.isqrt(i)], c) for i, c in enumerate(coeffs)]
        return d + 1, coeffs, x, apex, total

    zeros = [type(total)(0) for _ in range((order + 1) ** 2)]
    return dr.while_loop((index(0), zeros, x, apex, total), lambda d, *_: d < len(padded), body, mode="symbolic",
                         max_iterations=-1)[1]
