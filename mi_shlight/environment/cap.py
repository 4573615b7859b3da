"""Lights that are a cap of the sphere, and shadows of that shape.

A cap of half-angle a about d, ``{omega : omega . d > cos(a)}``, has the coefficients

    L_lm = 2 pi q_l(a) Y_lm(d) ,    q_l = int_{cos a}^1 P_l(z) dz = sin^2(a) P_l'(cos a) / (l (l + 1)) ,    q_0 = 2 sin^2(a / 2)      (1)

by Legendre's equation. [G03] ("synth_light") has them to degree 3, about the z axis, as Maple printed them; the usual
``q_l = (P_{l-1} - P_{l+1}) / (2 l + 1)`` is the same, but loses all digits of a small cap.
"""
from __future__ import annotations

import math

import drjit as dr

from ..arrays import vectors3
from ..errors import check_number, message
from ..light.arguments import float_list, not_literal
from ..light.polygon import direction as unit
from ..sh.arguments import coefficients_order
from ..sh.basis import check_order, sh_basis
from ..sh.rotation import rotate_frame
from .nodes import leggauss, sum_over_nodes


def project_cap(half_angle, order: int, direction=(0.0, 0.0, 1.0)) -> list:
    """SH coefficients of a round light of unit radiance, a cap of the sphere; closed form, equation (1).

    ``L_lm = 2 pi Y_lm(d) int_{cos a}^1 P_l(z) dz``, for distant discs (a sun, a moon), a hemisphere of sky, or a spherical light as it is
    seen from a point: there ``sin(half_angle)`` is its radius over the distance of its centre.

    Parameters
    ----------
    half_angle : float
        Angle in radians between the axis and the rim, 0 to pi: nothing to the whole sphere. A number or a Dr.Jit float, e.g. one value per
        point (its range is not checked then).
    order : int
        Highest degree, 0 to 64.
    direction : 3-vector
        Axis of the cap, of any length but 0.

    Returns
    -------
    list of (order + 1)**2 floats in steradians, index ``l (l + 1) + m``; their type follows the arguments.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, `half_angle` is not from 0 to pi, `order` not from 0 to 64, or `direction` is 0 or infinite.
        What is not a constant is not checked.

    Notes
    -----
    Relative error of each factor q_l about l eps at any half-angle, small ones included. Differentiable by half-angle and direction.
    """
    n = check_order("project_cap", order)
    d, half_angle = _cap_arguments("project_cap", direction, half_angle)
    return zonal_about(d, cap_bands(half_angle, n), n)


def proxy_shadow(coeffs, direction, half_angle, order: int | None = None) -> list:
    """Take the light of a cap of directions away: the shadow of a round proxy, in the light's own coefficients.

    The light is multiplied by 0 inside the cap and 1 outside ([G03] "proxy shadows", after Alex Evans), exactly, and the product projected:
    ``L'_lm = L_lm - sum_l'm' L_l'm' int_cap Y_lm Y_l'm'``. In the cap's own frame the integral couples equal m only.

    Parameters
    ----------
    coeffs : list of (n + 1)**2 floats
        The light. Python floats or Dr.Jit floats.
    direction : 3-vector
        Towards the centre of what casts the shadow, of any length but 0.
    half_angle : float
        Half the angle it takes up, in radians, 0 to pi: of a ball, asin(radius / distance). A number or a Dr.Jit float.
    order : int
        Highest degree of the result, 0 to 64. Default: that of `coeffs`. The product of a light of degree n with a cap has all degrees.

    Returns
    -------
    list of (order + 1)**2 floats.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or range, or the length of `coeffs` is no square. What is not a constant is not checked.

    Notes
    -----
    The projection of the exact product to rounding. What follows from a light cut off at degree n is the caller's: below about 180 / n
    degrees a cap takes little more than the mean of what the coefficients show there. Differentiable by all arguments.
    """
    name = "proxy_shadow"
    d, half_angle = _cap_arguments(name, direction, half_angle)
    n = coefficients_order(name, "coeffs", coeffs)
    count = (n + 1) ** 2
    coeffs = float_list(name, "coeffs", coeffs, type(d[0]), count, count, "Its entries are single numbers, or one per point.")
    out = n if order is None else check_order(name, order)
    number = type(d[0])
    s, t = tangents(d)
    local = rotate_frame([number(c) for c in coeffs], s, t, d, n, inverse=True)
    taken = rotate_frame(_inside(local, half_angle, n, out), s, t, d, out)
    return [(coeffs[i] if i < len(coeffs) else 0) - c for i, c in enumerate(taken)]


def tangents(n) -> tuple:
    """(s, t) of a right-handed orthonormal frame s, t, n (Duff et al. 2017); continuous but for n.z = 0."""
    sign = dr.mulsign(type(n.z)(1), n.z)
    a = -1 / (sign + n.z)
    b = n.x * n.y * a
    return type(n)(1 + sign * n.x * n.x * a, sign * b, -sign * n.x), type(n)(b, sign + n.y * n.y * a, -n.y)


def _cap_arguments(name: str, axis, half_angle) -> tuple:
    """(unit axis, half-angle) of one float type."""
    if not (dr.is_float_v(half_angle) and dr.is_array_v(half_angle) and dr.depth_v(half_angle) == 1):
        half_angle = check_number(name, "half_angle", half_angle, 0, math.pi, hint="It is in radians, from the axis to the rim.")
    axis, angle = vectors3(name, direction=axis, half_angle=(half_angle, 0.0, 0.0))
    return unit_vector(name, "direction", axis), not_literal(angle)[0]


def unit_vector(name: str, argument: str, vector):
    """Unit vector along one from :py:func:`vectors3`; ValueError if that is constant and without a direction."""
    if isinstance(vector, list):
        raise TypeError(message(name, argument, "be a single 3-vector", vector, "Many are one Dr.Jit vector of three arrays."))
    if not dr.is_jit_v(vector) or all(c.state == dr.VarState.Literal for c in vector):
        values = [dr.slice(dr.detach(c), 0) for c in vector]
        if not any(values) or not all(map(math.isfinite, values)):
            raise ValueError(message(name, argument, "be a 3-vector of finite length other than 0", values))
    return unit(not_literal(vector))


def zonal_about(axis, bands: list, order: int) -> list:
    """Coefficients ``bands_l Y_lm(axis)`` of a function symmetric about the unit vector `axis`."""
    return [bands[l] * y for (l, _), y in zip(((l, m) for l in range(order + 1) for m in range(-l, l + 1)), sh_basis(axis, order))]


def cap_bands(angle, order: int) -> list:
    """``2 pi q_0 .. 2 pi q_order`` of equation (1)."""
    c, s, half = dr.cos(angle), dr.sin(angle), dr.sin(angle * 0.5)
    bands, before, p, slope = [4 * math.pi * half * half], type(c)(1), c, type(c)(1)
    for l in range(1, order + 1):
        bands.append(2 * math.pi / (l * (l + 1)) * s * s * slope)
        p, before, slope = dr.fma((2 * l + 1) / (l + 1) * c, p, -l / (l + 1) * before), p, dr.fma(c, slope, (l + 1) * p)
    return bands


def _inside(coeffs: list, angle, order_in: int, order_out: int) -> list:
    """Coefficients of the part of a function inside the cap about z.

    ``int_{cos a}^1 dz`` of a polynomial, exact by Gauss-Legendre's rule: at each latitude the function's Fourier terms are summed over l,
    then projected.
    """
    top = max(order_in, order_out)
    nodes, weights = leggauss((order_in + order_out) // 2 + 1)
    shared = range(min(order_in, order_out) + 1)

    def term(values, sine, *coeffs):
        node, weight = values
        across = dr.sqrt(node * (2 - sine * sine * node))                 # sin(theta) / sin(a / 2)
        basis = sh_basis([sine * across, 0.0 * node, 1 - sine * sine * node], top)
        out = [type(sine)(0)] * (order_out + 1) ** 2
        for m in shared:
            column = [basis[l * (l + 1) + m] for l in range(m, top + 1)]
            for sign in (1, -1)[:1 + (m > 0)]:
                wave = column[0] * coeffs[m * (m + 1) + sign * m]
                for l in range(m + 1, order_in + 1):
                    wave = dr.fma(column[l - m], coeffs[l * (l + 1) + sign * m], wave)
                wave = wave * (sine * sine * weight)                      # dz = sin^2(a / 2) d node
                for l in range(m, order_out + 1):
                    out[l * (l + 1) + sign * m] = column[l - m] * wave
        return out

    # by m > 0 a Fourier term takes half of the circle; node: 1 - cos(theta) over sin^2(a / 2)
    number, half = type(angle), dr.sin(angle * 0.5)
    integrals = sum_over_nodes(number, (1 - nodes, weights), term, (order_out + 1) ** 2, half, *coeffs)
    return [value * (2 * math.pi if i == l * (l + 1) else math.pi) for l in range(order_out + 1)
            for i, value in list(enumerate(integrals))[l * l:(l + 1) ** 2]]
