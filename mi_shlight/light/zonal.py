"""Transfer that is symmetric about an axis: unshadowed Lambert about the normal, Phong about the mirror direction.

``T(omega) = sum_l t_l Y_l0(angle between omega and the axis)`` meets a light only through its n + 1 zonal integrals about that axis,

    S_l = int_Q P_l(omega . axis) d omega ,    sum_lm T_lm L_lm = sum_l w_l S_l ,    w_l = t_l sqrt((2 l + 1) / (4 pi)) .     (1)

[W18] eqs. 25-32 find S_l by a recurrence along each edge, whose short edges cancel: in float32 an edge of 1e-3 rad keeps two digits.
Here the edge form of :py:mod:`mi_shlight.light.edge_frame` takes its place. In the frame of an edge, z along its normal and x through
its middle, a light has only the coefficients with l + m odd and m >= 0, and those of ``P_l(omega . axis)`` are
``4 pi / (2 l + 1) Y_lm(axis)`` by the addition theorem. Nothing is rotated. With the axis (p, q, c) in that frame and
``Y_lm = K_lm c y_lm(c^2) Re (p + i q)^m``, y_lm a polynomial with leading coefficient 1,

    sum_l w_l S_l = w_0 Omega + sum_e c_e sum_m sin(m h) / m Re (p + i q)^m sum_l w_l a_lm y_lm(c_e^2) ,                      (2)
    a_lm = 8 pi / (l (l + 1) (2 l + 1)) K_lm^2 y_lm(0) ,    h = T_e / 2    (m = 0: h in place of sin(m h) / m) .

Derived for this package.
"""
from __future__ import annotations

import functools
import math

import drjit as dr

from ..errors import check_number
from ..sh.basis import check_order
from ..sh.lobes import MAX_ORDER
from .arguments import all_finite, float_list, polygon_arguments
from .polygon import direction, edge_frame, fan_solid_angle, legendre_p
from .project import default_error, prefers_cubature
from .quadrature import integrate


def shade_zonal(vertices, x, axis, zonal):
    """Shade by a uniform polygonal light of unit radiance where the transfer is symmetric about `axis`.

    ``sum_lm T_lm L_lm`` with ``T_lm = zonal[l] sqrt(4 pi / (2 l + 1)) Y_lm(axis)``: the same number as the dot product of this vector
    with :py:func:`mi_shlight.project_polygon`, without forming either.

    Parameters
    ----------
    vertices, x : list of N >= 3 3-vectors, 3-vector
        The light and the shading point, as in :py:func:`mi_shlight.project_polygon`: positive counter-clockwise as seen from
        outside the unit sphere about `x`.
    axis : 3-vector
        Axis of symmetry; need not be normalised. The zero vector leaves nothing but degree 0.
    zonal : list of order + 1 floats, in 1/sr
        Coefficients of the transfer in the zonal harmonics ``Y_l0`` about `axis`, as by :py:func:`zonal_lambert` or
        :py:func:`zonal_phong`; Python floats or Dr.Jit floats, wide or single. Order 0 to 64.

    Returns
    -------
    float
        Radiance for unit radiance of the light; its type follows the vectors.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, `vertices` has fewer than three entries, or `zonal` does not have 1 to 65.

    Notes
    -----
    Error: eps (6e-8 in float32, 1e-16 in float64) times the light's perimeter as seen from `x`, in radians, times the largest
    ``|zonal[l]|``; mostly within a factor of 2, measured up to 11, order 14. Relative to the result, which is of the size of the
    solid angle, that is 1e-6 in float32 for lights of moderate size, and grows as eps / theta for one of angular size theta.

    Limits for degenerate input as there; an infinite or NaN coordinate gives NaN. Differentiable by Dr.Jit's autodiff with respect to every
    argument.

    Python floats in `zonal` become part of the kernel: pass Dr.Jit floats if they change often.
    """
    name = "shade_zonal"
    light, x, apex, axis = polygon_arguments(name, vertices, x, axis=axis)
    hint = "It has one entry per degree, from 0 to the order, as zonal_lambert(8)."
    weights = times_pole_value(float_list(name, "zonal", zonal, type(x[0]), 1, MAX_ORDER + 1, hint))
    value = zonal_shader(direction(axis), weights)(light, x, apex)
    return dr.select(all_finite(*light.vertices, x, axis), value, dr.nan)


def zonal_lambert(order: int) -> list:
    """Zonal coefficients of ``max(0, cos) / pi``, the transfer of an unshadowed diffuse surface of reflectance 1 about its normal.

    ``A_l / pi * sqrt((2 l + 1) / (4 pi))`` with the ``A_l`` of Ramamoorthi and Hanrahan 2001: :py:func:`zonal_phong` with exponent 1.

    Parameters
    ----------
    order : int
        Highest degree, 0 to 64.

    Returns
    -------
    list of order + 1 Python floats in 1/sr, exact to rounding.
    """
    return times_pole_value(phong_bands(1.0, check_order("zonal_lambert", order)))


def zonal_phong(exponent, order: int) -> list:
    """Zonal coefficients of a Phong lobe, ``(s + 1) / (2 pi) max(0, cos)^s``, about its axis.

    The lobe is normalised: its integral over the sphere is 1. Exponent 1 is Lambert's cosine, 0 a constant over the hemisphere. The
    order must grow like the square root of the exponent for the lobe not to be cut off. As in Phong's model, a lobe about a mirror
    direction near the horizon reaches below the surface.

    Parameters
    ----------
    exponent : float
        s >= 0, a number or a Dr.Jit float (not checked then), e.g. one value per shading point.
    order : int
        Highest degree, 0 to 64.

    Returns
    -------
    list of order + 1 floats in 1/sr; Python floats or of the type of `exponent`.

    Raises
    ------
    TypeError, ValueError
        If `exponent` is not a finite number >= 0, or `order` is not an integer from 0 to 64.

    Notes
    -----
    Relative error below order * eps at every exponent and order (next to whole exponents, where odd or even coefficients vanish, of
    the exponent's own rounding). Differentiable.
    """
    n = check_order("zonal_phong", order)
    if not (dr.is_float_v(exponent) and dr.is_array_v(exponent) and dr.depth_v(exponent) == 1):
        exponent = check_number("zonal_phong", "exponent", exponent, 0, hint="1 is Lambert's cosine; larger is more glossy.")
    return times_pole_value(phong_bands(exponent, n))


def phong_bands(exponent, order: int) -> list:
    """Factors ``b_l`` of a normalised Phong lobe f, ``f_lm = b_l Y_lm(axis)``: ``b_l = (s + 1) int_0^1 z^s P_l(z) dz``.

    ``b_0 = 1, b_1 = (s + 1) / (s + 2), b_l = b_{l-2} (s - l + 2) / (s + l + 1)``: products of factors below 1, nothing cancels.
    """
    bands = [exponent * 0 + 1.0, (exponent + 1) / (exponent + 2)]
    for l in range(2, order + 1):
        bands.append(bands[l - 2] * ((exponent - (l - 2)) / (exponent + (l + 1))))
    return bands[:order + 1]


def times_pole_value(values: list) -> list:
    """Each value times ``Y_l0`` at the pole, ``sqrt((2 l + 1) / (4 pi))``: factors ``b_l`` -> zonal coefficients -> weights of ``P_l``."""
    return [value * math.sqrt((2 * l + 1) / (4 * math.pi)) for l, value in enumerate(values)]


def zonal_shader(axis, weights: list):
    """Function ``shade(light, x, apex, active)`` that gives ``sum_l weights_l S_l`` about the unit vector `axis`; equation (2)."""
    table = edge_series(len(weights) - 1)

    def term(v_i, v_j, point_data):
        (apex, axis), frame = point_data, edge_frame(v_i, v_j)
        p, q, c = (dr.dot(axis, v) for v in (frame.middle, dr.cross(frame.normal, frame.middle), frame.normal))
        sines = [sine * (1 / m) for m, (_, sine) in enumerate(_powers(frame.cos_half, frame.sin_half, len(table)), 1)]
        waves = [real for real, _ in _powers(p, q, len(table))]
        total, square = type(p)(0), c * c
        for wave, length, terms in zip([type(p)(1), *waves], [frame.arc * 0.5, *sines], table):
            series, before = type(p)(0), type(p)(0)
            for l, factor, e, f in reversed(terms):   # Clenshaw
                series, before = dr.fma(square - e, series, dr.fma(before, -f, weights[l] * factor)), series
            total = dr.fma(series * wave, length, total)
        return [dr.fma(total, c, weights[0] * fan_solid_angle(apex, frame))]

    # loops see derivatives of their state alone, so the axis joins it, beside the apex
    return lambda light, x, apex, active=True: light.sum(term, x, (apex, axis), 1, active)[0]


def zonal_light_shader(axis, weights: list):
    """:py:func:`zonal_shader` with cubature where the closed form would lose digits, by the rule of method ``auto``.

    Derivatives are those of the closed form; none by `weights`.
    """
    weights, order = [dr.detach(w) for w in weights], len(weights) - 1
    fixed, max_error = dr.detach(axis), default_error(axis)
    over_edges = zonal_shader(fixed, weights)

    def add(total, omega, solid_angle):
        value = 0
        for w, p in zip(weights, legendre_p(dr.dot(fixed, omega), order)):
            value = dr.fma(w, p, value)
        return dr.fma(solid_angle, value, total)

    def value(light, x, apex):
        cubature = prefers_cubature(light, x, order, max_error)
        return over_edges(light, x, apex, cubature ^ True) + integrate(light, x, order, max_error, add, type(x[0])(0), cubature)

    def shade(light, x, apex):
        if not (light.grad_enabled() or dr.grad_enabled(x) or dr.grad_enabled(axis)):
            return value(light, x, apex)
        return dr.replace_grad(value(light.detached(), dr.detach(x), apex), zonal_shader(axis, weights)(light, x, apex))

    return shade


@functools.lru_cache(maxsize=None)
def edge_series(order: int) -> tuple:
    """Constants of equation (2): for each m = 0 .. order - 1 the tuples ``(l, a_lm, e, f)``, l = m + 1, m + 3, ..

    With ``g_l = (l^2 - m^2) / (4 l^2 - 1)`` the normalised Legendre functions obey ``sqrt(g_{l+1}) Y_{l+1} = z Y_l - sqrt(g_l) Y_{l-1}``;
    twice, ``y_{l+2} = (z^2 - e_l) y_l - f_{l-2} y_{l-2}``, ``e_l = g_l + g_{l+1}``, ``f_l = g_{l+1} g_{l+2}``.
    """
    table, sectoral = [], 1 / (4 * math.pi)           # Y_mm^2 on the equator at azimuth 0, without the factor 2 of m > 0
    for m in range(order):
        g = lambda l, m=m: (l * l - m * m) / (4 * l * l - 1)
        sectoral *= (2 * m + 1) / (2 * m) if m else 1
        squared_scale, y, before, terms = (2 if m else 1) * sectoral / g(m + 1), 1.0, 0.0, []
        for l in range(m + 1, order + 1, 2):
            e, f = g(l) + g(l + 1), g(l + 1) * g(l + 2)
            terms.append((l, 8 * math.pi / (l * (l + 1) * (2 * l + 1)) * squared_scale * y, e, f))
            y, before = -e * y - g(l) * g(l - 1) * before, y
            squared_scale /= f
        table.append(tuple(terms))
    return tuple(table)


def _powers(re, im, count: int) -> list:
    """``(re + i im)^m`` as (real, imaginary), m = 1 .. count - 1; odd and even ones apart, so that either can be left out of a kernel."""
    square = dr.fma(re, re, -(im * im)), 2 * re * im
    out = [(re, im), square]
    for _ in range(3, count):
        a, b = out[-2]
        out.append((dr.fma(a, square[0], -(b * square[1])), dr.fma(a, square[1], b * square[0])))
    return out[:max(count - 1, 0)]
