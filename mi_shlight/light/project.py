"""Front door of the coefficient engine: checks its arguments and chooses the method."""
from __future__ import annotations

import drjit as dr
import numpy as np

from ..errors import check_choice
from ..sh.basis import check_order
from .arguments import all_finite, error_argument, polygon_arguments
from .edge_frame import edge_form_shader, project_edge
from .quadrature import demand, project_quadrature, quadrature_shader
from .recurrence import project_recurrence, recurrence_shader

METHODS = ("auto", "recurrence", "edge", "quadrature")
"""Accepted values of `method`."""

MAX_ERROR = (4e-6, 1e-12)
"""Default of `max_error` in float32 and float64: what the boundary forms reach for lights of moderate size, with some room."""

COSTS = {0: (4, 16, 3), 2: (4.9, 16, 3.8), 4: (6.3, 18, 3.8), 8: (12.5, 20, 6.5), 14: (42, 20, 18), 20: (115, 25, 35)}
"""Cost of one edge of the ``edge`` form, one strip and one point of cubature, by order, in nanoseconds of one thread: their ratios decide
where cubature is cheaper. Least squares over timings such as those of validation/engine.py; linear in between, constant above."""


def project_polygon(vertices, x, order: int, method: str = "auto", *, max_error=None) -> list:
    """Project a uniform polygonal light of unit radiance, seen from `x`, to spherical harmonics.

    ``L_lm = int_Q Y_lm(omega) d omega`` over the directions Q in which the polygon is seen ([W18] eq. 5). Multiply by
    the light's radiance afterwards; coefficients of several lights add.

    Parameters
    ----------
    vertices : list of N >= 3 3-vectors
        The polygon's corners in order, convex or not; Dr.Jit or Mitsuba vectors, wide or single, or triples of floats. The
        result is signed by orientation: positive when the corners run counter-clockwise as seen from outside the unit sphere
        about `x`, that is ``omega_0 . (omega_1 x omega_2) > 0``. Clipping at a horizon is not done: the transfer carries it.
    x : 3-vector
        Shading point, in the units of `vertices`.
    order : int
        Highest degree, 0 to 64.
    method : str
        ``"auto"``: ``edge`` (above order 32 ``recurrence``) or ``quadrature``, for each point whichever is accurate enough and cheaper.
        ``"edge"``: closed form in each edge's own frame. ``"recurrence"``: zonal recurrence of [W18], Algorithm 1, closed too; two to
        three times slower than ``edge``. ``"quadrature"``: cubature over the light's area, for lights of moderate and small angular size at
        any distance and angle, also where the closed forms cancel.
    max_error : float, optional
        Relative L2 error of all coefficients together that ``auto`` and ``quadrature`` aim at; 4e-6 in float32 and 1e-12 in float64 if
        not given. Larger values save time on distant lights. Not below the precision's rounding unit.

    Returns
    -------
    list of (order + 1)**2 floats in steradians, sign and index of :py:func:`mi_shlight.sh_basis`; the float type follows the
    arguments (Dr.Jit backend and precision; Python floats if no Dr.Jit type is given).

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, `vertices` has fewer than three entries, `order` is outside 0..64,
        `method` is unknown or `max_error` out of range.

    Notes
    -----
    Relative L2 error at order 14 over a reference set of 62 polygons: ``auto`` 8e-6 in float32 and 1e-12 in float64, also for lights
    1e6 times farther away than they are large, seen edge-on at 1e-6 of their size, and slivers of width 1e-6. The closed forms ``edge``
    and ``recurrence`` subtract edge terms. Their absolute error is at most max(4, 0.6 (order + 1)) eps K for ``edge``, twice that for
    ``recurrence`` (validation/stability_maps.py), with ``K = sum 2 tan(T / 2)`` over the angles T under which the edges are seen, mostly
    about the perimeter; relative to the solid angle it grows as eps / theta for a light of angular size theta. ``quadrature`` keeps to
    `max_error`, within a factor of 3 (7 in float64), up to angular sizes of about 1 radian and is useless close to the light. Where
    ``auto`` changes from one to the other the values differ by two or three times `max_error`. What is left: points nearly in the light's
    plane and close to its border, and slivers that span most of a half circle; ``auto`` has the error of ``edge`` there, up to
    all digits of a small result.

    Limits: a vertex at `x` contributes nothing with its two edges; an edge through `x`, and coincident vertices, contribute
    nothing. A polygon whose plane contains `x` has solid angle 0 if `x` is outside; inside, coefficients of degree 1 and more have one
    limit from both sides, and ``L_00`` is that of either side; on the outline ``L_00`` lies in between. ``quadrature`` gives 0 there.
    Finite input never gives NaN; a coordinate that is infinite or NaN makes all coefficients of its lane NaN.

    Differentiable in forward and reverse mode. Up to order 32 derivatives are analytic and those of ``edge``, whatever the method; see
    :py:func:`mi_shlight.project_polygon_gradient` for their accuracy. Derivatives with respect to `x`, and of a light that moves as a
    whole, add up those of the vertices: relative error eps / theta, and 1 in float32 for a light 1e6 sizes away.

    Each number of vertices, and each `max_error`, compiles a kernel of its own.

    Evaluate wide results together, ``dr.eval(coeffs)``: reading one coefficient after the other would compute each anew.
    """
    name = "project_polygon"
    n = check_order(name, order)
    check_choice(name, "method", method, METHODS)
    light, x, apex = polygon_arguments(name, vertices, x)
    coeffs = project_light(light, x, apex, n, method, error_argument(name, max_error, x))
    finite = all_finite(*light.vertices, x)
    coeffs = [dr.select(finite, c, float("nan")) for c in coeffs]
    if dr.is_jit_v(x) and dr.width(coeffs) == 1 and not dr.flag(dr.JitFlag.SymbolicScope):
        dr.schedule(coeffs)                           # reading them one by one would launch one kernel each
    return coeffs


def project_light(light, x, apex, order: int, method: str = "auto", max_error=None) -> list:
    """:py:func:`project_polygon` of a light given as edges and strips, without checks of its numbers: for callers inside loops.

    `light`: :py:class:`~mi_shlight.light.polygon.EdgeBuffer` or ``VertexList``; `apex`: unit vector from `x` into the light.
    """
    if light.grad_enabled() or dr.grad_enabled(x):
        values = project_light(light.detached(), dr.detach(x), apex, order, method, max_error)
        return [dr.replace_grad(v, s) for v, s in zip(values, boundary_form("auto", order)[0](light, x, apex, order))]
    max_error = default_error(x) if max_error is None else max_error
    if method == "quadrature":
        return project_quadrature(light, x, order, max_error)
    boundary = boundary_form(method, order)[0]
    if method != "auto":
        return boundary(light, x, apex, order)
    cubature = prefers_cubature(light, x, order, max_error)
    parts = boundary(light, x, apex, order, cubature ^ True), project_quadrature(light, x, order, max_error, cubature)
    return [a + b for a, b in zip(*parts)]


def light_shader(transfer: list, order: int, method: str = "auto", max_error=None):
    """Function ``shade(light, x, apex)`` that gives ``sum_lm T_lm L_lm`` of one light ([W18] eq. 4).

    What depends on the transfer alone is done here, once for all lights. Derivatives by the light's vertices and `x` are those of the edge
    form (of the recurrence above order 32), whatever the method of the value.
    """
    value, fixed = _value_shader(transfer, order, method, max_error), dr.detach(transfer)

    def shade(light, x, apex):
        if not (light.grad_enabled() or dr.grad_enabled(x)):
            return value(light, x, apex)
        slope = boundary_form("auto", order)[1](fixed, order)(light, x, apex)
        return value(light.detached(), dr.detach(x), apex) + dr.replace_grad(type(slope)(0), slope)

    return shade


def _value_shader(transfer: list, order: int, method: str, max_error):
    max_error = default_error(transfer[0]) if max_error is None else max_error
    cubature = quadrature_shader(transfer, order, max_error)
    if method == "quadrature":
        return lambda light, x, apex: cubature(light, x)
    boundary = boundary_form(method, order)[1](transfer, order)
    if method != "auto":
        return boundary

    def shade(light, x, apex):
        few = prefers_cubature(light, x, order, max_error)
        return boundary(light, x, apex, few ^ True) + cubature(light, x, few)

    return shade


def boundary_form(method: str, order: int) -> tuple:
    """(projection, shader) of the closed form that `method` stands for, or falls back to."""
    # at the highest orders the edge form takes minutes to compile: order 32 8 s, 64 150 s; the recurrence 3 s and 45 s
    if method == "recurrence" or method == "auto" and order > 32:
        return project_recurrence, recurrence_shader
    return project_edge, edge_form_shader


def prefers_cubature(light, x, order: int, max_error: float):
    """Mask: where method ``auto`` takes the cubature in place of the edge form.

    The edge form errs by about eps times perimeter over solid angle (measured: 0.2 to 2 of that; 0.2 to 0.7 for distant lights). It is
    left where 0.4 of that exceeds `max_error`, unless the light is too close for cubature, and where cubature costs less. Carries no
    derivatives.
    """
    need = demand(light, x, order, max_error)
    inexact = 0.4 * dr.epsilon(x) * need.perimeter > max_error * need.solid_angle
    number = type(x[0])
    edge, strip, point = (float(np.interp(order, list(COSTS), costs)) for costs in zip(*COSTS.values()))
    cheap = strip * number(light.strip_count()) + point * number(need.points) < edge * number(light.edge_count())
    return need.possible & (inexact | need.enough & cheap)


def default_error(value) -> float:
    """The entry of MAX_ERROR for the precision of `value`; Python floats are double."""
    return MAX_ERROR[0 if dr.is_array_v(value) and dr.epsilon(value) > 1e-10 else 1]
