"""SH coefficients of a polygonal light by cubature over its area: exact to rounding where every boundary form cancels.

A boundary form subtracts edge terms of size theta to get a result of size theta^2 or less, so distant, tiny, grazing and sliver lights
lose all digits of float32. A sum over points of the light has terms of one sign. It needs few points as long as the light looks small
against the wavelength of Y_lm, and these are placed so that few suffice:

The polygon is cut into strips with four corners each (two may coincide), bilinear patches ``p(s, t)`` relative to the shading point.
Their solid angle element is

    d omega = F(s, t) / |p|^3 ds dt,    F = p . (dp/ds x dp/dt).                                                          (1)

F is bilinear in (s, t), also if the corners are not in one plane: its four corner values, triple products, say all of it. They are the
only quantity that cancels (grazing and sliver lights), and are taken of exact vertex differences in doubled precision. At fixed s the
patch is a segment between two points A and B, seen under an angle Phi. Parametrised by the fraction u of that angle the direction is a
spherical linear interpolation, and (1) loses the poles of 1 / |p|^3:

    omega(u) = p A/|A| + q B/|B|,    p = sin((1 - u) Phi) / sin Phi,    q = sin(u Phi) / sin Phi,                            (2)
    F dt / |p|^3 = (F_A p / (|A|^2 |B|) + F_B q / (|A| |B|^2)) Phi / sin Phi du.                                             (3)

Times Y_lm that is a trigonometric polynomial of degree order + 1, for which the error of k Gauss-Legendre nodes is known
(:py:func:`node_limits`). Across, s runs over the same kind of variable along the patch's middle line. Derived for this package; [W20]
section 7.3 suggests a single sample.
"""
from __future__ import annotations

import functools
import math
from typing import NamedTuple

import drjit as dr
import numpy as np

from ..sh.basis import sh_basis, sh_basis_gradient
from ..sh.lobes import sh_matrix
from .polygon import (EdgeFrame, compensated_cross, edge_frame, exact_difference, fold, inverse_length, largest_component,
                      over_cosine, power_of_two_scale, safe_length, triple_product, zeros)

NODE_COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40)
"""Numbers of Gauss nodes per direction to choose from."""

_squared_chord = lambda angle: (2 * math.sin(angle / 2)) ** 2
WIDE_S = tuple(map(_squared_chord, (0.9, 1.5, 2.0, 2.0)))
WIDE_T = tuple(map(_squared_chord, (2.0, 2.6, 2.6, 2.6)))
SLIM = _squared_chord(0.3)
MISMATCH = (1.1, 1.8, 2.6, 3.5, 5.0, 6.5, 8.0, 12.0)
HOPELESS_T, HOPELESS_MISMATCH, HOPELESS_RULES, HOPELESS_GAP = _squared_chord(2.8), 20.0, 4, 0.1
"""The integral over t is not quite a trigonometric polynomial in s if the patch is seen under wide angles, or if distances along its two
borders rise differently (``|00| |11|`` against ``|10| |01|``). For each of these limits exceeded s takes the next larger rule; those
in t do not count for a patch slim in s. Beyond the HOPELESS ones, which a point near the border meets, no rule helps: the error is 1 for a
gap below 0.01 (:py:func:`_rough_solid_angle`), 1e-5 to 1e-2 where the largest rule is five or more too small. See
validation/stability.py."""


LARGEST_SCALE = 1e30
"""Derivatives of smaller lights, per unit of length, are beyond the largest float32."""


class Demand(NamedTuple):
    """What cubature of a light would take, and what it can say about the boundary forms. Without derivatives."""

    points: object
    """Number of points, all patches together."""
    enough: object
    """False if some patch would need more than the largest number of nodes."""
    possible: object
    """False if some patch is so near that the largest number of nodes would not even come close."""
    solid_angle: object
    """Estimate within a factor of a few, in steradians."""
    perimeter: object
    """Estimate within a factor of a few, in radians."""


class _View(NamedTuple):
    """A strip from the shading point: what its number of nodes depends on."""

    vectors: tuple
    """Corners 00, 10, 11, 01 in (s, t) relative to the shading point, scaled."""
    scale: object
    """The power of two that they are scaled by."""
    lengths: tuple
    sides: tuple
    """Squared chords ``(2 sin(Phi / 2))^2`` of the sides 00-10, 10-11, 11-01, 01-00."""
    narrow: object
    """Largest squared chord in the direction that is seen under the smaller angle: on both borders and halfway between."""
    wide: object
    """The same in the other direction."""
    swapped: object
    """True if s is the wide one. The narrow one is then called s: the integral over t has no error but that of its nodes."""


class _Patch(NamedTuple):
    """A strip in the roles of s and t that it has for the cubature; corners 00, 10, 11, 01."""

    vectors: tuple
    flux: tuple
    """F of equation (1) at the corners."""
    area: tuple
    """``dp/ds x dp/dt`` at the corners."""


@functools.lru_cache(maxsize=None)
def node_limits(order: int, max_error: float) -> tuple:
    """Largest angle in radians at which each of NODE_COUNTS keeps the relative L2 error of the coefficients below `max_error`.

    k Gauss-Legendre nodes on an interval of half-width h err by ``2^(2k+1) k!^4 / ((2k+1) (2k)!^3) h^(2k)`` times the derivative of order
    2k. Along an arc the integrand is a cosine of the azimuth times ``cos(m phi)``, or, where a strip narrows to a point, a sine:
    frequencies up to m + 1, and small arcs lose one power of h in the latter case. A single node is put into the centroid and does not.
    The degrees m count with the power that they have along a great circle.
    """
    equator = sh_matrix(np.array([[1.0, 0.0, 0.0]]), order)[0]
    m = np.arange(order + 1)
    power = np.array([sum(equator[l * (l + 1) + k] ** 2 for l in range(k, order + 1)) for k in m])
    power /= power.sum()

    def log_error(k, h):
        factor = 2 * k * math.log(2) + 4 * math.lgamma(k + 1) - math.log(2 * k + 1) - 3 * math.lgamma(2 * k + 1)
        w = (m + 1) * h
        rises = (1 + 2 * k / w if k > 1 else 1) * (w / w[-1]) ** (2 * k)
        return factor + 2 * k * math.log(w[-1]) + math.log(math.sqrt(power @ rises ** 2))

    limits = []
    for k in NODE_COUNTS:
        low, high = -40.0, math.log(math.pi / 2)      # logarithm of h
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (low, middle) if log_error(k, math.exp(middle)) > math.log(max_error) else (middle, high)
        limits.append(2 * math.exp(low))
    return tuple(limits)


def demand(light, x, order: int, max_error: float) -> Demand:
    """How many points cubature of `light` from `x` would take."""
    nodes, light, x = node_tables(type(x[0]), order, max_error), light.detached(), dr.detach(x)

    def body(corners, total, x):
        points, enough, possible, solid_angle, along, across = total
        view = _view(corners, x)
        choice_s, choice_t = nodes.choose(view)
        count = nodes.count(choice_s) * nodes.count(choice_t)
        enough = enough & (choice_s < len(NODE_COUNTS)) & (choice_t < len(NODE_COUNTS))
        part, gap = _rough_solid_angle(view)
        possible = (possible & (view.wide < HOPELESS_T) & (_mismatch(view) < HOPELESS_MISMATCH) & (gap > HOPELESS_GAP)
                    & (dr.maximum(choice_s, choice_t) < len(NODE_COUNTS) + HOPELESS_RULES))
        along = along + dr.sqrt(view.sides[0]) + dr.sqrt(view.sides[2])
        return (points + count, enough, possible, solid_angle + part, along,
                dr.maximum(across, dr.maximum(view.sides[1], view.sides[3])))

    zero = type(x[0])(0)
    yes = dr.mask_t(zero)(True)
    total = dr.uint32_array_t(zero)(0), yes, yes, zero, zero, zero
    strip = light.only_strip()
    total = body(strip, total, x) if strip else light.fold_patches(body, total, x)
    points, enough, possible, solid_angle, along, across = total
    return Demand(points, enough, possible, abs(solid_angle), along + 2 * dr.sqrt(across))


def integrate(light, x, order: int, max_error: float, add, total, active=True, slopes: bool = False):
    """Run ``total = add(total, omega, weight)`` over the cubature points of `light`: unit directions and their solid angles.

    If `slopes` it is ``add(total, omega, weight, inverse, area)``: 1 / distance, and the vector area of the light that belongs to the
    point over the cubed distance; for derivatives of such sums.

    Sums of functions that are polynomials of degree `order` on the sphere have a relative error of `max_error`, where a light is not
    too near (see :py:class:`Demand`); lanes not `active` keep their total.
    """
    nodes = node_tables(type(x[0]), order + slopes, max_error)

    def over_patch(corners, total, x, view):
        view = _View(*view)
        choice_s, choice_t = nodes.choose(view)
        patch = _patch(corners, x, view)
        centre, single = _centre(patch, (choice_s == 0) & (choice_t == 0))
        choice_s, choice_t = (dr.select(single | (choice > 0), choice, 1) for choice in (choice_s, choice_t))
        v00, v10, v11, v01 = patch.vectors
        middle = v00 + v01, v10 + v11
        lengths = tuple(safe_length(v) for v in middle)
        # Dr.Jit's loops see no members of named tuples
        others = tuple(patch), tuple(centre), tuple(edge_frame(*middle)), lengths, dr.minimum(view.scale, LARGEST_SCALE)

        def over_s(node, total, patch, centre, middle, lengths, unit):
            (v, f, g), centre, middle = patch, _Centre(*centre), EdgeFrame(*middle)
            p, q, ratio = _slerp(node[0], middle)
            a, b = lengths[0] * q, lengths[1] * p
            inverse = 1 / (a + b)
            r, s = b * inverse, a * inverse           # 1 - s would cancel where a border passes close to the shading point
            weight = node[1] * ratio * lengths[0] * lengths[1] * dr.square(inverse)       # ds/du
            start, end = dr.fma(v[0], r, v[1] * s), dr.fma(v[3], r, v[2] * s)
            frame = edge_frame(start, end)
            r_start, r_end = safe_length(start), safe_length(end)
            scale = weight / (r_start * r_end)
            f_start = dr.fma(f[0], r, f[1] * s) * scale / r_start
            f_end = dr.fma(f[3], r, f[2] * s) * scale / r_end
            ends = f_start, f_end
            if slopes:
                ends += dr.fma(g[0], r, g[1] * s) * (scale / r_start), dr.fma(g[3], r, g[2] * s) * (scale / r_end), 1 / r_start, 1 / r_end

            def over_t(node, total, centre, frame, ends, unit):
                centre, frame, (f_start, f_end, *rest) = _Centre(*centre), EdgeFrame(*frame), ends
                p, q, ratio = _slerp(node[0], frame)
                weight = dr.select(single, centre.solid_angle, dr.fma(f_start, p, f_end * q) * ratio * node[1])
                omega = _renormalised(dr.select(single, centre.omega, dr.fma(frame.omega_i, p, frame.omega_j * q)))
                if not slopes:
                    return add(total, omega, weight)
                g_start, g_end, inverse_start, inverse_end = rest
                area = dr.select(single, centre.area, dr.fma(g_start, p, g_end * q) * (ratio * node[1]))
                inverse = dr.select(single, centre.inverse, dr.fma(inverse_start, p, inverse_end * q))
                return add(total, omega, weight, inverse * unit, area * unit)

            return fold(*nodes.range(choice_t), nodes.read, over_t, total, (tuple(centre), tuple(frame), ends, unit))

        return fold(*nodes.range(choice_s), nodes.read, over_s, total, others)

    strip = light.only_strip()
    if strip:                                         # the view is the one that demand() had
        index = dr.uint32_array_t(type(x[0]))
        body = lambda _, total, x, strip, view: over_patch(strip, total, x, view)
        return fold(index(0), index(light.strip_count()), lambda i: i, body, total, (x, strip, tuple(_view(strip, x))), active)
    return light.fold_patches(lambda corners, total, x: over_patch(corners, total, x, _view(corners, x)), total, x, active)


def project_quadrature(light, x, order: int, max_error: float, active=True) -> list:
    """Coefficients ``L_lm`` of `light` seen from `x`: list of ``(order + 1)**2`` floats; 0 where not `active`."""
    add = lambda total, omega, weight: [dr.fma(weight, y, t) for t, y in zip(total, sh_basis(omega, order))]
    return integrate(light, x, order, max_error, add, zeros(x, (order + 1) ** 2), active)


def project_quadrature_spatial(light, x, order: int, max_error: float, active=True) -> tuple:
    """``(coeffs, (dx, dy, dz))``: coefficients of `light` and their derivatives by `x`, under the integral.

    With r the vector from `x` to a point of the light and dA its vector area, the derivative of ``Y_lm(r / |r|) r . dA / |r|^3`` by r is

        d omega / |r| grad Y_lm + Y_lm (dA / |r|^3 - 3 omega d omega / |r|) .                                              (4)

    All terms are of the size of the result, where the sum of the derivatives by the vertices is one of large terms.
    """
    count = (order + 1) ** 2

    def add(total, omega, weight, inverse, area):
        basis, gradient = sh_basis_gradient(omega, order)
        slope, rest = weight * inverse, dr.fma(omega, -3 * weight * inverse, area)
        terms = [dr.fma(g, slope, rest * y) for g, y in zip(gradient, basis)]
        return [dr.fma(weight, y, t) for t, y in zip(total, basis)] + [
            total[(k + 1) * count + i] - term[k] for k in range(3) for i, term in enumerate(terms)]

    total = integrate(light, x, order, max_error, add, zeros(x, 4 * count), active, slopes=True)
    return total[:count], tuple(total[k * count:(k + 1) * count] for k in (1, 2, 3))


def project_quadrature_lines(light, x, apex, order: int, max_error: float) -> list:
    """Of each edge of a :py:class:`~mi_shlight.light.polygon.VertexList` what its corners do to the coefficients, as
    :py:func:`mi_shlight.light.edge_frame.project_edge_lines` has it: by nodes along the edge.

    In the fraction u of an edge's angle the share of a corner over its distance is p or q of (2) over that distance, so that times Y_lm it
    is a trigonometric polynomial as (3).
    """
    nodes, count = node_tables(type(x[0]), order, max_error), (order + 1) ** 2

    def term(v_i, v_j, apex):
        frame = edge_frame(v_i, v_j)
        chosen = nodes.choose_along(dr.square(2 * frame.sin_half))

        def over_edge(node, total, frame, least):
            frame = EdgeFrame(*frame)
            p, q, _ = _slerp(node[0], frame, least)
            angle = (node[0] - 0.5) * frame.arc       # from the middle: near half circles p and q leave nothing of a direction
            omega = dr.fma(frame.middle, dr.cos(angle), dr.cross(frame.normal, frame.middle) * dr.sin(angle))
            basis = sh_basis(_renormalised(omega), order)
            p, q = (node[1] * frame.arc * share for share in (p, q))
            return [dr.fma(share, y, t) for t, (share, y) in zip(total, [(p, y) for y in basis] + [(q, y) for y in basis])]

        inverse_i, inverse_j = inverse_length(v_i), inverse_length(v_j)
        least = 1 / dr.maximum(2 * over_cosine(frame, inverse_i, inverse_j), 1)       # of the sine, as large as the half angle's cosine
        total = fold(*nodes.range(chosen), nodes.read, over_edge, zeros(x, 2 * count), (tuple(frame), least))
        return [value * -inverse_i for value in total[:count]] + [value * -inverse_j for value in total[count:]] + list(frame.normal)

    return light.sum_and_keep(term, x, apex, 0, 2 * count + 3)[1]


def quadrature_shader(transfer: list, order: int, max_error: float):
    """Function ``shade(light, x, active)`` that gives ``sum_lm T_lm L_lm``."""
    def add(total, omega, weight):
        value = 0
        for t, y in zip(transfer, sh_basis(omega, order)):
            value = dr.fma(t, y, value)
        return dr.fma(weight, value, total)

    return lambda light, x, active=True: integrate(light, x, order, max_error, add, type(x[0])(0), active)


def node_tables(number, order: int, max_error: float) -> "_Nodes":
    """The rules as tables of the type `number`.

    Held once per type, order and error, for `dr.freeze`: a recorded function may take no values from Python lists, so whoever is called in
    symbolic loops keeps the tables among what it is recorded with. Elsewhere they are made in a kernel while recording.
    """
    recording = dr.is_jit_v(number) and dr.flag(dr.JitFlag.FreezingScope) and not dr.flag(dr.JitFlag.SymbolicScope)
    return _Nodes(number, order, max_error, recording) if recording else _held_tables(number, order, max_error)


_gauss_legendre = functools.lru_cache(maxsize=None)(np.polynomial.legendre.leggauss)


@functools.lru_cache(maxsize=None)
def _held_tables(number, order: int, max_error: float) -> "_Nodes":
    return _Nodes(number, order, max_error, False)


class _Nodes:
    """Gauss-Legendre rules on [0, 1] with NODE_COUNTS nodes, as tables that lanes read with their own choice of rule."""

    DRJIT_STRUCT = dict.fromkeys(("_node", "_weight", "_first", "_count"), object)

    def __init__(self, number, order: int, max_error: float, in_kernel: bool):
        rules = [_gauss_legendre(k) for k in NODE_COUNTS]
        index = dr.uint32_array_t(number)
        jit = dr.is_jit_v(number)

        def table(kind, values):
            if not in_kernel:
                return kind(values) if jit else values
            row, entries = dr.arange(index, len(values)), kind(0)
            for i, value in enumerate(values):
                entries = dr.select(row == i, value, entries)
            return entries

        self._read = dr.gather if jit else lambda kind, table, i: table[i]
        self._number, self._index = number, index
        self._node = table(number, [(1 + u) / 2 for nodes, _ in rules for u in nodes.tolist()])
        self._weight = table(number, [w / 2 for _, weights in rules for w in weights.tolist()])
        self._first = table(index, [sum(NODE_COUNTS[:i]) for i in range(len(NODE_COUNTS) + 1)])
        self._count = table(index, NODE_COUNTS)
        self._limits = [_squared_chord(angle) for angle in node_limits(order, max_error)]

    def choose(self, view: _View) -> tuple:
        """Rules for s and t, as numbers in NODE_COUNTS; ``len(NODE_COUNTS)`` or more if none does."""
        s = self._count_above(view.narrow, [*self._limits, *WIDE_S]) + self._count_above(_mismatch(view), MISMATCH)
        s = dr.select(view.narrow > SLIM, s + self._count_above(view.wide, WIDE_T), s)
        return s, self._count_above(view.wide, self._limits)

    def choose_along(self, squared_chord):
        """Rule for an edge: one larger, as a corner's share is a factor more, and a single node would not tell the ends apart."""
        return self._count_above(squared_chord, self._limits) + 1

    def _count_above(self, value, limits):
        number = self._index(0)
        for limit in limits:
            number = dr.select(value > limit, number + 1, number)
        return number

    def count(self, choice):
        """Number of nodes of a rule."""
        return self._read(self._index, self._count, dr.minimum(choice, len(NODE_COUNTS) - 1))

    def range(self, choice):
        """Rows of the rule in the table; of the largest rule if none is enough."""
        choice = dr.minimum(choice, len(NODE_COUNTS) - 1)
        return self._read(self._index, self._first, choice), self._read(self._index, self._first, choice + 1)

    def read(self, row):
        return self._read(self._number, self._node, row), self._read(self._number, self._weight, row)


class _Centre(NamedTuple):
    """A small patch as a single point."""

    omega: object
    """Direction of the centroid of its solid angle."""
    solid_angle: object
    inverse: object
    """1 / distance, scaled."""
    area: object
    """Vector area over the cubed distance, scaled."""


def _view(corners, x) -> _View:
    vectors = [p - x for p in corners]
    scale = power_of_two_scale(functools.reduce(dr.maximum, map(largest_component, vectors)))
    v00, v10, v11, v01 = vectors = [v * scale for v in vectors]
    lengths = [safe_length(v) for v in vectors]
    omega = [v * (1 / r) for v, r in zip(vectors, lengths)]
    unit = lambda v: v * (1 / safe_length(v))
    sides = [dr.squared_norm(omega[k] - omega[(k + 1) % 4]) for k in range(4)]
    s = dr.maximum(dr.maximum(sides[0], sides[2]), dr.squared_norm(unit(v00 + v01) - unit(v10 + v11)))
    t = dr.maximum(dr.maximum(sides[1], sides[3]), dr.squared_norm(unit(v00 + v10) - unit(v01 + v11)))
    return _View(tuple(vectors), scale, tuple(lengths), tuple(sides), dr.minimum(s, t), dr.maximum(s, t), s > t)


def _patch(corners, x, view: _View) -> _Patch:
    """The strip for the cubature, with its fluxes to full relative accuracy."""
    scaled = lambda pair: (pair[0] * view.scale, pair[1] * view.scale)
    vectors = [scaled(exact_difference(p, x)) for p in corners]
    sides = [scaled(exact_difference(corners[(k + 1) % 4], corners[k])) for k in range(4)]
    flux = [triple_product(vectors[k], sides[k - 1], sides[k]) for k in range(4)]
    area = [_exact_cross(sides[k - 1], sides[k]) for k in range(4)]
    turn = lambda a: (a[0], dr.select(view.swapped, a[3], a[1]), a[2], dr.select(view.swapped, a[1], a[3]))
    return _Patch(turn(view.vectors), turn(flux), turn(area))


def _exact_cross(a: tuple, b: tuple):
    """Cross product of vectors given as (value, error): full relative accuracy of slim areas, too."""
    return compensated_cross(a[0], b[0]) + (dr.cross(a[1], b[0]) + dr.cross(a[0], b[1]))


def _mismatch(view: _View):
    r_00, r_10, r_11, r_01 = view.lengths
    even, odd = r_00 * r_11, r_10 * r_01
    return dr.maximum(even, odd) / dr.minimum(even, odd)


def _rough_solid_angle(view: _View) -> tuple:
    """(solid angle, gap): signed solid angle of the two triangles that a diagonal cuts off, within a factor of a few, as van Oosterom's
    quotient without arc tangent; and the smallest of its denominators for the four triangles of both diagonals.

    These are ``2 (1 + a . b + b . c + c . a)``: 0 for a shading point on a side, negative in the triangle's plane inside, 8 for a point far
    away. Corners off one plane have their patch between the triangles of the two diagonals. A corner in the shading point counts as 0.
    """
    v, r, sides = view.vectors, view.lengths, view.sides
    omega = [v[k] * (1 / r[k]) for k in range(4)]
    diagonals = dr.squared_norm(omega[0] - omega[2]), dr.squared_norm(omega[1] - omega[3])
    total, gap = 0, dr.select(functools.reduce(dr.minimum, map(largest_component, v)) > 0, type(r[0])(8), 0)
    for k in range(4):
        before, after = (k - 1) % 4, (k + 1) % 4
        denominator = 4 - 0.5 * (sides[before] + sides[k] + diagonals[1 - k % 2])       # a . b = 1 - |a - b|^2 / 2
        gap = dr.minimum(gap, denominator)
        if k % 2:
            numerator = dr.dot(v[k], dr.cross(v[k] - v[before], v[after] - v[k])) / (r[before] * r[k] * r[after])
            small = denominator > abs(numerator)
            total = total + dr.select(small, 2 * numerator / dr.select(small, denominator, 1), dr.select(numerator > 0, math.pi, -math.pi))
    return total, gap


def _centre(patch: _Patch, small) -> tuple:
    """A patch as a single point, and whether to take it so: `small`, and no change of sign inside."""
    r = [safe_length(v) for v in patch.vectors]
    # solid angle per unit of the node coordinates at the corners: nearly bilinear, as is the direction
    density = [patch.flux[k] / (r[k - 1] * r[k] * r[(k + 1) % 4]) for k in range(4)]
    total, size = sum(density), sum(map(abs, density))
    scale = power_of_two_scale(size)                  # the square of a tiny total, in the derivatives, would vanish
    safe = 9 * dr.select(total != 0, total * scale, 1)
    mean, inverse = 0, 0
    for k in range(4):                                # integral of a product of bilinear functions
        share = 4 * density[k] + 2 * (density[k - 1] + density[(k + 1) % 4]) + density[k - 2]
        part = share * scale / (safe * r[k])
        mean, inverse = mean + patch.vectors[k] * part, inverse + part
    area = sum(patch.area[k] * (1 / (r[k - 1] * r[k] * r[(k + 1) % 4])) for k in range(4)) * 0.25
    centre = _Centre(mean * (1 / safe_length(mean)), total * 0.25, inverse, area)
    return centre, small & (abs(total) == size) & (total != 0)


def _slerp(u, frame, least=1e-6):
    """(p, q, ratio) of equations (2) and (3): weights of the arc's ends at the fraction u of its angle, and ``Phi / sin Phi``.

    `least`: limit of the sine near half circles, which keeps areas finite that cubature makes no sense of.
    """
    curved = frame.arc > 0
    sin = dr.select(frame.cos < 0, dr.maximum(frame.sin, least), frame.sin)
    sin = dr.select(curved, sin, 1)
    p, q = dr.sin((1 - u) * frame.arc) / sin, dr.sin(u * frame.arc) / sin
    return dr.select(curved, p, 1 - u), dr.select(curved, q, u), dr.select(curved, frame.arc / sin, 1)


def _renormalised(omega):
    """A unit vector but for rounding, made one: near the poles Y_lm feels a length off by eps as l^2 eps / 2."""
    return omega * dr.fma(dr.squared_norm(omega), -0.5, 1.5)
