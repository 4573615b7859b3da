"""Lights that move from picture to picture: what is known of them, brought up to date without another look at each."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .light.cut import SUBDIVISIONS, cut, is_convex, weld
from .scene import PLANARITY


class MovingLights:
    """Follows the vertices of a scene's lights as long as they stay what they are: the same polygons, triangles and pieces of texture.

    Scenes may have hundreds of lights, all of which move in every frame, so their vertices are tested in arrays over all of them.
    """

    def __init__(self, lights: list):
        """`lights`: :py:class:`~mi_shlight.scene.PolygonLight` objects, which :py:meth:`follow` changes."""
        self._lights = lights
        self._first = np.cumsum([0] + [len(light.vertices) for light in lights])
        self._first_face = np.cumsum([0] + [len(light.faces) for light in lights])
        self._faces = np.concatenate([light.faces + first for light, first in zip(lights, self._first)])
        self._welded = np.concatenate([weld(light.vertices) + first for light, first in zip(lights, self._first)])
        self._positions = np.concatenate([light.vertices for light in lights])
        self._planar = self._planes(self._positions)[0]
        self._convex = [light.normal is not None or _is_convex(light, light.vertices) for light in lights]

    def follow(self) -> bool:
        """Give the lights their present vertices and normals. False, with nothing changed, if they have to be looked at anew.

        That is so if a mesh tears open, becomes planar or is no longer, loses its area, or turns its emitting side over; also if a
        texture is to be cut differently. Vertices that meet leave an outline with edges that cancel each other, which is as good.
        """
        buffers = [dr.detach(light.shape.vertex_positions_buffer()) for light in self._lights]
        if [dr.width(buffer) for buffer in buffers] != (3 * np.diff(self._first)).tolist():
            return False
        positions = np.array(dr.concat(buffers), np.float64).reshape(-1, 3)
        planar, normals, areas = self._planes(positions)
        if not (np.isfinite(positions).all() and (positions[self._welded] == positions).all() and (planar == self._planar).all()
                and np.add.reduceat(areas, self._first_face[:-1]).all()):
            return False
        moved = np.logical_or.reduceat((positions != self._positions).any(axis=1), self._first[:-1])
        vertices = np.split(positions, self._first[1:-1])
        of_lights = zip(self._lights, vertices, self._convex, moved)
        if not all(self._keeps(light, v, convex) for light, v, convex, changed in of_lights if changed):
            return False
        for light, v, normal in zip(self._lights, vertices, normals):
            light.vertices = v
            light.normal = None if light.normal is None else normal
        self._positions = positions
        return True

    def _planes(self, positions: np.ndarray) -> tuple:
        """(planar with all faces turned the same way (L,), unit normals (L, 3), areas of the faces (F,) times two)."""
        corners, lights = positions[self._faces], self._first_face[:-1]
        owner = np.repeat(np.arange(len(self._lights)), np.diff(self._first_face))
        vectors = np.cross(corners[:, 2] - corners[:, 0], corners[:, 1] - corners[:, 0])
        normals = np.add.reduceat(vectors, lights)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        middle = np.add.reduceat(corners.sum(axis=1), lights) / (3 * np.diff(self._first_face))[:, None]
        off = np.maximum.reduceat(np.abs(np.einsum("fcx,fx->fc", corners - middle[owner][:, None], normals[owner])).max(axis=1), lights)
        extent = np.maximum.reduceat(corners.max(axis=1), lights) - np.minimum.reduceat(corners.min(axis=1), lights)
        turned = np.minimum.reduceat(np.einsum("fx,fx->f", vectors, normals[owner]), lights) >= 0
        planar = turned & (length[:, 0] > 0) & (off <= PLANARITY * extent.max(axis=1))
        return planar, normals, np.linalg.norm(vectors, axis=1)

    @staticmethod
    def _keeps(light, vertices: np.ndarray, convex: bool) -> bool:
        """True if the cut of the light's texture, the side that it emits to, and whether its faces may hide one another are with other
        vertices what they were.
        """
        if light.normal is None and _is_convex(light, vertices) != convex:
            return False
        if light.textured and light.pieces is None:
            return False                              # its mean goes by the areas of its faces
        if light.pieces is not None:
            again = cut(light.faces, vertices, light.uv, getattr(light.emitter, "subdivisions", SUBDIVISIONS))
            if not all(np.array_equal(a, b) for a, b in zip(again, light.pieces)):
                return False
        if light.shape.class_name() != "Rectangle":   # a mesh goes by its winding, a rectangle may be mirrored
            return True
        a, b, c = vertices[light.faces[0]]
        return np.ravel(np.array(light.shape.sample_position(0, mi.Point2f(0.5)).n)) @ np.cross(c - a, b - a) > 0


def _is_convex(light, vertices: np.ndarray) -> bool:
    return is_convex(light.faces[:, ::-1], vertices, PLANARITY)
