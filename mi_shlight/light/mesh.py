"""Lights of many faces: meshes, and textured lights cut into pieces of constant radiance.

With radiance ``r_f`` on face f the coefficients are ``sum_f r_f L_lm(f)``. Closed forms integrate along the border of each face, once in
either direction along an edge that two faces share, so that for l >= 1

    sum_f r_f L_lm(f) = sum_e (r_left - r_right) E_lm(e) ,                                                                  (1)

left and right the faces that run along edge e from start to end and back, E_lm the integral of :py:mod:`mi_shlight.light.edge_frame`. Each
edge is integrated once, those between equal radiances not at all. A face that emits on one side only is left out of (1) where it is turned
away: between equal faces of a closed mesh there remains the outline that the point sees.

So is L_00 = solid angle / sqrt(4 pi), by fans from one apex (:py:func:`mi_shlight.light.polygon.fan_solid_angle`), provided that no face
covers the opposite of the apex. For a point inside the mesh there may be no such apex; there the solid angles are summed face by face.
"""
from __future__ import annotations

import functools
import operator
from typing import NamedTuple

import drjit as dr
import numpy as np

from ..arrays import array3, vectors3
from ..errors import check_choice, message
from ..sh.basis import check_order
from .arguments import SCALE, all_finite, error_argument, not_literal
from .edge_frame import MONOPOLE
from .polygon import direction, edge_frame, fan_solid_angle, fold, largest_component, power_of_two_scale, strip_corners, strip_count
from .project import METHODS, boundary_form, default_error, project_polygon
from .quadrature import node_limits, project_quadrature, quadrature_shader


class Topology(NamedTuple):
    """Faces as index tables, from :py:func:`mesh_topology`."""

    edges: np.ndarray
    """(E, 4): start, end, left face, right face; the number of faces stands for none."""
    triangles: np.ndarray
    """(T, 4): three corners, face. Together they fill the faces, with sign where a face is not convex."""
    strips: np.ndarray
    """(S, 5): four corners, face; as :py:meth:`mi_shlight.light.polygon.VertexList.fold_patches`."""
    first: np.ndarray
    """(F,): a corner of each face."""


def mesh_topology(faces: list) -> Topology:
    """Edges and parts of `faces`, a list of integer arrays of three or more vertex indices.

    Each edge is listed once, however many faces share it, as long as every face that runs along it one way finds one that runs back;
    otherwise, in meshes that are not consistently oriented, it stands there several times.
    """
    counts = np.array([len(face) for face in faces])
    directed, triangles, strips = [], [], []
    for n in np.unique(counts):
        owner = np.flatnonzero(counts == n)
        corners = np.array([faces[f] for f in owner])

        def rows(*columns, corners=corners, owner=owner):
            return np.column_stack([corners[:, k] for k in columns] + [owner])

        directed += [rows(k, (k + 1) % n) for k in range(n)]
        triangles += [rows(0, k, k + 1) for k in range(1, n - 1)]
        strips += [rows(*strip_corners(k, n)) for k in range(strip_count(n))]
    directed, triangles, strips = (np.concatenate(part) for part in (directed, triangles, strips))
    triangles, strips = (part[np.argsort(part[:, -1], kind="stable")] for part in (triangles, strips))
    start, end, owner = directed[directed[:, 0] != directed[:, 1]].T
    back = start > end
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((owner, back, high, low))
    low, high, back, owner = low[order], high[order], back[order], owner[order]
    _, first, group = np.unique(np.column_stack([low, high, back]), axis=0, return_index=True, return_inverse=True)
    rank = np.arange(len(low)) - first[group.reshape(-1)]       # among the faces that run along the edge the same way
    slots, slot = np.unique(np.column_stack([low, high, rank]), axis=0, return_inverse=True)
    sides = np.full((len(slots), 2), len(faces))
    sides[slot.reshape(-1), back.astype(int)] = owner
    return Topology(np.column_stack([slots[:, :2], sides]), triangles, strips, np.array([face[0] for face in faces]))


class MeshLight:
    """A light of many faces in flat tables, ready for kernels of a size that does not depend on their number.

    To the coefficient methods it is a light as :py:class:`~mi_shlight.light.polygon.EdgeBuffer`, except that sums come as *colours*:
    floats if the radiance has one channel, 3-vectors if it has three.

    Parameters
    ----------
    positions : Dr.Jit float of width 3 V
        x, y, z of the vertices.
    topology : Topology
    radiance : ndarray (F, C), or list of C Dr.Jit floats of width F
        Of an array, edges between equal radiances are dropped, unless the light is one-sided.
    one_sided : bool
        True if a face emits only to points from which its solid angle is positive.
    """

    def __init__(self, positions, topology: Topology, radiance, one_sided: bool = False):
        self._number = type(positions)
        self._vector, self._index = array3(self._number), dr.uint32_array_t(self._number)
        self._one_sided = one_sided
        edges = topology.edges
        if isinstance(radiance, np.ndarray):
            radiance = np.pad(radiance, ((0, 1), (0, 0)))                   # black: the face that stands for none
            if not one_sided:
                edges = edges[(radiance[edges[:, 2]] != radiance[edges[:, 3]]).any(axis=1)]
            radiance = [self._number(channel) for channel in radiance.T]
        else:
            radiance = [dr.concat([channel, dr.zeros(self._number)]) for channel in radiance]
        self._black = self._colour(self._number(0) for _ in radiance)
        self._edge_count = len(edges)
        self._edge_end, self._triangle_end, self._strip_end = (dr.opaque(self._index, len(rows))
                                                               for rows in (edges, topology.triangles, topology.strips))
        (*edges, left, right), (*triangles, triangle_owner), (*strips, strip_owner) = (
            [self._index(column) for column in rows.T] for rows in (edges, topology.triangles, topology.strips))
        # The parts have copies of their vertices. That is faster to read, and Dr.Jit 1.5.0 gets reverse-mode derivatives wrong of a flat
        # buffer that is gathered as vectors both inside and outside of symbolic loops.
        vertices = dr.unravel(self._vector, positions)
        self._edges, self._triangles, self._strips = ([dr.gather(self._vector, vertices, corner) for corner in corners]
                                                      for corners in (edges, triangles, strips))
        planes = self._measure(dr.detach(vertices), self._index(np.append(topology.first, 0)), triangle_owner)
        owners = [_Owners(owner, radiance, planes if one_sided else None) for owner in (left, right, triangle_owner, strip_owner)]
        self._left, self._right, self._triangle_owners, self._strip_owners = owners
        self._steps = [a - b for a, b in zip(self._left.radiance, self._right.radiance)]
        dr.eval(self._edges, self._triangles, self._strips, self._steps, [part.tables() for part in owners])

    def _measure(self, vertices, first, triangle_owner) -> list:
        """Measure the light as a whole; gives the planes of the faces as tables ``n_x, n_y, n_z, n . corner``. Without derivatives."""
        self._scale = power_of_two_scale(dr.max(largest_component(vertices)))         # keeps squares and areas in range
        a, b, c = (dr.detach(corner) * self._scale for corner in self._triangles)
        area = dr.zeros(self._vector, dr.width(first))
        dr.scatter_add(area, dr.cross(b - a, c - a) * 0.5, triangle_owner)
        self._area = dr.sum(area, axis=1)
        self._bent = (dr.sum(dr.norm(area)) - dr.norm(self._area)) * 0.25
        self._edge_length = self._number(0)
        if self._edge_count:
            start, end = (dr.detach(vertex) * self._scale for vertex in self._edges)
            self._edge_length = dr.sqrt(dr.sum(dr.squared_norm(end - start)))
        axes = [self._vector(1, 0, 0), self._vector(0, 1, 0), self._vector(0, 0, 1), direction(self._area)]
        heights = [dr.dot(axis, vertices) for axis in axes]
        self._slabs = [(axis, dr.min(height), dr.max(height)) for axis, height in zip(axes, heights)]
        low, high = (self._vector(*(slab[k] for slab in self._slabs[:3])) for k in (1, 2))
        self._centre, self._radius = low * 0.5 + high * 0.5, dr.norm(high * self._scale - low * self._scale) * 0.5
        normals = direction(area)
        planes = [*normals, dr.dot(normals, dr.gather(self._vector, vertices, first))]
        dr.eval(self._scale, self._area, self._bent, self._slabs, self._centre, self._radius, self._edge_length, planes)
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
        for axis, low, high in self._slabs:
            height = dr.dot(axis, x)
            before, behind = height < low, height > high
            into = dr.select(before, axis, dr.select(behind, -axis, into))
            outside = outside | before | behind
        return dr.select(outside, direction(direction(self._centre - x) + into), 0), outside

    def prefers_cubature(self, x, order: int, max_error: float):
        """Mask: where method ``auto`` takes the cubature in place of the edge form.

        For accuracy alone, as even one point takes longer than a face's share of the edges. The rounding errors of the edges are
        independent: together about 2 eps times the root of the sum of their squared angles, measured with meshes of 8 to 512
        triangles. The solid angle is that of the light's vector area, and, if it is one-sided, of a quarter of the area that cancels
        in it. Only where there are nodes enough for an angle as large as the whole light: close to it the edge form stays, grazing or not.
        """
        towards = (self._centre - dr.detach(x)) * self._scale
        distance = dr.norm(towards)
        seen = dr.dot(self._area, towards) / distance
        seen = self._bent + dr.maximum(seen, 0) if self._one_sided else abs(seen)
        angle = min(node_limits(order, max_error)[-1], 1)
        return (2 * self._radius < angle * distance) & (2 * dr.epsilon(x) * self._edge_length * distance > max_error * seen)

    def sum(self, term, x, apex, width: int, active=True) -> list:
        """Sum of ``term(v_i, v_j, apex)`` over the edges, weighted as in (1): list of `width` colours; 0 where not `active`."""
        def body(e, total, x, apex):
            v_i, v_j = (self._read(end, e) - x for end in self._edges)
            weight = self._colour(self._step(e, x))
            return [dr.fma(weight, value, t) for t, value in zip(total, term(v_i, v_j, apex))]

        differ = lambda e, x: self._left.differ(self._right, e, x)
        colours = [self._black for _ in range(width)]
        return self._fold(self._edge_end, differ, body, colours, (x, apex), active) if self._edge_count else colours

    def solid_angle(self, x, active=True):
        """Sum of radiance times signed solid angle over the faces: a colour; 0 where not `active`."""
        def body(t, total, x):
            corners = (self._read(corner, t) - x for corner in self._triangles)
            return dr.fma(self._colour(self._triangle_owners.emitted(t, x)), triangle_solid_angle(*corners), total)

        return self._fold(self._triangle_end, self._triangle_owners.face, body, self._black, (x,), active)

    def only_strip(self):
        return None

    def fold_patches(self, body, total, x, active=True):
        """Sum of radiance times what ``body(corners, total, x)`` adds to `total`, zero or a list of zeros, over the strips of all faces."""
        several = isinstance(total, list)

        def over_strip(i, colours, x):
            values = body(tuple(self._read(corner, i) for corner in self._strips), total, x)
            emitted = self._colour(self._strip_owners.emitted(i, x))
            return [dr.fma(emitted, value, colour) for colour, value in zip(colours, values if several else [values])]

        colours = [self._black for _ in total] if several else [self._black]
        colours = self._fold(self._strip_end, self._strip_owners.face, over_strip, colours, (x,), active)
        return colours if several else colours[0]

    def _fold(self, last, wanted, body, total, others: tuple, active):
        """``for i in range(last): total = body(i, total, *others)``; of a one-sided light only i that are ``wanted(i, x)``.

        Each lane runs on to the next i that it wants before the body, which costs much more, is entered.
        """
        if not self._one_sided:
            return fold(self._index(0), last, lambda i: i, body, total, others, active)

        def following(i, last, x):
            searching = lambda i: (i < last) & ~wanted(dr.minimum(i, last - 1), x)      # reads even where i is past the end
            return dr.while_loop((i,), searching, lambda i: (i + 1,), mode="symbolic")[0]

        def step(i, last, total, others):
            total = body(i, total, *others)
            return following(i + 1, last, others[0]), last, total, others

        last = dr.select(active, last, 0)
        state = following(self._index(0), last, others[0]), last, total, others
        return dr.while_loop(state, lambda i, last, *_: i < last, step, mode="symbolic", max_iterations=-1)[2]

    def _step(self, e, x) -> list:
        """By how much the radiance to the left of an edge exceeds that to the right, by channel."""
        if self._one_sided:
            return [a - b for a, b in zip(self._left.emitted(e, x), self._right.emitted(e, x))]
        return [dr.gather(self._number, steps, e) for steps in self._steps]

    def _read(self, corner, i):
        return dr.gather(self._vector, corner, i)

    def _colour(self, channels):
        channels = list(channels)
        return channels[0] if len(channels) == 1 else self._vector(*channels)


class _Owners:
    """The faces to which edges, triangles or strips belong, by the number of the part: what they send to a point."""

    def __init__(self, owner, radiance: list, planes):
        spread = lambda tables: [dr.gather(type(table), table, owner) for table in tables]
        self.radiance, self._planes = spread(radiance), planes and spread(planes)
        self._attached = dr.grad_enabled(self.radiance)

    def tables(self) -> list:
        return [*self.radiance, *(self._planes or [])]

    def face(self, i, x):
        """Mask: `x` lies on the side to which the face emits. To the last bit the same for all parts of a face."""
        x = dr.detach(x)
        n_x, n_y, n_z, height = (dr.gather(type(table), table, i) for table in self._planes)
        return dr.fma(n_x, x[0], dr.fma(n_y, x[1], n_z * x[2])) < height

    def emitted(self, i, x) -> list:
        """Radiance towards `x`, by channel."""
        radiance = [dr.gather(type(channel), channel, i) for channel in self.radiance]
        return [dr.select(self.face(i, x), r, 0) for r in radiance] if self._planes else radiance

    def differ(self, other, i, x):
        """Mask: the two do not send the same. If the radiance has derivatives, which differ even then: one of them faces `x`."""
        if self._attached:
            return self.face(i, x) | other.face(i, x)
        return functools.reduce(operator.or_, (a != b for a, b in zip(self.emitted(i, x), other.emitted(i, x))))


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

    def boundary(active):
        apex, outside = light.apex(x)
        coeffs = boundary_form(method, order)[0](light, x, apex, order, active)
        return [dr.fma(light.solid_angle(x, ~outside & active), MONOPOLE, coeffs[0]), *coeffs[1:]]

    cubature = lambda active: project_quadrature(light, x, order, max_error, active)
    return _by_method(light, x, order, method, max_error, boundary, cubature)


def mesh_shader(transfer: list, order: int, method: str = "auto", max_error=None):
    """Function ``shade(light, x)`` that gives ``sum_lm T_lm L_lm`` of a :py:class:`MeshLight`: a colour.

    The counterpart of :py:func:`mi_shlight.light.project.light_shader`; each edge costs one dot product, whatever the number of channels.
    """
    max_error = default_error(transfer[0]) if max_error is None else max_error
    over_edges = boundary_form(method, order)[1](transfer, order)
    over_area = quadrature_shader(transfer, order, max_error)

    def shade(light, x):
        def boundary(active):
            apex, outside = light.apex(x)
            return [dr.fma(light.solid_angle(x, ~outside & active), transfer[0] * MONOPOLE, over_edges(light, x, apex, active))]

        return _by_method(light, x, order, method, max_error, boundary, lambda active: [over_area(light, x, active)])[0]

    return shade


def _by_method(light, x, order: int, method: str, max_error: float, boundary, cubature) -> list:
    """``boundary(active)`` or ``cubature(active)``, or by ``auto`` at each point one of the two."""
    if method == "quadrature":
        return cubature(True)
    if method != "auto":
        return boundary(True)
    few = light.prefers_cubature(x, order, max_error)
    return [a + b for a, b in zip(boundary(~few), cubature(few))]


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
