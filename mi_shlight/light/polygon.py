"""Spherical geometry of a polygon seen from a point, shared by every coefficient method.

All functions take and return Dr.Jit values (or Python floats with ``drjit.scalar`` vectors); types follow the
arguments. Data-dependent trouble has a documented limit and never gives NaN for finite input.
"""
from __future__ import annotations

import functools
import math
from typing import NamedTuple

import drjit as dr

from ..arrays import array3


MANY_OUTPUTS = 64
"""Results of all edges together above which edges are computed side by side instead of in a loop."""


class EdgeFrame(NamedTuple):
    """One edge of the polygon as a great-circle arc on the unit sphere about the shading point."""

    omega_i: object
    """Unit vector to the edge's start; 0 if the start is the shading point."""
    omega_j: object
    """Unit vector to the edge's end."""
    normal: object
    """Unit normal of the arc's plane ([W18] eq. 19, mu_e); 0 for coincident or antipodal ends."""
    middle: object
    """Unit vector to the middle of the arc; 0 where the normal is."""
    sin: object
    cos: object
    """Sine and cosine of the arc."""
    sin_half: object
    cos_half: object
    """Sine and cosine of half the arc."""
    arc: object
    """Length of the arc in radians, 0 to pi; 0 where the normal is."""


def direction(v):
    """Unit vector along `v`; the zero vector for ``v = 0``. Safe for every finite length."""
    v, length = scaled(v)
    return v * (1 / length)


def edge_frame(v_i, v_j) -> EdgeFrame:
    """Frame of the edge from `v_i` to `v_j` (vertices relative to the shading point).

    The cross product is taken of the unnormalised vectors with compensated products, so that the normal of a short or distant
    edge keeps full relative accuracy; the arc is ``atan2(|cross|, dot)``, where [W18] eq. 20 has an acos that loses half of the
    digits.
    """
    v_i, length_i = scaled(v_i)
    v_j, length_j = scaled(v_j)
    inverse_i, inverse_j = 1 / length_i, 1 / length_j
    omega_i, omega_j = v_i * inverse_i, v_j * inverse_j
    cross = compensated_cross(v_i, v_j) * (inverse_i * inverse_j)
    sin2 = dr.squared_norm(cross)
    usable = sin2 > _tiny(cross)
    sin = dr.sqrt(dr.select(usable, sin2, 1))
    normal = dr.select(usable, cross * (1 / sin), 0)
    sin = dr.select(usable, sin, 0)
    cos = dr.dot(omega_i, omega_j)
    larger = dr.sqrt(dr.fma(abs(cos), 0.5, 0.5))      # of the half angle's sine and cosine; the other one follows without cancellation
    smaller = 0.5 * sin / larger
    sin_half, cos_half = dr.select(cos > 0, smaller, larger), dr.select(cos > 0, larger, smaller)
    middle = dr.select(usable, dr.fma(omega_i, cos_half, dr.cross(normal, omega_i) * sin_half), 0)
    arc = dr.select(usable, 2 * dr.atan2(sin_half, cos_half), 0)
    return EdgeFrame(omega_i, omega_j, normal, middle, sin, cos, sin_half, cos_half, arc)


def fan_solid_angle(apex, frame: EdgeFrame):
    """Signed solid angle of the spherical triangle (apex, omega_i, omega_j), in steradians.

    ``2 atan2(sin(T/2) a . n, cos(T/2) + a . m)`` with the normal n and the middle m of the edge: van Oosterom and Strackee's formula
    (1983) divided by ``2 cos(T/2)``, which keeps its digits where an edge spans nearly half a circle. [W18] eq. 24 has an acos form that is
    printed wrongly and is neither signed nor accurate. Summed over the edges of a closed polygon it gives the signed solid angle, for
    non-convex polygons too.
    """
    numerator = frame.sin_half * dr.dot(apex, frame.normal)
    denominator = frame.cos_half + dr.dot(apex, frame.middle)
    usable = (numerator != 0) | (denominator != 0)
    return dr.select(usable, 2 * dr.atan2(numerator, dr.select(usable, denominator, 1)), 0)


def interior_direction(vertices, x):
    """Direction from `x` halfway between the mean of a list of vertices and the normal of their plane, on the mean's side.

    An apex for :py:func:`fan_solid_angle`. In exact arithmetic any would do whose opposite is not in the polygon. A vertex loses digits
    where the light fills the hemisphere (3.6e-4 in float32 for a square of 1e4 times its distance), the mean where `x` is close to
    the plane of the light.
    """
    vertices, x = [dr.detach(v) for v in vertices], dr.detach(x)
    count = len(vertices)
    mean = vertices[0] * (1 / count)
    for v in vertices[1:]:
        mean = dr.fma(v, 1 / count, mean)
    a, b, c = vertices[0], vertices[count // 3], vertices[2 * count // 3]
    pairs = exact_difference(a, x), exact_difference(b, a), exact_difference(c, a)
    scale = power_of_two_scale(functools.reduce(dr.maximum, (largest_component(difference) for difference, _ in pairs)))
    corner, side, other = ((difference * scale, error * scale) for difference, error in pairs)
    return apex_direction(direction(mean - x), direction(dr.cross(side[0], other[0])), triple_product(corner, side, other))


def apex_direction(middle, normal, height):
    """Unit vector halfway between the unit vectors `middle` and `normal` of a plane, the latter negated where `height` is negative."""
    return direction(middle + normal * dr.select(height < 0, -1, 1))


def compensated_cross(a, b):
    """Cross product with each component ``a_i b_j - a_j b_i`` accurate to two roundings (Kahan's difference of products)."""
    def difference(p, q, r, s):
        rs = r * s
        return dr.fma(p, q, -rs) + dr.fma(-r, s, rs)

    return type(a)(difference(a[1], b[2], a[2], b[1]), difference(a[2], b[0], a[0], b[2]), difference(a[0], b[1], a[1], b[0]))


def exact_difference(a, b) -> tuple:
    """``a - b`` of two vectors and its rounding error: together exact (Knuth's TwoSum). The error carries no derivatives."""
    difference = a - b
    a, b, d = dr.detach(a), dr.detach(b), dr.detach(difference)
    part = d - a
    return difference, (a - (d - part)) - (b + part)


def triple_product(a: tuple, b: tuple, c: tuple):
    """``a . (b x c)`` of vectors given as (value, error), in doubled precision: full relative accuracy down to a cancellation of 1/eps.

    Products are split by FMA, sums by TwoSum (Ogita, Rump and Oishi 2005). Derivatives are those of the plain formula, which do not cancel.
    """
    plain = dr.dot(a[0], dr.cross(b[0], c[0]))
    (a, da), (b, db), (c, dc) = ([dr.detach(part) for part in pair] for pair in (a, b, c))
    total, error = 0, 0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        p, q = b[i] * c[j], b[j] * c[i]
        n, dn = exact_difference(p, q)                # component k of b x c
        dn = dn + (dr.fma(b[i], c[j], -p) - dr.fma(b[j], c[i], -q))
        dn = dn + dr.fma(b[i], dc[j], dr.fma(db[i], c[j], -dr.fma(b[j], dc[i], db[j] * c[i])))
        product = a[k] * n
        error = error + dr.fma(a[k], n, -product) + dr.fma(a[k], dn, da[k] * n)
        total, lost = exact_difference(product, -total)
        error = error + lost
    return dr.replace_grad(total + error, plain) if dr.grad_enabled(plain) else total + error


def legendre_p(z, order: int) -> list:
    """Legendre polynomials ``P_0(z) .. P_order(z)`` by [W18] eq. 11."""
    p = [type(z)(1), z]
    for l in range(2, order + 1):
        p.append(dr.fma((2 * l - 1) / l * z, p[l - 1], -(l - 1) / l * p[l - 2]))
    return p[:order + 1]


def strip_count(corners: int) -> int:
    """Number of strips that fill a polygon."""
    return (corners - 1) // 2


def strip_corners(i, corners: int) -> tuple:
    """Strip i of a polygon: four corners in the polygon's orientation, two of them equal in the last strip of an odd number of corners.

    Cut across, strips keep one direction of a many-sided light short. Of a non-convex polygon they may overlap with opposite signs.
    """
    return i, i + 1, corners - 2 - i, corners - 1 - i


class VertexList:
    """A closed polygon given as a list of vertices: edge i runs from vertex i to i + 1."""

    def __init__(self, vertices: list):
        self.vertices = vertices

    def detached(self):
        return VertexList([dr.detach(v) for v in self.vertices])

    def grad_enabled(self) -> bool:
        return dr.grad_enabled(self.vertices)

    def edge_count(self):
        return len(self.vertices)

    def sum(self, term, x, apex, width: int, active=True) -> list:
        """Sum ``term(v_i, v_j, apex) -> list of `width` floats`` over the edges, with ``v = vertex - x``; 0 where not `active`.

        A pair in the list stands for its product. One symbolic loop, so that kernels do not grow with the vertex count.
        """
        add = _adding(term)
        body = lambda _, corners, total, x, apex: add(corners, total, x, apex)
        return self._fold(len(self.vertices), self._ends, body, zeros(x, width), (x, apex), active)

    def sum_and_keep(self, term, x, apex, width: int, kept: int) -> tuple:
        """As :py:meth:`sum` for terms of `width` + `kept` floats: the sum of the first ones, and a list of the others for each edge.

        Carries no derivatives.
        """
        light, x, apex = self.detached(), dr.detach(x), dr.detach(apex)
        if not dr.is_jit_v(x):
            rows = [term(v - x, light.vertices[(e + 1) % len(light.vertices)] - x, apex) for e, v in enumerate(light.vertices)]
            return [sum(row[k] for row in rows) for k in range(width)], [row[width:] for row in rows]
        n = len(light.vertices)
        if n * kept > MANY_OUTPUTS and not dr.flag(dr.JitFlag.SymbolicScope):
            return light._in_lanes(term, x, apex, width)

        def body(e, corners, total, x, apex):
            values = term(corners[0] - x, corners[1] - x, apex)
            rows = [dr.select(e == i, value, total[width + i * kept + k]) for i in range(n) for k, value in enumerate(values[width:])]
            return [t + value for t, value in zip(total, values[:width])] + rows

        total = light._fold(n, light._ends, body, zeros(x, width + n * kept), (x, apex))
        return total[:width], [total[width + e * kept:width + (e + 1) * kept] for e in range(n)]

    def _in_lanes(self, term, x, apex, width: int) -> tuple:
        """:py:meth:`sum_and_keep` with the edges side by side: a kernel with thousands of results would take minutes to compile.

        The kernels are the same for all numbers of edges and points.
        """
        number, index = type(x[0]), dr.uint32_array_t(type(x[0]))
        n, lanes = len(self.vertices), dr.width(self.vertices, x, apex)
        corner, count = self._buffer(type(x), index, lanes), dr.opaque(index, n)
        row = dr.arange(index, n * lanes)
        lane = row // count
        edge = row - lane * count
        spread = lambda v: dr.gather(type(v), v + dr.zeros(type(v), lanes), lane)
        x, apex = spread(x), spread(apex)
        values = term(corner(edge, lane) - x, corner(dr.select(edge + 1 < count, edge + 1, 0), lane) - x, apex)
        dr.eval(values)
        rows = [dr.arange(index, lanes) * count + dr.opaque(index, e) for e in range(n)]
        return [dr.block_sum(v, n) for v in values[:width]], [[dr.gather(number, v, row) for v in values[width:]] for row in rows]

    def only_strip(self):
        """Corners of the strip if there is only one, otherwise None."""
        return tuple(self.vertices[k] for k in strip_corners(0, len(self.vertices))) if self.strip_count() == 1 else None

    def strip_count(self):
        return strip_count(len(self.vertices))

    def fold_patches(self, body, total, x, active=True):
        """Run ``total = body(corners, total, x)`` over strips that together have the polygon's boundary; lanes not `active` stay."""
        fill = lambda _, corners, total, x: body(corners, total, x)
        return self._fold(self.strip_count(), lambda i: strip_corners(i, len(self.vertices)), fill, total, (x,), active)

    def _ends(self, e) -> tuple:
        return e, dr.select(e + 1 < len(self.vertices), e + 1, 0)

    def _fold(self, count: int, corners, body, total, others: tuple, active=True):
        """``for i in range(count): total = body(i, (vertices of corners(i)), total, *others)``; lanes not `active` stay.

        Vertices are read from local memory, which carries no derivatives; from a buffer if they have gradients; and inside somebody else's
        symbolic loop or call from the state of the loop, as there can be no buffer there, and Dr.Jit 1.5 aborts over local memory in calls.
        """
        v, x = self.vertices, others[0]
        if not dr.is_jit_v(x):
            for i in range(count):
                total = body(i, tuple(v[k] for k in corners(i)), total, *others) if active else total
            return total
        index = dr.uint32_array_t(type(x[0]))
        bounds = index(0), index(count)
        if dr.flag(dr.JitFlag.SymbolicScope):
            pick = lambda v, i: functools.reduce(lambda found, k: dr.select(i == k, v[k], found), range(1, len(v)), v[0])
            step = lambda i, total, v, *others: body(i, tuple(pick(v, k) for k in corners(i)), total, *others)
            return fold(*bounds, lambda i: i, step, total, (v, *others), active)
        if dr.grad_enabled(v):
            lanes = dr.width(v)
            lane, corner = dr.arange(index, lanes), self._buffer(type(x), index, lanes)
            read = lambda i: corner(i, lane)
        else:
            read = self._local(type(x), index)
        step = lambda found, total, *others: body(*found, total, *others)
        return fold(*bounds, lambda i: (i, tuple(map(read, corners(i)))), step, total, others, active)

    def _local(self, kind, index):
        local = dr.alloc_local(kind, len(self.vertices))
        for i, vertex in enumerate(self.vertices):
            local.write(vertex, index(i))
        return local.read

    def _buffer(self, kind, index, lanes: int):
        """Function (corner number, lane) that reads from memory; differentiable."""
        buffer = kind(*(dr.concat([v[k] + dr.zeros(type(v[k]), lanes) for v in self.vertices]) for k in range(3)))
        lanes = dr.opaque(index, lanes)
        return lambda i, lane: dr.gather(kind, buffer, i * lanes + lane)


class EdgeBuffer:
    """Directed edges and strips of a light inside flat buffers: polygons with holes, many lights, differentiable vertices.

    ``positions``: flat x, y, z of all vertices; ``start``, ``end``: vertex indices of each edge; the light owns the edges
    ``first .. last - 1`` (may differ between lanes). ``patches`` = (corners, first, last): four vertex indices per strip, flat;
    ``one_strip``: no light of the buffer has more than one.
    """

    def __init__(self, positions, start, end, first, last, patches, one_strip: bool):
        self.positions, self.start, self.end, self.first, self.last = positions, start, end, first, last
        self.patches, self.one_strip = patches, one_strip

    def detached(self):
        return EdgeBuffer(dr.detach(self.positions), self.start, self.end, self.first, self.last, self.patches, self.one_strip)

    def grad_enabled(self) -> bool:
        return dr.grad_enabled(self.positions)

    def edge_count(self):
        return self.last - self.first

    def sum(self, term, x, apex, width: int, active=True) -> list:
        """As :py:meth:`VertexList.sum`."""
        corners = lambda e: tuple(self._vertex(dr.gather(type(self.start), table, e)) for table in (self.start, self.end))
        return fold(self.first, self.last, corners, _adding(term), zeros(x, width), (x, apex), active)

    def only_strip(self):
        """As :py:meth:`VertexList.only_strip`; that of any light where a lane has none."""
        return self._strip(self.patches[1]) if self.one_strip else None

    def strip_count(self):
        return self.patches[2] - self.patches[1]

    def fold_patches(self, body, total, x, active=True):
        """As :py:meth:`VertexList.fold_patches`."""
        return fold(*self.patches[1:], self._strip, body, total, (x,), active)

    def _strip(self, i):
        table = self.patches[0]
        return tuple(self._vertex(dr.gather(type(table), table, 4 * i + k)) for k in range(4))

    def _vertex(self, index):
        return dr.gather(array3(type(self.positions)), self.positions, index)


def fold(first, last, read, body, total, others: tuple = (), active=True):
    """``for i in first .. last - 1: total = body(read(i), total, *others)`` in one symbolic loop; lanes not `active` run none of it.

    `others`: what the body needs and may carry derivatives.
    """
    last = last if active is True else dr.select(active, last, first)
    if not dr.is_jit_v(last):
        for i in range(first, last):
            total = body(read(i), total, *others)
        return total
    step = lambda i, last, total, others: (i + 1, last, body(read(i), total, *others), others)
    return dr.while_loop((first, last, total, others), lambda i, last, *_: i < last, step, mode="symbolic", max_iterations=-1)[2]


def _adding(term):
    """Body of :py:func:`fold` that adds the values of a term."""
    def add(corners, total, x, apex):
        values = term(corners[0] - x, corners[1] - x, apex)
        return [dr.fma(*value, t) if isinstance(value, tuple) else t + value for t, value in zip(total, values)]

    return add


def zeros(x, width: int) -> list:
    """`width` zeros of the number type of a vector."""
    return [type(x[0])(0) for _ in range(width)]


def power_of_two_scale(largest):
    """A power of two that brings a positive number near 1: scaling by it is exact. Without derivatives; finite for 0."""
    number = type(largest)
    if number is float:
        return math.ldexp(1.0, -max(min(math.frexp(largest)[1], 1000), -1000))
    largest = dr.detach(largest)
    double = number.__name__ == "Float64"
    bits = (dr.uint64_array_t if double else dr.uint32_array_t)(largest)
    exponent, top, smallest = (0x7ff << 52, 0x7fe << 52, 1 << 52) if double else (0xff << 23, 0xfe << 23, 1 << 23)
    return dr.reinterpret_array(number, dr.maximum(top - (dr.reinterpret_array(bits, largest) & exponent), smallest))


def largest_component(v):
    """Largest absolute value of a vector's components."""
    return dr.maximum(dr.maximum(abs(v[0]), abs(v[1])), abs(v[2]))


def scaled(v):
    """`v` scaled by a power of two so that products of its components neither overflow nor vanish, and its length (1 for ``v = 0``)."""
    v = v * power_of_two_scale(largest_component(v))
    return v, safe_length(v)


def inverse_length(v):
    """1 / length of a vector of any size, at most 1e30 (1e300 in float64): products with numbers up to 1e8 stay finite."""
    scale = power_of_two_scale(largest_component(v))
    return dr.minimum(scale * (1 / safe_length(v * scale)), 1e30 if dr.epsilon(v) > 1e-10 else 1e300)


def over_cosine(frame: EdgeFrame, *inverses):
    """``1 / (2 cos(T / 2))`` of an edge, 0 if it has no plane; at most so large that its product with any of `inverses`,
    :py:func:`inverse_length` of the ends, stays finite.
    """
    least = functools.reduce(dr.maximum, inverses) * (0.5e-36 if dr.epsilon(frame.normal) > 1e-10 else 0.5e-306)
    return dr.select(frame.arc > 0, 0.5 / dr.maximum(frame.cos_half, least), 0)


def safe_length(v):
    """Length of a vector whose components are of moderate size, and never 0: 1 in its place."""
    squared = dr.squared_norm(v)
    return dr.sqrt(dr.select(squared > 0, squared, 1))


def _tiny(v) -> float:
    """Below this a squared sine is treated as zero: near the smallest normal number."""
    number = type(v[0])
    return 1e-300 if number is float or number.__name__ == "Float64" else 1e-37
