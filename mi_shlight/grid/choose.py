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
    facets, edges = table.count, dr.width(table.start)
    # powers of the order in between and beyond
    exact, near_edge, node, gather = (np.exp(np.polyval(np.polyfit(np.log(np.add(list(COSTS), 1)), np.log(costs), 1), np.log(order + 1)))
                                      for costs in zip(*COSTS.values()))
    read = gather * CORNERS * 4 * (order + 1) ** 2 * table.channels * (len(groups) - 1)
    best, least = (None, None), points * edges * exact
    for resolution in RESOLUTIONS:
        cells = Cells(lower, upper, resolution)
        if cells.cell_count * facets > MAX_PAIRS:
            break
        near = NearLists(cells, table, groups, max_error)
        if near.row_count(cells) * (4 * (order + 1) ** 2 * table.channels + PACKET) > MAX_NUMBERS:
            break
        per_facet = edges / facets
        cost = ((cells.point_count * facets + CORNERS * near.count) * per_facet * node
                + points * (read + near.mean_length(cells, samples) * per_facet * near_edge))
        if cost < least:
            best, least = (cells, near), cost
        elif best[0] is not None or cells.point_count * edges * node > least:
            break                                     # finer ones only cost more
    return best
