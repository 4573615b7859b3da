"""Lights of many faces: meshes, and textured lights cut into pieces of constant radiance.

With radiance ``r_f`` on face f the coefficients are ``sum_f r_f L_lm(f)``. Closed forms integrate along the border of each face, once in
either direction along an edge that two faces share, so that for l >= 1

    sum_f r_f L_lm(f) = sum_e (r_left - r_right) E_lm(e) ,                                                                  (1)

left and right the faces that run along edge e from start to end and back, E_lm the integral of :py:mod:`mi_shlight.light.edge_frame`. Each
edge is integrated once, those between equal radiances not at all. A face that emits on one side only is left out of (1) where it is turned
away: between equal faces of a closed mesh there remains the outline that the point sees. In a flat light all faces are turned away at once.

So is L_00 = solid angle / sqrt(4 pi), by fans from one apex (:py:func:`mi_shlight.light.polygon.fan_solid_angle`), provided that no face
covers the opposite of the apex. For a point inside the mesh there may be no such apex; there the solid angles are summed face by face.

Several lights may stand in one :py:class:`MeshLight` as its *parts*, which loops take one after the other.
"""
from __future__ import annotations

import copy
import functools
import operator
import sys
from typing import NamedTuple

import drjit as dr
import numpy as np

from ..arrays import array3, vectors3
from ..errors import check_choice, message
from ..sh.basis import check_order
from .arguments import SCALE, all_finite, error_argument, not_literal
from .edge_frame import MONOPOLE
from .polygon import (
    direction, edge_frame, fan_solid_angle, fold, largest_component, legendre_p, power_of_two_scale)
from .project import METHODS, boundary_form, default_error, project_polygon
from .quadrature import integrate, node_limits, project_quadrature, quadrature_shader
from .topology import MeshTables, mesh_topology
from .zonal import zonal_shader


class _Measures(NamedTuple):
    """What loops want to know of a light as a whole: tables with a row for each part, or the row of one part."""

    area: object
    """Vector area, scaled."""
    bent: object
    """Quarter of the area that cancels in it, scaled."""
    edge_length: object
    """Root of the sum of squares of all edges, scaled."""
    slabs: list
    """(axis, lowest, highest vertex) along four axes."""
    centre: object
    radius: object
    """Of a ball around the bounding box; the radius is scaled."""


class MeshLight:
    """A light of many faces in flat tables, ready for kernels of a size that does not depend on their number.

    To the coefficient methods it is a light as :py:class:`~mi_shlight.light.polygon.EdgeBuffer`, except that sums come as *colours*:
    floats if the radiance has one channel, vectors if it has three or four.

    Parameters
    ----------
    positions : Dr.Jit float of width 3 V, or 3-vector of width V
        The vertices.
    topology : Topology or MeshTables
    radiance : ndarray (F, C), list of C Dr.Jit floats of width F, or function
        Of an array, edges between equal radiances are dropped, unless the light is one-sided. A function gives the radiance of faces,
        a Dr.Jit integer, as a list of C floats; only for one-sided lights.
    one_sided : bool
        True if a face emits only to points from which its solid angle is positive.
    """

    def __init__(self, positions, topology, radiance, one_sided: bool = False):
        flat = dr.depth_v(positions) == 1
        self._number = type(positions if flat else positions[0])
        self._vector, self._index = array3(self._number), dr.uint32_array_t(self._number)
        self._one_sided = one_sided
        kept = None
        if isinstance(radiance, np.ndarray):
            radiance = np.pad(radiance, ((0, 1), (0, 0)))                   # black: the face that stands for none
            if not one_sided:
                kept = (radiance[topology.edges[:, 2]] != radiance[topology.edges[:, 3]]).any(axis=1)
            radiance = [self._number(channel) for channel in radiance.T]
        elif not callable(radiance):
            radiance = [dr.concat([channel, dr.zeros(self._number)]) for channel in radiance]
        tables = topology if isinstance(topology, MeshTables) else MeshTables(self._index, topology, kept)
        self._edge_count, self._bounds = tables.edge_count, tables.bounds
        # The parts have copies of their vertices. That is faster to read, and Dr.Jit 1.5.0 gets reverse-mode derivatives wrong of a flat
        # buffer that is gathered as vectors both inside and outside of symbolic loops.
        vertices = dr.unravel(self._vector, positions) if flat else self._vector(positions)
        self._edges, self._triangles, self._strips = ([dr.gather(self._vector, vertices, corner) for corner in corners]
                                                      for corners in (tables.edges, tables.triangles, tables.strips))
        planes = self._measure(dr.detach(vertices), tables)
        self._by_face = one_sided and not (tables.flat and not callable(radiance))
        self._owners = [_Owners(owner, radiance, planes if self._by_face else None, tables.face_count)
                        for owner in (*tables.sides, tables.triangle_owner, tables.strip_owner)]
        left, right = self._owners[:2]
        self._steps = [] if self._by_face else [a - b for a, b in zip(left.radiance, right.radiance)]
        self._equal = _equal(left.radiance, right.radiance) if self._by_face and left.radiance else None
        sample = radiance(self._index(0)) if callable(radiance) else radiance
        self._radiance_attached = dr.grad_enabled(sample)
        self._black = self._colour(self._number(0) for _ in sample)
        dr.eval(self._edges, self._triangles, self._strips, self._steps, self._equal, self._tables,
                [part.tables() for part in self._owners])
        self._choose(self._index(0))

    def part(self, k) -> "MeshLight":
        """Light number `k` alone."""
        view = copy.copy(self)
        view._choose(k)
        return view

    def detached(self) -> "MeshLight":
        """The light without derivatives."""
        light = copy.copy(self)
        light._edges, light._triangles, light._strips, light._steps = dr.detach([self._edges, self._triangles, self._strips, self._steps])
        light._owners, light._radiance_attached = [part.detached() for part in self._owners], False
        return light

    def grad_enabled(self) -> bool:
        return self._radiance_attached or dr.grad_enabled(self._triangles)

    def _choose(self, k) -> None:
        read = lambda table: dr.gather(type(table), table, k)
        self._edge_range, self._triangle_range, self._strip_range = ((read(table), dr.gather(type(table), table, k + 1))
                                                                     for table in self._bounds)
        area, bent, edge_length, slabs, centre, radius = self._tables
        self._measures = _Measures(read(area), read(bent), read(edge_length), [tuple(map(read, slab)) for slab in slabs], read(centre),
                                   read(radius))

    def _measure(self, vertices, tables: MeshTables) -> list:
        """Measure each part as a whole; gives the planes of the faces as tables ``n_x, n_y, n_z, n . corner``. Without derivatives."""
        parts, faces, part_of = tables.part_count, tables.face_count + 1, tables.triangle_part

        def collected(op, start, values, owner, count=parts):
            table = dr.full(type(values), start, count)
            dr.scatter_reduce(op, table, values, owner)
            return table

        total = functools.partial(collected, dr.ReduceOp.Add, 0)
        corners = dr.detach(self._triangles)
        # keeps squares and areas in range
        self._scale = power_of_two_scale(functools.reduce(dr.maximum, (dr.max(largest_component(corner)) for corner in corners)))
        a, b, c = (corner * self._scale for corner in corners)
        facing = dr.cross(b - a, c - a) * 0.5
        area, face_area = total(facing, part_of), total(facing, tables.triangle_owner, faces)
        bent = (total(dr.norm(facing), part_of) - dr.norm(area)) * 0.25
        edge_length = dr.zeros(self._number, parts)
        if self._edge_count:
            start, end = (dr.detach(vertex) * self._scale for vertex in self._edges)
            edge_length = dr.sqrt(total(dr.squared_norm(end - start), tables.edge_part))
        # of a light with two sides, either: it lies in one half-space as its first triangle
        first = direction(dr.gather(self._vector, facing, dr.gather(self._index, tables.bounds[1], dr.arange(self._index, parts))))
        axes = [self._vector(*(dr.full(self._number, float(i == k), parts) for i in range(3))) for k in range(3)]
        slabs = []
        for axis in (*axes, dr.select(dr.norm(area) > bent, direction(area), first)):
            own = dr.gather(self._vector, axis, part_of)
            heights = [dr.dot(own, corner) for corner in corners]
            low, high = functools.reduce(dr.minimum, heights), functools.reduce(dr.maximum, heights)
            slabs.append((axis, collected(dr.ReduceOp.Min, dr.inf, low, part_of), collected(dr.ReduceOp.Max, -dr.inf, high, part_of)))
        low, high = (self._vector(*(slab[k] for slab in slabs[:3])) for k in (1, 2))
        self._tables = _Measures(area, bent, edge_length, slabs, low * 0.5 + high * 0.5,
                                 dr.norm(high * self._scale - low * self._scale) * 0.5)
        normals = direction(face_area)
        planes = [*normals, dr.dot(normals, dr.gather(self._vector, vertices, tables.first))]
        dr.eval(self._scale, self._tables, planes)
        return planes

    def edge_count(self) -> int:
        """Number of edges that are integrated."""
        return self._edge_count

    def apex(self, x) -> tuple:
        """(apex, outside): a unit vector whose opposite points to no face, the zero vector where none is known; whether one is.

        It is known where all faces lie in one half-space seen from `x`, as outside of their bounding box, and on either side of
        a plane mesh.
        """
        x = dr.detach(x)
        outside, into = dr.mask_t(x[0])(False), self._vector(0)
        for axis, low, high in self._measures.slabs:
            height = dr.dot(axis, x)
            before, behind = height < low, height > high
            into = dr.select(before, axis, dr.select(behind, -axis, into))
            outside = outside | before | behind
        return dr.select(outside, direction(direction(self._measures.centre - x) + into), 0), outside

    def prefers_cubature(self, x, order: int, max_error: float):
        """Mask: where method ``auto`` takes the cubature in place of the edge form.

        For accuracy alone, as even one point takes longer than a face's share of the edges. The rounding errors of the edges are
        independent: together about 2 eps times the root of the sum of their squared angles, measured with meshes of 8 to 512
        triangles. The solid angle is that of the light's vector area, and, if it is one-sided, of a quarter of the area that cancels
        in it. Only where there are nodes enough for an angle as large as the whole light: close to it the edge form stays, grazing or not.
        """
        whole = self._measures
        towards = (whole.centre - dr.detach(x)) * self._scale
        distance = dr.norm(towards)
        seen = dr.dot(whole.area, towards) / distance
        seen = whole.bent + dr.maximum(seen, 0) if self._one_sided else abs(seen)
        angle = min(node_limits(order, max_error)[-1], 1)
        return (2 * whole.radius < angle * distance) & (2 * dr.epsilon(x) * whole.edge_length * distance > max_error * seen)

    def sum(self, term, x, apex, width: int, active=True) -> list:
        """Sum of ``term(v_i, v_j, apex)`` over the edges, weighted as in (1): list of `width` colours; 0 where not `active`.

        A pair in the list stands for its product.
        """
        def body(e, faces, total, x, apex):
            v_i, v_j = (self._read(end, e) - x for end in self._edges)
            weight = self._colour(self._step(e, faces))
            return [dr.fma(weight * value[0], value[1], t) if isinstance(value, tuple) else dr.fma(weight, value, t)
                    for t, value in zip(total, term(v_i, v_j, apex))]

        colours = [self._black for _ in range(width)]
        return self._fold(self._edge_range, self._owners[:2], body, colours, (x, apex), active) if self._edge_count else colours

    def solid_angle(self, x, active=True):
        """Sum of radiance times signed solid angle over the faces: a colour; 0 where not `active`."""
        owners = self._owners[2]

        def body(t, _, total, x):
            corners = (self._read(corner, t) - x for corner in self._triangles)
            return dr.fma(self._colour(owners.emitted(t)), triangle_solid_angle(*corners), total)

        return self._fold(self._triangle_range, [owners], body, self._black, (x,), active)

    def only_strip(self):
        return None

    def fold_patches(self, body, total, x, active=True):
        """Sum of radiance times what ``body(corners, total, x)`` adds to `total`, zero or a list of zeros, over the strips of all faces."""
        several, owners = isinstance(total, list), self._owners[3]

        def over_strip(i, _, colours, x):
            values = body(tuple(self._read(corner, i) for corner in self._strips), total, x)
            emitted = self._colour(owners.emitted(i))
            return [dr.fma(emitted, value, colour) for colour, value in zip(colours, values if several else [values])]

        colours = [self._black for _ in total] if several else [self._black]
        colours = self._fold(self._strip_range, [owners], over_strip, colours, (x,), active)
        return colours if several else colours[0]

    def _fold(self, bounds: tuple, owners: list, body, total, others: tuple, active):
        """``for i in range(*bounds): total = body(i, faces, total, *others)``; where faces emit to one side, of those i for which one of
        the masks `faces`, :py:meth:`_facing` of the owners of i, is set.

        Each lane runs on to the next such i before the body, which costs much more, is entered.
        """
        first, last = bounds
        if not self._by_face:
            active = active & self._emits_to(others[0]) if self._one_sided else active
            return fold(first, last, lambda i: i, lambda i, total, *others: body(i, None, total, *others), total, others, active)
        any_of = functools.partial(functools.reduce, operator.or_)

        def following(i, last, x):
            """One past the next i, with its masks."""
            state = i, [dr.mask_t(x[0])(False) for _ in owners]
            return dr.while_loop(state, lambda i, faces: (i < last) & ~any_of(faces), lambda i, _: (i + 1, self._facing(owners, i, x)),
                                 mode="symbolic")

        def step(i, faces, last, total, others):
            total = body(i - 1, faces, total, *others)
            return *following(i, last, others[0]), last, total, others

        last = dr.select(active, last, first)
        state = *following(first, last, others[0]), last, total, others
        return dr.while_loop(state, lambda i, faces, *_: any_of(faces), step, mode="symbolic", max_iterations=-1)[3]

    def _emits_to(self, x):
        """Mask: `x` lies on the side to which a flat light emits."""
        return dr.dot(self._measures.area, self._measures.centre - dr.detach(x)) > 0

    def _facing(self, owners: list, i, x) -> list:
        """Masks: the owners of i emit towards `x`; of an edge neither, if both do and there is nothing to tell them apart."""
        faces = [owner.face(i, x) for owner in owners]
        if len(owners) == 1 or self._radiance_attached:         # the derivatives differ even where the values do not
            return faces
        equal = _equal(*(side.emitted(i) for side in owners)) if self._equal is None else dr.gather(type(self._equal), self._equal, i)
        seam = faces[0] & faces[1] & equal
        return [face & ~seam for face in faces]

    def _step(self, e, faces) -> list:
        """By how much the radiance to the left of an edge exceeds that to the right, by channel."""
        if not self._by_face:
            return [dr.gather(self._number, steps, e) for steps in self._steps]
        left, right = ([dr.select(lit, r, 0) for r in owner.emitted(e)] for lit, owner in zip(faces, self._owners))
        return [a - b for a, b in zip(left, right)]

    def _read(self, corner, i):
        return dr.gather(self._vector, corner, i)

    def _colour(self, channels):
        channels = list(channels)
        if len(channels) == 1:
            return channels[0]
        vector = self._vector
        return getattr(sys.modules[vector.__module__], vector.__name__.replace("Array3", f"Array{len(channels)}"))(*channels)


class _Owners:
    """The faces to which edges, triangles or strips belong, by the number of the part: what they send to a point."""

    def __init__(self, owner, radiance, planes, face_count: int):
        spread = lambda tables: [dr.gather(type(table), table, owner) for table in tables]
        self._planes = planes and spread(planes)
        self.radiance = [] if callable(radiance) else spread(radiance)
        self._function = radiance if callable(radiance) else None
        self._face = dr.minimum(owner, face_count - 1) if callable(radiance) else None       # the plane of no face is turned away

    def tables(self) -> list:
        return [*self.radiance, *(self._planes or []), self._face]

    def detached(self) -> "_Owners":
        owners, function = copy.copy(self), self._function
        owners.radiance = dr.detach(self.radiance)
        owners._function = function and (lambda face: dr.detach(function(face)))
        return owners

    def face(self, i, x):
        """Mask: `x` lies on the side to which the face emits. To the last bit the same for all parts of a face."""
        x = dr.detach(x)
        n_x, n_y, n_z, height = (dr.gather(type(table), table, i) for table in self._planes)
        return dr.fma(n_x, x[0], dr.fma(n_y, x[1], n_z * x[2])) < height

    def emitted(self, i) -> list:
        """Radiance, by channel."""
        if self._function:
            return self._function(dr.gather(type(self._face), self._face, i))
        return [dr.gather(type(channel), channel, i) for channel in self.radiance]


def _equal(left: list, right: list):
    """Mask: all channels of two radiances are the same."""
    return functools.reduce(operator.and_, (dr.detach(a) == dr.detach(b) for a, b in zip(left, right)))


def triangle_solid_angle(a, b, c):
    """Signed solid angle of the triangle with corners `a`, `b`, `c` relative to the point, in steradians.

    By :py:func:`fan_solid_angle` with the longest side as edge, so that no other one is left that spans half a circle: two triangles on
    either side of such an edge have the same rounding error in it, which cancels in their sum.
    """
    u, v, w = direction(a), direction(b), direction(c)
    uv, vw, wu = dr.dot(u, v), dr.dot(v, w), dr.dot(w, u)
    second, third = (vw < uv) & (vw <= wu), (wu < uv) & (wu < vw)
    pick = lambda p, q, r: dr.select(second, q, dr.select(third, r, p))
    return fan_solid_angle(pick(w, u, v), edge_frame(pick(a, b, c), pick(b, c, a)))


def project_mesh(vertices, faces, radiance, x, order: int, method: str = "auto", *, one_sided: bool = False, max_error=None) -> list:
    """Project a light of many faces, each with its own radiance, to spherical harmonics as seen from `x`.

    ``sum_f r_f int_{Q_f} Y_lm(omega) d omega``: :py:func:`mi_shlight.project_polygon` summed over the faces times their radiance, but
    each edge that two faces share is integrated once, with the difference of their radiances, and not at all where they are equal.
    Faces do not occlude each other.

    Parameters
    ----------
    vertices : V points
        (V, 3) NumPy array, Dr.Jit or Mitsuba 3-vector of width V, flat Dr.Jit float of width 3 V (``vertex_positions_buffer()`` of a
        Mitsuba mesh), or a list of V single 3-vectors.
    faces : (F, K) integer array or list of F lists
        Polygons as indices of three or more vertices, convex or not. A face is positive where its corners run counter-clockwise as seen
        from outside the unit sphere about `x`: on the side to which the normal of a Mitsuba mesh points it is negative,
        ``faces[:, ::-1]`` turns it round. Only edges between the same two indices are shared: merge coincident vertices first. Edges with
        any number of faces, open and closed meshes, and faces turned either way are allowed.
    radiance : (F,) or (F, 3) floats
        Of each face, any sign: NumPy array or list; or a Dr.Jit float, or 3-vector, of width F.
    x : 3-vector
        Shading point, single or wide, in the units of `vertices`.
    order : int
        Highest degree, 0 to 64.
    method, max_error
        As in :py:func:`mi_shlight.project_polygon`; ``auto`` takes one method for the whole mesh at each point.
    one_sided : bool
        If True, points where a face would count as negative get nothing from it.

    Returns
    -------
    list of (order + 1)**2 floats, or of 3-vectors of the three channels, in units of `radiance` times steradian; sign and index of
    :py:func:`mi_shlight.sh_basis`, type by the arguments.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, shape or range, or a face names a vertex that does not exist.
    RuntimeError
        Inside a symbolic loop or call of Dr.Jit. Build a :py:class:`mi_shlight.light.mesh.MeshLight` before it, and call
        ``project_mesh_light`` or ``mesh_shader`` inside.

    Notes
    -----
    Relative error of ``edge``: about 2 eps times the root of the sum of squares of all edges' angles over the light's solid angle, and not
    below 1e-6 in float32 and 1e-15 in float64; of ``quadrature`` as there. ``auto`` keeps to `max_error` where the whole mesh is seen
    under less than about 1 rad; closer it is ``edge``, which loses digits of a light that is seen edge-on.

    Limits: those of :py:func:`mi_shlight.project_polygon` for each face; a point in the plane of a one-sided face is not lit by it, and
    within rounding of that plane either side may be taken. A vertex that is infinite or NaN makes all coefficients NaN, and so does `x`
    in its lane.

    Differentiable by Dr.Jit's autodiff with respect to vertices, radiance and point. Radiance with derivatives keeps all edges.

    Kernels do not grow with the mesh. Each call finds the shared edges anew, which takes some microseconds per face. If there is no Dr.Jit
    type among the arguments the faces are projected one by one.
    """
    name = "project_mesh"
    n = check_order(name, order)
    check_choice(name, "method", method, METHODS)
    positions, faces, radiance, x = _mesh_arguments(name, vertices, faces, radiance, x)
    if not isinstance(one_sided, bool):
        raise TypeError(message(name, "one_sided", "be True or False", one_sided))
    max_error = error_argument(name, max_error, x)
    if dr.flag(dr.JitFlag.SymbolicScope):
        raise RuntimeError(f"{name}(): must be called outside of symbolic loops and calls, as it evaluates the mesh. "
                           "Build a MeshLight before the loop and call project_mesh_light() inside.")
    if not dr.is_jit_v(x):
        return _project_scalar(positions, faces, radiance, x, n, method, one_sided, max_error)
    coeffs = project_mesh_light(MeshLight(positions, mesh_topology(faces), radiance, one_sided), x, n, method, max_error)
    finite = all_finite(x) & dr.all(dr.isfinite(positions))
    coeffs = [dr.select(finite, c, dr.nan) for c in coeffs]
    if dr.width(coeffs) == 1:
        dr.schedule(coeffs)                           # reading them one by one would launch one kernel each
    return coeffs


def _project_scalar(vertices: list, faces: list, radiance: np.ndarray, x, order: int, method: str, one_sided: bool, max_error) -> list:
    """:py:func:`project_mesh` in Python floats: the sum over the faces."""
    total = np.zeros(((order + 1) ** 2, radiance.shape[1]))
    for face, emitted in zip(faces, radiance):
        coeffs = project_polygon([vertices[k] for k in face], x, order, method, max_error=max_error)
        if not (one_sided and coeffs[0] < 0):
            total += np.outer(coeffs, emitted)
    return [row[0] if len(row) == 1 else type(x)(*row) for row in total.tolist()]


def project_mesh_light(light: MeshLight, x, order: int, method: str = "auto", max_error=None) -> list:
    """:py:func:`project_mesh` of a prepared light, without checks: list of colours."""
    max_error = default_error(x) if max_error is None else max_error

    def boundary(light, point, method, active=True):
        apex, outside = light.apex(point[0])
        coeffs = boundary_form(method, order)[0](light, *point, apex, order, active)
        return [dr.fma(light.solid_angle(*point, ~outside & active), MONOPOLE, coeffs[0]), *coeffs[1:]]

    cubature = lambda light, point, active: project_quadrature(light, *point, order, max_error, active)
    return _by_method(light, (x,), order, method, max_error, boundary, cubature)


def mesh_shader(transfer: list, order: int, method: str = "auto", max_error=None):
    """Function ``shade(light, x)`` that gives ``sum_lm T_lm L_lm`` of a :py:class:`MeshLight`: a colour.

    The counterpart of :py:func:`mi_shlight.light.project.light_shader`; each edge costs one dot product, whatever the number of channels.
    """
    max_error = default_error(transfer[0]) if max_error is None else max_error
    over_area = quadrature_shader(transfer, order, max_error)

    def boundary(light, point, method, active=True):
        apex, outside = light.apex(point[0])
        over_edges = boundary_form(method, order)[1](transfer, order)
        return [dr.fma(light.solid_angle(*point, ~outside & active), transfer[0] * MONOPOLE, over_edges(light, *point, apex, active))]

    cubature = lambda light, point, active: [over_area(light, *point, active)]
    return lambda light, x: _by_method(light, (x,), order, method, max_error, boundary, cubature)[0]


def zonal_mesh_shader(weights: list, method: str = "auto"):
    """Function ``shade(light, x, axis)`` that gives ``sum_l weights_l S_l`` about the unit vector `axis` of a :py:class:`MeshLight`.

    The counterpart of :py:func:`mi_shlight.light.zonal.zonal_light_shader`; `method`: ``auto`` or ``edge``. `axis` may carry derivatives.
    """
    order = len(weights) - 1

    def boundary(light, point, method, active=True):
        x, axis = point
        apex, outside = light.apex(x)
        over_edges = zonal_shader(axis, weights)(light, x, apex, active)
        return [dr.fma(light.solid_angle(x, ~outside & active), weights[0], over_edges)]

    def cubature(light, point, active):
        x, axis = point

        def add(total, omega, solid_angle):
            value = sum(w * p for w, p in zip(weights, legendre_p(dr.dot(axis, omega), order)))
            return dr.fma(solid_angle, value, total)

        return [integrate(light, x, order, default_error(x), add, type(x[0])(0), active)]

    return lambda light, x, axis: _by_method(light, (x, axis), order, method, default_error(x), boundary, cubature)[0]


def _by_method(light, point: tuple, order: int, method: str, max_error: float, boundary, cubature) -> list:
    """``boundary(light, point, method, active)`` or ``cubature(light, point, active)``, or by ``auto`` for each lane one of the two.

    `point`: the shading point and what else belongs to it. Derivatives are those of the boundary form that ``auto`` takes.
    """
    if light.grad_enabled() or dr.grad_enabled(point):
        values = _by_method(light.detached(), dr.detach(point), order, method, max_error, boundary, cubature)
        return [dr.replace_grad(value, slope) for value, slope in zip(values, boundary(light, point, "auto"))]
    if method == "quadrature":
        return cubature(light, point, True)
    if method != "auto":
        return boundary(light, point, method)
    few = light.prefers_cubature(point[0], order, max_error)
    return [a + b for a, b in zip(boundary(light, point, method, ~few), cubature(light, point, few))]


def _mesh_arguments(function: str, vertices, faces, radiance, x) -> tuple:
    """(positions, faces, radiance, x) of one common type, as :py:class:`MeshLight` and :py:func:`mesh_topology` take them."""
    given = {"x": x}
    if isinstance(vertices, np.ndarray):
        if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
            raise TypeError(message(function, "vertices", "be an array (V, 3) of numbers", vertices))
    elif dr.is_array_v(vertices) and dr.is_float_v(vertices) and dr.depth_v(vertices) == 1 and dr.is_dynamic_v(vertices):
        if dr.width(vertices) % 3:
            raise ValueError(message(function, "vertices", "have three numbers for each vertex", vertices))
        given["vertices"] = dr.unravel(array3(type(vertices)), vertices)
    else:
        given["vertices"] = list(vertices) if isinstance(vertices, tuple) else vertices
    wide = dr.is_jit_v(radiance)
    if wide:
        single = dr.depth_v(radiance) == 1
        given["radiance"] = (radiance, radiance, radiance) if single else radiance
    given = dict(zip(given, vectors3(function, **given)))
    x, points = given["x"], given.get("vertices", vertices)
    number, jit = type(x[0]), dr.is_jit_v(x)
    if isinstance(points, np.ndarray):
        count, positions = len(points), number(points.ravel()) if jit else [type(x)(*row) for row in points.tolist()]
    elif isinstance(points, list):
        if jit and max(map(dr.width, points)) > 1:
            raise ValueError(message(function, "vertices", "be single points if they are a list", vertices, "Or pass one wide 3-vector."))
        count, positions = len(points), dr.concat([c for v in points for c in v]) if jit else points
    else:
        count, positions = dr.width(points), dr.ravel(points)
    faces = _checked_faces(function, faces, count)
    if wide:
        radiance = list(given["radiance"])[:1 if single else 3]
        if max(map(dr.width, radiance)) != len(faces):
            raise ValueError(message(function, "radiance", f"have the width {len(faces)}, one value for each face", radiance))
        radiance = [r + dr.zeros(number, len(faces)) for r in radiance]
    else:
        radiance = _checked_table(function, radiance, len(faces))
    if not jit:
        return positions, faces, radiance, x
    return positions * SCALE, faces, radiance, not_literal(x) * SCALE


def _checked_faces(function: str, faces, vertex_count: int) -> list:
    """`faces` as a list of integer arrays."""
    rule, hint = "be integer vertex indices, three or more for each face", "Example: [[0, 1, 2], [0, 2, 3]]."
    try:
        faces = [np.asarray(face) for face in faces]
    except (TypeError, ValueError):
        faces = []
    if not faces or any(face.ndim != 1 or len(face) < 3 or face.dtype.kind not in "iu" for face in faces):
        raise TypeError(message(function, "faces", rule, faces, hint))
    flat = np.concatenate(faces)
    if flat.min() < 0 or flat.max() >= vertex_count:
        wrong = flat[(flat < 0) | (flat >= vertex_count)][0]
        raise ValueError(message(function, "faces", f"name vertices from 0 to {vertex_count - 1}", int(wrong)))
    return [face.astype(np.int64) for face in faces]


def _checked_table(function: str, radiance, face_count: int) -> np.ndarray:
    """Radiance known on the host as (F, C) array."""
    rule = f"be {face_count} finite numbers or triples, one for each face"
    if isinstance(radiance, (list, tuple)) and any(dr.is_array_v(r) for r in radiance):
        raise TypeError(message(function, "radiance", rule, radiance, "Or one Dr.Jit float or 3-vector of that width."))
    try:
        table = np.asarray(radiance, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(message(function, "radiance", rule, radiance)) from None
    if table.shape not in ((face_count,), (face_count, 3)) or not np.isfinite(table).all():
        raise ValueError(message(function, "radiance", rule, radiance))
    return table.reshape(face_count, -1)
