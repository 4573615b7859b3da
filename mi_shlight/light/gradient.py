"""Coefficients together with their analytic derivatives: by every vertex of the light, or by the shading point."""
from __future__ import annotations

import drjit as dr

from ..errors import check_choice
from ..sh.basis import check_order
from .arguments import SCALE, all_finite, polygon_arguments
from .edge_frame import project_edge_lines, project_edge_spatial
from .project import METHODS, boundary_form, default_error, prefers_cubature
from .quadrature import project_quadrature, project_quadrature_lines, project_quadrature_spatial
from .recurrence import project_recurrence, project_recurrence_lines, project_recurrence_spatial


def project_polygon_gradient(vertices, x, order: int, method: str = "auto") -> tuple:
    """Project a uniform polygonal light to spherical harmonics, with the derivatives of all coefficients by all of its vertices.

    ``dL_lm / dp_i = - sum_e n_e int w_i Y_lm d omega`` over the two edges that meet in vertex i, w_i the share of a point of the edge in
    the vertex over its distance: Reynolds' theorem, as [W20] eq. 18 has it for the shading point.

    Parameters
    ----------
    vertices, x, order, method
        As in :py:func:`mi_shlight.project_polygon`. The line integrals are in closed form in the edge's own frame (``"edge"``,
        ``"auto"``), by the recurrences of [W20] (``"recurrence"``), or by nodes along the edges (``"quadrature"``).

    Returns
    -------
    coeffs : list of (order + 1)**2 floats in steradians
        As from :py:func:`mi_shlight.project_polygon`.
    gradients : list of N lists of (order + 1)**2 3-vectors, in steradians per unit of length
        ``gradients[i][k]`` is the derivative of ``coeffs[k]`` with respect to vertex i, a plain Dr.Jit ``Array3f``. That with respect to
        `x` is minus the sum over i; :py:func:`project_polygon_spatial_gradient` gives it without the cancellation in that sum.

    Raises
    ------
    TypeError, ValueError
        As :py:func:`mi_shlight.project_polygon`.

    Notes
    -----
    Nothing cancels: relative L2 error over all vertices and coefficients of each of the 62 reference polygons, order 14, at any distance,
    angle and width of the light, at most 2e-6 in float32 and 5e-15 in float64 by ``edge``, ``auto`` and ``quadrature``. ``recurrence``:
    8e-6 and 2e-14, for lights at 10 to 1e4 of their sizes up to 2e-5 and 3e-11.

    Limits: derivatives grow without bound as `x` comes near the border, or the light near `x`; beyond 1e30 (1e300 in float64) per unit
    of length they stay finite, but may be too small, and below 1e-30 they lose digits. A vertex at `x`, an edge
    through `x`, and coincident vertices get 0 from the edges concerned. Finite input never gives NaN; a coordinate that is infinite or
    NaN makes its lane NaN. Carries no derivatives itself.

    Time to compile: 1 s at order 8, 2 s at 14, 10 s at 20 (float64: twice that). The result grows with vertices times coefficients. For a
    sum ``sum_lm T_lm L_lm`` alone use :py:func:`mi_shlight.shade_polygon_gradient`, for reverse mode :py:func:`mi_shlight.shade_polygon`.
    """
    n, light, x, apex = _arguments("project_polygon_gradient", vertices, x, order, method)
    light, x = light.detached(), dr.detach(x)
    max_error = default_error(x)
    if method == "quadrature":
        coeffs, rows = project_quadrature(light, x, n, max_error), project_quadrature_lines(light, x, apex, n, max_error)
    else:
        recurrence = boundary_form(method, n)[0] is project_recurrence
        coeffs, rows = (project_recurrence_lines if recurrence else project_edge_lines)(light, x, apex, n)
    if method == "auto":
        few = prefers_cubature(light, x, n, max_error)
        coeffs = [dr.select(few, near, far) for near, far in zip(project_quadrature(light, x, n, max_error, few), coeffs)]
    finite, count = all_finite(*light.vertices, x), len(coeffs)
    normals = [dr.select(finite, type(x)(*row[2 * count:]) * SCALE, dr.nan) for row in rows]
    gradients = [[dr.fma(normals[e], row[k], normals[e - 1] * rows[e - 1][count + k]) for k in range(count)] for e, row in enumerate(rows)]
    coeffs = [dr.select(finite, c, dr.nan) for c in coeffs]
    if not dr.flag(dr.JitFlag.SymbolicScope):
        for part in (coeffs, *gradients):             # kernels with fewer results compile in a fraction of the time
            dr.eval(part)
    return coeffs, gradients


def project_polygon_spatial_gradient(vertices, x, order: int, method: str = "auto") -> tuple:
    """Project a uniform polygonal light to spherical harmonics, with the derivatives of all coefficients by the shading point.

    [W20] Algorithm 2, in one pass over the edges.

    Parameters
    ----------
    vertices, x, order, method
        As in :py:func:`mi_shlight.project_polygon`. ``"auto"`` decides between ``"edge"`` and ``"quadrature"`` at each point as there.

    Returns
    -------
    coeffs : list of (order + 1)**2 floats in steradians
        As from :py:func:`mi_shlight.project_polygon`.
    gradient : list of (order + 1)**2 3-vectors, in steradians per unit of length
        Derivative of each with respect to `x`; of a light that moves with all its vertices it is the negative.

    Raises
    ------
    TypeError, ValueError
        As :py:func:`mi_shlight.project_polygon`.

    Notes
    -----
    Relative L2 error of ``auto`` for each of the 62 reference polygons, order 14: at most 9e-6 in float32 and 2e-10 in float64. The closed
    forms ``edge`` and ``recurrence`` sum terms of size theta to a result of size theta^2 for a light of angular size theta, as they do for
    the coefficients: 1e-6 in float32 for lights of moderate size, 1e-4 at 100 sizes, useless at 1e5. ``quadrature`` integrates the
    derivative over the light's area and keeps its digits there, but is useless close to the light.

    Limits as for :py:func:`project_polygon_gradient`. Evaluate wide results together, ``dr.eval(coeffs, gradient)``.

    Differentiable in forward and reverse mode with respect to `vertices` and `x`, coefficients as well as gradient. Up to order 32 these
    derivatives are analytic and those of ``edge``, whatever the method; above, by autodiff through the recurrences. Relative L2 error of
    what one vertex of a reference polygon does, order 4, at any distance and angle: at most 8e-7 in float32 and 6e-15 in float64. Where
    all vertices move together, or `x`, the sum leaves a relative error of eps / theta: 1e-4 in float32 at 100 sizes. A vertex, or the line
    of an edge, nearer to `x` than 1e-15 (1e-150 in float64) counts as at that distance. They take 2 s to compile at order 8, 9 s at 14,
    25 s at 20, and many minutes above 32.
    """
    n, light, x, apex = _arguments("project_polygon_spatial_gradient", vertices, x, order, method)
    coeffs, parts = project_light_spatial(light, x, apex, n, method)
    finite = all_finite(*light.vertices, x)
    gradient = [dr.select(finite, type(x)(*values) * SCALE, dr.nan) for values in zip(*parts)]
    coeffs = [dr.select(finite, c, dr.nan) for c in coeffs]
    if dr.is_jit_v(x) and dr.width(coeffs, gradient) == 1 and not dr.flag(dr.JitFlag.SymbolicScope):
        dr.schedule(coeffs, gradient)                 # reading them one by one would launch one kernel each
    return coeffs, gradient


def project_light_spatial(light, x, apex, order: int, method: str = "auto", max_error=None, active=True) -> tuple:
    """``(coeffs, (dx, dy, dz))``: :py:func:`project_polygon_spatial_gradient` of a light given as edges and strips, without checks of its
    numbers: for callers inside loops. 0 where not `active`. Derivatives by the light's vertices and `x` are those of the edge form (of the
    recurrence above order 32), whatever the method of the value.

    `light`: :py:class:`~mi_shlight.light.polygon.EdgeBuffer` or ``VertexList``; `apex`: unit vector from `x` into the light.
    """
    if light.grad_enabled() or dr.grad_enabled(x):
        values = project_light_spatial(light.detached(), dr.detach(x), apex, order, method, max_error, active)
        return dr.replace_grad(values, _boundary_spatial("auto", order)(light, x, apex, order, active))
    max_error = default_error(x) if max_error is None else max_error
    if method == "quadrature":
        return project_quadrature_spatial(light, x, order, max_error, active)
    boundary = _boundary_spatial(method, order)
    if method != "auto":
        return boundary(light, x, apex, order, active)
    few = prefers_cubature(light, x, order, max_error)
    coeffs, parts = boundary(light, x, apex, order, active & (few ^ True))
    more, slopes = project_quadrature_spatial(light, x, order, max_error, active & few)
    return [a + b for a, b in zip(coeffs, more)], tuple([a + b for a, b in zip(*pair)] for pair in zip(parts, slopes))


def _boundary_spatial(method: str, order: int):
    return project_recurrence_spatial if boundary_form(method, order)[0] is project_recurrence else project_edge_spatial


def _arguments(function: str, vertices, x, order, method) -> tuple:
    order = check_order(function, order)
    check_choice(function, "method", method, METHODS)
    light, x, apex = polygon_arguments(function, vertices, x)
    return order, light, x, apex
