"""Diffuse shadowed transfer at a point, for lights that stand inside the scene.

The papers' visibility is a property of the receiver alone, "does a ray leave the scene". In a closed room every ray hits a
wall; what is meant is whether anything lies between the point and the light. So a light's own shape never occludes it, and a
hit counts only if it is nearer than the light in that direction.

Directions that miss every light are free: the light there is zero, but they enter the projection to spherical harmonics. Their
visibility is taken from the nearest direction that does hit a light (for a light grown by a margin within which it may move).
So the visibility is constant wherever a point sees all of its lights, or none: there the transfer is exact up to the band limit
of the cosine, with no ringing from walls, from the ceiling behind a light or from distant silhouettes; only the silhouettes
that cross the light itself remain. The part of a light below the receiver's horizon is left to the clamped cosine: a point
whose lights are all below its horizon gets a zero transfer.
"""
from __future__ import annotations

import copy
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..light.polygon import direction
from ..scene import aligned, shape_index
from ..sh.basis import sh_basis
from .cosine import cosine_transfer
from .light_tree import LightTrees, worth

GOLDEN = (math.sqrt(5) - 1) / 2

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


def shadowed_transfer(occluders, lights, group, p, n, order: int, samples: int, offset, active=True) -> tuple:
    """SH coefficients of ``V(p, omega) max(0, n . omega) / pi`` towards the lights of one group.

    Cosine-distributed Fibonacci directions, shifted by `offset`; the mean visibility times the analytic cosine serves as a
    control variate, so points that see all or nothing of their lights carry no sampling error.

    Parameters
    ----------
    occluders : Occluders
        What can block the light.
    lights : BakeLights
        Light polygons and the margin they may move in.
    group : (UInt32, UInt32)
        First light of the group and one past its last.
    p, n : mi.Point3f, mi.Normal3f
        Points and unit normals; rays start at a small offset along `n`.
    samples : int
        Number of directions per point.
    offset : mi.Point2f
        Shift of the direction set, in [0, 1)^2.

    Returns
    -------
    (list of (order + 1)**2 floats, visibility, conflict): the coefficients in 1/sr; the cosine-weighted mean of V in [0, 1];
    and the cosine-weighted part of the hemisphere, in [0, 1], in which two lights of the group stand behind each other with an
    occluder between, which one V cannot represent.
    """
    frame = mi.Frame3f(n)
    origin = _lifted(p, n)
    count = (order + 1) ** 2

    stride = neighbour_stride(samples)                # what one direction has met bounds the search of the next

    def body(s, i, visible, conflict, weighted, plain, met, origin, offset):
        u = (mi.Float(i) + offset.x) / samples
        angle = 2 * dr.pi * (mi.Float(i) * GOLDEN + offset.y - dr.floor(mi.Float(i) * GOLDEN))
        radius = dr.sqrt(u)
        sin, cos = dr.sincos(angle)
        d = frame.to_world(mi.Vector3f(radius * cos, radius * sin, dr.sqrt(dr.maximum(1 - u, 0))))
        target, distance, farther, any_above, met = lights.nearest(group, origin, n, d, met)
        blocked = ~any_above | occluders.blocked(group, origin, target, distance, active & any_above)
        hidden = mi.Bool(False)
        if lights.crowded:
            behind = active & ~blocked & (farther > distance * (1 + 1e-3))
            hidden = behind & occluders.blocked(group, origin, target, farther, behind)
        v = dr.select(blocked, mi.Float(0), 1)
        basis = sh_basis(d, order)
        weighted = [dr.fma(v, y, w) for y, w in zip(basis, weighted)]
        plain = [y + w for y, w in zip(basis, plain)]
        following = i + stride
        return (s + 1, dr.select(following < samples, following, following - samples), visible + v,
                conflict + dr.select(hidden, mi.Float(1), 0), weighted, plain, met, origin, offset)

    zeros = lambda: [mi.Float(0) for _ in range(count)]
    last = dr.select(active, mi.UInt32(samples), 0)
    start = (mi.UInt32(0), mi.UInt32(0), mi.Float(0), mi.Float(0), zeros(), zeros(), mi.Vector3f(dr.inf), origin, offset)
    _, _, visible, conflict, weighted, plain, *_ = dr.while_loop(start, lambda s, *_: s < last, body, mode="symbolic")
    mean = visible / samples
    exact = cosine_transfer(n, order)
    coeffs = [dr.fma(mean, e - b / samples, w / samples) for e, b, w in zip(exact, plain, weighted)]
    return [dr.select(visible > 0, c, 0) for c in coeffs], mean, conflict / samples


def inside_a_body(scene, p, n, samples: int = 32):
    """True for points from which every direction of the hemisphere about `n` ends on the back of a surface: inside a solid
    body.

    Only such points are certain never to be seen from outside; `p`, `n` as in :py:func:`shadowed_transfer`.
    """
    frame, origin = mi.Frame3f(n), _lifted(p, n)

    def body(s, inside, origin):
        u = (mi.Float(s) + 0.5) / samples
        sin, cos = dr.sincos(2 * dr.pi * GOLDEN * mi.Float(s))
        d = frame.to_world(mi.Vector3f(dr.sqrt(u) * cos, dr.sqrt(u) * sin, dr.sqrt(1 - u)))
        si = scene.ray_intersect(mi.Ray3f(origin, d), mi.RayFlags.Minimal, coherent=False, active=inside)
        return s + 1, inside & si.is_valid() & (dr.dot(si.n, d) > 0), origin

    state = (mi.UInt32(0), mi.Bool(True), origin)
    return dr.while_loop(state, lambda s, inside, origin: inside & (s < samples), body, mode="symbolic")[1]


def neighbour_stride(samples: int) -> int:
    """Step through `samples` Fibonacci directions in which each is close to the one before, and which meets them all: a Fibonacci
    number near the root of `samples` that has no divisor in common with it.
    """
    a, b = 1, 2
    while b * b < samples or math.gcd(b, samples) > 1:
        a, b = b, a + b
    return b % samples


class BakeLights:
    """Light polygons as the bake sees them: both sides, positions fixed, grown by `margin` (scene units)."""

    DRJIT_STRUCT = dict.fromkeys(("edges", "first_edge", "normal", "trees", "_group"), object)

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
        trees = LightTrees(np.array([outline.mean(axis=(0, 1)) for outline in outlines]), first[groups])
        self.trees = trees.refitted(self.edges, self.first_edge)

    def at(self, edges, normal) -> "BakeLights":
        """The same lights elsewhere: flat buffers of both ends of each edge, and of the normals."""
        lights = copy.copy(self)
        lights.edges, lights.normal = edges, normal
        lights.trees = self.trees.refitted(edges, self.first_edge)
        return lights

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

        def edge_body(e, inside, near, near_q, near_edge, x, n, d, hit):
            v_i, v_j = self._vertex(e, 0) - x, self._vertex(e, 1) - x
            # even-odd rule in the light's plane
            y_i, y_j = dr.dot(v_i - hit, across), dr.dot(v_j - hit, across)
            x_i, x_j = dr.dot(v_i - hit, along), dr.dot(v_j - hit, along)
            crosses = (y_i > 0) != (y_j > 0)
            right = x_i - y_i * (x_j - x_i) / dr.select(crosses, y_j - y_i, 1) > 0
            inside = inside ^ (crosses & right)
            above, v_i, v_j = _clip_to_horizon(v_i, v_j, n)
            q, chord2 = _nearest_on_arc(v_i, v_j, d)
            closer = above & (chord2 < near)
            return (e + 1, inside, dr.select(closer, chord2, near), dr.select(closer, q, near_q), dr.select(closer, e, near_edge), x, n,
                    d, hit)

        start = (first, mi.Bool(False), mi.Float(dr.inf), mi.Vector3f(d), mi.UInt32(0), x, n, d, hit)
        _, inside, chord2, q, edge, *_ = dr.while_loop(start, lambda e, *_: e < last, edge_body, mode="symbolic")
        inside &= hits_plane
        return inside, dr.select(inside, through, dr.inf), dr.select(inside, 0, chord2), dr.select(inside, d, q), edge

    def _vertex(self, edge, end: int):
        return dr.gather(mi.Point3f, self.edges, 2 * edge + end)


def _distance_to_plane(normal, height, d):
    """Distance along `d` to the plane ``normal . v = height``; infinite if it lies behind."""
    slope = dr.dot(normal, d)
    return dr.select(height * slope > 0, height / dr.select(slope != 0, slope, 1), dr.inf)


def _lifted(p, n):
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
