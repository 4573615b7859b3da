"""A bake of one place and orientation, used in another: rotating an object is rotating the light into its frame."""
from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from ..errors import message
from ..scene import keep_quiet, mesh_arrays, occluder_hash, polygon_lights, receivers, shape_name
from ..sh.rotation import rotate
from .store import Transfer

TOLERANCE = 1e-4
"""Distance from where a rigid motion takes it, relative to the size of the scene, up to which a vertex has moved along."""


def rotate_transfer(transfer: Transfer, scene, moved) -> Transfer:
    """The bake of a scene for the same scene turned and moved as a whole, without a ray.

    What a point sees turns with it, ``T'(omega) = T(R^-1 omega)``, so its coefficients are rotated, ``T' = D(R) T``
    (:py:func:`mi_shlight.sh.rotate`), and ``T' . L = T . D(R)^-1 L``: as if the light had been rotated into the frame of the object
    ([G03] "Rotating Spherical Harmonics").
    Meant for an object under lights at an infinite distance. Polygonal lights, and all that casts shadows, must have moved along.

    Parameters
    ----------
    transfer : Transfer
        Bake of `scene`.
    scene, moved : mi.Scene
        The scene as it was baked, and the same shapes in the same order somewhere else, both loaded with ``optimize=False``: meshes, and
        spheres without light. The rotation and translation between them are found from the vertices.

    Returns
    -------
    Transfer
        Bake of `moved`: its :py:meth:`~mi_shlight.Transfer.check` passes there, and ``shprt`` takes it as ``transfer_file``.

    Raises
    ------
    TypeError, ValueError
        If `scene` or `moved` is no scene, `transfer` does not belong to `scene`, or `moved` differs from it by more than a rotation and a
        translation.

    Notes
    -----
    Equal to a new bake to the noise of the two: a few parts in 10^7 are added.
    """
    name = "rotate_transfer"
    for argument, value in (("scene", scene), ("moved", moved)):
        if not isinstance(value, mi.Scene):
            raise TypeError(message(name, argument, f"be a mitsuba.Scene of the current variant ({mi.variant()})", value))
    if not isinstance(transfer, Transfer):
        raise TypeError(message(name, "transfer", "be a Transfer", transfer, "Bake one with mi_shlight.bake_transfer()."))
    transfer.check(scene)
    old, new = _points(scene), _points(moved)
    hint = "Load the same file with another to_world around all of its shapes, with optimize=False."
    if [(kind, topology) for kind, topology, *_ in old] != [(kind, topology) for kind, topology, *_ in new]:
        raise ValueError(message(name, "moved", "have the shapes of 'scene' in the same order",
                                 ", ".join(shape_name(s) for s in moved.shapes()), hint))
    points, moved_points = (np.concatenate([points for _, _, points, *_ in shapes]) for shapes in (old, new))
    size = np.ptp(points, axis=0).max()
    rotation, translation = rigid_motion(points, moved_points)
    for shape, (_, _, points, normals, radius), (_, _, moved_points, moved_normals, moved_radius) in zip(moved.shapes(), old, new):
        apart = max(abs(points @ rotation.T + translation - moved_points).max(), abs(radius - moved_radius))
        turned = abs(normals @ rotation.T - moved_normals).max(initial=0)
        if apart > TOLERANCE * size or turned > 100 * TOLERANCE:
            raise ValueError(message(name, "moved", "be 'scene' after a rotation and a translation, of all shapes together",
                                     f"shape '{shape_name(shape)}' elsewhere, or otherwise shaped", hint))
    content = {a.content: b.content for a, b in zip(receivers(scene, keep_quiet), receivers(moved, keep_quiet))}
    blocks = [replace(block, content=content[block.content]) for block in transfer.meshes]
    outlines = [light.outline for light in polygon_lights(moved, keep_quiet)]
    cones = np.concatenate([transfer.cones[..., :3] @ rotation.T, transfer.cones[..., 3:]], axis=-1).astype(np.float32)
    return replace(transfer, coeffs=rotate(transfer.coeffs, rotation).astype(np.float32), cones=cones, meshes=blocks, outlines=outlines,
                   occluders=occluder_hash(moved))


def rigid_motion(points: np.ndarray, moved: np.ndarray) -> tuple:
    """Rotation (3, 3) and translation (3,) that take `points` (N, 3) to `moved` with the least squared distance (Kabsch 1976)."""
    centre, moved_centre = points.mean(axis=0), moved.mean(axis=0)
    u, _, vt = np.linalg.svd((moved - moved_centre).T @ (points - centre))
    u[:, 2] *= np.linalg.det(u) * np.linalg.det(vt)   # no reflection
    rotation = u @ vt
    return rotation, moved_centre - rotation @ centre


def _points(scene) -> list:
    """Of each shape its class and topology, and as float64 the points and vertex normals that show how it moved, and a sphere's radius."""
    shapes = []
    for shape in scene.shapes():
        if shape.is_mesh():
            faces, positions, normals, side = mesh_arrays(shape)
            shapes.append(("mesh", (faces.tobytes(), side), positions.astype(np.float64),
                           np.zeros((0, 3)) if normals is None else normals.astype(np.float64), 0.0))
        elif shape.class_name() == "Sphere" and not shape.is_emitter():
            box = shape.bbox()
            radius = float((box.max - box.min).x) / 2
            shapes.append(("sphere", None, np.array([np.ravel(box.center())], dtype=np.float64), np.zeros((0, 3)), radius))
        else:
            raise ValueError(message("rotate_transfer", "scene", "consist of meshes, and spheres that do not shine",
                                     f"'{shape_name(shape)}' ({shape.class_name()})"))
    return shapes
