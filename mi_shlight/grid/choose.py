"""The resolution that costs least: more grid points leave fewer facets near to a cell."""
from __future__ import annotations

import drjit as dr
import numpy as np

from .cells import CORNERS, Cells
from .nodes import MAX_NUMBERS, PACKET
from .split import MAX_PAIRS, NearLists

RESOLUTIONS = (4, 6, 8, 12, 16, 24, 32)

COSTS = {4: (12.5, 8, 23, 0.11), 8: (17, 11, 70, 0.12), 14: (31, 26, 220, 0.15)}
"""Nanoseconds, by order, for an edge of a facet at a point without a grid, for one that is near to the point's cell, for one at a point of
the grid (with the gradient, three channels), and for each number read from the grid. Measured with hundreds of triangles turned every way,
method ``auto``, one thread; their ratios decide."""


def cheapest_grid(table, groups: list, lower, upper, order: int, points: int, samples, max_error: float):
    """``(cells, near)``: grid from `lower` to `upper` and its near lists, for shading `points` points that lie as the `samples` do;
    (None, None) if exact evaluation of all facets costs less.

    `groups`, `max_error`: see :py:class:`mi_shlight.grid.split.NearLists`.
    """
    best, least = (None, None), exact_cost(table, order) * points
    for cells, near in grids(table, groups, lower, upper, order, max_error):
        cost = grid_cost(table, groups, cells, near, near.mean_length(cells, samples), order, points)
        if cost < least:
            best, least = (cells, near), cost
        elif best[0] is not None or cells.point_count * dr.width(table.start) * _costs(order)[2] > least:
            break                                     # finer ones only cost more
    return best


def grids(table, groups: list, lower, upper, order: int, max_error: float):
    """``(cells, near)`` of finer and finer grids, as far as they can be held."""
    for resolution in RESOLUTIONS:
        cells = Cells(lower, upper, resolution)
        if cells.cell_count * table.count > MAX_PAIRS:
            return
        near = NearLists(cells, table, groups, max_error)
        if near.row_count(cells) * (4 * (order + 1) ** 2 * table.channels + PACKET) > MAX_NUMBERS:
            return
        yield cells, near


def exact_cost(table, order: int) -> float:
    """Nanoseconds that shading one point by all facets takes."""
    return dr.width(table.start) * _costs(order)[0]


def grid_cost(table, groups: list, cells, near, near_mean: float, order: int, points: int) -> float:
    """Nanoseconds that a picture of so many points takes by the grid, of which `near_mean` facets are near to a point."""
    _, near_edge, node, gather = _costs(order)
    read = gather * CORNERS * 4 * (order + 1) ** 2 * table.channels * (len(groups) - 1)
    per_facet = dr.width(table.start) / table.count
    return (cells.point_count * table.count + CORNERS * near.count) * per_facet * node + points * (read + near_mean * per_facet * near_edge)


def _costs(order: int) -> list:
    """Those of COSTS at any order: powers of it in between and beyond."""
    return [np.exp(np.polyval(np.polyfit(np.log(np.add(list(COSTS), 1)), np.log(costs), 1), np.log(order + 1)))
            for costs in zip(*COSTS.values())]
