"""The light grid over the receivers of a scene."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import array3
from .grid.cells import Cells
from .grid.choose import cheapest_grid, grids
from .grid.nodes import NodeTable
from .grid.split import NearLists

SAMPLES = 4096
"""Points of the receivers, by area, at which the resolution ``auto`` looks how many facets are near."""

PADDING = 1e-3
"""Share of the receivers' diagonal by which the grid is larger: rounding leaves no hit outside, and a floor alone fills a box."""


class SceneGrid:
    """Where the grid stands, and what is near to its cells; what is at its points is made anew for each picture.

    Parameters
    ----------
    receivers : list of Receiver
        The grid fills their bounding box.
    groups : sequence of int
        Light group g has the facets ``groups[g] .. groups[g + 1] - 1``.
    resolution : int or str
        Grid points along each axis, or ``"auto"``: what costs least for the first picture, and for others of its size.
    interpolation : str
    max_error : float
        Near and far are told apart by it; 0: everything is far.
    order, method : int, str
    estimate : bool
        Estimate the error by interpolation, too, for :py:meth:`error`.
    """

    DRJIT_STRUCT = dict.fromkeys(("_lower", "_upper", "_samples", "_cells", "_near", "_error"), object)

    def __init__(self, receivers: list, groups, resolution, interpolation: str, max_error: float, order: int, method: str,
                 estimate: bool = False):
        boxes = [r.shape.bbox() for r in receivers if not r.black]
        lower, upper = (np.array([np.ravel(getattr(box, end)) for box in boxes] or [[0, 0, 0]], float) for end in ("min", "max"))
        lower, upper = lower.min(axis=0), upper.max(axis=0)
        padding = PADDING * max(np.linalg.norm(upper - lower), 1e-30)
        self._lower, self._upper = (array3(mi.Float)(corner.tolist()) for corner in (lower - padding, upper + padding))
        dr.make_opaque(self._lower, self._upper)
        self._samples = _samples([r.shape for r in receivers if not r.black]) if resolution == "auto" else None
        self._groups, self._resolution, self._interpolation = list(groups), resolution, interpolation
        self._max_error, self._order, self._method = max_error, order, method
        self._cells = None if resolution == "auto" else Cells(self._lower, self._upper, resolution)
        self._near = self._points = self._error = None
        self._estimate = estimate

    def prepare(self, facets, points: int) -> None:
        """Find out which facets are near to which cells, for a picture of so many points. `facets`: placed, with their radiance.

        If that has derivatives, dark facets count as lit, too.
        """
        if self._resolution == "auto" and points != self._points:
            self._cells, self._near = cheapest_grid(facets, self._groups, self._lower, self._upper, self._order, points, self._samples,
                                                    self._max_error)
            self._points = points
        elif self._cells is not None:
            self._near = NearLists(self._cells, facets, self._groups, self._max_error or None)
        if self._estimate and self._cells is not None:
            self._error = self._near.far_error(self._cells, facets)

    def error(self, x):
        """Estimated error by interpolation at points `x`, in radiance of a white surface; for the lights that were prepared."""
        if self._cells is None:
            return mi.Float(0)
        return dr.gather(mi.Float, self._error, self._cells.locate(array3(mi.Float)(x))[0])

    def sizes(self, facets):
        """``(cells, near, facets near to a point in the mean)`` of the grids that ``auto`` chooses from, finer and finer."""
        for cells, near in grids(facets, self._groups, self._lower, self._upper, self._order, self._max_error):
            yield cells, near, near.mean_length(cells, self._samples)

    @property
    def prepared(self) -> bool:
        """True once :py:meth:`prepare` was called."""
        return self._near is not None or self._points is not None

    def nodes(self, facets) -> NodeTable | None:
        """The table of the grid's points, with the derivatives of the facets; None where exact evaluation of all facets costs less."""
        if self._cells is None:
            return None
        return NodeTable(self._cells, facets, self._near, self._order, self._interpolation, self._method)


def _samples(shapes: list):
    """Points of the shapes, uniform by area, the same for each call; of those that are no meshes, points of their bounding boxes."""
    boxes = [(np.ravel(box.min), np.ravel(box.max)) for box in (shape.bbox() for shape in shapes)]
    area = np.array([np.ravel(shape.surface_area())[0] if shape.is_mesh() else np.sum(np.square(high - low))
                     for shape, (low, high) in zip(shapes, boxes)])
    counts = np.ceil(SAMPLES * area / max(area.sum(), 1e-30)).astype(int)
    points = [np.zeros((3, 1))]                       # for a scene in which nothing is lit
    for shape, (low, high), count in zip(shapes, boxes, counts):
        random = mi.PCG32(size=int(count))
        if shape.is_mesh():
            found = shape.sample_position(0, mi.Point2f(random.next_float32(), random.next_float32())).p
        else:
            share = mi.Point3f(random.next_float32(), random.next_float32(), random.next_float32())
            found = mi.Point3f(*low.tolist()) + share * mi.Vector3f(*(high - low).tolist())
        points.append(np.array(found + dr.zeros(mi.Point3f, int(count))))
    return array3(mi.Float)(np.concatenate(points, axis=1))
