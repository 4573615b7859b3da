"""Which facets are too near to a cell of the grid to be interpolated there.

A facet seen from the distance d is a smooth function of the place with features of size d, the smaller the higher the order, so
interpolation over a cell of size h errs by a part ``(h / d)^4`` of it. In a cell that the plane of the facet cuts there is a kink
instead, where the facet turns its back, of size h / d. Facets with too large an error are left to the point itself.
"""
from __future__ import annotations

import functools
import math

import drjit as dr
import numpy as np

from ..arrays import array3
from ..errors import message
from ..light.polygon import direction
from .cells import CORNERS

SMOOTH, KINK = 0.06, 0.02
"""Root mean square error over a cell of what a facet shades, diffuse transfer, as a part of its solid angle times ``(h / d)^4``, or times
h / d in a cell cut by its plane. Measured at order 8 over cells and 60 random facets: medians of the first 0.02 to 0.07, 90 % below
0.11, less where d < 2 h (0.1 to 0.5 with white noise of 0.03 in all coefficients of the transfer); of the second 0.001 to 0.005, but 0.02
if the plane is that of the cell's face, as of a lamp in a ceiling."""

TOUCHING = 1.2
"""Facets nearer to the middle of a cell than this many times its corners are always near."""

MAX_PAIRS = 1 << 27
"""Largest number of cells times facets: a gigabyte or two for a moment."""


class NearLists:
    """Near facets of each cell, by group. Without derivatives.

    Parameters
    ----------
    cells : Cells
    table : FacetTable
        Placed, with its radiance.
    groups : list of int
        Group g holds the facets ``groups[g] .. groups[g + 1] - 1``.
    max_error : float or None
        Largest error by interpolation of a cell's light, as a part of what its middle sends to a diffuse white surface that faces it; None:
        no facet is near.

    Attributes
    ----------
    bounds, facets
        List ``cell * group_count + group`` holds ``facets[bounds[list]] .. facets[bounds[list + 1] - 1]``. Cell number ``cell_count``
        stands for all points outside of the grid, and gets every facet.
    count : int
        Entries of `facets` that belong to cells of the grid.
    flags
        Mask for each (cell, facet), flat: near. None if there are none.
    crowded
        Numbers of the lists that are not empty.
    """

    DRJIT_STRUCT = dict.fromkeys(("bounds", "facets", "flags", "crowded"), object)

    def __init__(self, cells, table, groups: list, max_error):
        index, facets, count = type(table.first_edge), table.count, cells.cell_count
        if max_error is not None:
            _check_pairs(cells, facets)
        self.group_count = len(groups) - 1
        group_of = index(np.repeat(np.arange(self.group_count), np.diff(groups)).tolist())
        self.facets, cell = dr.arange(index, facets), dr.full(index, count, facets)
        self.flags, self.crowded, self.count = None, None, 0
        if max_error is not None:
            flags = _near(cells, table, max_error)
            dr.eval(flags)
            near = dr.compress(flags)
            self.count = dr.width(near)
            if self.count:
                self.flags = flags
                self.facets, cell = dr.concat([near % facets, self.facets]), dr.concat([near // facets, cell])
        sizes = dr.zeros(index, (count + 1) * self.group_count)
        dr.scatter_add(sizes, index(1), cell * self.group_count + dr.gather(index, group_of, self.facets))
        self.bounds = dr.concat([index(0), dr.cumsum(sizes)])
        if self.count:
            self.crowded = dr.compress((sizes > 0) & (dr.arange(index, dr.width(sizes)) < count * self.group_count))
        dr.eval(self.bounds, self.facets)

    def row_count(self, cells) -> int:
        """Rows of numbers that a grid holds: for its points by group, and for the corners of cells with near facets."""
        return cells.point_count * self.group_count + (0 if self.flags is None else CORNERS * dr.width(self.crowded))

    def mean_length(self, cells, x) -> float:
        """Mean number of near facets, of all groups, at points `x`."""
        cell = cells.locate(x)[0]
        return dr.mean(type(x[0])(self.range(cell, self.group_count - 1)[1] - self.range(cell, 0)[0]))[0]

    def far_error(self, cells, table):
        """Estimated error of what is interpolated, of all groups together, in each cell: of the radiance that a diffuse white surface
        sends, root mean square over the cell, ``hermite``. 0 in the last entry, which stands for all points outside.
        """
        _check_pairs(cells, table.count)
        error, _, _, seen = _estimates(cells, table)
        error = dr.minimum(error, seen / dr.pi)       # what touches a cell errs by all of it at most
        if self.flags is not None:
            error = dr.select(self.flags, 0, error)
        total = dr.concat([dr.block_sum(error, table.count), dr.zeros(type(error), 1)])
        dr.eval(total)
        return total

    def range(self, cell, group) -> tuple:
        """Bounds in `facets` of the list of a cell and group."""
        return tuple(dr.gather(type(self.bounds), self.bounds, cell * self.group_count + group + k) for k in (0, 1))


def _check_pairs(cells, facets: int) -> None:
    if cells.cell_count * facets > MAX_PAIRS:
        raise ValueError(message("light grid", "resolution", f"leave at most {MAX_PAIRS} pairs of cells and polygons", cells.resolution,
                                 f"With {facets} polygons there are {cells.cell_count * facets}. Choose a coarser grid."))


def _estimates(cells, table) -> tuple:
    """For each (cell, facet), flat: error by interpolation; what the middle of the cell gets, if it faces the facet; mask of the facets
    that touch the cell; and the most that a point there gets.
    """
    index, facets = type(table.first_edge), table.count
    measure = _measure(table)
    i = dr.arange(index, cells.cell_count * facets)
    k, cell = i % facets, i // facets
    read = lambda values: dr.gather(type(values), values, k)
    centre, u, v, n, half, area, power = map(read, measure)
    offset = cells.centre(cell) - centre
    extent = dr.dot(abs(n), cells.size) * 0.5                   # half of the cell's extent along the normal
    height = dr.dot(offset, n)
    beside = [dr.maximum(abs(dr.dot(offset, axis)) - h, 0) for axis, h in ((u, half[0]), (v, half[1]))]
    distance = dr.sqrt(beside[0] * beside[0] + beside[1] * beside[1] + height * height)
    size, reach = dr.max(cells.size), TOUCHING * 0.5 * dr.norm(cells.size)
    touching = distance < reach
    ratio = size / dr.maximum(distance, reach)
    seen = power * dr.minimum(area / dr.square(dr.maximum(distance, reach)), 2 * dr.pi)
    smooth = SMOOTH * dr.minimum((height + extent) / distance, 1) * dr.square(dr.square(ratio))
    kink = dr.select(abs(height) < extent * (1 + 1e-3), KINK * extent / size * ratio, 0)
    lights = (height + extent * (1 + 1e-3) > 0) & (power > 0)
    error = dr.select(lights, seen * (smooth + kink), 0)
    light = dr.select(touching, seen, seen * dr.clip(height / distance, 0, 1))
    touching &= lights
    dr.eval(error, light, touching, seen)
    return error, light, touching, seen


def _near(cells, table, max_error: float):
    """Mask for each (cell, facet), flat."""
    error, light, touching, _ = _estimates(cells, table)
    index, facets = type(table.first_edge), table.count
    cell, error = dr.arange(index, cells.cell_count * facets) // facets, dr.select(touching, 0, error)
    dr.eval(cell, error)
    allowed = max_error / dr.pi * dr.block_sum(light, facets)
    limit = dr.full(type(light), dr.inf, cells.cell_count)
    for step in range(math.ceil(math.log2(facets)) + 1):        # errors add up: those of the pieces of a light have the same sign
        within = dr.select(error <= dr.gather(type(limit), limit, cell), error, 0)
        limit = dr.select(dr.block_sum(within, facets) <= allowed, limit, allowed * 2.0 ** -step)
        dr.eval(limit)
    return touching | (error > dr.gather(type(limit), limit, cell))


def _measure(table) -> tuple:
    """Of each facet: centre, two axes and the normal of a box around it, half its sides, its area, and its largest radiance."""
    number, index = type(table.positions), type(table.first_edge)
    vector = array3(number)
    k = dr.arange(index, table.count)
    n, centroid = table.vector(table.normal, k), table.vector(table.centroid, k)
    a, b = (table.corner(ends, table.edge_range(k)[0]) for ends in (table.start, table.end))
    u = direction(b - a)
    u = dr.select(dr.squared_norm(u) > 0, u, direction(dr.cross(n, vector(n[1], n[2], n[0]))))
    v = dr.cross(n, u)

    def body(a, b, low, high, area, u, v, n, centroid):
        a, b = a - centroid, b - centroid
        place = vector(dr.dot(a, u), dr.dot(a, v), 0)
        return dr.minimum(low, place), dr.maximum(high, place), area - dr.dot(dr.cross(a, b), n) * 0.5, u, v, n, centroid

    state = vector(0), vector(0), number(0), u, v, n, centroid
    low, high, area, *_ = table.fold_edges(k, body, state)
    middle, half = (low + high) * 0.5, (high - low) * 0.5
    power = functools.reduce(dr.maximum, (abs(dr.detach(r)) for r in table.radiance(k)))
    if dr.grad_enabled(table.emitted):                # derivatives by the radiance of a dark light are to be right, too
        mean = dr.mean(power)
        power = dr.maximum(power, dr.select(mean > 0, mean, 1))
    measure = centroid + u * middle[0] + v * middle[1], u, v, n, half, area, power
    dr.eval(measure)
    return measure
