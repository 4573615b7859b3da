"""Shading by one polygon as a differentiable operation: the value by any method, derivatives by the adjoint of the edge form."""
from __future__ import annotations

import functools
import operator

import drjit as dr

from ..errors import check_choice
from ..sh.basis import check_order
from .arguments import SCALE, all_finite, float_list, polygon_arguments
from .edge_frame import shade_edge_lines
from .polygon import VertexList
from .project import METHODS, default_error, light_shader, prefers_cubature, project_light
from .quadrature import quadrature_shader


def shade_polygon(vertices, x, transfer, order: int, method: str = "auto"):
    """Shade by a uniform polygonal light of unit radiance: ``sum_lm T_lm L_lm`` ([W18] eq. 4).

    The dot product of `transfer` with the coefficients of :py:func:`mi_shlight.project_polygon`, which are not formed.

    A Dr.Jit custom operation: nothing but its arguments is kept for derivatives. These are computed when they are asked for, in one pass
    over the edges, each of which turns the transfer into its own frame once and finds in it the derivatives by both of its ends
    (:py:mod:`mi_shlight.light.edge_frame`, equation (3)). May stand in symbolic loops and calls and in ``dr.freeze``.

    Parameters
    ----------
    vertices, x : list of N >= 3 3-vectors, 3-vector
        The light and the shading point, as in :py:func:`mi_shlight.project_polygon`: positive counter-clockwise as seen from outside
        the unit sphere about `x`.
    transfer : list of (order + 1)**2 floats, in 1/sr
        Transfer vector, sign and index of :py:func:`mi_shlight.sh_basis`; Python floats or Dr.Jit floats, wide or single; or a NumPy
        array.
    order : int
        Highest degree, 0 to 64. Derivatives compile for about 1 s at 20, 7 s at 32, minutes at 64.
    method : str
        Of the value: ``"auto"``, ``"edge"``, ``"recurrence"`` or ``"quadrature"``, as in :py:func:`mi_shlight.project_polygon`.

    Returns
    -------
    float
        Radiance for unit radiance of the light; its type follows the vectors.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, `vertices` has fewer than three entries, `order` is out of range, `method` is unknown, or
        `transfer` does not have ``(order + 1)**2`` entries.

    Notes
    -----
    Accuracy of the value and limits for degenerate input: those of :py:func:`mi_shlight.project_polygon`. Derivatives with respect to
    the vertices: as :py:func:`shade_polygon_gradient`; `x`: minus their sum, with a relative error that grows as eps / theta for a light of
    angular size theta; `transfer`: the coefficients by `method`. Forward and reverse mode; not second derivatives.

    Examples
    --------
    >>> import drjit.llvm.ad as backend, drjit as dr
    >>> corner = backend.Array3f(1, 0, 2)
    >>> dr.enable_grad(corner)
    >>> triangle = [corner, backend.Array3f(0, 1, 2), backend.Array3f(-1, -1, 2)]
    >>> dr.backward(shade_polygon(triangle, backend.Array3f(0, 0, 0), [0.28, 0, 0.33, 0], order=1))
    """
    name = "shade_polygon"
    light, x, apex, transfer, order = _arguments(name, vertices, x, transfer, order, method)
    attached = light.grad_enabled() or dr.grad_enabled(x), dr.grad_enabled(transfer)
    vertices = light.vertices
    if dr.flag(dr.JitFlag.SymbolicScope):             # sums over lanes for single inputs are not possible there
        lanes = dr.width(vertices, x, transfer)
        widen = lambda v: v + dr.zeros(type(v), lanes)
        vertices, x, transfer = [widen(v) for v in vertices], widen(x), [widen(t) for t in transfer]
    value = dr.custom(_ShadePolygon, vertices, x, transfer, apex, order, method, attached)
    return dr.select(all_finite(*light.vertices, x), value, dr.nan)


def shade_polygon_gradient(vertices, x, transfer, order: int, method: str = "auto") -> tuple:
    """Value and derivatives of :py:func:`shade_polygon` by all vertices in one pass, without autodiff.

    Parameters
    ----------
    vertices, x, transfer, order, method
        As in :py:func:`shade_polygon`.

    Returns
    -------
    value : float
    gradients : list of N 3-vectors, in radiance per unit of length
        Derivative with respect to each vertex, as plain Dr.Jit ``Array3f``; that with respect to `x` is minus their sum.

    Raises
    ------
    TypeError, ValueError
        As :py:func:`shade_polygon`.

    Notes
    -----
    The derivatives of :py:func:`mi_shlight.project_polygon_gradient` times the transfer, with their accuracy and limits: as far as nothing
    cancels in the sum over lm, relative L2 error 2e-6 in float32 and 5e-15 in float64, order 14. Carries no derivatives itself.
    """
    name = "shade_polygon_gradient"
    light, x, apex, transfer, order = _arguments(name, vertices, x, transfer, order, method)
    light, x, transfer = light.detached(), dr.detach(x), dr.detach(transfer)
    one_pass = method in ("auto", "edge")
    value, gradients = shade_edge_lines(light, x, apex, transfer, order, one_pass)
    if not one_pass:
        value = light_shader(transfer, order, method)(light, x, apex)
    elif method == "auto":
        max_error = default_error(x)
        few = prefers_cubature(light, x, order, max_error)
        value = dr.select(few, quadrature_shader(transfer, order, max_error)(light, x, few), value)
    finite = all_finite(*light.vertices, x)
    return dr.select(finite, value, dr.nan), [dr.select(finite, g * SCALE, dr.nan) for g in gradients]


class _ShadePolygon(dr.CustomOp):
    """``sum_lm T_lm L_lm`` with derivatives by vertices, shading point and transfer."""

    def eval(self, vertices, x, transfer, apex, order, method, attached):
        self.light, self.x, self.transfer, self.apex, self.order, self.method = VertexList(vertices), x, transfer, apex, order, method
        self.moves, self.transfer_changes = attached
        return light_shader(transfer, order, method)(self.light, x, apex)

    def forward(self):
        slope = type(self.x[0])(0)
        if self.transfer_changes:
            by = [type(slope)(t) for t in self.grad_in("transfer")]
            slope = light_shader(by, self.order, self.method)(self.light, self.x, self.apex)
        if self.moves:
            by_x = self.grad_in("x")
            for gradient, by in zip(self._gradients(), self.grad_in("vertices")):
                slope = slope + dr.dot(gradient, by - by_x)
        self.set_grad_out(slope)

    def backward(self):
        weight = self.grad_out()
        weighted = lambda value: dr.select(weight == 0, 0, value * weight)    # lanes that nobody asks for may hold anything
        if self.transfer_changes:
            coeffs = [weighted(c) for c in project_light(self.light, self.x, self.apex, self.order, self.method)]
            _together(coeffs)
            self.set_grad_in("transfer", coeffs)
        if self.moves:
            gradients = [weighted(g) for g in self._gradients()]
            by_x = -functools.reduce(operator.add, gradients)
            _together(gradients, by_x)
            self.set_grad_in("vertices", gradients)
            self.set_grad_in("x", by_x)

    def name(self):
        return "shade_polygon"

    def _gradients(self):
        return shade_edge_lines(self.light, self.x, self.apex, self.transfer, self.order, value=False)[1]


def _together(*values) -> None:
    """Evaluate values in one kernel, where possible: sums over the lanes of single inputs would compute each of them anew."""
    if not dr.flag(dr.JitFlag.SymbolicScope):
        dr.schedule(*values)


def _arguments(function: str, vertices, x, transfer, order, method) -> tuple:
    order = check_order(function, order)
    check_choice(function, "method", method, METHODS)
    light, x, apex = polygon_arguments(function, vertices, x)
    count = (order + 1) ** 2
    transfer = float_list(function, "transfer", transfer, type(x[0]), count, count, "It has one entry for each l and m up to 'order'.")
    return light, x, apex, [type(x[0])(t) for t in transfer], order
