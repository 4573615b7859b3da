"""The resolution that costs least: more grid points leave fewer facets near to a cell."""
from __future__ import annotations

import drjit as dr

from .cells import CORNERS, Cells
from .split import MAX_PAIRS, NearLists

RESOLUTIONS = (4, 6, 8, 12, 16, 24, 32)

EXACT, NODE, GATHER = 12.0, 40.0, 0.3
"""Nanoseconds at order 8 for an edge of a facet at a point, for one at a grid point (with the gradient, three channels), and for each
number read from the grid; one thread, float32. Their ratios decide; see validation/grid.py."""


def cheapest_grid(table, groups: list, lower, upper, order: int, points: int, samples, max_error: float):
    """``(cells, near)``: grid from `lower` to `upper` and its near lists, for shading `points` points that lie as the `samples` do;
    (None, None) if exact evaluation of all facets costs less.

    `groups`, `max_error`: see :py:class:`mi_shlight.grid.split.NearLists`.
    """
    facets, edges = table.count, dr.width(table.start)
    by_order = ((order + 1) / 9) ** 2.5
    exact, node = EXACT * by_order, NODE * by_order
    read = GATHER * CORNERS * 4 * (order + 1) ** 2 * table.channels * (len(groups) - 1)
    best, least = (None, None), points * edges * exact
    for resolution in RESOLUTIONS:
        cells = Cells(lower, upper, resolution)
        if cells.cell_count * facets > MAX_PAIRS:
            break
        near = NearLists(cells, table, groups, max_error)
        per_facet = edges / facets
        cost = ((cells.point_count * facets + CORNERS * near.count) * per_facet * node
                + points * (read + near.mean_length(cells, samples) * per_facet * exact))
        if cost < least:
            best, least = (cells, near), cost
        elif best[0] is not None or cells.point_count * edges * node > least:
            break                                     # finer ones only cost more
    return best
