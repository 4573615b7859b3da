"""Many one-sided polygons in flat buffers, for symbolic loops whose kernels do not grow with their number."""
from __future__ import annotations

import dataclasses

import drjit as dr
import numpy as np

from ..arrays import array3
from .polygon import EdgeBuffer, apex_direction, direction, strip_corners, strip_count


@dataclasses.dataclass
class FacetTable:
    """Planar polygons of uniform radiance that emit to one side, and what loops over them read.

    Facet k owns the edges ``first_edge[k] .. first_edge[k + 1] - 1`` and the strips ``first_patch[k] .. first_patch[k + 1] - 1``. It emits
    to the points from which its solid angle is positive.
    """

    positions: object
    """x, y, z of all vertices, flat; may carry derivatives."""
    start: object
    end: object
    """Vertex index of the two ends of each edge."""
    first_edge: object
    patches: object
    """Four vertex indices for each strip, flat; see :py:meth:`mi_shlight.light.polygon.VertexList.fold_patches`."""
    first_patch: object
    one_strip: bool
    """True if no facet has more than one strip."""
    emitted: object = None
    """Radiance of all facets, flat with `channels` numbers each; may carry derivatives."""
    channels: int = 1
    centroid: object = None
    normal: object = None
    """Mean corner and unit normal of each facet, on the side that emits: flat x, y, z without derivatives."""

    @property
    def count(self) -> int:
        return dr.width(self.first_edge) - 1

    def placed(self, positions, emitted=None, channels: int = 1) -> "FacetTable":
        """A copy with the vertices at `positions`, and another radiance."""
        table = dataclasses.replace(self, positions=positions, emitted=emitted, channels=channels)
        table.centroid, table.normal = table._planes()
        return table

    def edges(self, k, x, active) -> EdgeBuffer:
        """Edges and strips of facet `k` for the points that it lights: none where `x` lies behind it or `active` is false."""
        facing = active & self.faces(k, x)

        def owned(table):
            first, last = dr.gather(type(table), table, k), dr.gather(type(table), table, k + 1)
            return first, dr.select(facing, last, first)

        return EdgeBuffer(self.positions, self.start, self.end, *owned(self.first_edge), (self.patches, *owned(self.first_patch)),
                          self.one_strip)

    def faces(self, k, x):
        """Mask: `x` lies on the side to which facet `k` emits."""
        return dr.dot(self.vector(self.normal, k), dr.detach(x) - self.vector(self.centroid, k)) > 0

    def apex(self, k, x):
        """Unit vector from `x` into facet `k`: apex of the solid angle's fan."""
        middle = direction(self.vector(self.centroid, k) - dr.detach(x))
        return apex_direction(middle, self.vector(self.normal, k), -1)

    def radiance(self, k) -> list:
        """Radiance of facet `k`, by channel."""
        return [dr.gather(type(self.emitted), self.emitted, k * self.channels + c) for c in range(self.channels)]

    def vector(self, table, k):
        """Entry `k` of a flat table of 3-vectors."""
        return dr.gather(array3(type(table)), table, k)

    def corner(self, ends, e):
        """Position, without derivatives, of the vertex at one of the `ends` (`start` or `end`) of edge `e`."""
        return self.vector(dr.detach(self.positions), dr.gather(type(ends), ends, e))

    def edge_range(self, k) -> tuple:
        """First edge of facet `k`, and one past its last."""
        return dr.gather(type(self.first_edge), self.first_edge, k), dr.gather(type(self.first_edge), self.first_edge, k + 1)

    def fold_edges(self, k, body, state: tuple) -> tuple:
        """``state = body(a, b, *state)`` over the edges (a, b) of facets `k`. Without derivatives."""
        step = lambda e, last, *state: (e + 1, last, *body(self.corner(self.start, e), self.corner(self.end, e), *state))
        return dr.while_loop((*self.edge_range(k), *state), lambda e, last, *_: e < last, step, mode="symbolic")[2:]

    def _planes(self) -> tuple:
        index, vector = type(self.first_edge), array3(type(self.positions))
        k = dr.arange(index, self.count)
        first, last = self.edge_range(k)
        origin = self.corner(self.start, first)

        def body(a, b, total, area, origin):
            a, b = a - origin, b - origin
            return total + a, area + dr.cross(a, b), origin

        total, area, _ = self.fold_edges(k, body, (vector(0), vector(0), origin))
        planes = dr.ravel(origin + total / type(self.positions)(last - first)), dr.ravel(-direction(area))
        dr.eval(planes)
        return planes


def facet_table(number, faces: list) -> FacetTable:
    """Table of the polygons `faces`, arrays of vertex indices; numbers of the Dr.Jit type `number`. Place it before use."""
    index = dr.uint32_array_t(number)
    table = lambda rows: index([int(i) for i in np.concatenate(rows)])
    offsets = lambda counts: index([0, *np.cumsum(counts).tolist()])
    strips = [[face[i] for s in range(strip_count(len(face))) for i in strip_corners(s, len(face))] for face in faces]
    return FacetTable(None, table(faces), table([np.roll(face, -1) for face in faces]), offsets([len(face) for face in faces]),
                      table(strips), offsets([len(s) // 4 for s in strips]), all(len(s) == 4 for s in strips))
