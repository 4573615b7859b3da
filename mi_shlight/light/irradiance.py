"""Exact irradiance of a uniform polygon: Lambert's formula, with the light cut off at the receiver's horizon.

For a light above the horizon ``E = 1/2 sum_e c_e T_e`` (Lambert 1760), ``c_e = n_e . normal``: the area of the light's vertical projection
into the unit disc, taken along its outline. Below, the outline is replaced by its shadow on the horizon under the pole p on the
light's other side: every point moves along its meridian. The swept area is then a sum over the edges alone, without a search for
where the light enters and leaves the horizon,

    E = 1/2 sum_e (c_e T_e' + d_e) + pi w ,                                                                                 (1)

with ``T_e'`` the part of the arc above the horizon and

- the nadir as p if the apex is above the horizon: ``d_e`` is the change of azimuth along the part below;
- the zenith as p if it is below: ``d_e`` is minus the change of azimuth along the part above.

Meridians meet in p, so (1) counts with w how often the light covers p: the signed crossings of its edges with the way from the point
opposite to the apex, which no planar light covers, to p. That way is at most a quarter circle. If no edge passes the horizon, the sums of
d_e and w cancel and are left out, so that a light wholly below gives 0 and one wholly above loses no digits.
"""
from __future__ import annotations

import math

import drjit as dr

from .arguments import all_finite, polygon_arguments
from .polygon import direction, edge_frame

TINY = 1e-18
"""Far below the rounding of a unit vector, with a square that float32 still holds."""


def polygon_irradiance(vertices, x, normal):
    """Irradiance at `x` of a uniform polygonal light of unit radiance, exact: Lambert's formula after clipping at the horizon.

    ``E = int_Q max(0, normal . omega) d omega`` over the directions Q in which the polygon is seen. The limit to which unshadowed shading
    by spherical harmonics converges, ``E / pi``, as the order grows.

    Parameters
    ----------
    vertices, x : list of N >= 3 3-vectors, 3-vector
        The light and the receiving point, as in :py:func:`mi_shlight.project_polygon`: a planar polygon, convex or not; positive
        counter-clockwise as seen from outside the unit sphere about `x`.
    normal : 3-vector
        Normal of the receiving surface; need not be normalised, the zero vector gives 0.

    Returns
    -------
    float
        -pi to pi, in units of the light's radiance times steradian; its type follows the arguments. A diffuse surface of reflectance rho
        reflects the radiance ``rho * E / pi``.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, or `vertices` has fewer than three entries.

    Notes
    -----
    Error: eps (6e-8 in float32, 1e-16 in float64) times the light's perimeter as seen from `x`, in radians; mostly within a factor of 2,
    measured up to 5. Relative to the result that is 1e-6 in float32 for lights of moderate size, and grows as eps / theta for one of
    angular size theta. A light wholly below the horizon gives exactly 0.

    Limits: a vertex at `x` contributes nothing with its two edges; an edge through `x`, and coincident vertices, contribute nothing;
    `x` outside the light in its plane gives 0; inside the light, one of the limits from its two sides. Finite input never gives
    NaN; a coordinate that is infinite or NaN does.

    Differentiable by Dr.Jit's autodiff with respect to every argument.
    """
    light, x, apex, normal = polygon_arguments("polygon_irradiance", vertices, x, normal=normal)
    value = irradiance_shader(direction(normal))(light, x, apex)
    return dr.select(all_finite(*light.vertices, x, normal), value, dr.nan)


def irradiance_shader(normal):
    """Function ``shade(light, x, apex, active)`` that gives the irradiance on a surface with the unit vector `normal`.

    The point opposite to the apex must lie more than 2 degrees off the light, as that of ``interior_direction`` does.
    """
    number, vector = type(normal[0]), type(normal)
    dot = lambda a, b: a[0] * b[0] + a[1] * b[1]
    cross = lambda a, b: a[0] * b[1] - a[1] * b[0]

    def term(v_i, v_j, point_data):
        apex, normal = point_data
        east = direction(dr.cross(dr.select(abs(normal[0]) < 0.5, vector(1, 0, 0), vector(0, 1, 0)), normal))
        north = dr.cross(normal, east)
        flat = lambda v: (dr.dot(east, v) + TINY, dr.dot(north, v))     # the shift gives a corner in the pole an azimuth, too
        apex = apex + east * 0.012 + north * 0.029    # in symmetric scenes edges would lie along the way to the pole
        above = dr.dot(normal, apex) >= 0
        frame = edge_frame(v_i, v_j)
        height_i, height_j = dr.dot(normal, frame.omega_i), dr.dot(normal, frame.omega_j)
        up_i, up_j = height_i >= -TINY, height_j >= -TINY
        # Shares of the lower and the upper end in the point where the edge passes the horizon; 1, 0 if it stays above and 0, 1 below.
        stays = up_i & up_j
        high = dr.select(stays, 1, dr.maximum(dr.maximum(height_i, height_j), 0))
        low = dr.select(stays, 0, -dr.minimum(height_i, height_j))
        high, low = high / (high + low), low / (high + low)
        arc = _angle(dr.fma(high, frame.cos, low), high * frame.sin)

        # Azimuths from the ends' projections into the horizon: what one edge rounds the next one takes back. The frame knows the sine of an
        # edge to its own size; that counts only if all edges are short, and near the pole it could contradict the projections.
        i, j, a = flat(frame.omega_i), flat(frame.omega_j), flat(apex)
        square_i, square_j, slope = dot(i, i), dot(j, j), dr.dot(normal, frame.normal)
        passes_by = (square_i > 0.5) & (square_j > 0.5) & (frame.cos > 0)
        cos, turn = dot(i, j), cross(i, j)
        sin = dr.select(passes_by, slope * frame.sin, turn)
        upper, lower = dr.select(up_i, square_i, square_j), dr.select(up_i, square_j, square_i)
        azimuth = _angle(dr.select(above, high * lower + low * cos, low * upper + high * cos), dr.select(above, low, high) * sin)

        # Does the edge cross the way from the point opposite to the apex to the pole?
        inwards = (turn >= 0) ^ above                 # the pole lies to its left
        left_i, left_j = (cross(i, a) >= 0) == above, (cross(j, a) >= 0) == above
        crosses = (left_i ^ left_j) & (left_i == inwards) & ((dr.dot(apex, frame.normal) > 0) == inwards)
        covers = dr.select(crosses, dr.select(inwards, number(math.pi), -math.pi), 0)
        shadow = dr.fma(dr.select(above, 0.5, -0.5), azimuth, covers)
        values = 0.5 * slope * arc, shadow, dr.select(up_i ^ up_j, number(1), 0)
        return [dr.select(frame.sin > 0, value, 0) for value in values]

    def shade(light, x, apex, active=True):
        # loops see derivatives of their state alone, so the normal joins it, beside the apex
        lambert, shadow, passes = light.sum(term, x, (apex, normal), 3, active)
        return lambert + dr.select(passes > 0, shadow, 0)  # all above or all below: the rest is 0 but for rounding

    return shade


def _angle(cos, sin):
    """``atan2(sin, cos)``, 0 where both vanish."""
    usable = abs(sin) + abs(cos) > TINY ** 1.5
    return dr.select(usable, dr.atan2(dr.select(usable, sin, 0), dr.select(usable, cos, 1)), 0)
