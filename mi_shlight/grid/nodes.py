"""Sums over facets at the points of a grid, and the interpolation between them."""
from __future__ import annotations

import functools
import operator
import sys

import drjit as dr

from ..arrays import array3
from ..errors import message
from ..light.facets import FacetTable
from ..light.gradient import project_light_spatial
from ..light.project import project_light
from .cells import CORNERS, Cells, corner_weights
from .split import NearLists

PART = 36
"""Numbers of a row that one kernel copies: all at once would compile for half a minute."""

PACKET = 16
"""Numbers that are read together: twice as fast as one by one."""

MAX_NUMBERS = 1 << 28
"""A gigabyte in float32, and several while it is filled."""


class NodeTable:
    """The engine of :py:class:`mi_shlight.LightGrid`: no checks, any number of groups of lights, which stay apart.

    At each point of the grid it holds, for each coefficient and channel, value and gradient of the sum over a group's facets, without those
    that are near to all cells around the point. A cell with near facets has corners of its own, without these. So nothing large is ever
    added and taken away again: a light that touches a point of the grid is near to all cells around it.

    Parameters
    ----------
    cells : Cells
    table : FacetTable
        Placed, with its radiance. Its derivatives are kept.
    near : NearLists
        Of these cells and facets; which groups there are, too.
    order, method : int, str
        As in :py:func:`mi_shlight.project_polygon`.
    interpolation : str
        One of ``INTERPOLATIONS``.
    """

    def __init__(self, cells: Cells, table: FacetTable, near: NearLists, order: int, interpolation: str, method: str):
        self.cells, self.table, self.near, self.order, self._interpolation = cells, table, near, order, interpolation
        # Near facets are not as small as to need the cubature, and those far off matter together. Its mere presence doubles the time.
        self.method = "edge" if method == "auto" else method
        self._groups, self._entries = near.group_count, (order + 1) ** 2 * 4 * table.channels
        self._stride = -(-self._entries // PACKET) * PACKET
        numbers = near.row_count(cells) * self._stride
        if numbers > MAX_NUMBERS:
            raise ValueError(message("light grid", "resolution", f"leave at most {MAX_NUMBERS} numbers to hold", cells.resolution,
                                     f"There are {numbers} at order {order}. Choose a coarser grid (grid_resolution in shprt) or a lower "
                                     "order."))
        index = self._index = type(table.first_edge)
        self._packet = _array_type(type(table.positions))
        self._points, self._cells_end = dr.opaque(index, cells.point_count), dr.opaque(index, cells.cell_count)
        self._own = None if near.flags is None else dr.zeros(index, (cells.cell_count + 1) * self._groups)
        self._rows = self._sums()
        dr.eval(self._rows, self._own)

    def _sums(self):
        """Rows of values, x, y, and z derivatives by channel for each coefficient, flat. First those of the grid's points, one group after
        the other, then of the corners of cells with near facets, which `_own` numbers from 1, 0 for cells without.
        """
        index, cells, number = self._index, self.cells, type(self.table.positions)
        shared = dr.arange(index, cells.point_count * self._groups)
        point, cell, group = shared % self._points, dr.zeros(index, dr.width(shared)) + self._cells_end, shared // self._points
        if self._own is not None:
            lists = self.near.crowded
            dr.scatter(self._own, dr.arange(index, dr.width(lists)) + 1, lists)
            corner = dr.arange(index, dr.width(lists) * CORNERS)
            own = dr.gather(index, lists, corner // CORNERS)
            cell, group = dr.concat([cell, own // self._groups]), dr.concat([group, own % self._groups])
            point = dr.concat([point, cells.corner_point(own // self._groups, corner % CORNERS)])
        total = self._sums_at(point, *self.near.range(cell, group)) + [dr.zeros(number)] * (self._stride - self._entries)
        rows, first_own = dr.opaque(index, dr.width(point)), dr.opaque(index, dr.width(shared))
        whole = point + group * self._points                    # the row with all facets of the group
        dr.eval(whole)
        columns = dr.concat([_column(total[k:k + PART], dr.width(point)) for k in range(0, self._stride, PART)])
        entry = dr.arange(index, dr.width(point) * self._stride)
        row, column = entry // self._stride, entry % self._stride * rows
        near = dr.gather(number, columns, column + row, row >= first_own)
        return dr.gather(number, columns, column + dr.gather(index, whole, row)) - near

    def _sums_at(self, point, first, last) -> list:
        """Sums over the facets ``first .. last - 1`` of the near lists, as far as they are kept at each `point`: the numbers of a row."""
        facets = self.near.facets
        dr.eval(point, first, last, facets)
        table, x, number = self.table, self.cells.point(point), type(self.table.positions)
        facet = lambda i: dr.gather(self._index, facets, i)
        kept = self._kept(point)

        def following(i, last):
            """The next facet to add: lanes without one run ahead before the body, which costs much more, is entered."""
            def searching(i, last):
                k = facet(dr.minimum(i, last - 1))
                return (i < last) & ~(kept(k) & table.faces(k, x))

            return dr.while_loop((i, last), searching, lambda i, last: (i + 1, last), mode="symbolic")[0]

        def body(i, last, total):
            k = facet(i)
            coeffs, slopes = project_light_spatial(table.edges(k, x, True), x, table.apex(k, x), self.order, self.method)
            numbers = [c for values in zip(coeffs, *slopes) for c in values]
            radiance = table.radiance(k)
            total = [dr.fma(r, v, t) for t, (v, r) in zip(total, ((v, r) for v in numbers for r in radiance))]
            return following(i + 1, last), last, total

        state = following(first, last), last, [number(0) for _ in range(self._entries)]
        total = dr.while_loop(state, lambda i, last, _: i < last, body, mode="symbolic", max_iterations=-1)[2]
        dr.eval(total)
        return total

    def _kept(self, point):
        """Function of a facet's number: mask of the points at which it is added, those with a cell around that it is not near to."""
        flags, facets = self.near.flags, self.table.count
        if flags is None:
            return lambda k: True
        around = [self.cells.adjacent_cell(point, corner) for corner in range(CORNERS)]
        far = lambda cell, exists, k: exists & ~dr.gather(type(flags), flags, cell * facets + k, exists)
        return lambda k: functools.reduce(operator.or_, (far(*cell, k) for cell in around))

    def eval(self, x, group=0, active=True) -> list:
        """Coefficients at `x`: list of colours, lists of one float for each channel."""
        count, channels = (self.order + 1) ** 2, self.table.channels
        cell, t = self.cells.locate(x)

        def body(total, base, weights, inside):
            row = self._row(base, inside)
            for i in range(count * channels):
                parts = row[i // channels * 4 * channels + i % channels::channels][:4]
                total[i] = functools.reduce(lambda sum, part: dr.fma(*part, sum), zip(weights, parts), total[i])
            return total

        total = self._fold_corners(cell, t, group, active, body, count * channels)

        def add(k, total, x):
            coeffs = project_light(self.table.edges(k, x, active), x, self.table.apex(k, x), self.order, self.method)
            radiance = self.table.radiance(k)
            return [dr.fma(radiance[i % channels], coeffs[i // channels], t) for i, t in enumerate(total)]

        near = self._fold_near(cell, group, active, add, count * channels, x)
        total = [a + b for a, b in zip(total, near)]
        return [total[i * channels:(i + 1) * channels] for i in range(count)]

    def shade(self, x, transfer: list, shade, group=0, active=True, others: tuple = ()) -> list:
        """``sum_lm T_lm L_lm`` at `x`, by channel; near facets by ``shade(light, x, apex, *others)``, as from
        :py:func:`mi_shlight.light.project.light_shader`. `others`: what else it needs and may carry derivatives.
        """
        channels = self.table.channels
        cell, t = self.cells.locate(x)

        def body(total, base, weights, inside, *transfer):
            sums = [type(self._rows)(0) for _ in range(4 * channels)]
            for i, value in enumerate(self._row(base, inside)):
                sums[i % len(sums)] = dr.fma(transfer[i // len(sums)], value, sums[i % len(sums)])
            return [functools.reduce(lambda sum, j: dr.fma(weights[j], sums[j * channels + c], sum), range(4), total[c])
                    for c in range(channels)]

        total = self._fold_corners(cell, t, group, active, body, channels, *transfer)

        def add(k, total, x, *others):
            value = shade(self.table.edges(k, x, active), x, self.table.apex(k, x), *others)
            return [dr.fma(r, value, t) for r, t in zip(self.table.radiance(k), total)]

        near = self._fold_near(cell, group, active, add, channels, x, *others)
        return [a + b for a, b in zip(total, near)]

    def _row(self, base, active) -> list:
        """The numbers of the row that starts at `base`."""
        packets = (dr.gather(self._packet, self._rows, base // PACKET + k, active, shape=(PACKET, dr.width(base)))
                   for k in range(self._stride // PACKET))
        return [value for packet in packets for value in packet][:self._entries]

    def _fold_near(self, cell, group, active, body, width: int, *others) -> list:
        """``total = body(k, total, *others)`` over the facets k that are near to the cell, from `width` zeros."""
        first, last = self.near.range(cell, group)
        last = dr.select(active, last, first)

        def step(i, last, total, *others):
            return i + 1, last, body(dr.gather(self._index, self.near.facets, i), total, *others), *others

        state = first, last, [type(self._rows)(0) for _ in range(width)], *others
        return dr.while_loop(state, lambda i, last, *_: i < last, step, mode="symbolic", max_iterations=-1)[2]

    def _fold_corners(self, cell, t, group, active, body, width: int, *others) -> list:
        """``total = body(total, offset of the row, weights, inside, *others)`` over the corners of the cell, from `width` zeros."""
        index, cells, number = self._index, self.cells, type(self._rows)
        inside = active & (cell < self._cells_end)
        own = 0 if self._own is None else dr.gather(index, self._own, cell * self._groups + group, inside)

        def step(k, total, cell, own, group, inside, t, others):
            row = group * self._points + cells.corner_point(cell, k)
            row = dr.select(own > 0, self._points * self._groups + (own - 1) * CORNERS + k, row)
            weights = corner_weights(self._interpolation, t, cells.size)(k)
            return k + 1, body(total, row * self._stride, weights, inside, *others), cell, own, group, inside, t, others

        state = (index(0), [number(0) for _ in range(width)], cell, index(own), index(group), inside, t, others)
        end = dr.select(inside, index(CORNERS), 0)
        return dr.while_loop(state, lambda k, *_: k < end, step, mode="symbolic", max_iterations=-1)[1]


def _column(values: list, width: int):
    column = dr.concat([value + dr.zeros(type(value), width) for value in values])
    dr.eval(column)
    return column


def _array_type(number):
    """Dr.Jit's array of any number of floats."""
    vector = array3(number)
    return getattr(sys.modules[vector.__module__], vector.__name__.replace("Array3", "ArrayX"))
