"""Meshes as lights, in index arrays: outlines of planar ones, textured ones cut into triangles, and whether faces hide one another."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .polygon import strip_corners, strip_count

SUBDIVISIONS = 128
"""Triangles into which a textured light is cut unless it says otherwise."""

CHUNK = 1 << 22
"""Pairs of face and vertex that the test of convexity looks at together."""


class Pieces(NamedTuple):
    """Triangles into which the faces of a mesh are cut; their corners are fixed mixtures of the mesh's vertices."""

    index: np.ndarray
    """(C, 3): vertices of the mesh for each corner point of the cut."""
    weight: np.ndarray
    """(C, 3): their shares."""
    triangles: np.ndarray
    """(K, 3) corner points. Neighbours share theirs."""
    uv: np.ndarray
    """(K, 3, 2) texture coordinates at the corners of each triangle."""


def weld(positions: np.ndarray) -> np.ndarray:
    """One number for all vertices at equal positions, as meshes often repeat them per face: that of the first of them."""
    _, first, number = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    return first[number.reshape(-1)]


def boundary_edges(faces: np.ndarray, positions: np.ndarray) -> tuple:
    """Directed edges of a mesh that no other face shares: arrays of start and end vertex indices. Welded vertices count as one."""
    welded = weld(positions)
    start = faces.ravel()
    end = np.roll(faces, -1, axis=1).ravel()
    a, b = welded[start], welded[end]
    count = len(positions)
    boundary = ~np.isin(a * count + b, b * count + a) & (a != b)
    return start[boundary], end[boundary]


def strips(start: np.ndarray, end: np.ndarray, faces: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Corners (P, 4) of the strips that fill a polygon: cut across from its outline if that is one loop, otherwise its triangles."""
    welded = weld(positions)
    following = dict(zip(welded[start].tolist(), range(len(start))))
    loop, edge = [], 0
    while len(loop) < len(start):
        loop.append(int(start[edge]))
        edge = following.get(int(welded[end[edge]]))
        if not edge:                                  # back at the first edge, or at a loose end
            break
    n = len(loop)
    if n == len(start) == len(following) and edge == 0:
        return np.array([[loop[k] for k in strip_corners(i, n)] for i in range(strip_count(n))])
    return faces[:, strip_corners(0, 3)]


def is_convex(faces: np.ndarray, positions: np.ndarray, tolerance: float) -> bool:
    """True if no vertex stands before the plane of any face by more than `tolerance` of the mesh's extent: no face hides another.

    `faces` (F, 3), wound counter-clockwise as seen from the side that emits; F V steps.
    """
    corners = positions[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 0] / length[length > 0, None]
    heights = np.einsum("fk,fk->f", normals, corners[length > 0, 0])
    points = np.unique(corners.reshape(-1, 3), axis=0)
    limit = tolerance * np.ptp(points, axis=0).max()
    step = max(1, CHUNK // len(points))
    return all((normals[k:k + step] @ points.T - heights[k:k + step, None]).max() <= limit for k in range(0, len(normals), step))


def cut(faces: np.ndarray, positions: np.ndarray, uv: np.ndarray, count: int) -> Pieces:
    """Cut the triangles `faces` (F, 3) of a mesh into about `count` parts, each face into as many, uniformly.

    A parallelogram of two faces, with a texture laid evenly over both, becomes a grid of cells nearly square in space, each cut in two.
    Otherwise each side of each face is cut into s equal parts, which makes F s^2 triangles.

    Parameters
    ----------
    positions : (V, 3) floats
    uv : (F, 3, 2) floats
        Texture coordinates at the corners of each face.
    """
    corners = _parallelogram(faces, positions, uv)
    return _refined(faces, positions, uv, count) if corners is None else _grid(faces, positions, uv, count, corners)


def _refined(faces: np.ndarray, positions: np.ndarray, uv: np.ndarray, count: int) -> Pieces:
    s = max(1, round((count / len(faces)) ** 0.5))
    shares = lattice(s)                                                     # (s^2, 3, 3) integers
    of_face = np.broadcast_to(faces[:, None, None], (len(faces), *shares.shape)).reshape(-1, 3)
    parts = np.broadcast_to(shares, (len(faces), *shares.shape)).reshape(-1, 3)
    # A point is named by the vertices it mixes and their shares, so that it is the same seen from each of the faces that meet in it.
    names = np.where(parts > 0, weld(positions)[of_face] * (s + 1) + parts, -1)
    _, first, triangles = np.unique(np.sort(names, axis=1), axis=0, return_index=True, return_inverse=True)
    return Pieces(of_face[first], parts[first] / s, triangles.reshape(-1, 3),
                  np.einsum("tik,fkc->ftic", shares / s, uv).reshape(-1, 3, 2))


def lattice(s: int) -> np.ndarray:
    """Corners (s^2, 3, 3) of the triangles into which a triangle falls whose sides are cut in s: barycentric coordinates times s."""
    up = [[(i, j), (i + 1, j), (i, j + 1)] for i in range(s) for j in range(s - i)]
    down = [[(i + 1, j), (i + 1, j + 1), (i, j + 1)] for i in range(s) for j in range(s - i - 1)]
    ij = np.array(up + down)
    return np.concatenate([s - ij.sum(axis=-1, keepdims=True), ij], axis=-1)


def _parallelogram(faces: np.ndarray, positions: np.ndarray, uv: np.ndarray):
    """Corners of two faces that make up a parallelogram as (face, corner), in order; None if they do not."""
    if len(faces) != 2:
        return None
    welded = weld(positions)[faces]
    shared = np.isin(welded, np.intersect1d(*welded))
    if (shared.sum(axis=1) != 2).any():
        return None
    (a,), (c,) = (np.flatnonzero(~row) for row in shared)
    ring = [(0, a), (0, (a + 1) % 3), (1, c), (0, (a + 2) % 3)]
    if welded[1][(c + 1) % 3] != welded[0][(a + 2) % 3]:
        return None                                                         # wound the other way
    values = np.concatenate([positions[faces], uv], axis=-1)
    corner = np.array([values[k] for k in ring])
    even = np.abs(corner[0] + corner[2] - corner[1] - corner[3]) < 1e-5 * np.ptp(corner, axis=0).max()
    twins = np.allclose(values[1][(c + 1) % 3], corner[3]) and np.allclose(values[1][(c + 2) % 3], corner[1])
    return ring if even.all() and twins else None


def _grid(faces: np.ndarray, positions: np.ndarray, uv: np.ndarray, count: int, ring: list) -> Pieces:
    corner = np.array([positions[faces[k]] for k in ring])
    width, height = (np.linalg.norm(corner[k] - corner[0]) for k in (1, 3))
    a = int(np.clip(round((count / 2 * width / height) ** 0.5), 1, max(1, count // 2)))
    b = max(1, round(count / 2 / a))
    i, j = (v.ravel() for v in np.meshgrid(np.arange(a + 1), np.arange(b + 1)))
    s, t = i / a, j / b
    # corners 0, 1, 3 span one face, 2, 3, 1 the other
    near = (s + t <= 1)[:, None]
    vertex = np.array([faces[k] for k in ring])
    index = np.where(near, vertex[[0, 1, 3]], vertex[[2, 3, 1]])
    weight = np.where(near, np.stack([1 - s - t, s, t], axis=1), np.stack([s + t - 1, 1 - s, 1 - t], axis=1))
    first = (np.arange(b)[:, None] * (a + 1) + np.arange(a)).ravel()
    triangles = np.concatenate([np.stack([first, first + 1, first + a + 1], 1), np.stack([first + a + 2, first + a + 1, first + 1], 1)])
    edge = np.array([uv[k] for k in ring])
    texture = edge[0] + s[:, None] * (edge[1] - edge[0]) + t[:, None] * (edge[3] - edge[0])
    return Pieces(index, weight, triangles, texture[triangles])
