"""Front door of the coefficient engine: checks its arguments and chooses the method."""
from __future__ import annotations

import drjit as dr

from ..arrays import vectors3
from ..errors import check_choice, message
from ..sh.basis import check_order
from .edge_frame import MAX_EDGE_ORDER, edge_form_shader, project_edge
from .polygon import VertexList, interior_direction
from .recurrence import project_recurrence, recurrence_shader

METHODS = ("auto", "recurrence", "edge")
"""Accepted values of `method`; ``auto`` stands for ``recurrence``."""


def check_method(function: str, method: str, order: int) -> None:
    """Raise TypeError/ValueError unless `method` is known and can do `order`."""
    check_choice(function, "method", method, METHODS)
    if method == "edge" and order > MAX_EDGE_ORDER:
        raise ValueError(message(function, "order", f"be at most {MAX_EDGE_ORDER} with method='edge'", order,
                                 "Use method='recurrence' above."))


def project_polygon(vertices, x, order: int, method: str = "auto") -> list:
    """Project a uniform polygonal light of unit radiance, seen from `x`, to spherical harmonics in closed form.

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
        ``"recurrence"``: zonal recurrence of [W18], Algorithm 1. ``"edge"``: closed form in each edge's own frame, up to order 20; about
        twice as fast to run and three times as fast to compile. ``"auto"`` today means ``recurrence``.

    Returns
    -------
    list of (order + 1)**2 floats in steradians, sign and index of :py:func:`mi_shlight.sh_basis`; the float type follows the
    arguments (Dr.Jit backend and precision; Python floats if no Dr.Jit type is given).

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, `vertices` has fewer than three entries, `order` is outside 0..64 (0..20 for ``edge``) or
        `method` is unknown.

    Notes
    -----
    Relative L2 error at order 14 for lights of moderate angular size: below 1e-12 (float64) and 5e-6 (float32). A boundary form
    subtracts edge terms, so the error grows like eps / theta for a light of angular size theta.

    Limits: a vertex at `x` contributes nothing with its two edges; an edge through `x`, and coincident vertices, contribute
    nothing; a polygon whose plane contains `x` has solid angle 0. Finite input never gives NaN.

    Differentiable by Dr.Jit's autodiff; with ``edge`` not where the plane through `x` and an edge is the x-y plane.

    Evaluate wide results together, ``dr.eval(coeffs)``: reading one coefficient after the other would compute each anew.
    """
    name = "project_polygon"
    n = check_order(name, order)
    check_method(name, method, n)
    if not isinstance(vertices, (list, tuple)):
        raise TypeError(message(name, "vertices", "be a list of 3-vectors", vertices, "Example: [mi.Point3f(0, 0, 1), ...]."))
    if len(vertices) < 3:
        raise ValueError(message(name, "vertices", "have at least three entries", vertices, "A polygon has three or more corners."))
    vertices, x = vectors3(name, vertices=list(vertices), x=x)
    vertices, x = [_not_literal(v) for v in vertices], _not_literal(x)
    coeffs = project_edges(VertexList(vertices), x, interior_direction(vertices, x), n, method)
    if dr.is_jit_v(x) and dr.width(coeffs) == 1 and not dr.flag(dr.JitFlag.SymbolicScope):
        dr.schedule(coeffs)                           # reading them one by one would launch one kernel each
    return coeffs


def _not_literal(v):
    """Keep constants out of the kernel's source: otherwise each polygon would compile its own kernel."""
    literal = lambda c: dr.is_jit_v(c) and not dr.grad_enabled(c) and c.state == dr.VarState.Literal
    return type(v)(*(dr.opaque(type(c), c[0]) if literal(c) else c for c in v))


def project_edges(edges, x, apex, order: int, method: str = "auto") -> list:
    """:py:func:`project_polygon` of a light given as edges, without checks: for callers inside loops.

    `edges`: :py:class:`~mi_shlight.light.polygon.EdgeBuffer` or ``VertexList``; `apex`: unit vector from `x` into the light.
    """
    return (project_edge if method == "edge" else project_recurrence)(edges, x, apex, order)


def edge_shader(transfer: list, order: int, method: str = "auto"):
    """Function ``shade(edges, x, apex)`` that gives ``sum_lm T_lm L_lm`` of one light ([W18] eq. 4).

    What depends on the transfer alone is done here, once for all lights.
    """
    return (edge_form_shader if method == "edge" else recurrence_shader)(transfer, order)
