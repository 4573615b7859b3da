"""Trees of bounding spheres over light polygons: which of them lie near a direction, without a look at all of them.

One binary tree per light group, all cut from one heap: node i has the children 2 i and 2 i + 1, and the leaves, all at one depth, hold
a polygon each or none. A walk needs no stack: the bits of one integer, the *trail*, tell at which levels the sibling is still to be
seen. Who shares a node with whom is decided once; the spheres follow lights that move.
"""
from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene import aligned

EMPTY = 2 ** 32 - 1

ROUNDING = 1 + 1e-4
"""Factor on the radii: rounding must not let a direction miss a sphere and meet its polygon."""


class LightTrees:
    """Trees over the polygons of all light groups; :py:meth:`refitted` ones have spheres, too."""

    DRJIT_STRUCT = dict.fromkeys(("leaves", "roots", "polygons", "spheres", "_levels"), object)

    def __init__(self, centres: np.ndarray, bounds):
        """`centres` (P, 3) of all polygons; group g holds the polygons ``bounds[g] .. bounds[g + 1] - 1``."""
        groups = len(bounds) - 1
        depth = _depth(max(np.diff(bounds)))
        table = np.full((2 ** _depth(groups), 2 ** depth), EMPTY)
        for g in range(groups):
            order, slots = _leaf_slots(centres[bounds[g]:bounds[g + 1]], depth)
            table[g, slots] = order + bounds[g]
        self.polygons = aligned(mi.UInt32, table.ravel())
        self.leaves, self.roots = mi.UInt32(table.size), mi.UInt32(len(table))
        dr.make_opaque(self.leaves, self.roots)
        self._levels = [dr.arange(mi.UInt32, table.size >> k, table.size >> k << 1) for k in range(depth + 1)]
        dr.eval(self._levels)
        self.spheres = None

    def refitted(self, edges, first_edge) -> "LightTrees":
        """A copy with spheres around polygons given by both ends of all edges (flat x, y, z) and the number of each one's first edge."""
        spheres = dr.zeros(mi.Float, 8 * len(self.polygons))
        for level, node in enumerate(self._levels):
            if level == 0:
                sphere = _around_polygon(edges, first_edge, *self.polygon(node))
            else:
                sphere = _around_both(dr.gather(mi.Vector4f, spheres, 2 * node), dr.gather(mi.Vector4f, spheres, 2 * node + 1))
            dr.scatter(spheres, sphere, node)
            dr.eval(spheres)
        trees = copy.copy(self)
        trees.spheres = spheres
        return trees

    def polygon(self, leaf, active=True) -> tuple:
        """(number, True) of the polygon in a leaf; (any, False) if it has none or `active` is false."""
        active = active & (leaf >= self.leaves)
        polygon = dr.gather(mi.UInt32, self.polygons, leaf - self.leaves, active)
        return polygon, active & (polygon != EMPTY)

    def bound(self, node, x, n, d):
        """Lower bound of the squared chord between `d` and the directions from `x` to what is in a node, above the horizon of `n`."""
        return _chord2_to_sphere(dr.gather(mi.Vector4f, self.spheres, node), x, n, d)

    def next_leaf(self, node, trail, x, n, d, near) -> tuple:
        """(node, trail) of the next leaf that may hold something above the horizon as near to the direction `d` as the squared
        chord `near`, or on `d` itself; nearer ones first. Start at a root with an empty trail; node 0 is the end.
        """
        def body(node, trail, x, n, d, near):
            left, right = self.bound(2 * node, x, n, d), self.bound(2 * node + 1, x, n, d)
            down = worth(dr.minimum(left, right), near)
            both = worth(dr.maximum(left, right), near)
            up, above = self.climb(node, trail)
            child = 2 * node + dr.select(right < left, mi.UInt32(1), 0)
            return (dr.select(down, child, up), dr.select(down, 2 * trail + dr.select(both, mi.UInt32(1), 0), above), x, n, d, near)

        inner = lambda node, *_: (node > 0) & (node < self.leaves)
        return dr.while_loop((node, trail, x, n, d, near), inner, body, mode="symbolic")[:2]

    @staticmethod
    def climb(node, trail) -> tuple:
        """(node, trail) of the next sibling that the trail has left behind; node 0 if there is none."""
        steps = dr.minimum(dr.tzcnt(trail), 31)
        more = trail > 0
        return dr.select(more, (node >> steps) ^ 1, 0), dr.select(more, (trail >> steps) ^ 1, 0)


def worth(bound, near):
    """Whether to look at what is at least the squared chord `bound` away when the nearest found so far is `near` away.

    Everything that may lie on the direction itself is: one may hide another.
    """
    return (bound < near) | (bound == 0)


def _chord2_to_sphere(sphere, x, n, d):
    """Lower bound of the squared chord between the unit vector `d` and the directions from `x` to what is inside a sphere; infinite
    if the sphere is empty or below the horizon of `n`.
    """
    v, r = sphere.xyz - x, sphere.w
    squared = dr.squared_norm(v)
    tangent = dr.safe_sqrt(squared - r * r)
    across, along = dr.norm(dr.cross(d, v)), dr.dot(d, v)
    # sine and cosine, times |v|^2, of the angle between d and the cone about the sphere
    sin, cos = across * tangent - along * r, along * tangent + across * r
    outside = (squared > r * r) & (sin > 0)
    bound = dr.select(outside, 2 * sin * sin / dr.maximum(squared * (squared + cos), dr.smallest(mi.Float)), 0)
    return dr.select((r >= 0) & (dr.dot(n, v) + r > 0), bound, dr.inf)


def _depth(leaves: int) -> int:
    """Depth of the smallest complete binary tree with so many leaves."""
    return int(leaves - 1).bit_length()


def _leaf_slots(centres: np.ndarray, depth: int) -> tuple:
    """Halve points (P, 3) `depth` times across the longest side of their bounding box: (order, slots), so that leaf ``slots[i]`` of
    ``2**depth`` holds point ``order[i]``.
    """
    order, slots = np.arange(len(centres)), np.zeros(len(centres), np.int64)
    for _ in range(depth):
        points = centres[order]
        present, first, size = np.unique(slots, return_index=True, return_counts=True)
        extent = np.maximum.reduceat(points, first) - np.minimum.reduceat(points, first)
        owner = np.repeat(np.arange(len(present)), size)
        along = points[np.arange(len(points)), extent.argmax(axis=1)[owner]]
        order = order[np.lexsort((along, slots))]
        rank = np.arange(len(order)) - first[owner]
        slots = 2 * slots + (2 * rank >= size[owner])
    return order, slots


def _around_polygon(edges, first_edge, polygon, some):
    """Sphere around the corners of a polygon; radius -1 if there is none."""
    first, last = (dr.gather(mi.UInt32, first_edge, polygon + k, some) for k in (0, 1))
    corner = lambda e: dr.gather(mi.Vector3f, edges, 2 * e)
    inf = mi.Vector3f(dr.inf)

    def grow(e, low, high, last):
        return e + 1, dr.minimum(low, corner(e)), dr.maximum(high, corner(e)), last

    _, low, high, _ = dr.while_loop((first, inf, -inf, last), lambda e, low, high, last: e < last, grow, mode="symbolic")
    centre = (low + high) / 2

    def reach(e, radius2, centre, last):
        return e + 1, dr.maximum(radius2, dr.squared_norm(corner(e) - centre)), centre, last

    radius2 = dr.while_loop((first, mi.Float(0), centre, last), lambda e, radius2, centre, last: e < last, reach, mode="symbolic")[1]
    return mi.Vector4f(*dr.select(some, centre, 0), dr.select(some, dr.sqrt(radius2) * ROUNDING, -1))


def _around_both(a, b):
    """Smallest sphere around two; one of negative radius is empty."""
    apart = b.xyz - a.xyz
    distance = dr.norm(apart)
    radius = (a.w + b.w + distance) / 2
    between = a.xyz + apart * ((radius - a.w) / dr.select(distance > 0, distance, 1))
    both = mi.Vector4f(*between, radius * ROUNDING)
    a_is_all, b_is_all = (b.w < 0) | (distance + b.w <= a.w), (a.w < 0) | (distance + a.w <= b.w)
    return dr.select(a_is_all, a, dr.select(b_is_all, b, both))
