"""How long a bake and a picture take, from sizes of the scene, the measured time of a ray, and constants of the code.

Constants are nanoseconds of one thread at the speed at which a fused ``dr.sh_eval`` of order 8 takes `UNIT` of them per point; the machine
at hand is compared with that by running it. All are times of the processor, so that other programs do not count.
"""
from __future__ import annotations

import math
import time
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..grid.choose import exact_cost, grid_cost
from ..scene import mesh_arrays
from ..transfer.bake import ROWS_PER_LAUNCH
from ..transfer.mesh import MAX_POINTS, subdivision_of

UNIT = 2.2
PROBE_POINTS = 1 << 18

ROW, ROW_COEFFICIENT = 1800.0, 10.0
"""To set up, fit and store one baked point of one light group; the second for each of its coefficients."""

ROW_SERIAL, LAUNCH, LAUNCH_COEFFICIENT = 1000.0, 3e6, 0.11e6
"""Work of one thread: for a baked point; to record the program of a launch, of `ROWS_PER_LAUNCH` points and one light group, and what each
coefficient adds.
"""

HIT, HIT_ROW, HIT_TRACED, HIT_UNSHADOWED_EDGE, HIT_EXACT_EDGE = 180.0, 1.5, 800.0, 6.0, 40.0
"""To find a camera hit; to interpolate one coefficient of one light group; to begin with rays at a hit; for an edge of a light, unshadowed
and exact, beside those of :py:data:`mi_shlight.grid.choose.COSTS`.
"""

PICTURE, PICTURE_COEFFICIENT, GRID = 25e6, 0.2e6, 40e6
"""To record the program of a picture: at all, for each coefficient, and with a grid."""

BOUNCE_RAY, BOUNCE_STEP, BOUNCES = 1.4, 1.5, 8
"""A ray between surfaces, in those to lights; to pass on a channel along it, in one bounce; and the usual number of bounces."""

GLOSS_HIT, GLOSS_TABLES = 1300.0, 40e6
"""To reflect gloss at a hit, for `bsdf_order` 8, with what is blocked; grows as the cube of the order. To tabulate it, by one thread."""

COMPILE_BAKE, COMPILE_PICTURE = (0.2, 0.0065), (0.35, 0.0045)
"""Seconds to compile, and for each coefficient, where kernels are not in the cache."""


class Machine(NamedTuple):
    """Speed of the machine at hand."""

    scale: float
    """Time of the code's constants, in their own."""
    threads: int

    def seconds(self, nanoseconds: float) -> float:
        """Time of work that all threads share."""
        return nanoseconds * 1e-9 * self.scale / self.threads


def measure_machine() -> Machine:
    """Run the unit and take its best time."""
    d = [dr.linspace(mi.Float, -1, 1, PROBE_POINTS) + 0.1 * k for k in range(3)]
    d = dr.normalize(mi.Vector3f(*d))
    dr.eval(d)
    times = []
    for _ in range(6):
        total = sum(dr.sh_eval(d, 8))
        start = time.process_time()
        dr.eval(total)
        dr.sync_thread()
        times.append(time.process_time() - start)
    return Machine(min(times) * 1e9 / PROBE_POINTS / UNIT, dr.thread_count())


class Sizes(NamedTuple):
    """Sizes of a scene and a picture."""

    hits: int
    """Camera hits of one picture, all samples."""
    edges: int
    """Edges of all faces of lights."""
    groups: int
    meshed: float
    """Share of the hits that are on shapes with baked points."""
    rays: list
    """Seconds of the processor for one ray to each light group."""
    glossy: bool


def bake_seconds(machine: Machine, sizes: Sizes, points: float, order: int, rays: int) -> float:
    """Time to bake `points` points for all light groups."""
    count = (order + 1) ** 2
    row = sizes.groups * (ROW + ROW_COEFFICIENT * count)
    serial = points * ROW_SERIAL + sizes.groups * math.ceil(points / ROWS_PER_LAUNCH) * (LAUNCH + LAUNCH_COEFFICIENT * count)
    return machine.seconds(points * row) + points * rays * sum(sizes.rays) / machine.threads + serial * 1e-9 * machine.scale


def picture_seconds(machine: Machine, sizes: Sizes, direct: str, order: int, lights: float, traced: int) -> float:
    """Time of a picture with direct light alone.

    `lights`: nanoseconds for all lights' coefficients at all hits. `traced`: rays at each hit that has no baked transfer, 0 where all have.
    """
    count, each = (order + 1) ** 2, HIT
    if direct == "unshadowed":
        each += sizes.edges * HIT_UNSHADOWED_EDGE
    else:
        each += sizes.groups * count * HIT_ROW
        each += sizes.edges * HIT_EXACT_EDGE if direct == "exact" else 0
    fixed = (PICTURE + PICTURE_COEFFICIENT * count) * 1e-9 * machine.scale
    rays = traced * (sum(sizes.rays) + 1e-9 * sizes.groups * (HIT_TRACED + ROW_COEFFICIENT * count) * machine.scale / max(traced, 1))
    return fixed + machine.seconds(sizes.hits * each + lights) + sizes.hits * rays / machine.threads


def lights_nanoseconds(table, groups: list, order: int, hits: int, grid=None) -> float:
    """For all lights at all hits: one by one, or by a grid, given as (cells, near, mean)."""
    if table is None:
        return 0.0
    return hits * exact_cost(table, order) if grid is None else grid_cost(table, groups, *grid, order, hits) + GRID


def bounce_seconds(machine: Machine, sizes: Sizes, points: float, rays: int) -> float:
    """Time to find the table of rays between `points` baked points, and to let light go to and fro."""
    steps = points * rays * BOUNCES * BOUNCE_STEP * 3
    return points * rays * BOUNCE_RAY * max(sizes.rays) / machine.threads + machine.seconds(steps)


def gloss_seconds(machine: Machine, sizes: Sizes, bsdf_order: int, visibility_order: int, lights: float) -> float:
    """Time that gloss adds to a picture; `lights` as for :py:func:`picture_seconds`, at the order that gloss needs."""
    each = GLOSS_HIT * ((bsdf_order + 1) / 9) ** 3 + sizes.groups * HIT_ROW * (visibility_order + 1) ** 2
    return machine.seconds(sizes.hits * each + 3 * lights) + GLOSS_TABLES * 1e-9 * machine.scale


def compile_seconds(order: int, bakes: bool) -> float:
    """Time to compile, once on a machine."""
    count = (order + 1) ** 2
    return COMPILE_PICTURE[0] + COMPILE_PICTURE[1] * count + (COMPILE_BAKE[0] + COMPILE_BAKE[1] * count if bakes else 0)


def baked_points(receivers: list, edges) -> list:
    """Points that a bake of the receivers has, for each length of `max_edge`; infinite if they are more than can be held."""
    totals = np.zeros(len(edges))
    for receiver in receivers:
        if not receiver.baked:
            continue
        faces, positions, normals, _ = mesh_arrays(receiver.shape)
        joined = _apart(faces, positions) if normals is None else faces
        pairs = np.sort(np.stack([joined, np.roll(joined, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        corners = joined.max(initial=-1) + 1
        _, first, shared = np.unique(pairs[:, 0] * corners + pairs[:, 1], return_index=True, return_counts=True)
        rim = first[shared == 1] // 3
        for i, edge in enumerate(edges):
            k = subdivision_of(faces, positions, edge)[0].astype(np.int64)
            inside = (1.5 * (k - 1) + (k - 1) * (k - 2) / 2).sum()
            totals[i] += (corners + inside + 0.5 * (k[rim] - 1).sum()) * (1 + receiver.two_sided)
            if ((k + 1) * (k + 2) // 2).sum() * (1 + receiver.two_sided) > MAX_POINTS:
                totals[i] = np.inf
    return totals.tolist()


def _apart(faces: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Faces of a mesh of which only those of one plane share corners, as flat shading has it."""
    corners = positions[faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    turned = (np.round(normal * 1000).astype(np.int64) + 1000) @ [2001 ** 2, 2001, 1]
    return np.unique(faces * 2001 ** 3 + turned[:, None], return_inverse=True)[1].reshape(-1, 3)
