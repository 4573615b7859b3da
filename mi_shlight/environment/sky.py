"""The sky models of the CIE's standard daylight: overcast, clear, partly cloudy.

Luminance relative to that of the zenith, theta the angle from the zenith, gamma the angle from the sun, S that between sun and zenith:

    overcast        (1 + 2 cos theta) / 3                                                       (Moon and Spencer 1942, CIE 1955)
    clear           f(gamma) g(theta) / (f(S) g(0)) ,   f(x) = 0.91 + 10 exp(-3 x) + 0.45 cos^2 x ,   g(x) = 1 - exp(-0.32 / cos x)
                                                                                                (Kittler 1967, CIE 1973)
    partly_cloudy   f(gamma) g(theta) / (f(S) g(0)) ,   f(x) = 0.526 + 5 exp(-1.5 x) ,                g(x) = 1 - exp(-0.80 / cos x)
                                                                                                (Matsuura 1987)

[G03] ("Creating Light Sources") prints them with two slips. Of the overcast sky it calls beta, of which it takes the sine, the angle from
the zenith; it is the one above the horizon: the zenith is three times as bright as the horizon. And of the partly cloudy sky it prints
cos(gamma) in g(theta), with which the zenith would not have the luminance of the zenith.

Nothing comes from below the horizon. The sun itself is no part of the sky: add it as a ``directional`` light, or as a cap.
"""
from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ..arrays import vectors3
from ..errors import check_choice, check_number, message
from ..light.polygon import direction as unit
from ..light.zonal import phong_bands
from ..sh.basis import check_order, sh_basis
from ..sh.rotation import rotate_frame
from .cap import cap_bands, tangents, unit_vector, zonal_about
from .nodes import leggauss, sum_over_nodes

SKIES = ("overcast", "clear", "partly_cloudy")

_GLOW = {"clear": (0.91, 10.0, 3.0, 0.45), "partly_cloudy": (0.526, 5.0, 1.5, 0.0)}
"""Of f(x): the constant, factor and decay of the exponential, factor of the squared cosine."""

_HAZE = {"clear": 0.32, "partly_cloudy": 0.80}
"""Of g(x)."""


def cie_sky(direction, kind: str, sun=None, zenith=(0.0, 1.0, 0.0), zenith_luminance=1.0):
    """Luminance of a CIE standard sky in a direction.

    Parameters
    ----------
    direction : 3-vector
        Where to look; this and the others may have any length but 0.
    kind : str
        ``"overcast"``, ``"clear"`` or ``"partly_cloudy"``.
    sun : 3-vector, optional
        Towards the sun, above or below the horizon; not for ``overcast``, which has none, and needed by the others.
    zenith : 3-vector
        Up. Default: y, as Mitsuba's ``envmap`` and the scenes of this package have it.
    zenith_luminance : float
        Luminance of the zenith, in whatever unit the result is to have: a number >= 0 or a Dr.Jit float.

    Returns
    -------
    float
        Its type follows the vectors; 0 below the horizon.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or value, a vector that is constant is 0 or infinite, or `sun` is missing or too much.

    Notes
    -----
    The formulas are at the head of :py:mod:`mi_shlight.environment.sky`, with two slips of [G03] put right. Differentiable; not at the
    point of the sun, where the sky has a cusp, nor across the horizon.
    """
    name = "cie_sky"
    zenith_luminance = _luminance(name, zenith_luminance)
    direction, zenith, sun = _sky_arguments(name, kind, sun, direction=direction, zenith=zenith)
    toward = None if sun is None else (_angle(direction, sun), _angle(zenith, sun))
    return zenith_luminance * _relative(kind, dr.dot(direction, zenith), toward)


def project_sky(kind: str, order: int, sun=None, zenith=(0.0, 1.0, 0.0), zenith_luminance=1.0) -> list:
    """SH coefficients of a CIE standard sky, :py:func:`cie_sky`.

    In closed form if overcast, otherwise by Gauss-Legendre's rule over the angles from the zenith and about it, in panels that meet at the
    sun and end at the horizon, where the sky is not smooth.

    Parameters
    ----------
    kind, sun, zenith, zenith_luminance
        As in :py:func:`cie_sky`; the vectors and the luminance may hold many values, one sky each.
    order : int
        Highest degree, 0 to 64.

    Returns
    -------
    list of (order + 1)**2 floats, in `zenith_luminance` times steradian, index ``l (l + 1) + m``.

    Raises
    ------
    TypeError, ValueError
        As :py:func:`cie_sky`.

    Notes
    -----
    Error relative to the largest coefficient: 1e-6 at most, 5e-6 in float32; of an overcast sky rounding alone. Differentiable by sun,
    zenith and luminance.
    """
    name = "project_sky"
    n = check_order(name, order)
    zenith_luminance = _luminance(name, zenith_luminance)
    zenith, sun = _sky_arguments(name, kind, sun, zenith=zenith)
    if sun is None:
        half, cosine = (zonal_about(zenith, bands, n) for bands in (cap_bands(type(zenith[0])(math.pi / 2), n), phong_bands(1.0, n)))
        return [zenith_luminance * (h + 2 * math.pi * c) / 3 for h, c in zip(half, cosine)]
    number, array = type(zenith[0]), type(zenith)
    level = sun - zenith * dr.dot(sun, zenith)
    aside = dr.squared_norm(level) > 1e-12                                # otherwise the sun stands in the zenith
    other = tangents(zenith)[0]
    east = unit(array(*(dr.select(aside, a, b) for a, b in zip(level, other))))

    nodes, weights = leggauss(n // 2 + _NODES)
    upper, u, v = (grid.ravel() for grid in np.meshgrid([1.0, 0.0], (1 + nodes) / 2, (1 + nodes) / 2, indexing="ij"))
    weight = np.tile(np.outer(weights, weights).ravel() / 4, 2)

    def term(values, apart):
        """One panel from the zenith to the sun, or the horizon if that is nearer, and one from there to the horizon."""
        upper, u, v, weight = values
        split = dr.minimum(apart, math.pi / 2)
        span = dr.select(upper > 0, split, math.pi / 2 - split)
        (sin, cos), (sin_phi, cos_phi) = dr.sincos(span * u + dr.select(upper > 0, 0, split)), dr.sincos(number(math.pi * v))
        place = array(sin * cos_phi, sin * sin_phi, cos)
        gamma = _angle(place, array(dr.sin(apart), number(0), dr.cos(apart)))
        area = _relative(kind, cos, (gamma, apart)) * sin * span * (weight * (2 * math.pi))   # even in phi: both halves at once
        return [y * area if m >= 0 else number(0) for y, m in zip(sh_basis(place, n), orders)]

    orders = [m for l in range(n + 1) for m in range(-l, l + 1)]
    local = sum_over_nodes(number, (upper, u, v, weight), term, (n + 1) ** 2, _angle(zenith, sun))
    return [c * zenith_luminance for c in rotate_frame(local, east, dr.cross(zenith, east), zenith, n)]


_NODES = 24
"""Nodes along each side of a panel, beside those that the spherical harmonics need."""


def _sky_arguments(name: str, kind: str, sun, **vectors) -> list:
    """The vectors of one common type and unit length, with the sun as last; None if there is none."""
    check_choice(name, "kind", kind, SKIES)
    if kind == "overcast":
        if sun is not None:
            raise ValueError(message(name, "sun", "be left out with kind='overcast'", sun, "An overcast sky is the same all around."))
    elif sun is None:
        raise ValueError(message(name, "sun", f"be a 3-vector with kind='{kind}'", sun, "It points towards the sun: (1, 1, 0)."))
    else:
        vectors["sun"] = sun
    units = [unit_vector(name, argument, vector) for argument, vector in zip(vectors, vectors3(name, **vectors))]
    return units if "sun" in vectors else [*units, None]


def _luminance(name: str, value):
    if dr.is_float_v(value) and dr.is_array_v(value) and dr.depth_v(value) == 1:
        return value
    return check_number(name, "zenith_luminance", value, 0)


def _relative(kind: str, cosine, toward):
    """Luminance over that of the zenith, `cosine` the one of theta and `toward` the angles gamma and S; 0 below the horizon."""
    if kind == "overcast":
        relative = (1 + 2 * cosine) / 3
    else:
        gamma, apart = toward
        relative = _glow(kind, gamma) * _haze(kind, cosine) / (_glow(kind, apart) * _haze(kind, type(cosine)(1)))
    return dr.select(cosine > 0, relative, 0)


def _glow(kind: str, angle):
    constant, factor, decay, square = _GLOW[kind]
    return constant + factor * dr.exp(-decay * angle) + square * dr.square(dr.cos(angle))


def _haze(kind: str, cosine):
    return 1 - dr.exp(-_HAZE[kind] / dr.maximum(cosine, 1e-3))            # at 1e-3 it is 1 in any precision


def _angle(a, b):
    """Angle between unit vectors: exact where they meet, where an acos is not."""
    return dr.atan2(dr.safe_sqrt(dr.squared_norm(dr.cross(a, b))), dr.dot(a, b))
