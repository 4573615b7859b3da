"""Bake the transfer of a scene's meshes."""
from __future__ import annotations

import sys
import warnings
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import __version__
from ..errors import UnsupportedSceneWarning, check_choice, check_integer, check_number, message
from ..scene import aligned, mesh_arrays, occluder_hash, polygon_lights, receivers
from ..sh.basis import check_order
from .localised import KINDS, cone_fit, sample_transfer
from .mesh import MAX_POINTS, MAX_SUBDIVISION, automatic_edge, contacts, refine, spread_to_buried, subdivision_of
from .store import MeshBlock, Transfer
from .visibility import MAX_GROUPS, BakeLights, LightSight, Occluders, SkySight, inside_a_body, light_groups

ROWS_PER_LAUNCH = 8192


def bake_transfer(scene, order: int = 8, transfer: str = "shadowed", samples: int = 1024, *, localised: bool = True,
                  max_edge: float = 0.0, light_margin: float = 0.0, progress=False) -> Transfer:
    """Bake transfer at the (refined) vertices of every mesh in a Mitsuba scene.

    For each baked point, side and light group the coefficients of ``T(omega) = V(omega) max(0, n . omega) / pi`` ([W18] section
    3.1, [G03] shadowed diffuse transfer) are found with `samples` rays. ``V`` asks whether something lies between the point and the lights
    (:py:mod:`mi_shlight.transfer.visibility`), so closed rooms work.

    Parameters
    ----------
    scene : mi.Scene
        Loaded in a JIT variant, with ``optimize=False``.
    order : int
        Highest degree, 0 to 64.
    transfer : str
        ``"shadowed"``; ``"exact"``: only how T differs from its mean visibility v times the cosine, to be added to v times the exact
        unshadowed radiance; ``"visibility"``: 1 - V, for glossy surfaces. (Unshadowed transfer is analytic and needs no bake.)
    samples : int
        Rays per baked point and light group, 1 to 65536. The noise of a penumbra falls like 1/sqrt(samples) or faster.
    localised : bool
        Fit T to the directions from which the lights of a group are seen, or may be seen after they have moved by `light_margin`
        (:py:mod:`mi_shlight.transfer.localised`), in place of a projection over the sphere; many times more accurate. Such a
        bake is of use at its own `order` only. Of no effect for lights all around, at order 0 and beyond 14.
    max_edge : float
        Triangles are refined, for baking only, until no edge is longer; scene units. 0: 1/64 of the diagonal of the receivers'
        bounding box. An edge is cut into at most 256 parts; a warning tells where that is not enough.
    light_margin : float
        Distance, in scene units, by which lights may move before the bake is stale. Visibility is then resolved in the grown
        neighbourhood of each light, and as well there: a wide margin costs accuracy.
    progress : bool or callable
        True: a line on standard error. A callable is called with (points done, points in all).

    Returns
    -------
    Transfer
        If the scene has a light at an infinite distance (``constant``, ``envmap``), with one more light group for that.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, or the scene has no polygonal light, a light that is far from planar, or more than 16 million
        points to bake.
    """
    name = "bake_transfer"
    if not isinstance(scene, mi.Scene):
        raise TypeError(message(name, "scene", f"be a mitsuba.Scene of the current variant ({mi.variant()})", scene,
                                "Load it with mi.load_file(path, optimize=False)."))
    order = check_order(name, order)
    hint = "Unshadowed transfer is analytic; interreflected and glossy are additions that 'shprt' traces itself."
    check_choice(name, "transfer", transfer, KINDS, hint)
    samples = check_integer(name, "samples", samples, 1, 65536, "It is the number of rays per baked point.")
    max_edge = check_number(name, "max_edge", max_edge, 0, hint="It is a length in scene units; 0 chooses automatically.")
    light_margin = check_number(name, "light_margin", light_margin, 0, hint="It is a length in scene units.")
    if not isinstance(localised, bool):
        raise TypeError(message(name, "localised", "be True or False", localised))
    if not (isinstance(progress, bool) or callable(progress)):
        raise TypeError(message(name, "progress", "be True, False or a callable (done, total)", progress))
    lights, distant = polygon_lights(scene), scene.environment() is not None
    if not (lights or distant):
        raise ValueError(message(name, "scene", "have a polygonal or distant light", "none",
                                 "Light from points and directions has exact shadows, which are traced when a picture is rendered."))
    return trace_transfer(scene, lights, receivers(scene), order, samples, max_edge, light_margin, progress, transfer, localised, distant)


def trace_transfer(scene, lights: list, lit: list, order: int, samples: int, max_edge: float, light_margin: float, progress,
                   kind: str = "shadowed", localised: bool = True, distant: bool = False) -> Transfer:
    """:py:func:`bake_transfer` for the lights and receivers already found in `scene`; arguments are not checked.

    `distant`: bake a last group for lights at an infinite distance. There may be no other `lights`.
    """
    report = _printer() if progress is True else progress or (lambda done, total: None)
    baked = [r for r in lit if r.baked]
    max_edge = max_edge or _automatic_edge(lit)
    groups = np.array(light_groups(len(lights)))
    _check_size(baked, max_edge)
    with dr.suspend_grad():
        points = _bake_points(baked, max_edge)
        count = len(groups) - 1 + distant
        floats = len(points.positions) * count * (order + 1) ** 2
        if floats >= 2 ** 32:                         # the look-up counts them in 32 bits
            raise ValueError(message("bake_transfer", "max_edge", "leave less than 2^32 coefficients to bake", max_edge,
                                     f"{len(points.positions)} points, {count} light groups and order {order} make {floats}. Choose a "
                                     "longer edge, a lower order, or transfer_domain='pixel'."))
        fit, sights = cone_fit(order, samples) if localised else None, []
        if lights:
            occluders, bake_lights = Occluders(scene, lights), BakeLights(lights, light_margin)
        for first, last in zip(groups[:-1], groups[1:]):
            group = mi.UInt32(int(first)), mi.UInt32(int(last))
            dr.make_opaque(group)
            sights.append((LightSight(occluders, bake_lights, group), kind, fit))
        if distant:
            sights.append((SkySight(scene), "shadowed" if kind == "exact" else kind, None))
        buried = _buried(scene, points)
        traced = _trace(sights, points, order, samples, report)
        buried &= (traced.visibility == 0).all(axis=0)
        for mesh, side in points.sides():
            _widen_cones(mesh, buried[side], traced.cones[:, side])
            for values in (traced.coeffs, traced.visibility[..., None], traced.variance[..., None], traced.residual[..., None]):
                spread_to_buried(mesh, buried[side], values[:, side])
    conflict = float(traced.conflict.max(initial=0))
    if conflict > 1e-3:
        warnings.warn(f"bake_transfer(): at some point {100 * conflict:.2g} % of the rays see two lights behind each other "
                      f"with an occluder between; more than {MAX_GROUPS} lights share one visibility, so the farther light shines "
                      "through there.", UnsupportedSceneWarning, stacklevel=3)
    versions = {"mi_shlight": __version__, "mitsuba": mi.__version__, "drjit": dr.__version__}
    return Transfer(order, kind, fit is not None, distant, samples, traced.coeffs, traced.visibility, traced.variance, traced.residual,
                    traced.cones, groups, [light.outline for light in lights], light_margin, max_edge, conflict,
                    [block for block, _ in points.blocks], occluder_hash(scene), versions)


def _automatic_edge(lit: list) -> float:
    """Default of `max_edge`, with a warning if it is too long for the shadow of some shape."""
    boxes = np.array([[np.ravel(r.shape.bbox().min), np.ravel(r.shape.bbox().max)] for r in lit if r.light < 0], dtype=float)
    if not len(boxes):
        return 1.0
    edge = max(automatic_edge(np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])), 1e-30)
    small = np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1) < edge
    if small.any():
        warnings.warn(f"bake_transfer(): {small.sum()} shape(s) are smaller than a baked cell (max_edge = {edge:.3g}, chosen from the size "
                      "of the scene): their shadows are lost. Set max_edge to less than the smallest shape that matters, or use "
                      "transfer_domain='pixel'.", UnsupportedSceneWarning, stacklevel=4)
    return edge


def _check_size(baked: list, max_edge: float) -> None:
    """Raise ValueError before memory is taken for more points than can be held; warn where `max_edge` cannot be reached."""
    total, coarse = 0, []
    for receiver in baked:
        faces, positions, _, _ = mesh_arrays(receiver.shape)
        _, points, limited = subdivision_of(faces, positions, max_edge)
        total += points * (1 + receiver.two_sided)
        coarse += [receiver.name] if limited else []
        if total > MAX_POINTS:
            raise ValueError(message("bake_transfer", "max_edge", f"leave at most {MAX_POINTS} points to bake", max_edge,
                                     f"With mesh '{receiver.name}' there are {total}. Choose a longer edge, or transfer_domain='pixel'."))
    if coarse:
        warnings.warn(f"bake_transfer(): {len(coarse)} mesh(es), such as '{coarse[0]}', have faces too large for max_edge = "
                      f"{max_edge:.3g}: an edge is cut into at most {MAX_SUBDIVISION} parts. Subdivide them where detail matters, or "
                      "use transfer_domain='pixel'.", UnsupportedSceneWarning, stacklevel=4)


class BakePoints(NamedTuple):
    """All points of a bake."""

    blocks: list
    """(block, refined mesh) of each mesh."""
    positions: np.ndarray
    """(R, 3)"""
    normals: np.ndarray
    """(R, 3)"""
    cells: np.ndarray
    """(R,): how far away the transfer of a point may be used."""

    def sides(self):
        """(refined mesh, rows of one side as a slice) of all meshes."""
        for block, mesh in self.blocks:
            for side in range(1 + block.two_sided):
                yield mesh, slice(block.first_row + side * block.row_count, block.first_row + (side + 1) * block.row_count)


def _bake_points(baked: list, max_edge: float) -> BakePoints:
    none = np.zeros((0, 3), np.float32)
    blocks, positions, normals, cells, row = [], [none], [none], [none[:, 0]], 0
    for receiver in baked:
        faces, vertices, vertex_normals, side = mesh_arrays(receiver.shape)
        mesh = refine(faces, vertices, vertex_normals, max_edge, side)
        count = len(mesh.positions)
        block = MeshBlock(receiver.name, receiver.content, receiver.two_sided, row, count, mesh.subdivision, mesh.first, mesh.rows)
        blocks.append((block, mesh))
        positions += [mesh.positions] * (1 + receiver.two_sided)
        normals += [mesh.normals, -mesh.normals][:1 + receiver.two_sided]
        cells += [mesh.cells] * (1 + receiver.two_sided)
        row += count * (1 + receiver.two_sided)
    return BakePoints(blocks, *map(np.concatenate, (positions, normals, cells)))


def _buried(scene, points: BakePoints) -> np.ndarray:
    """Mask (R,) of the points inside solid bodies. The cells of those that will stand in for them grow by the way to them."""
    rows = len(points.positions)
    buried = np.empty(rows, bool)
    for part in _launches(rows):
        p, n = _points(mi.Point3f, points.positions[part]), _points(mi.Normal3f, points.normals[part])
        buried[part] = np.array(inside_a_body(scene, p, n))
    for mesh, side in points.sides():
        points.cells[side][contacts(mesh, buried[side])[:, 1]] *= 2
    return buried


class Traced(NamedTuple):
    """What rays have found, for all groups and points: :py:class:`~mi_shlight.transfer.localised.Sampled`."""

    visibility: np.ndarray
    variance: np.ndarray
    conflict: np.ndarray
    residual: np.ndarray
    coeffs: np.ndarray
    cones: np.ndarray
    """Axis and half-angle."""


def _trace(sights: list, points: BakePoints, order: int, samples: int, report) -> Traced:
    """Trace all points for each group; `sights`: (sight, kind, fit) of each."""
    rows, size = len(points.positions), (order + 1) ** 2
    traced = Traced(*(np.empty((len(sights), rows, *shape), np.float32) for shape in ((), (), (), (), (size,), (4,))))
    for g, (sight, kind, fit) in enumerate(sights):
        for part in _launches(rows):
            p, n = _points(mi.Point3f, points.positions[part]), _points(mi.Normal3f, points.normals[part])
            found = sample_transfer(sight, p, n, order, samples, _hashed_shift(part), kind=kind, fit=fit,
                                    cell=aligned(mi.Float, points.cells[part]))
            dr.eval(*found)                           # Dr.Jit does not look into named tuples
            for table, columns in ((traced.coeffs, found.coeffs), (traced.cones, (*found.axis, found.angle))):
                for i, column in enumerate(columns):
                    table[g, part, i] = np.array(column)
            for name in ("visibility", "variance", "conflict", "residual"):
                getattr(traced, name)[g, part] = np.array(getattr(found, name))
            report(g * rows + part.stop, rows * len(sights))
    return traced


def _widen_cones(mesh, buried: np.ndarray, cones: np.ndarray) -> None:
    """Overwrite the `cones` (G, R, 4) of buried points by some that hold those of the neighbours that stand in for them, in place."""
    pairs = contacts(mesh, buried)
    targets, slot = np.unique(pairs[:, 0], return_inverse=True)
    for group in cones:
        axes, angles = group[pairs[:, 1], :3].astype(np.float64), group[pairs[:, 1], 3]
        middle = np.zeros((len(targets), 3))
        np.add.at(middle, slot, axes)
        middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-30)
        reach = angles + 2 * np.arcsin(np.minimum(np.linalg.norm(axes - middle[slot], axis=1) / 2, 1))
        widest = np.zeros(len(targets))
        np.maximum.at(widest, slot, reach)
        group[targets] = np.column_stack([middle, np.minimum(widest, np.pi)])


def _launches(rows: int) -> list:
    """Slices of the points that are traced together."""
    return [slice(begin, min(begin + ROWS_PER_LAUNCH, rows)) for begin in range(0, rows, ROWS_PER_LAUNCH)]


def _points(kind, rows: np.ndarray):
    return dr.gather(kind, aligned(mi.Float, rows.ravel()), dr.arange(mi.UInt32, len(rows)))


def _hashed_shift(part: slice):
    """Reproducible numbers in [0, 1), one for each point, so that neighbours' errors are independent."""
    sequence = mi.UInt64(part.start)
    dr.make_opaque(sequence)                          # a literal would be compiled into the kernel of each launch
    return mi.PCG32(size=part.stop - part.start, initstate=0x5EED, initseq=sequence).next_float32()


def _printer():
    """Progress on standard error, one line that overwrites itself; nothing unless it is a terminal."""
    def report(done: int, total: int) -> None:
        if sys.stderr.isatty():
            print(f"\rbaking transfer: {100 * done // max(total, 1)} %", end="" if done < total else "\n", file=sys.stderr, flush=True)
    return report
