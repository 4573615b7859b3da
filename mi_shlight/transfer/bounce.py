"""Diffuse interreflection between the baked points of a scene.

Light that a surface of reflectance 1 would send from a baked point, for the light that comes from other surfaces, is a mean over
cosine-distributed rays: ``E(p) = 1/M sum_k rho(q_k) E(q_k)``, with q_k the surface that ray k meets. Each ray of a baked point ends between
three others; one of them, drawn with its barycentric weight, stands for the hit. What is left of the scene is a table of point numbers:
a matrix whose rows sum to one or less, so no bounce gains energy, whatever the noise. Nothing in it depends on lights or colours.

The series over the bounces is summed with the present reflectances, either of the light at the points itself, which is exact for lights
at any distance, or of the transfer vectors ([G03] interreflected diffuse transfer), which takes lights for equal as seen from both
ends of a ray.
"""
from __future__ import annotations

from typing import NamedTuple

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import message
from ..scene import aligned, mesh_arrays, shape_index
from .bake import ROWS_PER_LAUNCH
from .mesh import contacts, refine
from .visibility import GOLDEN, lifted

REFLECTANCE_SAMPLES = 16
"""Points of the cells around a baked point over which its reflectance is averaged."""

MAX_BOUNCES = 256
"""Where a series ends that is to be summed up to a tolerance."""

CHANNELS_PER_LAUNCH = 32

ROOT_2 = 0.41421356


class BakedPoints:
    """The points of a bake as emitters and receivers of bounced light: positions, normals, and the surface around each.

    Parameters
    ----------
    transfer : Transfer
        Whose rows are meant.
    lit : list of Receiver
        Receivers of a scene for which :py:meth:`Transfer.check` passes.

    Attributes
    ----------
    count : int
        Rows R of the bake, or 1 if there are none.
    positions, normals : mi.Point3f, mi.Normal3f
        World space, without derivatives; normals of back rows point to the back.
    meshes : list of (int, BakeMesh)
        First row of each side of each mesh, and its points.
    """

    DRJIT_STRUCT = dict.fromkeys(("positions", "normals", "_shape", "_side", "_faces", "_uv"), object)

    def __init__(self, transfer, lit: list):
        self.count = count = max(transfer.coeffs.shape[1], 1)       # in a scene without meshes one that nothing meets
        blocks = {block.content: block for block in transfer.meshes}
        positions, normals = np.zeros((count, 3), np.float32), np.tile(np.float32([0, 0, 1]), (count, 1))
        shape, side = np.zeros(count, np.uint32), np.ones(count, np.float32)
        faces = np.zeros((REFLECTANCE_SAMPLES, count), np.uint32)
        uv = np.zeros((2, REFLECTANCE_SAMPLES, count), np.float32)
        self.meshes = []
        for receiver in lit:
            block = blocks.get(receiver.content) if receiver.baked else None
            if block is None:
                continue
            triangles, vertices, vertex_normals, winding = mesh_arrays(receiver.shape)
            mesh = refine(triangles, vertices, vertex_normals, transfer.max_edge, winding)
            around = _points_around(mesh, triangles, vertices)
            for sign, first in list(zip((1, -1), (block.first_row, block.first_row + block.row_count)))[:1 + block.two_sided]:
                rows = slice(first, first + block.row_count)
                positions[rows], normals[rows] = mesh.positions, sign * mesh.normals
                shape[rows], side[rows] = shape_index(receiver.shape), sign
                faces[:, rows], uv[:, :, rows] = around
                self.meshes.append((first, mesh))
        flat = lambda kind, rows: dr.gather(kind, aligned(mi.Float, rows.ravel()), dr.arange(mi.UInt32, count))
        self.positions, self.normals = flat(mi.Point3f, positions), flat(mi.Normal3f, normals)
        self._shape, self._side, self._faces = aligned(mi.UInt32, shape), aligned(mi.Float, side), aligned(mi.UInt32, faces.ravel())
        self._uv = aligned(mi.Float, np.moveaxis(uv, 0, -1).ravel())
        dr.eval(self.positions, self.normals)

    def reflectance(self, rows, wavelengths, share=None):
        """Diffuse reflectance around baked points as it is now, with its derivatives; unpolarised spectrum.

        Mean over stratified points of the surrounding cells, weighted as interpolation weighs the baked point there.

        Parameters
        ----------
        rows : UInt32
            Numbers of the points.
        wavelengths
            In nm, as a ray carries them.
        share : function, optional
            ``share(shape, back_side, active)``: part of the reflectance of a BSDF that is diffuse.
        """
        kind = type(mi.unpolarized_spectrum(mi.Spectrum(0)))
        stride = dr.opaque(mi.UInt32, self.count)

        def body(s, total, rows, wavelengths):
            at = s * stride + rows
            pi = dr.zeros(mi.PreliminaryIntersection3f)
            pi.valid, pi.t, pi.shape = True, 0, dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, self._shape, rows))
            pi.prim_index, pi.prim_uv = dr.gather(mi.UInt32, self._faces, at), dr.gather(mi.Point2f, self._uv, at)
            ray = dr.zeros(mi.Ray3f)
            ray.wavelengths = wavelengths
            si = pi.compute_surface_interaction(ray)
            si.wi = mi.Vector3f(0, 0, dr.gather(mi.Float, self._side, rows))
            value = mi.unpolarized_spectrum(si.bsdf().eval_diffuse_reflectance(si))
            if share:
                value *= share(si.shape, si.wi.z < 0, True)
            return s + 1, total + value, rows, wavelengths

        state = mi.UInt32(0), kind(0), rows, wavelengths
        total = dr.while_loop(state, lambda s, *_: s < REFLECTANCE_SAMPLES, body, mode="symbolic", max_iterations=-1)[1]
        return total / REFLECTANCE_SAMPLES


class Gather:
    """The table of hits as a linear operator on values of the baked points.

    Attributes
    ----------
    table : UInt32
        Row that ray k of row r meets, at ``k * count + r``; `count` where it meets nothing that reflects.
    stand_in : UInt32
        For each row the one whose values it shows: another one inside bodies and behind walls.
    count, samples : int
        Rows R and rays per row M. The table takes ``4 R M`` bytes.
    """

    DRJIT_STRUCT = dict.fromkeys(("table", "stand_in", "_count", "_samples"), object)

    def __init__(self, table, stand_in, samples: int):
        self.table, self.stand_in, self.count, self.samples = table, stand_in, len(stand_in), samples
        self._count, self._samples = dr.opaque(mi.UInt32, self.count), dr.opaque(mi.UInt32, samples)     # one kernel for all scenes

    def apply(self, field, channels: int = 1):
        """Mean of `field` over the hits of each row; rays that meet nothing count as zero.

        Parameters
        ----------
        field : Float
            ``count * channels`` values, the channels of a row one after the other; any unit.

        Returns
        -------
        Float like `field`. Derivatives in forward and reverse mode, any number of times in a row.
        """
        return dr.custom(_Apply, field, self._pull, self._push, channels)

    def _pull(self, field, channels: int):
        """``out[r] = 1/M sum_k field[table[k, r]]``."""
        out = dr.zeros(mi.Float, self.count * channels)
        row = dr.arange(mi.UInt32, self.count)
        for first in range(0, channels, CHANNELS_PER_LAUNCH):
            means = self._pull_some(field, row, channels, first)
            for c, mean in enumerate(means):
                dr.scatter(out, mean, row * channels + (first + c), mode=dr.ReduceMode.Permute)
            dr.eval(out)
        return out

    def _pull_some(self, field, row, channels: int, first: int) -> list:
        def body(k, totals, row):
            hit = dr.gather(mi.UInt32, self.table, k * self._count + row)
            met = hit < self._count
            start = hit * channels + first
            return k + 1, [t + dr.gather(mi.Float, field, start + c, met) for c, t in enumerate(totals)], row

        totals = [mi.Float(0) for _ in range(min(CHANNELS_PER_LAUNCH, channels - first))]
        totals = dr.while_loop((mi.UInt32(0), totals, row), lambda k, *_: k < self._samples, body, mode="symbolic")[1]
        return [t / self._samples for t in totals]

    def _push(self, field, channels: int):
        """The transpose of :py:meth:`_pull`."""
        out = dr.zeros(mi.Float, self.count * channels)
        row = dr.arange(mi.UInt32, self.count)
        for first in range(0, channels, CHANNELS_PER_LAUNCH):
            self._push_some(out, field / self._samples, row, channels, first)
        return out

    def _push_some(self, out, field, row, channels: int, first: int) -> None:
        values = [dr.gather(mi.Float, field, row * channels + first + c) for c in range(min(CHANNELS_PER_LAUNCH, channels - first))]

        def body(k, values, row):
            hit = dr.gather(mi.UInt32, self.table, k * self._count + row)
            for c, value in enumerate(values):
                dr.scatter_add(out, value, hit * channels + first + c, hit < self._count)
            return k + 1, values, row

        dr.while_loop((mi.UInt32(0), values, row), lambda k, *_: k < self._samples, body, mode="symbolic")
        dr.eval(out)


class _Apply(dr.CustomOp):
    """Its adjoint is the transpose of the table: autodiff would hold all R M gathered values."""

    def eval(self, field, pull, push, channels):
        self.pull, self.push, self.channels = pull, push, channels
        return pull(field, channels)

    def forward(self):
        self.set_grad_out(self.pull(self.grad_in("field"), self.channels))

    def backward(self):
        self.set_grad_in("field", self.push(self.grad_out(), self.channels))

    def name(self):
        return "gather_bounce"


def trace_bounces(scene, lookup, points: BakedPoints, samples: int, progress=None) -> Gather:
    """Trace `samples` cosine-distributed rays from each baked point to the baked points around their ends.

    Parameters
    ----------
    scene : mi.Scene
        Every shape of it blocks; those without baked points, and backs of one-sided surfaces, are black.
    lookup : TransferLookup
        From hits to rows.
    samples : int
        Rays per point, stratified; each point has its own shift of the set. The noise of bounced light falls like 1/sqrt(samples)
        or faster.
    progress : callable, optional
        Called with (points done, points in all).

    Raises
    ------
    ValueError
        If the table would have 2^32 entries or more.

    Notes
    -----
    Points within bodies or behind walls, more of whose rays end on backs than on fronts, are seen through interpolation only. A neighbour
    that is not stands in for them, as :py:func:`mi_shlight.transfer.mesh.spread_to_buried` does for the transfer.
    """
    if points.count * samples >= 2 ** 32:
        raise ValueError(message("trace_bounces", "samples", "leave less than 2^32 rays to store", samples,
                                 f"There are {points.count} baked points. Choose fewer samples, or a longer max_edge."))
    count = dr.opaque(mi.UInt32, points.count)
    table = dr.full(mi.UInt32, points.count, points.count * samples)
    sealed = dr.ones(mi.UInt32, points.count)
    with dr.suspend_grad():
        for begin in range(0, points.count, ROWS_PER_LAUNCH):
            row = dr.opaque(mi.UInt32, begin) + dr.arange(mi.UInt32, min(ROWS_PER_LAUNCH, points.count - begin))
            _trace_rows(scene, lookup, points, samples, count, row, table, sealed)
            if progress:
                progress(begin + len(row), points.count)
    stand_in = aligned(mi.UInt32, _stand_ins(points, np.array(sealed) > 0))
    table = dr.gather(mi.UInt32, dr.concat([stand_in, count]), table)
    dr.eval(table)
    return Gather(table, stand_in, samples)


def bounced_at(scene, lookup, sent_by, p, n, samples: int, shift, active):
    """What surfaces send to points without rows, such as hits on a sphere: mean over `samples` cosine-distributed rays.

    Parameters
    ----------
    sent_by : function
        From ``(rows, weights, active)``, the baked points around the end of a ray, to what is sent there: a spectrum, with derivatives.
    p, n : mi.Point3f, mi.Normal3f
        Points and unit normals, taken without derivatives.
    shift : mi.Point3f
        Shift of the direction set, in [0, 1)^3.
    """
    zero = mi.unpolarized_spectrum(mi.Spectrum(0))
    frame, origin = mi.Frame3f(dr.detach(n)), lifted(dr.detach(p), dr.detach(n))

    def body(k, total, origin, frame, shift):
        rows, weights, met, *_ = _hit_rows(scene, lookup, origin, _direction(frame, k, samples, shift), active)
        return k + 1, total + (sent_by(rows, weights, met) & met), origin, frame, shift

    last = dr.select(active, mi.UInt32(samples), 0)
    state = mi.UInt32(0), zero, origin, frame, shift
    return dr.while_loop(state, lambda k, *_: k < last, body, mode="symbolic", max_iterations=-1)[1] / samples


class Bounced(NamedTuple):
    """Result of :py:func:`solve_bounces`."""

    total: object
    """What arrives after one bounce or more, flat."""
    last: object
    """The part of it that belongs to the last bounce."""
    count: int
    """Bounces summed."""
    converged: bool
    """False if those left out may add up to more than the tolerance."""


def solve_bounces(gather: Gather, direct, reflectance, channels: int, bounces: int, tolerance: float) -> Bounced:
    """Sum of the light of bounces 1 .. N: ``sum_b (G rho)^b direct``, G the gather.

    Parameters
    ----------
    direct, reflectance : Float
        Flat, the channels of a row one after the other: what arrives without a bounce, in any unit; and reflectance.
    bounces : int
        Largest number N of bounces, 1 or more.
    tolerance : float
        Stop as soon as the bounces left out, taken for a geometric series by the last two, add up to less than this part of all bounces.
        0: never.
    """
    size = lambda values: float(dr.sum(abs(dr.detach(values)))[0])
    term, total, count = direct, mi.Float(0), 0
    before, everything = math.inf, 0.0                # direct light tells nothing of the series: most of it may leave an open scene
    while count < bounces:
        term = gather.apply(reflectance * term, channels)
        total, count = total + term, count + 1
        dr.eval(term, total)
        if tolerance > 0:
            now = size(term)
            everything += now
            if now == 0 or count > 1 and now * now <= tolerance * everything * (before - now):    # now q / (1 - q), q = now / before
                return Bounced(total, term, count, True)
            before = now
    return Bounced(total, term, count, tolerance == 0)


def _trace_rows(scene, lookup, points, samples: int, count, row, table, sealed) -> None:
    """Fill in the hits of some rows, and clear `sealed` where no more rays end on backs than on fronts."""
    sequence = dr.opaque(mi.UInt64, int(row[0]))
    generator = mi.PCG32(size=len(row), initstate=0xB0CE, initseq=sequence)
    shift = mi.Point3f(*(generator.next_float32() for _ in range(3)))
    n = dr.gather(mi.Normal3f, dr.ravel(points.normals), row)
    frame, origin = mi.Frame3f(n), lifted(dr.gather(mi.Point3f, dr.ravel(points.positions), row), n)

    def body(k, excess, row, origin, frame, shift):
        rows, weights, met, front, back = _hit_rows(scene, lookup, origin, _direction(frame, k, samples, shift), True)
        choice = _fraction(mi.Float(k) * ROOT_2 + shift.z)
        chosen = dr.select(choice < weights[0], rows[0], dr.select(choice < weights[0] + weights[1], rows[1], rows[2]))
        dr.scatter(table, chosen, k * count + row, met)
        excess = excess + dr.select(back, mi.Int32(1), 0) - dr.select(front, mi.Int32(1), 0)
        return k + 1, excess, row, origin, frame, shift

    last = dr.opaque(mi.UInt32, samples)
    state = mi.UInt32(0), mi.Int32(0), row, origin, frame, shift
    excess = dr.while_loop(state, lambda k, *_: k < last, body, mode="symbolic")[1]
    dr.scatter(sealed, dr.select(excess > 0, mi.UInt32(1), 0), row)
    dr.eval(table, sealed)


def _hit_rows(scene, lookup, origin, d, active) -> tuple:
    """(rows, weights, met, front, back): the baked points around what a ray meets, whether that side of it reflects, and whether it is
    the front or the back of a face.
    """
    ray = mi.Ray3f(origin, d)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, active)
    behind = mi.Frame3f.cos_theta(si.wi) <= 0
    rows, weights, baked = lookup.rows_at(pi, si.shape, behind, active & si.is_valid())
    two_sided = dr.gather(mi.UInt32, lookup.back, dr.reinterpret_array(mi.UInt32, si.shape), baked) > 0
    back = dr.dot(si.n, d) > 0
    return rows, weights, baked & (two_sided | ~behind), si.is_valid() & ~back, si.is_valid() & back


def _direction(frame, k, samples: int, shift):
    """Direction k of `samples` cosine-distributed ones: a Fibonacci set."""
    u = (mi.Float(k) + shift.x) / samples
    sin, cos = dr.sincos(2 * dr.pi * _fraction(mi.Float(k) * GOLDEN + shift.y))
    return frame.to_world(mi.Vector3f(dr.sqrt(u) * cos, dr.sqrt(u) * sin, dr.sqrt(dr.maximum(1 - u, 0))))


def _fraction(value):
    return value - dr.floor(value)


def _stand_ins(points, sealed: np.ndarray) -> np.ndarray:
    """For each row the one to take in its place: itself, or for a sealed one a neighbour that is not, if there is one."""
    rows = np.arange(points.count)
    for first, mesh in points.meshes:
        pairs = contacts(mesh, sealed[first:first + len(mesh.positions)])
        target, start = np.unique(pairs[:, 0], return_index=True)
        rows[first + target] = first + pairs[start, 1]
    return rows


def _points_around(mesh, faces, vertices) -> tuple:
    """Faces (S, R) and barycentric coordinates (2, S, R) of points about each baked point, denser towards it."""
    corners, owners, areas = [np.zeros((0, 3, 2))], [np.zeros((0, 3), np.int64)], [np.zeros(0)]
    owner_face = [np.zeros(0, np.int64)]
    sides = vertices[faces].astype(np.float64)
    area = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    for k in np.unique(mesh.subdivision).tolist():
        number = {cell: g for g, cell in enumerate((i, j) for j in range(k + 1) for i in range(k + 1 - j))}
        cells = [((i, j), (i + 1, j), (i, j + 1)) for i, j in number if i + j < k]
        cells += [((i + 1, j + 1), (i, j + 1), (i + 1, j)) for i, j in number if i + j < k - 1]
        local = np.array([[number[corner] for corner in cell] for cell in cells])
        chosen = np.flatnonzero(mesh.subdivision == k)
        owners.append(mesh.rows[mesh.first[chosen].astype(np.int64)[:, None, None] + local].reshape(-1, 3).astype(np.int64))
        corners.append(np.tile(np.array(cells) / k, (len(chosen), 1, 1)))
        areas.append(np.repeat(area[chosen] / k ** 2, len(cells)))
        owner_face.append(np.repeat(chosen, len(cells)))
    owners, corners, areas, owner_face = (np.concatenate(part) for part in (owners, corners, areas, owner_face))
    # one entry for each cell that a row touches, sorted by row; a row's entries get shares by their area
    entry = np.argsort(owners.ravel(), kind="stable")
    row = owners.ravel()[entry]
    weight = np.repeat(areas, 3)[entry] + 1e-30
    total = np.bincount(row, weight, len(mesh.positions))
    end = np.cumsum(weight) - (np.cumsum(total) - total)[row]
    key = row + end / total[row]
    count, rows = len(mesh.positions), np.arange(len(mesh.positions))
    chosen_faces, uv = np.zeros((REFLECTANCE_SAMPLES, count), np.uint32), np.zeros((2, REFLECTANCE_SAMPLES, count), np.float32)
    for s in range(REFLECTANCE_SAMPLES):
        found = np.searchsorted(key, rows + (s + 0.5) / REFLECTANCE_SAMPLES).clip(0, len(key) - 1)
        cell, corner = np.divmod(entry[found], 3)
        a, b = (rows * GOLDEN + s * 0.7548777) % 1, (rows * ROOT_2 + s * 0.5698403) % 1
        near = 0.5 - np.sin(np.arcsin(1 - 2 * a) / 3)                   # density proportional to the weight of the row
        weights = near, (1 - near) * b, (1 - near) * (1 - b)
        chosen_faces[s] = owner_face[cell]
        uv[:, s] = sum(w[:, None] * corners[cell, (corner + c) % 3] for c, w in enumerate(weights)).T
    return chosen_faces, uv
