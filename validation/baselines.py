"""Two earlier ways to the same coefficients, for comparison only: the monomial recurrence and Monte Carlo over the light.

**Monomials** ([W18] Table 2). W18 compares with the recurrence of Snyder 1996 for the integrals of ``z^k``, ``z = w . omega``: "we used our
iterative method to compute the monomials instead of the ZH, followed by combining them to compute the ZH coefficients, and then using
our sparse SH rotation". That is what is built here. For each lobe direction w and edge, with a, b, c of [W18] eq. 20 and T = T_e,

    I_k = int_0^T z_e^k dt:   I_0 = T,   I_1 = a sin T - b cos T + b,
    k I_k = (k - 1) (a^2 + b^2) I_{k-2} + (a sin T - b cos T) z_e(T)^{k-1} + b a^{k-1}                                         (1)

(by parts, as ``z'' = -z`` and ``z'^2 = a^2 + b^2 - z^2``); for the polygon (Arvo 1995, axial moments)

    M_k = int_Q z^k d omega:  M_0 = solid angle,   (k + 1) M_k = (k - 1) M_{k-2} + sum_e c_e I_{k-1,e} ;                       (2)

then the step that the zonal recurrence does not have, O(order) terms for each degree and lobe,

    S_l = sum_k p_lk M_k ,   P_l(z) = sum_k p_lk z^k ,                                                                         (3)

and [W18] eq. 33. Lobes, edge geometry, solid angle and the loop over the edges are those of the engine. The coefficients p_lk
alternate in sign and grow like 2.4^l, so (3) cancels: up to 0.4 digits per degree.

Outcome, unlike W18's: there the zonal recurrence is 2 to 4 times faster, as a GPU shader that reads Legendre polynomials from textures.
Here monomials are the faster of the two, by 10 to 25 % at order 8: (1) takes fewer operations per degree than the zonal recurrence, which
evaluates two Legendre polynomials, and (3) runs once per polygon, not per edge, with the p_lk as constants of the kernel. What rules
monomials out is the cancellation: a float32 error of 2e-3 at order 14, a thousand times that of the zonal recurrence.

**Monte Carlo** ([W18] section 7 and Fig. 4): mean over points on the light of the integrand.
"""
from __future__ import annotations

import functools
import sys

import drjit as dr
import numpy as np

from mi_shlight.errors import message
from mi_shlight.light.polygon import EdgeFrame, edge_frame, fan_solid_angle
from mi_shlight.sh.basis import sh_basis
from mi_shlight.sh.lobes import lobes

MAX_MONOMIAL_ORDER = 14
"""Above, (3) leaves fewer than three digits of float32."""

SH_EVAL_ORDER = 9
"""Highest order of ``dr.sh_eval``."""


@functools.lru_cache(maxsize=None)
def legendre_coefficients(order: int) -> tuple:
    """``p_lk`` of equation (3): for each degree l the pairs (k, p_lk), of which every second is zero and left out."""
    series = lambda l: np.polynomial.legendre.leg2poly([0] * l + [1])
    return tuple(tuple((k, float(series(l)[k])) for k in range(l % 2, l + 1, 2)) for l in range(order + 1))


def monomial_integrals(frame: EdgeFrame, order: int, directions) -> list:
    """``c_e I_{k,e}``, equation (1), of one edge: for each lobe direction a list over k = 0 .. order - 1."""
    tangent = dr.cross(frame.normal, frame.omega_i)
    out = []
    for w in directions:
        project = lambda v: dr.fma(v[0], w[0], dr.fma(v[1], w[1], v[2] * w[2]))
        a, b, c, z_end = (project(v) for v in (frame.omega_i, tangent, frame.normal, frame.omega_j))
        at_start, at_end = b, dr.fma(a, frame.sin, -b * frame.cos)       # times z^(k-1)
        squared = dr.fma(a, a, b * b)
        values = [frame.arc, at_end + b]
        for k in range(2, order):
            at_start, at_end = at_start * a, at_end * z_end
            values.append(dr.fma(squared * ((k - 1) / k), values[k - 2], (at_start + at_end) * (1 / k)))
        out.append([c * value for value in values[:order]])
    return out


def project_monomial(edges, x, apex, order: int) -> list:
    """Coefficients ``L_lm`` of the polygon `edges` seen from `x`, as the engine's methods give them; `order` up to 14."""
    table, number = _lobes("project_monomial", order), type(x[0])
    directions = [[float(c) for c in d] for d in table.directions]

    def term(v_i, v_j, apex):
        frame = edge_frame(v_i, v_j)
        return [fan_solid_angle(apex, frame), *(value for lobe in monomial_integrals(frame, order, directions) for value in lobe)]

    total = edges.sum(term, x, apex, 1 + order * len(directions))
    coeffs = [number(0)] * (order + 1) ** 2
    for d in range(len(directions)):
        moments, boundary = [total[0]], total[1 + d * order:1 + (d + 1) * order]
        for k in range(1, order + 1):                                                            # (2)
            value = boundary[k - 1] * (1 / (k + 1))
            moments.append(dr.fma(moments[k - 2], (k - 1) / (k + 1), value) if k > 1 else value)
        for l, band in enumerate(table.weights):
            zonal_s = number(0)
            for k, p in legendre_coefficients(order)[l]:                                         # (3)
                zonal_s = dr.fma(moments[k], p, zonal_s)
            for m in range(2 * l + 1):                                                           # [W18] eq. 33
                coeffs[l * l + m] = dr.fma(zonal_s, float(band[m, d]), coeffs[l * l + m])
    return coeffs


def monomial_shader(transfer: list, order: int):
    """Function ``shade(edges, x, apex)`` that gives ``sum_lm T_lm L_lm``.

    Better than what W18 compares with, and as good as the engine's own recurrence is treated: the transfer is taken through the
    transposes of eq. 33, (3) and (2) once, before all lights, so an edge pays for (1) alone.
    """
    table, number = _lobes("monomial_shader", order), type(transfer[0])
    directions = [[float(c) for c in d] for d in table.directions]
    solid_weight, edge_weights = number(0), []
    for d in range(len(directions)):
        weights = [number(0)] * (order + 1)                  # of M_k
        for l, band in enumerate(table.weights):
            zonal_weight = number(0)
            for m in range(2 * l + 1):
                zonal_weight = dr.fma(transfer[l * l + m], float(band[m, d]), zonal_weight)
            for k, p in legendre_coefficients(order)[l]:
                weights[k] = dr.fma(zonal_weight, p, weights[k])
        for k in range(order, 1, -1):
            weights[k - 2] = dr.fma(weights[k], (k - 1) / (k + 1), weights[k - 2])
        solid_weight = solid_weight + weights[0]
        edge_weights.append([weights[k] * (1 / (k + 1)) for k in range(1, order + 1)])

    def term(v_i, v_j, apex):
        frame = edge_frame(v_i, v_j)
        value = solid_weight * fan_solid_angle(apex, frame)
        for weights, integrals in zip(edge_weights, monomial_integrals(frame, order, directions)):
            for w, integral in zip(weights, integrals):
                value = dr.fma(w, integral, value)
        return [value]

    return lambda edges, x, apex: edges.sum(term, x, apex, 1)[0]


def _lobes(function: str, order: int):
    if order > MAX_MONOMIAL_ORDER:
        raise ValueError(message(function, "order", f"be at most {MAX_MONOMIAL_ORDER}", order, "Higher ones cancel every digit."))
    return lobes(order)


def project_monte_carlo(vertices: list, x, order: int, side: int, seed: int = 0, stratified: bool = True) -> list:
    """Coefficients by random points on the light, uniform by area: list of ``(order + 1)**2`` floats.

    ``L_lm = sum_t  (p . (q x r))_t / 2  mean_s  Y_lm(v / |v|) / |v|^3`` over the triangles (p, q, r), relative to `x`, of a signed fan
    about the first vertex: ``d omega = (v . N) / |v|^3 dA``, and ``v . N`` is constant on a plane.

    Parameters
    ----------
    vertices : list of 3-vectors of a Dr.Jit JIT backend
        As for ``project_polygon``.
    x : 3-vector
        Shading points; each has its own random numbers.
    order : int
        Highest degree.
    side : int
        ``side**2`` points on each of the N - 2 triangles.
    seed : int
        Equal seeds give equal results.
    stratified : bool
        One point in each of ``side x side`` cells, as W18 samples; otherwise independent points.

    Notes
    -----
    Standard error proportional to 1 / side, stratified to 1 / side^2.
    """
    number = type(x[0])
    index, state, random = dr.uint32_array_t(number), dr.uint64_array_t(number), sys.modules[number.__module__].PCG32
    basis = dr.sh_eval if order <= SH_EVAL_ORDER else sh_basis
    coeffs = [number(0)] * (order + 1) ** 2
    fan = list(zip(vertices[1:-1], vertices[2:]))
    for t, (q, r) in enumerate(fan):
        p, q, r = vertices[0] - x, q - x, r - x
        stream = random(dr.width(x), dr.opaque(state, seed * len(fan) + t))
        means = _mean_over_triangle(p, q, r, index, stream, basis, order, side, stratified)
        coeffs = [dr.fma(mean, 0.5 * dr.dot(p, dr.cross(q, r)), c) for mean, c in zip(means, coeffs)]
    return coeffs


def _mean_over_triangle(p, q, r, index, random, basis, order, side, stratified):
    """Mean of ``Y_lm(v / |v|) / |v|^3`` over points v, uniform on the triangle."""
    number = type(p[0])

    def body(i, total, random):
        s, t = random.next_float(number), random.next_float(number)
        if stratified:
            s, t = (number(i % side) + s) * (1 / side), (number(i // side) + t) * (1 / side)
        s = dr.sqrt(s)
        v = p + s * ((1 - t) * (q - p) + t * (r - p))
        inverse = dr.rsqrt(dr.dot(v, v))
        weight = inverse * inverse * inverse * (1 / side ** 2)
        return i + 1, [dr.fma(y, weight, value) for y, value in zip(basis(v * inverse, order), total)], random

    zeros = [number(0) for _ in range((order + 1) ** 2)]
    return dr.while_loop((index(0), zeros, random), lambda i, *_: i < side ** 2, body, mode="symbolic")[1]
