"""Where transfer is baked: vertices of a mesh, refined where its triangles are too coarse to carry a shadow.

The rendered geometry is untouched. Each triangle is cut into k x k smaller ones, k a power of two; a *row* is one baked point
(position and normal), shared by the triangles that meet there with the same normal. Triangles of different k share an edge
without cracks in the geometry, but their interpolated transfer may differ slightly along it.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_SUBDIVISION = 256
RIM = 0.05
MAX_POINTS = 16_000_000
"""Grid points of a scene's faces before equal ones merge; they take 2 GB while a bake is set up."""


@dataclass
class BakeMesh:
    """Baked points of one mesh and the way from a hit to them.

    Attributes
    ----------
    positions, normals : ndarray (R, 3), float32
        Baked points of the front side. Points on the rim of a face are pulled inwards by 5 % of a cell, so that rays from the
        edge between two walls do not start in the other wall.
    cells : ndarray (R,), float32
        Longest edge of the cells around each point: how far away its transfer may be used.
    subdivision : ndarray (F,), uint32
        k of each face.
    first : ndarray (F,), uint32
        Index in `rows` of the face's first grid point.
    rows : ndarray, uint32
        For each face its (k + 1)(k + 2) / 2 grid points, row after row of the barycentric grid, as indices into `positions`.
    """

    positions: np.ndarray
    normals: np.ndarray
    cells: np.ndarray
    subdivision: np.ndarray
    first: np.ndarray
    rows: np.ndarray


def subdivision_of(faces: np.ndarray, positions: np.ndarray, max_edge: float) -> tuple:
    """Parts k of each face (F,), the number of grid points that makes, and whether the limit of 256 parts was met by any
    face.
    """
    corners = positions[faces].astype(np.float64)
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1, initial=0)
    parts = np.ceil(longest / max_edge - 1e-6)
    k = (2 ** np.ceil(np.log2(np.clip(parts, 1, MAX_SUBDIVISION)))).astype(np.uint32)
    return k, int(((k.astype(np.int64) + 1) * (k.astype(np.int64) + 2) // 2).sum()), bool((parts > MAX_SUBDIVISION).any())


def refine(faces: np.ndarray, positions: np.ndarray, normals, max_edge: float, side: float = 1.0) -> BakeMesh:
    """Cut triangles until no edge is longer than `max_edge` (at most 256 parts per edge) and merge equal points.

    Parameters
    ----------
    faces : ndarray (F, 3) of vertex indices
    positions : ndarray (V, 3)
        World space.
    normals : ndarray (V, 3) or None
        Vertex normals; None for flat faces, whose points are then kept apart where faces meet at an angle.
    max_edge : float
        In units of `positions`; ``inf`` keeps the mesh as it is.
    side : float
        -1 if the normals of flat faces point against their winding, else 1.
    """
    corners = positions[faces].astype(np.float64)
    if normals is None:
        flat = side * _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        corner_normals = np.repeat(flat[:, None], 3, axis=1)
    else:
        corner_normals = normals[faces].astype(np.float64)
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    subdivision, _, _ = subdivision_of(faces, positions, max_edge)
    sizes = (subdivision + 1) * (subdivision + 2) // 2
    first = np.concatenate([[0], np.cumsum(sizes.astype(np.int64))])
    points, directions, pulls = (np.empty((first[-1], 3)) for _ in range(3))
    for k in np.unique(subdivision):
        chosen = np.flatnonzero(subdivision == k)
        weights = _grid(int(k))
        target = (first[chosen][:, None] + np.arange(len(weights))).ravel()
        points[target] = np.einsum("gc,fcd->fgd", weights, corners[chosen]).reshape(-1, 3)
        directions[target] = np.einsum("gc,fcd->fgd", weights, corner_normals[chosen]).reshape(-1, 3)
        rim = (weights == 0).any(axis=1)
        pull = _unit(corners[chosen].mean(axis=1)[:, None] - points[target].reshape(len(chosen), -1, 3)) * rim[:, None]
        pulls[target] = (pull * (longest[chosen] / k)[:, None, None]).reshape(-1, 3)
    directions = _unit(directions)
    extent = max(np.ptp(positions, axis=0).max(), 1e-30) if len(positions) else 1.0
    keys = np.concatenate([np.round(points / (extent * 1e-6)), np.round(directions * 1e3)], axis=1).astype(np.int64)
    _, index, rows = np.unique(_hashable(keys), return_index=True, return_inverse=True)
    rows, points, directions = rows.reshape(-1), points[index], directions[index]
    shared = np.bincount(rows, minlength=len(index))[:, None]
    inwards = np.stack([np.bincount(rows, column, len(index)) for column in pulls.T], axis=1) / shared
    inwards -= directions * (inwards * directions).sum(axis=1, keepdims=True)
    cells = np.zeros(len(index), np.float32)
    np.maximum.at(cells, rows, np.repeat(longest / subdivision, sizes))
    return BakeMesh((points + RIM * inwards).astype(np.float32), directions.astype(np.float32), cells, subdivision,
                    first[:-1].astype(np.uint32), rows.astype(np.uint32))


def spread_to_buried(mesh: BakeMesh, buried: np.ndarray, values: np.ndarray) -> None:
    """Overwrite `values` (..., R, N) at buried points by the mean over their neighbours that are not, in place.

    A wall or floor that runs into another body has points inside that body, where everything is dark. Interpolation would draw
    this dark out to the visible side, a halo one cell wide around the contact; extrapolating from the visible side removes it.
    Buried points with no such neighbour are never seen and stay.
    """
    pairs = contacts(mesh, buried)
    targets, slot = np.unique(pairs[:, 0], return_inverse=True)
    count = np.bincount(slot)
    for index in np.ndindex(values.shape[:-2]):
        total = np.zeros((len(targets), values.shape[-1]))
        np.add.at(total, slot, values[index][pairs[:, 1]])
        values[index][targets] = total / count[:, None]


def contacts(mesh: BakeMesh, buried: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) of a buried and a visible row that are neighbours in some face's grid, each pair once."""
    pairs = [np.zeros((0, 2), np.int64)]
    if not buried.any():
        return pairs[0]
    for k in np.unique(mesh.subdivision):
        number = {(i, j): g for g, (i, j) in enumerate((i, j) for j in range(k + 1) for i in range(int(k) + 1 - j))}
        local = np.array([(g, number[i + di, j + dj]) for (i, j), g in number.items()
                          for di, dj in ((1, 0), (0, 1), (-1, 1)) if (i + di, j + dj) in number])
        chosen = np.flatnonzero(mesh.subdivision == k)
        edges = mesh.rows[(mesh.first[chosen].astype(np.int64)[:, None, None] + local).reshape(-1, 2)]
        pairs += [ends[buried[ends[:, 0]] & ~buried[ends[:, 1]]] for ends in (edges, edges[:, ::-1])]
    return np.unique(np.concatenate(pairs), axis=0)


def automatic_edge(bounds: np.ndarray) -> float:
    """Default `max_edge`: 1/64 of the diagonal of the receivers' bounding box (2, 3)."""
    return float(np.linalg.norm(bounds[1] - bounds[0])) / 64


def _grid(k: int) -> np.ndarray:
    """Barycentric weights of the grid points of a triangle cut k x k: row j holds i = 0 .. k - j, weights (k - i - j, i, j) /
    k.
    """
    return np.array([((k - i - j) / k, i / k, j / k) for j in range(k + 1) for i in range(k + 1 - j)])


def _unit(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.where(length > 0, v / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


def _hashable(keys: np.ndarray) -> np.ndarray:
    """Rows as single opaque items, which numpy sorts and compares as a whole."""
    keys = np.ascontiguousarray(keys)
    return keys.view(np.dtype((np.void, keys.dtype.itemsize * keys.shape[1]))).reshape(-1)
