"""Bake the transfer of a scene's meshes."""
from __future__ import annotations

import sys
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import __version__
from ..errors import UnsupportedSceneWarning, check_choice, check_integer, check_number, message
from ..scene import aligned, mesh_arrays, occluder_hash, polygon_lights, receivers
from ..sh.basis import check_order
from .mesh import MAX_POINTS, MAX_SUBDIVISION, automatic_edge, refine, spread_to_buried, subdivision_of
from .store import MeshBlock, Transfer
from .visibility import MAX_GROUPS, BakeLights, Occluders, inside_a_body, light_groups, shadowed_transfer

ROWS_PER_LAUNCH = 8192


def bake_transfer(scene, order: int = 8, transfer: str = "shadowed", samples: int = 1024, *, max_edge: float = 0.0,
                  light_margin: float = 0.0, progress=False) -> Transfer:
    """Bake diffuse shadowed transfer at the (refined) vertices of every mesh in a Mitsuba scene.

    For each baked point, side and light group the coefficients of ``T(omega) = V(omega) max(0, n . omega) / pi`` ([W18] section
    3.1, [G03] shadowed diffuse transfer) are estimated with `samples` cosine-distributed rays and the analytic cosine as
    control variate. ``V`` asks whether something lies between the point and the lights
    (:py:mod:`mi_shlight.transfer.visibility`), so closed rooms work.

    Parameters
    ----------
    scene : mi.Scene
        Loaded in a JIT variant, with ``optimize=False``.
    order : int
        Highest degree, 0 to 64.
    transfer : str
        ``"shadowed"``. (Unshadowed transfer is analytic and needs no bake.)
    samples : int
        Rays per baked point, 1 to 65536. The noise of a penumbra falls like 1/sqrt(samples) or faster.
    max_edge : float
        Triangles are refined, for baking only, until no edge is longer; scene units. 0: 1/64 of the diagonal of the receivers'
        bounding box. An edge is cut into at most 256 parts; a warning tells where that is not enough.
    light_margin : float
        Distance, in scene units, by which lights may move before the bake is stale. Visibility is then resolved in the grown
        neighbourhood of each light.
    progress : bool or callable
        True: a line on standard error. A callable is called with (points done, points in all).

    Returns
    -------
    Transfer

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
    check_choice(name, "transfer", transfer, ("shadowed",), "Unshadowed transfer is analytic: use it directly in 'shprt'.")
    samples = check_integer(name, "samples", samples, 1, 65536, "It is the number of rays per baked point.")
    max_edge = check_number(name, "max_edge", max_edge, 0, hint="It is a length in scene units; 0 chooses automatically.")
    light_margin = check_number(name, "light_margin", light_margin, 0, hint="It is a length in scene units.")
    if not (isinstance(progress, bool) or callable(progress)):
        raise TypeError(message(name, "progress", "be True, False or a callable (done, total)", progress))
    return trace_transfer(scene, polygon_lights(scene), receivers(scene), order, samples, max_edge, light_margin, progress)


def trace_transfer(scene, lights: list, lit: list, order: int, samples: int, max_edge: float, light_margin: float,
                   progress) -> Transfer:
    """:py:func:`bake_transfer` for the lights and receivers already found in `scene`; arguments are not checked."""
    report = _printer() if progress is True else progress or (lambda done, total: None)
    baked = [r for r in lit if r.baked]
    max_edge = max_edge or _automatic_edge(lit)
    groups = np.array(light_groups(len(lights)))
    _check_size(baked, max_edge)
    with dr.suspend_grad():
        points, positions, normals = _bake_points(baked, max_edge)
        floats = len(positions) * (len(groups) - 1) * (order + 1) ** 2
        if floats >= 2 ** 32:                         # the look-up counts them in 32 bits
            raise ValueError(message("bake_transfer", "max_edge", "leave less than 2^32 coefficients to bake", max_edge,
                                     f"{len(positions)} points, {len(groups) - 1} light groups and order {order} make {floats}. Choose a "
                                     "longer edge, a lower order, or transfer_domain='pixel'."))
        coeffs, visibility, conflict = _trace(Occluders(scene, lights), BakeLights(lights, light_margin), groups, positions, normals,
                                              order, samples, report)
        _clean_contacts(scene, points, positions, normals, coeffs, visibility)
    if conflict > 1e-3:
        warnings.warn(f"bake_transfer(): at some point {100 * conflict:.2g} % of the hemisphere sees two lights behind each other "
                      f"with an occluder between; more than {MAX_GROUPS} lights share one visibility, so the farther light shines "
                      "through there.", UnsupportedSceneWarning, stacklevel=3)
    versions = {"mi_shlight": __version__, "mitsuba": mi.__version__, "drjit": dr.__version__}
    return Transfer(order, "shadowed", samples, coeffs, visibility, groups, [light.outline for light in lights], light_margin,
                    max_edge, conflict, [block for block, _ in points], occluder_hash(scene), versions)


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


def _bake_points(baked: list, max_edge: float) -> tuple:
    """[(block, refined mesh)], positions (R, 3) and normals (R, 3) of all baked points."""
    blocks, positions, normals, row = [], [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)], 0
    for receiver in baked:
        faces, vertices, vertex_normals, side = mesh_arrays(receiver.shape)
        mesh = refine(faces, vertices, vertex_normals, max_edge, side)
        count = len(mesh.positions)
        block = MeshBlock(receiver.name, receiver.content, receiver.two_sided, row, count, mesh.subdivision, mesh.first, mesh.rows)
        blocks.append((block, mesh))
        positions += [mesh.positions] * (1 + receiver.two_sided)
        normals += [mesh.normals, -mesh.normals][:1 + receiver.two_sided]
        row += count * (1 + receiver.two_sided)
    return blocks, np.concatenate(positions), np.concatenate(normals)


def _trace(occluders, lights, groups, positions, normals, order: int, samples: int, report) -> tuple:
    """Coefficients (G, R, N), visibility (G, R) and the largest conflict over all points."""
    count, rows = (order + 1) ** 2, len(positions)
    coeffs = np.empty((len(groups) - 1, rows, count), np.float32)
    visibility = np.empty((len(groups) - 1, rows), np.float32)
    conflict, total = 0.0, rows * (len(groups) - 1)
    for g in range(len(groups) - 1):
        group = mi.UInt32(int(groups[g])), mi.UInt32(int(groups[g + 1]))
        dr.make_opaque(group)
        for begin in range(0, rows, ROWS_PER_LAUNCH):
            part = slice(begin, min(begin + ROWS_PER_LAUNCH, rows))
            p, n = _points(mi.Point3f, positions[part]), _points(mi.Normal3f, normals[part])
            shift = _hashed_shift(begin, part.stop - begin)
            t, v, c = shadowed_transfer(occluders, lights, group, p, n, order, samples, shift)
            dr.eval(t, v, c)
            for i in range(count):
                coeffs[g, part, i] = np.array(t[i])
            visibility[g, part] = np.array(v)
            conflict = max(conflict, float(np.max(np.array(c), initial=0.0)))
            report(g * rows + part.stop, total)
    return coeffs, visibility, conflict


def _clean_contacts(scene, points, positions, normals, coeffs, visibility) -> None:
    """Replace the transfer of points inside solid bodies by that of their visible neighbours, in place."""
    dark = np.flatnonzero((visibility == 0).all(axis=0))
    if len(dark) == 0:
        return
    found = inside_a_body(scene, _points(mi.Point3f, positions[dark]), _points(mi.Normal3f, normals[dark]))
    buried = np.zeros(len(positions), bool)
    buried[dark] = np.array(found)
    for block, mesh in points:
        for side in range(1 + block.two_sided):
            rows = slice(block.first_row + side * block.row_count, block.first_row + (side + 1) * block.row_count)
            spread_to_buried(mesh, buried[rows], coeffs[:, rows])


def _points(kind, rows: np.ndarray):
    return dr.gather(kind, aligned(mi.Float, rows.ravel()), dr.arange(mi.UInt32, len(rows)))


def _hashed_shift(begin: int, count: int):
    """A reproducible shift of the direction set for each point, so that neighbours' errors are independent."""
    sequence = mi.UInt64(begin)
    dr.make_opaque(sequence)                          # a literal would be compiled into the kernel of each launch
    generator = mi.PCG32(size=count, initstate=0x5EED, initseq=sequence)
    return mi.Point2f(generator.next_float32(), generator.next_float32())


def _printer():
    """Progress on standard error, one line that overwrites itself; nothing unless it is a terminal."""
    def report(done: int, total: int) -> None:
        if sys.stderr.isatty():
            print(f"\rbaking transfer: {100 * done // max(total, 1)} %", end="" if done < total else "\n", file=sys.stderr, flush=True)
    return report
