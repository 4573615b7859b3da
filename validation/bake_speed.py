"""Claim: in a bake the spherical harmonics cost a small part of the ray tracing.

    python -m validation.bake_speed [--quick] [--out DIR] [--side N] [--rounds N]

writes ``bake_speed.json`` and prints a table. A hilly floor of 200,000 vertices with columns on it under one light, 512 rays per vertex,
order 8. In one process, round after round, for 2048 neighbouring vertices at each of three places of the floor:

- **ray_test**: Mitsuba's own, on the very rays of the bake, which lie in memory in the order of the bake: 8 or 16 neighbouring vertices
  side by side, each with its next ray. So coherence is the same.
- **bake**: what ``bake_transfer`` launches. Its rays pass through the light's own shape up to its other side, which asks for the nearest
  hit in place of any.
- **no rays**: the bake with visibility from a comparison of two numbers: directions, the search for the light's nearest direction, and
  the harmonics.
- **harmonics**: without that search, too; what is left are directions, sums, fit and rotation.

Then the whole bake by ``bake_transfer``. Times per ray, medians of the rounds; every ratio is of times of one round.
"""
from __future__ import annotations

import time

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_shlight import bake_transfer
from mi_shlight.scene import aligned, mesh_arrays, polygon_lights
from mi_shlight.transfer.localised import cone_fit, sample_transfer
from mi_shlight.transfer.mesh import refine
from mi_shlight.transfer.visibility import BakeLights, LightSight, Occluders
from validation import experiment

ORDER, RAYS = 8, 512
ROWS = 2048
"""Vertices that are traced together: their rays, for ``ray_test``, are 29 MB, which costs little to read again."""


def terrain(side: int) -> tuple:
    """Positions (side^2, 3), normals and faces of a hilly floor, 4 x 4."""
    u = np.linspace(-2, 2, side)
    x, z = (a.ravel() for a in np.meshgrid(u, u))
    y = 0.08 * np.sin(3 * x) * np.cos(4 * z) + 0.02 * np.sin(17 * x + 3) * np.sin(13 * z)
    normals = np.stack([-0.24 * np.cos(3 * x) * np.cos(4 * z) - 0.34 * np.cos(17 * x + 3) * np.sin(13 * z), np.ones_like(x),
                        0.32 * np.sin(3 * x) * np.sin(4 * z) - 0.26 * np.sin(17 * x + 3) * np.cos(13 * z)], axis=1)
    index = np.arange(side * side).reshape(side, side)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)])
    return np.stack([x, y, z], axis=1), normals / np.linalg.norm(normals, axis=1, keepdims=True), faces


def build(side: int):
    positions, normals, faces = terrain(side)
    floor = mi.Mesh("floor", len(positions), len(faces), has_vertex_normals=True)
    parameters = mi.traverse(floor)
    parameters["vertex_positions"], parameters["vertex_normals"] = (aligned(mi.Float, a.ravel()) for a in (positions, normals))
    parameters["faces"] = aligned(mi.UInt32, faces.ravel())
    parameters.update()
    both_sides = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    columns = {f"column_{i}_{j}": {"type": "cylinder", "p0": [1.2 * i, -0.2, 1.2 * j], "p1": [1.2 * i, 0.7, 1.2 * j], "radius": 0.12,
                                   "bsdf": both_sides} for i in (-1, 0, 1) for j in (-1, 0, 1)}
    to_world = mi.ScalarTransform4f().translate([0.3, 2.5, 0.4]).rotate([1, 0, 0], 90).scale(0.5)
    light = {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area"}}
    return mi.load_dict({"type": "scene", "floor": floor, "light": light, **columns}, optimize=False)


class Recorder(Occluders):
    """Writes down the rays instead of tracing them."""

    def __init__(self, scene, lights, rows: int):
        super().__init__(scene, lights)
        self.rows, self.count, self.table = rows, dr.zeros(mi.UInt32, rows), dr.zeros(mi.Float, rows * RAYS * 7)
        dr.eval(self.count, self.table)

    def blocked(self, group, origin, d, distance, active):
        lane = dr.arange(mi.UInt32, self.rows)
        place = dr.scatter_inc(self.count, lane, active) * self.rows + lane
        for k, value in enumerate((*origin, *d, distance)):
            dr.scatter(self.table, value, place + k * self.rows * RAYS, active)
        return mi.Bool(False)

    def rays(self) -> tuple:
        """(rays, which of them there are)."""
        lane = dr.arange(mi.UInt32, self.rows * RAYS)
        x, y, z, u, v, w, end = (dr.gather(mi.Float, self.table, lane + k * len(lane)) for k in range(7))
        ray = mi.Ray3f(mi.Point3f(x, y, z), mi.Vector3f(u, v, w))
        ray.maxt = end * (1 - mi.math.ShadowEpsilon)
        there = end > 0
        dr.eval(ray, there)
        return ray, there


class NoRays(LightSight):
    """Visibility by a comparison."""

    def look(self, origin, n, d, met, active):
        _, distance, _, found, met = self.lights.nearest(self.group, origin, n, d, met)
        return active & found & (distance > 2.6), mi.Bool(False), met


class NoSearch(LightSight):
    """Visibility by a comparison of the direction itself."""

    def look(self, origin, n, d, met, active):
        return active & (d.x > 0), mi.Bool(False), met


def measure(scene, localised: bool, rounds: int) -> dict:
    """Nanoseconds per ray of each part, and ratios."""
    lights = polygon_lights(scene)
    faces, positions, normals, _ = mesh_arrays(next(s for s in scene.shapes() if s.id() == "floor"))
    mesh = refine(faces, positions, normals, np.inf)
    group = mi.UInt32(0), mi.UInt32(1)
    dr.make_opaque(group)
    bake_lights, fit = BakeLights(lights, 0.0), cone_fit(ORDER, RAYS) if localised else None
    occluders = Occluders(scene, lights)
    sights = {"bake": LightSight(occluders, bake_lights, group), "no rays": NoRays(occluders, bake_lights, group),
              "harmonics": NoSearch(occluders, bake_lights, group)}
    times = {name: [] for name in ("ray_test", *sights)}
    for begin in len(mesh.positions) * np.array([1, 4, 7]) // 8:
        part = slice(begin, begin + min(ROWS, len(mesh.positions) // 8))
        p, n = (mi.Vector3f(*(aligned(mi.Float, c) for c in table[part].T)) for table in (mesh.positions, mesh.normals))
        cell = aligned(mi.Float, mesh.cells[part])
        shift = mi.PCG32(size=len(cell)).next_float32()
        dr.eval(shift)

        def trace(sight):
            found = sample_transfer(sight, mi.Point3f(p), mi.Normal3f(n), ORDER, RAYS, shift, fit=fit, cell=cell)
            dr.eval(*found)

        recorder = Recorder(scene, lights, len(cell))
        trace(LightSight(recorder, bake_lights, group))
        ray, there = recorder.rays()
        count = int(np.array(recorder.count).sum())
        jobs = {"ray_test": lambda: dr.eval(scene.ray_test(ray, coherent=False, active=there)),
                **{name: lambda sight=sight: trace(sight) for name, sight in sights.items()}}
        for i in range(rounds + 1):
            for name, job in jobs.items():
                dr.sync_thread()
                start = time.perf_counter()
                job()
                dr.sync_thread()
                if i:                                 # the first one compiles
                    times[name].append((time.perf_counter() - start) / count * 1e9)
    tests = np.array(times["ray_test"])
    ratio = lambda values: float(np.median(values / tests))
    report = {"localised": localised, **{f"{name}, ns per ray": float(np.median(values)) for name, values in times.items()}}
    return {**report, "bake / ray_test": ratio(np.array(times["bake"])), "no rays / ray_test": ratio(np.array(times["no rays"])),
            "harmonics / ray_test": ratio(np.array(times["harmonics"]))}


def main(arguments=None) -> None:
    options = experiment.options(
        __doc__, arguments, side={"type": int, "default": 448, "help": "vertices along each side of the floor (default: %(default)s)"},
        rounds={"type": int, "default": 5, "help": "default: %(default)s"})
    if options.quick:
        options.side, options.rounds = 64, 1
    mi.set_variant("llvm_ad_rgb")
    scene, rows = build(options.side), []
    for localised in (False, True):
        row = measure(scene, localised, options.rounds)
        bake_transfer(scene, ORDER, samples=1, localised=localised, max_edge=4)       # finds the normals and builds the tree
        start = time.perf_counter()
        baked = bake_transfer(scene, ORDER, samples=RAYS, localised=localised, max_edge=4)
        row["whole bake, s"] = time.perf_counter() - start
        row["points"] = baked.coeffs.shape[1]
        row["whole bake, million rays per s"] = row["points"] * RAYS / row["whole bake, s"] / 1e6
        rows.append(row)
        for key, value in row.items():
            print(f"{key:32}{value:>12.3g}" if isinstance(value, float) else f"{key:32}{value!s:>12}", flush=True)
        print()
    lines = [experiment.verdict(f"{kind}: harmonics take at most a quarter of the time of a ray test", row["harmonics / ray_test"], 0.25)
             for kind, row in zip(("projected", "localised"), rows)]
    experiment.print_targets(lines)
    report = {"targets": lines, "order": ORDER, "rays per point": RAYS, "rows": rows}
    experiment.write(options.out / "bake_speed.json", report, options.quick)


if __name__ == "__main__":
    main()
