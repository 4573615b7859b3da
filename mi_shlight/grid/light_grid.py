"""The public light grid."""
from __future__ import annotations

import drjit as dr

from ..arrays import array3, vectors3
from ..errors import check_choice, check_integer, check_number, message
from ..light.arguments import SCALE, all_finite, float_list
from ..light.facets import facet_table
from ..light.mesh import _mesh_arguments as mesh_arguments
from ..light.project import METHODS, light_shader
from ..sh.basis import check_order
from .cells import INTERPOLATIONS, MAX_RESOLUTION, Cells
from .nodes import NodeTable
from .split import NearLists


class LightGrid:
    """Many polygonal lights at once: coefficients and their gradients on a grid of points, interpolated in between.

    [W20] Algorithm 1. The time for a point does not depend on the number of lights, except for those near to it: a grid alone blurs what
    lies close to a light or in its plane ([W20] Fig. 12), so with `max_error` each cell knows the faces that it cannot interpolate. They
    are left out of its corners and evaluated exactly.

    Parameters
    ----------
    vertices, faces, radiance
        As in :py:func:`mi_shlight.project_mesh`. A face emits, with uniform radiance, to the points from which its corners run
        counter-clockwise as seen from outside the unit sphere about the point. Faces do not occlude each other.
    lower, upper : 3-vectors
        Corners of the box that the grid fills, in the units of `vertices`.
    resolution : int
        Grid points along each axis, 2 to 256 ([W20]: 8), as far as memory permits: about 64 at order 8 with three channels.
    order : int
        Highest degree, 0 to 64. The grid holds ``4 (order + 1)**2`` numbers for each channel and point, and for the eight corners of each
        cell with near faces.
    interpolation : str
        ``"hermite"`` (default): cubic, of values and gradients, error of fourth order in the size of the cells.
        ``"tricubic"``: [W20] Algorithm 4; the same along the axes, of third order elsewhere. For comparison only:
        ``"trilinear"``; ``"taylor"`` (Annen 2004); ``"inverse_distance"`` ([G03]).
    method : str
        As in :py:func:`mi_shlight.project_polygon`, but ``"auto"`` is ``"edge"``: in float32 a face at 1e4 of its sizes has an
        error of 1e-3.
    max_error : float or None
        Error that interpolation may cause, as a part of what a diffuse white surface sends that faces the light; None: all faces are
        interpolated, as in [W20], and a face that touches a point of the grid spoils the cells around.

    `resolution`, `order`, `interpolation`, `method` and `max_error` are attributes, too.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, shape or range, none of them is a Dr.Jit type (the grid needs a JIT backend), the box is
        empty, or the grid would hold more than 2**28 numbers.
    RuntimeError
        Inside a symbolic loop or call of Dr.Jit.

    Notes
    -----
    A vertex or radiance that is infinite or NaN makes all results NaN, and so does a point in its lane.

    Differentiable with respect to `vertices` and `radiance`, through :py:meth:`eval` and :py:meth:`shade`; they are linear in what the grid
    holds. Which faces are near carries no derivative.

    The estimate of `max_error` is measured for ``hermite`` (validation/grid.py), not a bound. Where faces change from near to far, from one
    cell to the next, values jump by about `max_error`.

    Examples
    --------
    >>> import numpy as np, drjit.llvm as backend
    >>> corners = np.array([[0, 0, 2], [0, 1, 2], [1, 1, 2], [1, 0, 2]], dtype=float)
    >>> grid = LightGrid(corners, [[0, 1, 2], [0, 2, 3]], [1.0, 2.0], backend.Array3f(-1, -1, 0), backend.Array3f(2, 2, 1), resolution=8)
    >>> coeffs = grid.eval(backend.Array3f([0.1, 0.5], 0.2, 0.3))
    """

    def __init__(self, vertices, faces, radiance, lower, upper, resolution: int, order: int = 8, interpolation: str = "hermite", *,
                 method: str = "auto", max_error=None):
        name = "LightGrid"
        self.resolution = check_integer(name, "resolution", resolution, 2, MAX_RESOLUTION, "It is the number of grid points along an axis.")
        self.order = check_order(name, order)
        check_choice(name, "interpolation", interpolation, INTERPOLATIONS)
        check_choice(name, "method", method, METHODS)
        if max_error is not None:
            max_error = check_number(name, "max_error", max_error, 0, 1, "It is a relative error; None interpolates all faces.")
        self.interpolation, self.method, self.max_error = interpolation, method, max_error
        if dr.flag(dr.JitFlag.SymbolicScope):
            raise RuntimeError(f"{name}(): must be made outside of symbolic loops and calls, as it evaluates the grid.")
        lower, upper = vectors3(name, lower=lower, upper=upper)
        positions, faces, radiance, lower = mesh_arguments(name, vertices, faces, radiance, lower)
        if not dr.is_jit_v(lower):
            raise TypeError(message(name, "lower", "be a 3-vector of a JIT backend of Dr.Jit", lower, "For instance drjit.llvm.Array3f."))
        upper = type(lower)(upper) * SCALE
        if dr.width(lower, upper) != 1 or not (dr.all(upper > lower) & all_finite(lower, upper))[0]:
            raise ValueError(message(name, "upper", "be one finite point that lies above 'lower' along each axis", upper / SCALE,
                                     f"'lower' is {lower / SCALE}."))
        self._number = type(positions)
        channels = radiance if isinstance(radiance, list) else [self._number(column) for column in radiance.T]
        emitted = channels[0] if len(channels) == 1 else dr.ravel(array3(self._number)(*channels))
        table = facet_table(self._number, faces).placed(positions, emitted, len(channels))
        self._finite = dr.all(dr.isfinite(positions)) & dr.all(dr.isfinite(emitted), axis=None)
        dr.make_opaque(lower, upper, self._finite)
        cells = Cells(lower, upper, self.resolution)
        near = NearLists(cells, table, [0, len(faces)], max_error)
        self._nodes = NodeTable(cells, table, near, self.order, interpolation, method)

    @property
    def near_faces(self) -> float:
        """Mean number of near faces of a cell: what a point costs besides the interpolation."""
        return self._nodes.near.count / self._nodes.cells.cell_count

    def eval(self, x) -> list:
        """SH coefficients of all lights at `x`.

        Parameters
        ----------
        x : 3-vector
            Points, single or wide. Outside of the box all faces are evaluated exactly.

        Returns
        -------
        list of (order + 1)**2 floats, or of 3-vectors of the three channels, in units of radiance times steradian; sign and index of
        :py:func:`mi_shlight.sh_basis`.

        Raises
        ------
        TypeError
            If `x` is not a 3-vector of the grid's backend and precision.
        """
        x = self._point("LightGrid.eval", x)
        finite = all_finite(x)
        coeffs = [self._colour(c, finite) for c in self._nodes.eval(x)]
        if dr.width(coeffs) == 1:
            dr.schedule(coeffs)
        return coeffs

    def shade(self, x, transfer):
        """``sum_lm T_lm L_lm`` of all lights at `x`: a float, or a 3-vector of the three channels.

        Parameters
        ----------
        x : 3-vector
            As in :py:meth:`eval`.
        transfer : list of (order + 1)**2 floats
            For instance SH coefficients of BRDF, visibility and cosine; units of 1/sr if the result is to be a radiance.

        Raises
        ------
        TypeError, ValueError
            As :py:meth:`eval`; if `transfer` does not have ``(order + 1)**2`` entries.
        """
        name, count = "LightGrid.shade", (self.order + 1) ** 2
        x = self._point(name, x)
        transfer = float_list(name, "transfer", transfer, self._number, count, count, "It has one entry for each l and m up to 'order'.")
        transfer = [self._number(t) for t in transfer]
        shaded = self._nodes.shade(x, transfer, light_shader(transfer, self.order, self._nodes.method))
        return self._colour(shaded, all_finite(x))

    def _point(self, function: str, x):
        x = vectors3(function, x=x)[0]
        kind = array3(self._number)
        if dr.is_jit_v(x) and type(x) is not kind:
            rule = f"be of the backend and precision of the grid, {kind.__module__}.{kind.__name__}"
            raise TypeError(message(function, "x", rule, type(x)))
        return kind(x) * SCALE

    def _colour(self, channels: list, finite):
        channels = [dr.select(finite & self._finite, c, dr.nan) for c in channels]
        return channels[0] if len(channels) == 1 else array3(self._number)(*channels)
