"""Faces of a mesh as index tables: edges that faces share, listed once, and the parts that fill the faces."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .polygon import strip_corners, strip_count


class Topology(NamedTuple):
    """Faces as index tables, from :py:func:`mesh_topology`."""

    edges: np.ndarray
    """(E, 4): start, end, left face, right face, part by part; the number of faces stands for none."""
    triangles: np.ndarray
    """(T, 4): three corners, face. Together they fill the faces, with sign where a face is not convex."""
    strips: np.ndarray
    """(S, 5): four corners, face; as :py:meth:`mi_shlight.light.polygon.VertexList.fold_patches`."""
    first: np.ndarray
    """(F,): a corner of each face."""
    part: np.ndarray
    """(F,): number of the light to which each face belongs, ascending."""


def mesh_topology(faces: list, part=None) -> Topology:
    """Edges, triangles and strips of `faces`, a list of integer arrays of three or more vertex indices. `part`: 0 for all by default.

    Each edge is listed once, however many faces share it, as long as every face that runs along it one way finds one that runs back;
    otherwise, in meshes that are not consistently oriented, it stands there several times. Faces of different parts share none.
    """
    part = np.zeros(len(faces), int) if part is None else np.asarray(part)
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
    order = np.lexsort((owner, back, high, low, part[owner]))
    low, high, back, owner = low[order], high[order], back[order], owner[order]
    _, first, group = np.unique(np.column_stack([part[owner], low, high, back]), axis=0, return_index=True, return_inverse=True)
    rank = np.arange(len(low)) - first[group.reshape(-1)]       # among the faces that run along the edge the same way
    slots, slot = np.unique(np.column_stack([part[owner], low, high, rank]), axis=0, return_inverse=True)
    sides = np.full((len(slots), 2), len(faces))
    sides[slot.reshape(-1), back.astype(int)] = owner
    return Topology(np.column_stack([slots[:, 1:3], sides]), triangles, strips, np.array([face[0] for face in faces]), part)


class MeshTables:
    """A topology on the device, which pictures with other positions and radiance share."""

    DRJIT_STRUCT = dict.fromkeys(("edges", "sides", "edge_part", "triangles", "triangle_part", "triangle_owner", "strips", "strip_owner",
                                  "first", "bounds"), object)
    """Buffers that `dr.freeze` must know of."""

    def __init__(self, index, topology: Topology, kept=None, flat: bool = False):
        """`index`: Dr.Jit type; `kept`: mask of the edges that matter; `flat`: each part lies in a plane, its faces turned the same way."""
        self.flat = flat
        edges = topology.edges if kept is None else topology.edges[kept]
        self.face_count, self.edge_count, self.part_count = len(topology.first), len(edges), int(topology.part[-1]) + 1
        edge_part = topology.part[np.minimum(edges[:, 2], edges[:, 3])]         # none has the largest number
        triangle_part, strip_part = (topology.part[rows[:, -1]] for rows in (topology.triangles, topology.strips))
        column = lambda values: index(values.tolist())
        (*self.edges, left, right), (*self.triangles, self.triangle_owner), (*self.strips, self.strip_owner) = (
            [column(values) for values in rows.T] for rows in (edges, topology.triangles, topology.strips))
        self.sides = [left, right]
        self.edge_part, self.triangle_part = column(edge_part), column(triangle_part)
        self.first = column(np.append(topology.first, 0))                       # and one for the face that stands for none
        self.bounds = [column(np.searchsorted(parts, np.arange(self.part_count + 1))) for parts in (edge_part, triangle_part, strip_part)]
