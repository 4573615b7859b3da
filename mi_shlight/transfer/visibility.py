"""What a point sees of lights that stand inside the scene, and of those outside.

The papers' visibility is a property of the receiver alone, "does a ray leave the scene". In a closed room every ray hits a
wall; what is meant is whether anything lies between the point and the light. So a light's own shape never occludes it, and a
hit counts only if it is nearer than the light in that direction.

Directions that miss every light are free: the light there is zero, but they enter the spherical harmonics. Their visibility is
taken from the nearest direction that does hit a light (for a light grown by a margin within which it may move). So the
visibility is constant wherever a point sees all of its lights, or none: only the silhouettes that cross the light itself remain,
and not those of walls, of the ceiling behind a light or of distant objects. The part of a light below the receiver's horizon is left
to the clamped cosine: a point whose lights are all below its horizon gets a zero transfer.

Rays start at a small offset along the normal and both sides of a surface block them. So neither the surface itself nor one
that lies in the same plane darkens a point, and a sheet casts the same shadow from either side.
"""
from __future__ import annotations

import copy
import math
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..light.polygon import direction
from ..scene import aligned, shape_index
from .light_tree import LightTrees, worth

GOLDEN = (math.sqrt(5) - 1) / 2
"""Fractional parts of its multiples are spread evenly."""

MAX_GROUPS = 4
"""Up to this many lights each has its own visibility; more lights share one."""


def light_groups(count: int) -> list:
    """Bounds of the light groups of `count` lights: group g holds the lights ``bounds[g] .. bounds[g + 1] - 1``."""
    return list(range(count + 1)) if count <= MAX_GROUPS else [0, count]


class Occluders:
    """What can come between a point and a light: every shape of the scene but the lights of the group in question."""

    DRJIT_STRUCT = dict.fromkeys(("_light",), object)

    def __init__(self, scene, lights: list):
        self.scene = scene
        numbers = {shape_index(light.shape): k for k, light in enumerate(lights)}
        self._none = len(lights)
        self._size = 1 + max(numbers, default=0)
        self._light = mi.UInt32([numbers.get(i, self._none) for i in range(self._size)])

    def blocked(self, group, origin, d, distance, active):
        """True where a ray from `origin` meets a shape before `distance`; it passes through the lights of `group`."""
        first, last = group

        def body(going, blocked, o, left):
            ray = mi.Ray3f(o, d)
            ray.maxt = left
            pi = self.scene.ray_intersect_preliminary(ray, coherent=False, active=going)
            hit = going & pi.is_valid()
            number = dr.reinterpret_array(mi.UInt32, pi.shape)
            known = hit & (number < self._size)
            light = dr.select(known, dr.gather(mi.UInt32, self._light, number, known), self._none)
            own = hit & (light >= first) & (light < last)
            step = pi.t + (1 + dr.max(abs(o))) * mi.math.RayEpsilon
            return own & (left > step), blocked | (hit & ~own), dr.select(own, o + d * step, o), left - dr.select(own, step, 0)

        left = dr.minimum(distance * (1 - mi.math.ShadowEpsilon), dr.largest(mi.Float))
        state = (mi.Bool(active), mi.Bool(False), mi.Point3f(origin), left)
        return dr.while_loop(state, lambda going, *_: going, body, mode="symbolic")[1]


class Cone(NamedTuple):
    """Directions, as seen from a point, among which all lights of a group are."""

    axis: object
    angle: object
    """Half-angle; no bound if it is pi / 2 or more."""
    dips: object
    """True where lights are, or may come, below the point's horizon."""


class BakeLights:
    """Light polygons as the bake sees them: both sides, positions fixed, grown by `margin` (scene units)."""

    DRJIT_STRUCT = dict.fromkeys(("edges", "first_edge", "normal", "trees", "_group", "_group_edges"), object)

    def __init__(self, lights: list, margin: float):
        """`lights`: :py:class:`~mi_shlight.scene.PolygonLight` objects."""
        polygons = [light.polygons for light in lights]
        outlines = [outline for faces in polygons for outline, _ in faces]
        self.edges = aligned(mi.Float, np.concatenate([outline.ravel() for outline in outlines]))
        self.first_edge = aligned(mi.UInt32, np.cumsum([0] + [len(outline) for outline in outlines]))
        self.normal = aligned(mi.Float, np.concatenate([normal for faces in polygons for _, normal in faces]))
        self.margin = margin
        self.crowded = len(lights) > MAX_GROUPS
        groups = light_groups(len(lights))
        self._group = aligned(mi.UInt32, np.repeat(np.arange(len(groups) - 1), np.diff(groups)))
        first = np.cumsum([0] + [len(faces) for faces in polygons])
        self._group_edges = aligned(mi.UInt32, np.array(self.first_edge)[first[groups]])
        trees = LightTrees(np.array([outline.mean(axis=(0, 1)) for outline in outlines]), first[groups])
        self.trees = trees.refitted(self.edges, self.first_edge)

    def at(self, edges, normal) -> "BakeLights":
        """The same lights elsewhere: flat buffers of both ends of each edge, and of the normals."""
        lights = copy.copy(self)
        lights.edges, lights.normal = edges, normal
        lights.trees = self.trees.refitted(edges, self.first_edge)
        return lights

    def cone(self, group, x, n, cell) -> Cone:
        """Where the lights of a group are, or may come, as seen from any point within `cell` of `x`; `n` is the normal there.

        Bounds a ball about each corner. Where that gives less than a right angle it bounds what is between them, too.
        """
        number = dr.gather(mi.UInt32, self._group, group[0])
        first, last = (dr.gather(mi.UInt32, self._group_edges, number + k) for k in (0, 1))
        reach = self.margin + cell

        def each(step, *state):
            body = lambda e, *state: (e + 1, *step(mi.Vector3f(self._vertex(e, 0) - x), *state))
            return dr.while_loop((first, *state), lambda e, *_: e < last, body, mode="symbolic")[1:]

        def farthest(axis):
            def step(v, angle, towards):
                omega, distance = direction(v), dr.norm(v)
                ball = dr.asin(dr.select(distance > reach, reach / dr.select(distance > 0, distance, 1), 1))
                apart = 2 * dr.asin(dr.minimum(dr.norm(omega - axis) / 2, 1)) + ball
                return dr.maximum(apart, angle), dr.select(apart > angle, omega, towards)

            start = dr.select(dr.squared_norm(axis) > 0.5, mi.Float(0), math.pi)      # no axis where directions cancel
            return each(step, start, mi.Vector3f(axis))

        add = lambda v, total, height: (total + direction(v), dr.minimum(height, dr.dot(n, v)))
        total, height = each(add, mi.Vector3f(0), mi.Float(dr.inf))
        middle = direction(total)
        angle, one = farthest(middle)
        between = direction(one + farthest(one)[1])
        other = farthest(between)[0]
        return Cone(dr.select(other < angle, between, middle), dr.minimum(other, angle), height < self.margin)

    def nearest(self, group, x, n, d, met) -> tuple:
        """Where to look for visibility in place of direction `d`: (direction, distance to the light there, largest such
        distance, found, met).

        `d` itself where it meets a light of the group or comes as near as the margin; otherwise the nearest direction that
        does. Lights are clipped to the horizon of the normal `n`; `found` is False where nothing of them is left. `met` is the nearest
        direction without the margin; given with the same point's next `d` it saves time if that is close (infinite: nothing known).
        """
        trees = self.trees

        def leaf_body(node, trail, best, best_q, reach, winner, rim, farthest, x, n, d):
            node, trail = trees.next_leaf(node, trail, x, n, d, best)
            polygon, some = trees.polygon(node, worth(trees.bound(node, x, n, d), best))
            inside, through, chord2, q, edge = self._nearest_on_polygon(polygon, some, x, n, d)
            closer = (chord2 < best) | (inside & (best == 0) & (through < reach))
            node, trail = trees.climb(node, trail)
            return (node, trail, dr.select(closer, chord2, best), dr.select(closer, q, best_q), dr.select(closer, through, reach),
                    dr.select(closer, polygon, winner), dr.select(closer, edge, rim),
                    dr.select(inside, dr.maximum(farthest, through), farthest), x, n, d)

        root = trees.roots + dr.gather(mi.UInt32, self._group, group[0])
        near = dr.squared_norm(d - met) * (1 + 1e-3) + 1e-6     # more than rounding
        start = (root, mi.UInt32(0), near, mi.Vector3f(dr.inf), mi.Float(dr.inf), mi.UInt32(0), mi.UInt32(0), mi.Float(0), x, n,
                 mi.Vector3f(d))
        _, _, chord2, q, through, winner, rim, farthest, *_ = dr.while_loop(start, lambda node, *_: node > 0, leaf_body, mode="symbolic")
        found, met = dr.isfinite(q.x), q
        _, v_i, v_j = _clip_to_horizon(self._vertex(rim, 0) - x, self._vertex(rim, 1) - x, n)
        distance = dr.select(dr.isfinite(through), through, _distance_on_edge(v_i, v_j, q))
        if self.margin > 0:
            # Only in front of the light, and only up to its plane: what is behind it does not count.
            normal = dr.gather(mi.Vector3f, self.normal, winner)
            height = dr.dot(normal, self._vertex(dr.gather(mi.UInt32, self.first_edge, winner), 0) - x)
            apart = 2 * dr.asin(dr.minimum(dr.sqrt(chord2) / 2, 1))
            angle = dr.select(height < 0, dr.minimum(dr.atan2(mi.Float(self.margin), distance), apart), 0)
            sin, cos = dr.sincos(angle)
            q = mi.Vector3f(q * cos + direction(d - q * dr.dot(d, q)) * sin)
            distance = dr.select(angle > 0, dr.minimum(distance, _distance_to_plane(normal, height, q)), distance)
        return q, distance, farthest, found, met

    def _nearest_on_polygon(self, polygon, active, x, n, d) -> tuple:
        """(d meets the polygon, distance to it there or infinite, squared chord from `d` to its nearest direction, that direction, edge
        it is on); an infinite chord if nothing is above the horizon or `active` is false.
        """
        normal = dr.gather(mi.Vector3f, self.normal, polygon, active)
        first, last = (dr.gather(mi.UInt32, self.first_edge, polygon + k, active) for k in (0, 1))
        through = _distance_to_plane(normal, dr.dot(normal, self._vertex(first, 0) - x), d)
        hits_plane = dr.isfinite(through)
        hit = d * dr.select(hits_plane, through, 0)
        axis = dr.select(abs(normal.x) > 0.9, mi.Vector3f(0, 1, 0), mi.Vector3f(1, 0, 0))
        across = dr.cross(normal, axis)
        along = dr.cross(normal, across)

        def crossings(e, inside, x, hit):             # even-odd rule in the light's plane
            v_i, v_j = self._vertex(e, 0) - x - hit, self._vertex(e, 1) - x - hit
            y_i, y_j, x_i, x_j = dr.dot(v_i, across), dr.dot(v_j, across), dr.dot(v_i, along), dr.dot(v_j, along)
            crosses = (y_i > 0) != (y_j > 0)
            right = x_i - y_i * (x_j - x_i) / dr.select(crosses, y_j - y_i, 1) > 0
            return e + 1, inside ^ (crosses & right), x, hit

        inside = dr.while_loop((first, mi.Bool(False), x, hit), lambda e, *_: e < last, crossings, mode="symbolic")[1] & hits_plane

        def arcs(e, near, near_q, near_edge, x, n, d):
            above, v_i, v_j = _clip_to_horizon(self._vertex(e, 0) - x, self._vertex(e, 1) - x, n)
            q, chord2 = _nearest_on_arc(v_i, v_j, d)
            closer = above & (chord2 < near)
            return e + 1, dr.select(closer, chord2, near), dr.select(closer, q, near_q), dr.select(closer, e, near_edge), x, n, d

        start = (dr.select(inside, last, first), dr.select(inside, mi.Float(0), dr.inf), mi.Vector3f(d), mi.UInt32(0), x, n, d)
        _, chord2, q, edge, *_ = dr.while_loop(start, lambda e, *_: e < last, arcs, mode="symbolic")
        return inside, dr.select(inside, through, dr.inf), chord2, q, edge

    def _vertex(self, edge, end: int):
        return dr.gather(mi.Point3f, self.edges, 2 * edge + end)


class LightSight:
    """How a point sees the lights of one group: `group` is (first light, one past the last), as UInt32."""

    def __init__(self, occluders: Occluders, lights: BakeLights, group: tuple):
        self.occluders, self.lights, self.group = occluders, lights, group

    def cone(self, p, n, cell) -> Cone:
        """Where the lights are, or may come, as seen from any point within `cell` of `p`; `n` is the normal there."""
        return self.lights.cone(self.group, p, n, cell)

    def look(self, origin, n, d, met, active) -> tuple:
        """(visible, hidden, met): whether the light in direction `d`, or the one nearest to it, is seen from `origin`; whether another one
        straight behind it is not; and where it was met, for :py:meth:`BakeLights.nearest`.
        """
        target, distance, farther, found, met = self.lights.nearest(self.group, origin, n, d, met)
        visible = active & found & ~self.occluders.blocked(self.group, origin, target, distance, active & found)
        hidden = mi.Bool(False)
        if self.lights.crowded:
            behind = visible & (farther > distance * (1 + 1e-3))
            hidden = behind & self.occluders.blocked(self.group, origin, target, farther, behind)
        return visible, hidden, met


class SkySight:
    """How a point sees what is infinitely far away: all shapes are in its way, lights included."""

    def __init__(self, scene):
        self.scene = scene

    def look(self, origin, n, d, met, active) -> tuple:
        """As :py:meth:`LightSight.look`: whether a ray leaves the scene."""
        return active & ~self.scene.ray_test(mi.Ray3f(origin, d), coherent=False, active=active), mi.Bool(False), met


def inside_a_body(scene, p, n, samples: int = 32):
    """True for points from which every direction of the hemisphere about `n` ends on the back of a surface: inside a solid
    body.

    Only such points are certain never to be seen from outside; `p`, `n`: points and unit normals.
    """
    frame, origin = mi.Frame3f(n), lifted(p, n)

    def body(s, inside, origin):
        u = (mi.Float(s) + 0.5) / samples
        sin, cos = dr.sincos(2 * dr.pi * GOLDEN * mi.Float(s))
        d = frame.to_world(mi.Vector3f(dr.sqrt(u) * cos, dr.sqrt(u) * sin, dr.sqrt(1 - u)))
        si = scene.ray_intersect(mi.Ray3f(origin, d), mi.RayFlags.Minimal, coherent=False, active=inside)
        return s + 1, inside & si.is_valid() & (dr.dot(si.n, d) > 0), origin

    state = (mi.UInt32(0), mi.Bool(True), origin)
    return dr.while_loop(state, lambda s, inside, origin: inside & (s < samples), body, mode="symbolic")[1]


def _distance_to_plane(normal, height, d):
    """Distance along `d` to the plane ``normal . v = height``; infinite if it lies behind."""
    slope = dr.dot(normal, d)
    return dr.select(height * slope > 0, height / dr.select(slope != 0, slope, 1), dr.inf)


def lifted(p, n):
    """Start of rays from a surface point: off the surface along its normal."""
    return p + n * ((1 + dr.max(abs(p))) * mi.math.RayEpsilon)


def _clip_to_horizon(v_i, v_j, n) -> tuple:
    """(anything left, start, end) of the segment `v_i` .. `v_j` above the plane with normal `n` through the origin."""
    h_i, h_j = dr.dot(n, v_i), dr.dot(n, v_j)
    span = dr.select(h_i != h_j, h_i - h_j, 1)
    crossing = v_i + (v_j - v_i) * (h_i / span)
    return (h_i > 0) | (h_j > 0), dr.select(h_i > 0, v_i, crossing), dr.select(h_j > 0, v_j, crossing)


def _nearest_on_arc(v_i, v_j, d) -> tuple:
    """Unit vector on the arc from `v_i` to `v_j` nearest to `d`, and the squared chord between the two."""
    a, b = direction(v_i), direction(v_j)
    normal = direction(dr.cross(a, b))
    q = direction(d - normal * dr.dot(d, normal))
    within = (dr.dot(dr.cross(normal, a), q) > 0) & (dr.dot(dr.cross(b, normal), q) > 0)
    end = dr.select(dr.dot(a, d) > dr.dot(b, d), a, b)
    q = dr.select(within, q, end)
    return q, dr.squared_norm(d - q)


def _distance_on_edge(v_i, v_j, q):
    """Distance to the point of the segment `v_i` .. `v_j` that lies in direction `q`."""
    a, b = dr.norm(dr.cross(v_i, q)), dr.norm(dr.cross(q, v_j))
    t = dr.select(a + b > 0, a / dr.select(a + b > 0, a + b, 1), 0)
    return dr.norm(v_i + t * (v_j - v_i))
