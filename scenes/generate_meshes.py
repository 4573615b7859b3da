"""Meshes, lights and textures of the example scenes, for ``generate.py``: procedural, and the same to the last byte on every run.

Axes: y up, lengths in scene units. Faces are wound counter-clockwise seen from outside (lights: from the lit side).
"""
from __future__ import annotations

import math
import random
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


# ------------------------------------------------------------------------------------------------ meshes
class Surface(NamedTuple):
    """A triangle mesh: `vertices` (N, 3) and `faces` (M, 3), indices into `vertices`."""

    vertices: np.ndarray
    faces: np.ndarray


def merge(parts: list[Surface]) -> Surface:
    """One mesh holding all `parts`; nothing is welded, so parts keep their own normals."""
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return Surface(np.concatenate([p.vertices for p in parts]),
                   np.concatenate([p.faces + o for p, o in zip(parts, offsets)]))


def transform(surface: Surface, matrix, offset) -> Surface:
    """`surface` with every vertex p moved to matrix @ p + offset (matrix without reflection)."""
    return Surface(surface.vertices @ np.asarray(matrix, float).T + np.asarray(offset, float), surface.faces)


def grid_faces(rows: int, columns: int, wrap_rows: bool = False, wrap_columns: bool = False) -> np.ndarray:
    """Faces of a rows x columns vertex grid (index row * columns + column); a wrapped direction closes on itself.

    The normal side is (column direction) x (row direction).
    """
    r, c = np.meshgrid(np.arange(rows if wrap_rows else rows - 1),
                       np.arange(columns if wrap_columns else columns - 1), indexing="ij")
    r, c = r.ravel(), c.ravel()
    r1, c1 = (r + 1) % rows, (c + 1) % columns
    a, b, d, e = r * columns + c, r * columns + c1, r1 * columns + c, r1 * columns + c1
    return np.stack([a, b, e, a, e, d], axis=1).reshape(-1, 3)


def rotation(axis: str, degrees: float) -> np.ndarray:
    """3 x 3 matrix of the right-handed rotation about 'x', 'y' or 'z'."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def normalize(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def lathe(profile: list[tuple[float, float]], segments: int) -> Surface:
    """Surface of revolution about y of a smooth profile of (radius, height) pairs; normals point to its left side."""
    radius, height = np.array(profile, float).T
    angle = 2 * np.pi * np.arange(segments) / segments
    vertices = np.stack([radius[:, None] * np.sin(angle), np.repeat(height[:, None], segments, axis=1),
                         radius[:, None] * np.cos(angle)], axis=-1)
    return Surface(vertices.reshape(-1, 3), grid_faces(len(profile), segments, wrap_columns=True))


def disc(radius: float, dome: float, rings: int, segments: int) -> Surface:
    """Round cap facing +y around a single centre vertex, raised by `dome` in the middle."""
    rim = [(radius * k / rings, dome * (1 - (k / rings) ** 2)) for k in range(rings, 0, -1)]
    ring = lathe(rim, segments)
    centre, last = len(ring.vertices), (rings - 1) * segments
    k = np.arange(segments)
    fan = np.stack([last + k, last + (k + 1) % segments, np.full(segments, centre)], axis=1)
    return Surface(np.concatenate([ring.vertices, [[0.0, dome, 0.0]]]), np.concatenate([ring.faces, fan]))


def ball(rings: int, segments: int) -> Surface:
    """Unit sphere about y: `rings` circles of `segments` vertices between two poles."""
    angle = np.pi * np.arange(1, rings + 1) / (rings + 1)
    body = lathe(list(zip(np.sin(angle), -np.cos(angle))), segments)
    k, south = np.arange(segments), len(body.vertices)
    following, last = (k + 1) % segments, south - segments
    caps = np.concatenate([np.stack([following, k, np.full_like(k, south)], axis=1),
                           np.stack([last + k, last + following, np.full_like(k, south + 1)], axis=1)])
    return Surface(np.concatenate([body.vertices, [[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]]), np.concatenate([body.faces, caps]))


def tube(path: np.ndarray, radius: np.ndarray, segments: int) -> Surface:
    """Open round tube along the polyline `path` (N, 3), which must never run along x, with a radius per point."""
    tangent = normalize(np.gradient(path, axis=0))
    side = normalize(np.cross(tangent, [1.0, 0.0, 0.0]))
    other = np.cross(side, tangent)
    angle = 2 * np.pi * np.arange(segments)[:, None] / segments
    ring = np.cos(angle) * side[:, None] - np.sin(angle) * other[:, None]
    return Surface((path[:, None] + radius[:, None, None] * ring).reshape(-1, 3),
                   grid_faces(len(path), segments, wrap_columns=True))


def write_ply(path: Path, surface: Surface) -> None:
    """Binary little-endian PLY without normals: the loader builds smooth ones; 16-bit indices halve the file."""
    if len(surface.vertices) > 1 << 16:
        raise ValueError(f"write_ply(): 'surface' must have at most 65536 vertices, got {len(surface.vertices)}.")
    header = ("ply\nformat binary_little_endian 1.0\n"
              f"element vertex {len(surface.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
              f"element face {len(surface.faces)}\nproperty list uchar ushort vertex_indices\nend_header\n")
    faces = np.zeros(len(surface.faces), dtype=[("count", "u1"), ("index", "<u2", 3)])
    faces["count"], faces["index"] = 3, surface.faces
    # Adding 0 turns -0 into 0
    vertices = (np.round(surface.vertices, 5) + 0.0).astype("<f4")
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())


def write_png(path: Path, pixels: np.ndarray) -> None:
    """8-bit sRGB picture (H, W, 3) of less than 64 KB, stored without compression, whose bytes would depend on the library."""
    raw = b"".join(b"\0" + row.tobytes() for row in pixels.astype(np.uint8))
    size = struct.pack("<H", len(raw))
    stored = b"\x78\x01\x01" + size + bytes(255 - b for b in size) + raw + struct.pack(">I", zlib.adler32(raw))
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    header = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", stored) + chunk(b"IEND", b""))


def flat_light(outline: list[tuple[float, float]], triangles: list[tuple[int, int, int]],
               position, target) -> Surface:
    """Planar polygon light, `outline` counter-clockwise in (right, up) as seen from `target`, facing `target`."""
    normal = normalize(np.subtract(target, position).astype(float))
    right = normalize(np.cross([0.0, 1.0, 0.0], normal))
    up = np.cross(normal, right)
    flat = np.array(outline, float)
    return Surface(np.asarray(position, float) + flat[:, :1] * right + flat[:, 1:] * up, np.array(triangles))


# ------------------------------------------------------------------------------------------------ plant
STEM_BASE, STEM_TOP = 0.50, 1.42


def stem_point(t) -> np.ndarray:
    """Point of the gently curved stem; t from 0 (soil) to 1 (top)."""
    t = np.asarray(t, float)
    return np.stack([0.09 * np.sin(2.6 * t), STEM_BASE + (STEM_TOP - STEM_BASE) * t, 0.06 * np.sin(3.5 * t)], axis=-1)


def pot() -> Surface:
    """Flower pot: outer wall, rim and inner wall, each smooth and with a crease between."""
    wall = [(0.24 + 0.12 * t + 0.015 * math.sin(math.pi * t), 0.44 * t) for t in np.linspace(0, 1, 14)]
    band = [(0.40 + 0.008 * math.sin(math.pi * t), 0.44 + 0.12 * t) for t in np.linspace(0, 1, 5)]
    inner = [(0.36 - 0.01 * t, 0.56 - 0.10 * t) for t in np.linspace(0, 1, 5)]
    parts = [wall, [wall[-1], band[0]], band, [band[-1], inner[0]], inner]
    return merge([lathe(part, 56) for part in parts])


def leaf(base, azimuth: float, elevation: float, droop: float, length: float, width: float, roll: float) -> Surface:
    """Pointed leaf of 21 x 11 vertices bending down along its midrib; angles in radians, upper side is the normal side."""
    rows, half = 21, 5
    t = np.linspace(0, 1, rows + 2)
    angle = elevation - droop * t**1.3
    step = length / (rows + 1)
    along = np.stack([np.cos(angle) * math.sin(azimuth), np.sin(angle), np.cos(angle) * math.cos(azimuth)], axis=-1)
    midrib = np.asarray(base) + step * np.concatenate([np.zeros((1, 3)), np.cumsum(along[:-1], axis=0)])
    level = np.array([-math.cos(azimuth), 0.0, math.sin(azimuth)])
    side = math.cos(roll) * level + math.sin(roll) * np.cross(level, along)
    above = np.cross(side, along)
    # Widest a little before the middle, pointed at both ends
    shape = width * np.sin(np.pi * t[1:-1] ** 0.76) * (1 - 0.25 * t[1:-1])
    s = np.arange(-half, half + 1) / half
    cup = 0.45 * np.abs(s) ** 1.4 + 0.10 * s**2 * np.sin(14 * t[1:-1, None] + 2 * np.sign(s))
    inside = (midrib[1:-1, None] + shape[:, None, None] * (s[:, None] * side[1:-1, None])
              + (shape[:, None] * cup)[..., None] * above[1:-1, None])
    columns, tip = 2 * half + 1, rows * (2 * half + 1)
    k = np.arange(columns - 1)
    last = tip - columns
    ends = np.concatenate([np.stack([k + 1, k, np.full_like(k, tip)], axis=1),
                           np.stack([last + k, last + k + 1, np.full_like(k, tip + 1)], axis=1)])
    return Surface(np.concatenate([inside.reshape(-1, 3), midrib[[0, -1]]]),
                   np.concatenate([grid_faces(rows, columns), ends]))


def plant() -> tuple[Surface, Surface]:
    """(stem with leaf stalks, leaves): 26 leaves up the stem, each turned by the golden angle."""
    rng = random.Random(7)
    t = np.linspace(0, 1, 30)
    stalks = [tube(stem_point(t), 0.030 - 0.016 * t, 12)]
    leaves = []
    count = 26
    for k in range(count):
        up = k / (count - 1)
        azimuth = k * GOLDEN_ANGLE + 0.5 * (rng.random() - 0.5)
        elevation = math.radians(22 + 50 * up**1.5 + 14 * (rng.random() - 0.5))
        root = stem_point(0.22 + 0.76 * up)
        reach = 0.20 - 0.12 * up
        outward = np.array([math.sin(azimuth), 0.0, math.cos(azimuth)])
        s = np.linspace(0, 1, 8)[:, None]
        stalk = root + s * reach * math.cos(elevation) * outward + [0.0, 1.0, 0.0] * (
            s * reach * math.sin(elevation) + 0.02 * s * (1 - s))
        stalks.append(tube(stalk, np.full(8, 0.011), 7))
        leaves.append(leaf(stalk[-1], azimuth, elevation, droop=1.5 + 0.5 * rng.random() - 0.7 * up,
                           length=(0.62 - 0.22 * up) * (0.9 + 0.2 * rng.random()), width=0.135 - 0.05 * up,
                           roll=0.5 * (rng.random() - 0.5)))
    return merge(stalks), merge(leaves)


# ------------------------------------------------------------------------------------------------ sculpture
def sculpture() -> Surface:
    """Trefoil knot of a flattened bar that turns twice about its own axis on the way round."""
    rows, columns = 320, 36
    u = (2 * np.pi * np.arange(rows) / rows)[:, None]
    circle = np.concatenate([np.cos(2 * u), np.sin(2 * u), 0 * u], axis=1)
    centre = circle * (1 + 0.40 * np.cos(3 * u)) + 0.46 * np.sin(3 * u) * [0.0, 0.0, 1.0]
    tangent = normalize(np.roll(centre, -1, axis=0) - np.roll(centre, 1, axis=0))
    outward = centre - circle                    # away from the torus's core circle: a frame that closes on itself
    across = normalize(np.cross(tangent, outward))
    outward = np.cross(across, tangent)
    v = 2 * np.pi * np.arange(columns) / columns
    turn = 2 * u
    a, b = 0.31 * np.cos(v), 0.12 * np.sin(v)
    x, y = a * np.cos(turn) - b * np.sin(turn), a * np.sin(turn) + b * np.cos(turn)
    vertices = centre[:, None] + x[..., None] * outward[:, None] + y[..., None] * across[:, None]
    return Surface(vertices.reshape(-1, 3), grid_faces(rows, columns, wrap_rows=True, wrap_columns=True))


PLINTH_HALF_WIDTH, PLINTH_TURN = 0.55, 24


def cove() -> Surface:
    """Seamless studio backdrop: floor, quarter-round and wall in one sheet, finest where the plinth stands.

    Light baked at a vertex under the plinth is black and would bleed out through the triangles that the plinth's edge
    cuts; so the floor has a hole there, whose rim is the first vertices inside, moved out to the plinth's foot.
    """
    foot = PLINTH_HALF_WIDTH + 0.001
    radius, depth, back, height, half_width = 1.2, 3.2, -2.0, 4.2, 4.5
    floor = [(z, 0.0) for z in [*np.linspace(depth, 0.9, 10, endpoint=False),
                                *np.linspace(0.9, back + radius, 26, endpoint=False)]]
    bend = [(back + radius * (1 - math.sin(a)), radius * (1 - math.cos(a))) for a in np.linspace(0, np.pi / 2, 13)]
    wall = [(back, y) for y in np.linspace(radius, height, 14)[1:]]
    z, y = np.array(floor + bend + wall).T
    s = np.linspace(-1, 1, 61)
    x = half_width * (0.4 * s + 0.6 * s**3)
    vertices = np.stack(np.broadcast_arrays(x, y[:, None], z[:, None]), axis=-1).reshape(-1, 3)
    turn = rotation("y", PLINTH_TURN)
    local = vertices @ turn
    reach = np.abs(local[:, [0, 2]]).max(axis=1)
    inside = (vertices[:, 1] == 0) & (reach < foot)
    axis = np.where(np.abs(local[:, 0]) > np.abs(local[:, 2]), 0, 2)[inside]
    local[inside, axis] = np.copysign(foot, local[inside, axis])
    faces = grid_faces(len(z), len(x))
    used, faces = np.unique(faces[~inside[faces].all(axis=1)], return_inverse=True)
    return Surface((local @ turn.T)[used], faces.reshape(-1, 3))


# ------------------------------------------------------------------------------------------------ textured room
def cushion() -> Surface:
    """A cube of side 2 with round edges and bulging sides, to be scaled into upholstery."""
    sphere = ball(23, 36)
    return Surface(sphere.vertices / np.sum(sphere.vertices**8, axis=1, keepdims=True) ** (1 / 8), sphere.faces)


def bottle() -> Surface:
    """Vase on a foot, closed at the bottom, open at the top; height 1."""
    wall = [(0.20 + 0.12 * math.sin(2.6 * t + 0.5) + 0.06 * math.cos(7 * t), t) for t in np.linspace(0, 1, 24)]
    foot = transform(disc(wall[0][0], 0.0, 3, 32), rotation("x", 180), (0, 0, 0))
    return merge([lathe(wall, 32), foot])


def blue_waves() -> np.ndarray:
    """Texture of the left light of `textured_room`: waves of blue, cyan and white, (56, 96, 3), 0 to 255."""
    y, x = np.meshgrid((np.arange(56) + 0.5) / 56, (np.arange(96) + 0.5) / 96, indexing="ij")
    wave = 0.5 + 0.5 * np.sin(9 * x + 2.5 * np.sin(5 * y + 1))
    crest = wave**6
    return np.round(255 * np.stack([0.2 + 0.8 * crest, 0.6 + 0.4 * wave, 0.9 + 0.1 * wave], axis=-1))


def pink_rings() -> np.ndarray:
    """Texture of the right light of `textured_room`: rings of pink, magenta and orange, (64, 88, 3), 0 to 255."""
    y, x = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(88) + 0.5) / 64, indexing="ij")
    ring = 0.5 + 0.5 * np.cos(14 * np.hypot(x - 0.5, y - 0.6))
    return np.round(255 * np.stack([0.95 + 0.05 * ring, 0.35 + 0.5 * ring**2 + 0.15 * y, 0.85 - 0.45 * x * (1 - ring)], axis=-1))


# ------------------------------------------------------------------------------------------------ many lights
def pillar() -> Surface:
    """Fluted column that narrows and turns by a third of a circle on its way up, with a domed end; height 2.2."""
    rows, columns = 44, 45
    t = np.linspace(0, 1, rows)[:, None]
    azimuth = 2 * np.pi * np.arange(columns) / columns
    end = np.sqrt(1 - np.clip((t - 0.9) / 0.1, 0, 1) ** 2)
    radius = (0.42 - 0.2 * t**1.5) * (1 + 0.16 * np.cos(5 * (azimuth - 2.1 * t))) * end
    ring = np.stack([radius * np.sin(azimuth), np.broadcast_to(2.2 * t, radius.shape), radius * np.cos(azimuth)], axis=-1)
    k, tip = np.arange(columns), (rows - 1) * columns
    fan = np.stack([tip - columns + k, tip - columns + (k + 1) % columns, np.full_like(k, tip)], axis=1)
    return Surface(np.concatenate([ring[:-1].reshape(-1, 3), ring[-1:, 0]]),
                   np.concatenate([grid_faces(rows - 1, columns, wrap_columns=True), fan]))


TRIANGLE = Surface(np.array([[math.sin(a), math.cos(a), 0.0] for a in (0, -2 * math.pi / 3, 2 * math.pi / 3)]), np.array([[0, 1, 2]]))
"""The light of `many_lights`: equilateral, its centre at the origin, facing +z; each copy has a transform of its own."""

PANEL_CELLS, PANEL_LIGHTS = 11, 241
"""A panel has PANEL_CELLS^2 square cells of two triangles each; the last of these 242 is left out."""


def panel(position, target, size: float, colours) -> list[tuple[np.ndarray, np.ndarray]]:
    """(3 x 4 matrix from `TRIANGLE`, radiance) of the lights of a square panel that faces `target`.

    `colours`: radiance (4, 3) at the lower left, lower right, upper left and upper right corner, linear in between.
    """
    normal = normalize(np.subtract(target, position).astype(float))
    right = normalize(np.cross([0.0, 1.0, 0.0], normal))
    frame = np.column_stack([right, np.cross(normal, right), normal])
    cell = 1 / PANEL_CELLS
    lights = []
    for k in range(PANEL_LIGHTS):
        row, column, upper = k // 2 // PANEL_CELLS, k // 2 % PANEL_CELLS, k % 2
        corners = cell * np.array([(column + 1, row + 1), (column, row + 1), (column + 1, row)] if upper else
                                  [(column, row), (column + 1, row), (column, row + 1)])
        centre = corners.mean(axis=0)
        spokes = 0.85 * size * (corners - centre)                   # a gap around each light: they can be turned alone
        flat = np.linalg.lstsq(TRIANGLE.vertices[:, :2], spokes, rcond=None)[0].T
        place = np.asarray(position, float) + size * (frame[:, :2] @ (centre - 0.5))
        matrix = np.column_stack([frame[:, :2] @ flat, frame[:, 2], place])
        u, v = centre
        lights.append((matrix, np.array([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]) @ np.asarray(colours, float)))
    return lights
