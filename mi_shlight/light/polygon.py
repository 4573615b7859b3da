"""Spherical geometry of a polygon seen from a point, shared by every coefficient method.

All functions take and return Dr.Jit values (or Python floats with ``drjit.scalar`` vectors); types follow the
arguments. Data-dependent trouble has a documented limit and never gives NaN for finite input.
"""
from __future__ import annotations

from typing import NamedTuple

import drjit as dr


class EdgeFrame(NamedTuple):
    """One edge of the polygon as a great-circle arc on the unit sphere about the shading point."""

    omega_i: object
    """Unit vector to the edge's start; 0 if the start is the shading point."""
    omega_j: object
    """Unit vector to the edge's end."""
    cross: object
    """``omega_i x omega_j``."""
    normal: object
    """Unit normal of the arc's plane ([W18] eq. 19, mu_e); 0 for coincident or antipodal ends."""
    sin: object
    cos: object
    """Sine and cosine of the arc."""
    arc: object
    """Length of the arc in radians, 0 to pi; 0 where the normal is."""


def direction(v):
    """Unit vector along `v`; the zero vector for ``v = 0``. Safe for every finite length."""
    v, length = _moderate(v)
    return v / dr.select(length > 0, length, 1)


def edge_frame(v_i, v_j) -> EdgeFrame:
    """Frame of the edge from `v_i` to `v_j` (vertices relative to the shading point).

    The cross product is taken of the unnormalised vectors with compensated products, so that the normal of a short or distant
    edge keeps full relative accuracy; the arc is ``atan2(|cross|, dot)``, where [W18] eq. 20 has an acos that loses half of the
    digits.
    """
    v_i, length_i = _moderate(v_i)
    v_j, length_j = _moderate(v_j)
    safe_i, safe_j = dr.select(length_i > 0, length_i, 1), dr.select(length_j > 0, length_j, 1)
    omega_i, omega_j = v_i / safe_i, v_j / safe_j
    cross = compensated_cross(v_i, v_j) / (safe_i * safe_j)
    sin2 = dr.dot(cross, cross)
    usable = sin2 > _tiny(cross)
    sin = dr.sqrt(dr.select(usable, sin2, 0))
    normal = cross / dr.select(usable, sin, float("inf"))
    cos = dr.dot(omega_i, omega_j)
    arc = dr.select(usable, dr.atan2(sin, cos), 0)
    return EdgeFrame(omega_i, omega_j, cross, normal, sin, cos, arc)


def fan_solid_angle(apex, frame: EdgeFrame):
    """Signed solid angle of the spherical triangle (apex, omega_i, omega_j), in steradians.

    ``2 atan2(a . (b x c), 1 + a.b + b.c + c.a)`` (van Oosterom and Strackee 1983) in place of [W18] eq. 24, whose acos form is
    printed wrongly and is neither signed nor accurate. Summed over the edges of a closed polygon it gives the signed solid
    angle, for non-convex polygons too. Any apex will do in exact arithmetic; one inside the polygon keeps the digits.
    """
    numerator = dr.dot(apex, frame.cross)
    denominator = 1 + dr.dot(apex, frame.omega_i) + frame.cos + dr.dot(frame.omega_j, apex)
    usable = (numerator != 0) | (denominator != 0)
    return dr.select(usable, 2 * dr.atan2(numerator, dr.select(usable, denominator, 1)), 0)


def interior_direction(vertices, x):
    """Direction from `x` to the mean of a list of vertices: an apex for :py:func:`fan_solid_angle`.

    A fan about a vertex would lose digits where the light fills the hemisphere (3.6e-4 in float32 for a square of 1e4 times its
    distance).
    """
    total = vertices[0] - x
    for v in vertices[1:]:
        total = total + (v - x)
    return direction(dr.detach(total))


def compensated_cross(a, b):
    """Cross product with each component ``a_i b_j - a_j b_i`` accurate to two roundings (Kahan's difference of products)."""
    def difference(p, q, r, s):
        rs = r * s
        return dr.fma(p, q, -rs) + dr.fma(-r, s, rs)

    return type(a)(difference(a[1], b[2], a[2], b[1]), difference(a[2], b[0], a[0], b[2]), difference(a[0], b[1], a[1], b[0]))


def legendre_p(z, order: int) -> list:
    """Legendre polynomials ``P_0(z) .. P_order(z)`` by [W18] eq. 11."""
    p = [type(z)(1), z]
    for l in range(2, order + 1):
        p.append(dr.fma((2 * l - 1) / l * z, p[l - 1], -(l - 1) / l * p[l - 2]))
    return p[:order + 1]


class VertexList:
    """Edges of a closed polygon given as a list of vertices: edge i runs from vertex i to i + 1."""

    def __init__(self, vertices: list):
        self.vertices = vertices

    def sum(self, term, x, apex, width: int) -> list:
        """Sum ``term(v_i, v_j, apex) -> list of `width` floats`` over the edges, with ``v = vertex - x``.

        One symbolic loop, so that kernels do not grow with the vertex count. The loop reads the vertices from local memory, or,
        as that carries no derivatives, from a buffer if they have gradients. Only vertices with gradients inside somebody
        else's symbolic loop are unrolled.
        """
        v, number = self.vertices, type(x[0])
        attached = dr.grad_enabled(v)
        if not dr.is_jit_v(x) or attached and dr.flag(dr.JitFlag.SymbolicScope):
            total = [number(0)] * width
            for i in range(len(v)):
                values = term(v[i] - x, v[(i + 1) % len(v)] - x, apex)
                total = [t + value for t, value in zip(total, values)]
            return total
        index = dr.uint32_array_t(number)
        read = self._buffer(type(x), index) if attached else self._local(type(x), index)
        endpoints = lambda e: (read(e), read(dr.select(e + 1 < len(v), e + 1, 0)))
        return _loop_over_edges(index(0), index(len(v)), endpoints, term, x, apex, width)

    def _local(self, kind, index):
        local = dr.alloc_local(kind, len(self.vertices))
        for i, vertex in enumerate(self.vertices):
            local.write(vertex, index(i))
        return local.read

    def _buffer(self, kind, index):
        lanes = max(dr.width(v) for v in self.vertices)
        buffer = kind(*(dr.concat([v[k] + dr.zeros(type(v[k]), lanes) for v in self.vertices]) for k in range(3)))
        lane = dr.arange(index, lanes)
        return lambda i: dr.gather(kind, buffer, i * lanes + lane)


class EdgeBuffer:
    """Directed edges of a light inside flat buffers: polygons with holes, many lights, differentiable vertices.

    ``positions``: flat x, y, z of all vertices; ``start``, ``end``: vertex indices of each edge; the light owns the edges
    ``first .. last - 1`` (may differ between lanes).
    """

    def __init__(self, positions, start, end, first, last):
        self.positions, self.start, self.end, self.first, self.last = positions, start, end, first, last

    def sum(self, term, x, apex, width: int) -> list:
        """As :py:meth:`VertexList.sum`."""
        vertex = lambda table, e: dr.gather(type(x), self.positions, dr.gather(type(self.start), table, e))
        endpoints = lambda e: (vertex(self.start, e), vertex(self.end, e))
        return _loop_over_edges(self.first, self.last, endpoints, term, x, apex, width)


def _loop_over_edges(first, last, endpoints, term, x, apex, width: int) -> list:
    def body(e, total, x, apex):
        p_i, p_j = endpoints(e)
        return e + 1, [t + value for t, value in zip(total, term(p_i - x, p_j - x, apex))], x, apex

    total = [type(x[0])(0) for _ in range(width)]
    return dr.while_loop((first, total, x, apex), lambda e, *_: e < last, body, mode="symbolic", max_iterations=-1)[1]


def _moderate(v):
    """`v`, scaled only where products of its components could overflow or vanish, and its length."""
    largest = dr.maximum(dr.maximum(abs(v[0]), abs(v[1])), abs(v[2]))
    usable = largest > _tiny(v)
    scale = dr.select((largest > 1e-4) & (largest < 1e4), 1, 1 / dr.select(usable, largest, float("inf")))
    v = v * scale
    return v, dr.sqrt(dr.dot(v, v))


def _tiny(v) -> float:
    """Below this a component or a squared sine is treated as zero: near the smallest normal number."""
    number = type(v[0])
    return 1e-300 if number is float or number.__name__ == "Float64" else 1e-37
