"""Procedural scenes with the triangle and light counts of [W20] Table 1, of any size: vertices as shading points, lights as triangles."""
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

STEP = 1e-4
"""Of the differences that give normals, in a surface's own parameters."""
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


class Points(NamedTuple):
    """Vertices of a mesh."""

    positions: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    """(V, 3) each."""
    faces: np.ndarray


class Lights(NamedTuple):
    """Triangles as :py:func:`mi_shlight.project_mesh` takes them: positive from the side that `target` was on."""

    vertices: np.ndarray
    faces: np.ndarray
    radiance: np.ndarray


class Scene(NamedTuple):
    name: str
    figure: int
    """Of [W20] that it stands for."""
    points: Points
    lights: Lights

    @property
    def bounds(self) -> tuple:
        """Corners of the box around all points, 0.1 % wider."""
        lower, upper = self.points.positions.min(axis=0), self.points.positions.max(axis=0)
        margin = 1e-3 * np.max(upper - lower)
        return lower - margin, upper + margin


class Published(NamedTuple):
    """A row of [W20] Table 1: counts, milliseconds on their GPU, mean absolute error, and how much faster than [W18] it is."""

    figure: int
    triangles: int
    lights: int
    coefficients: float
    gradients: float
    interpolation: float
    total: float
    error: float
    reference: float
    speedup: float


W20 = {
    "Dragon & Bunny": Published(1, 1_280_000, 723, 16.5, 20.2, 6.6, 27.9, 0.18e-3, 110e3, 3943),
    "Monkey": Published(7, 71_200, 118, 1.3, 1.8, 0.4, 3.3, 0.29e-3, 177, 35),
    "Plants": Published(8, 190_000, 2, 0.08, 0.1, 2.1, 3.1, 0.17e-3, 9.4, 3),
    "Asian Dragon": Published(9, 1_420_000, 181, 2.3, 3.0, 8.1, 12.7, 1.35e-3, 3.22e3, 254),
    "Room": Published(10, 1_710_000, 344, 4.3, 5.8, 10.3, 17.7, 0.34e-3, 6.85e3, 387),
    "Buddha": Published(11, 422_000, 210, 4.8, 5.7, 6.0, 12.7, 0.07e-3, 28.6e3, 2252),
}


# Surfaces: functions of (u, v), arrays from 0 to 1, that give points (..., 3); normals point along df/du x df/dv.

def patch(surface, triangles: float, albedo=(0.7, 0.7, 0.7)) -> Points:
    """A square grid over a surface, with about as many triangles."""
    n = max(2, round(math.sqrt(triangles / 2)))
    u, v = (c.ravel() for c in np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij"))
    inside_u, inside_v = (np.clip(c, STEP, 1 - STEP) for c in (u, v))
    along_u = surface(inside_u + STEP, inside_v) - surface(inside_u - STEP, inside_v)
    along_v = surface(inside_u, inside_v + STEP) - surface(inside_u, inside_v - STEP)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.column_stack([corner, corner + n + 1, corner + n + 2]),
                            np.column_stack([corner, corner + n + 2, corner + 1])])
    return Points(surface(u, v), normalize(np.cross(along_u, along_v)), np.tile(np.asarray(albedo, float), (len(u), 1)), faces)


def joined(parts: list) -> Points:
    offsets = np.cumsum([0, *(len(part.positions) for part in parts[:-1])])
    faces = [part.faces + offset for part, offset in zip(parts, offsets)]
    return Points(*(np.concatenate([part[k] for part in parts]) for k in range(3)), np.concatenate(faces))


def normalize(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def plane(origin, u_edge, v_edge):
    origin, u_edge, v_edge = (np.asarray(v, float) for v in (origin, u_edge, v_edge))
    return lambda u, v: origin + u[..., None] * u_edge + v[..., None] * v_edge


def floor(size: float):
    """Level square at height 0, facing up (+y)."""
    return plane((-size, 0, size), (2 * size, 0, 0), (0, 0, -2 * size))


def ball(centre, radii, bumps: float = 0.0, power: float = 2.0):
    """Ellipsoid with poles along y; larger powers square it; `bumps` is the part of the radius by which lumps stand out."""
    def surface(u, v):
        azimuth, polar = 2 * np.pi * u, np.pi * (1 - (0.002 + 0.996 * v))
        d = np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], axis=-1)
        d = d / np.sum(np.abs(d) ** power, axis=-1, keepdims=True) ** (1 / power)
        lump = 1 + bumps * np.sin(9 * d[..., 0] + 2) * np.sin(8 * d[..., 1]) * np.sin(10 * d[..., 2] + 1)
        return np.asarray(centre, float) + np.asarray(radii, float) * d * lump[..., None]

    return surface


def knot(centre, radius: float, turns: tuple = (2, 3), thickness: float = 0.3, scales: float = 0.0):
    """Tube along a torus knot; `scales` is the part of its thickness by which scales stand out."""
    p, q = turns

    def spine(t):
        reach = 1 + 0.4 * np.cos(q * t)
        return np.stack([np.cos(p * t) * reach, 0.4 * np.sin(q * t), np.sin(p * t) * reach], axis=-1)

    def surface(u, v):
        t, angle = 2 * np.pi * u, -2 * np.pi * v
        tangent = normalize(spine(t + 1e-3) - spine(t - 1e-3))
        side = normalize(np.cross(tangent, spine(t) - np.stack([np.cos(p * t), 0 * t, np.sin(p * t)], axis=-1)))
        other = np.cross(tangent, side)
        r = thickness * (1 + scales * np.sin(60 * t) * np.sin(8 * angle))
        ring = np.cos(angle)[..., None] * side + np.sin(angle)[..., None] * other
        return np.asarray(centre, float) + radius * (spine(t) + r[..., None] * ring)

    return surface


def column(centre, radius: float, height: float, flutes: int = 5, twist: float = 2.0):
    """Fluted column around y that swings in and out on its way up."""
    def surface(u, v):
        azimuth = 2 * np.pi * u
        r = radius * (1 + 0.35 * np.sin(7 * v) * (1 - v)) * (1 + 0.12 * np.cos(flutes * azimuth - twist * v)) * (1.02 - v**4)
        return np.asarray(centre, float) + np.stack([r * np.sin(azimuth), height * v, r * np.cos(azimuth)], axis=-1)

    return surface


def leaf(base, azimuth: float, rise: float, length: float, width: float):
    """Pointed leaf that bends down."""
    out, across = np.array([math.sin(azimuth), 0, math.cos(azimuth)]), np.array([math.cos(azimuth), 0, -math.sin(azimuth)])

    def surface(u, v):
        up = length * (rise * v - 0.9 * v * v)
        half = width * np.sin(np.pi * (0.01 + 0.98 * v)) * (2 * u - 1)
        return np.asarray(base) + length * v[..., None] * out + half[..., None] * across + (up + 0.3 * np.abs(half))[..., None] * [0, 1, 0]

    return surface


# Lights.

def frame(position, target) -> np.ndarray:
    """Columns right, up, normal of a light at `position` that faces `target`."""
    normal = normalize(np.subtract(target, position).astype(float))
    right = normalize(np.cross([0.0, 1.0, 1e-3], normal))
    return np.column_stack([right, np.cross(normal, right), normal])


def placed(flat: np.ndarray, faces: np.ndarray, radiance: np.ndarray, position, target) -> Lights:
    """Flat triangles, counter-clockwise in (right, up) as seen from `target`, put in place; turned round for ``project_mesh``."""
    return Lights(np.asarray(position, float) + flat @ frame(position, target)[:, :2].T, faces[:, ::-1], radiance)


def textured(position, target, width: float, height: float, columns: int, rows: int, count: int, colours, apart: float = 1.0) -> Lights:
    """Rectangle of ``2 columns rows`` triangles, of which the first `count` are there; radiance changes linearly between four corners.

    `apart` below 1: every triangle shrunk to that part about its centre, with corners of its own.
    """
    u, v = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    flat = np.column_stack([width * (u.ravel() - 0.5), height * (v.ravel() - 0.5)])
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    lower = np.column_stack([corner, corner + 1, corner + columns + 1])
    upper = np.column_stack([corner + columns + 2, corner + columns + 1, corner + 1])
    faces = np.stack([lower, upper], axis=1).reshape(-1, 3)[:count]
    centre = flat[faces].mean(axis=1)
    a, b = (centre / [width, height] + 0.5).T
    a, b = a[:, None], b[:, None]
    low_left, low_right, top_left, top_right = np.asarray(colours, float)
    radiance = (1 - b) * ((1 - a) * low_left + a * low_right) + b * ((1 - a) * top_left + a * top_right)
    if apart < 1:
        flat = (centre[:, None] + apart * (flat[faces] - centre[:, None])).reshape(-1, 2)
        faces = np.arange(3 * len(faces)).reshape(-1, 3)
    return placed(flat, faces, radiance, position, target)


def sierpinski(depth: int, size: float, position, target, colours) -> Lights:
    """Fractal triangle of 3^depth triangles."""
    corners = [size * np.array([[-1, -0.58], [1, -0.58], [0, 1.15]])]
    for _ in range(depth):
        corners = [0.5 * (triangle + triangle[k]) for triangle in corners for k in range(3)]
    flat = np.array(corners).reshape(-1, 2)
    height = np.array([triangle.mean(axis=0)[1] for triangle in corners]) / (2 * size) + 0.3
    low, high = np.asarray(colours, float)
    return placed(flat, np.arange(len(flat)).reshape(-1, 3), low + height[:, None] * (high - low), position, target)


def star(count: int, size: float, position, target, colour) -> Lights:
    """Strip of `count` triangles round a hole, with twelve points outside."""
    k = np.arange(count + 2)
    angle = 2 * np.pi * k / (count + 2)
    radius = size * np.where(k % 2 == 0, 0.45, 0.8 + 0.3 * np.cos(12 * angle))
    flat = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    faces = np.column_stack([k[:-2], k[1:-1], k[2:]])
    faces[1::2] = faces[1::2, ::-1]
    return placed(flat, faces, np.tile(np.asarray(colour, float), (count, 1)), position, target)


def together(parts: list) -> Lights:
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Lights(np.concatenate([part.vertices for part in parts]),
                  np.concatenate([part.faces + offset for part, offset in zip(parts, offsets)]),
                  np.concatenate([part.radiance for part in parts]))


# The scenes.

def shares(triangles: float, *parts) -> Points:
    """Patches ``(surface, share of the triangles, albedo)``."""
    return joined([patch(surface, share * triangles, albedo) for surface, share, albedo in parts])


GREY, WARM, COOL = (0.6, 0.6, 0.6), (0.75, 0.66, 0.55), (0.55, 0.65, 0.75)


def dragon_and_bunny(triangles: float) -> tuple:
    points = shares(triangles, (floor(3), 0.1, GREY), (knot((0.9, 0.95, 0), 0.85, (2, 3), 0.3, 0.08), 0.6, WARM),
                    (ball((-1.3, 0.7, 0.3), (0.6, 0.7, 0.6), 0.15), 0.3, COOL))
    panels = [textured(*place, 2.2, 2.2, 11, 11, 241, colours, 0.85) for place, colours in (
        (((-3.4, 2.8, 2.2), (0, 0.6, 0)), [(9, 1, 1), (9, 5, 1), (8, 1, 3), (9, 8, 4)]),
        (((3.6, 2.6, 1.8), (0, 0.6, 0)), [(1, 2, 8), (1, 6, 7), (3, 2, 9), (2, 8, 5)]),
        (((0.2, 4.6, -0.8), (0, 0.3, 0)), [(1, 5, 2), (5, 5, 5), (2, 2, 6), (6, 2, 5)]))]
    return points, together(panels)


def monkey(triangles: float) -> tuple:
    points = shares(triangles, (floor(2.2), 0.2, GREY), (ball((0, 0.9, 0), (0.8, 0.8, 0.7), 0.2), 0.6, WARM),
                    (ball((-0.85, 1.1, 0), (0.25, 0.3, 0.12)), 0.1, WARM), (ball((0.85, 1.1, 0), (0.25, 0.3, 0.12)), 0.1, WARM))
    return points, textured((-1.6, 2.9, 2.4), (0, 0.7, 0), 1.8, 1.8, 8, 8, 118, [(6, 3, 1), (6, 6, 5), (2, 4, 6), (6, 2, 4)])


def plants(triangles: float) -> tuple:
    stalks = [(-0.9, 0.2), (0.8, -0.4), (0.1, 0.9)]
    leaves = [leaf((x, 0.35 + 0.045 * k, z), k * GOLDEN_ANGLE, 1.1 + 0.02 * k, 0.75 - 0.015 * k, 0.12)
              for x, z in stalks for k in range(24)]
    points = shares(triangles, (floor(2.5), 0.2, GREY), *((column((x, 0, z), 0.25, 0.4), 0.05, WARM) for x, z in stalks),
                    *((surface, 0.65 / len(leaves), (0.3, 0.6, 0.25)) for surface in leaves))
    near = placed(np.array([[-0.5, -0.4], [0.5, -0.4], [0, 0.6]]), np.array([[0, 1, 2]]), np.array([[12.0, 9, 6]]), (-2.2, 2.4, 1.6),
                  (0, 0.6, 0))
    far = placed(np.array([[-0.6, -0.5], [0.7, -0.4], [0.1, 0.7]]), np.array([[0, 1, 2]]), np.array([[6.0, 8, 11]]), (2.4, 2.8, 1.4),
                 (0, 0.6, 0))
    return points, together([near, far])


def asian_dragon(triangles: float) -> tuple:
    points = shares(triangles, (floor(2.6), 0.12, GREY), (knot((0, 0.85, 0), 1.15, (3, 5), 0.2, 0.12), 0.88, (0.5, 0.68, 0.55)))
    return points, textured((0.6, 2.5, 1.9), (0, 0.5, 0), 2.6, 1.5, 13, 7, 181, [(7, 2, 1), (6, 6, 2), (2, 3, 7), (5, 2, 6)])


def room(triangles: float) -> tuple:
    walls = [floor(1.5), plane((-1.5, 0, -1.5), (3, 0, 0), (0, 2.2, 0)), plane((-1.5, 0, 1.5), (0, 0, -3), (0, 2.2, 0)),
             plane((1.5, 0, -1.5), (0, 0, 3), (0, 2.2, 0)), plane((-1.5, 2.2, -1.5), (3, 0, 0), (0, 0, 3))]
    cushions = [((0, 0.18, -0.9), (0.8, 0.16, 0.36)), ((-0.37, 0.42, -0.85), (0.37, 0.1, 0.34)), ((0.37, 0.42, -0.85), (0.37, 0.1, 0.34)),
                ((-0.37, 0.75, -1.15), (0.37, 0.27, 0.12)), ((0.37, 0.75, -1.15), (0.37, 0.27, 0.12)),
                ((-0.9, 0.35, -0.9), (0.12, 0.3, 0.39)), ((0.9, 0.35, -0.9), (0.12, 0.3, 0.39)), ((0, 0.4, 0.3), (0.45, 0.03, 0.3))]
    points = shares(triangles, *((wall, 0.06, GREY) for wall in walls), *((ball(*place, power=8), 0.08, WARM) for place in cushions),
                    (column((0.2, 0.43, 0.3), 0.09, 0.35), 0.06, COOL))
    blue = textured((-1.45, 1.2, 0.2), (0, 1.2, 0.2), 1.8, 1.05, 12, 7, 168, [(0.5, 2, 6), (1, 5, 6), (0.5, 1, 5), (3, 5, 6)])
    pink = textured((1.45, 1.2, 0.2), (0, 1.2, 0.2), 1.65, 1.2, 11, 8, 176, [(6, 1, 4), (6, 3, 5), (5, 1, 2), (6, 5, 4)])
    return points, together([blue, pink])


def buddha(triangles: float) -> tuple:
    points = shares(triangles, (floor(2.4), 0.2, GREY), (column((0, 0.3, 0), 0.55, 1.9, 6, 3), 0.6, WARM),
                    (ball((0, 0.2, 0), (0.8, 0.22, 0.8), power=6), 0.2, COOL))
    lights = [star(129, 1.0, (-2.8, 2.2, 1.8), (0, 0.9, 0), (2, 5, 9)),
              sierpinski(4, 1.2, (2.7, 2.3, 1.7), (0, 0.9, 0), [(9, 2, 1), (3, 8, 6)])]
    return points, together(lights)


BUILDERS = dict(zip(W20, (dragon_and_bunny, monkey, plants, asian_dragon, room, buddha)))


def table_scene(name: str, scale: float = 1.0) -> Scene:
    """A scene of [W20] Table 1 with `scale` times its triangles and all of its lights."""
    points, lights = BUILDERS[name](scale * W20[name].triangles)
    return Scene(name, W20[name].figure, points, lights)
