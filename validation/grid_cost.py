"""What the light grid costs and how far off it is: [W20] Table 1, Figs. 8 and 9, shared edges, moving lights."""
from __future__ import annotations

import resource
import sys
import time
from typing import NamedTuple

import drjit as dr
import numpy as np
from drjit.llvm.ad import Array3f, Float, UInt32

from mi_shlight import LightGrid
from mi_shlight.light.facets import facet_table
from mi_shlight.light.mesh import MeshLight, mesh_shader, project_mesh_light
from mi_shlight.light.project import light_shader, project_light
from mi_shlight.light.topology import MeshTables, mesh_topology
from mi_shlight.panel import srgb
from mi_shlight.transfer.cosine import cosine_transfer
from validation.engine_report import Record
from validation.experiment import significant
from validation.grid_scenes import W20, Lights, Scene, placed, table_scene, textured

ORDER, RESOLUTION = 8, 8
"""The order is that of the plan: validation.grid sets it."""
CHUNK = 1 << 16
"""Points that are shaded at once: memory does not grow with the scene."""
DISPLAY_MEAN = 0.4
SPLIT = "hermite, near lights exact"
VARIANTS = {"hermite": ("hermite", None), SPLIT: ("hermite", 1e-3), "tricubic": ("tricubic", None), "trilinear": ("trilinear", None),
            "taylor": ("taylor", None), "inverse distance": ("inverse_distance", None)}
"""Name of a row -> interpolation and `max_error` of the grid. ``tricubic`` is Algorithm 4 of [W20]."""
TARGETED = ("hermite", SPLIT)
"""Rows whose interpolation is timed at all vertices; the others cost as much as the first."""
TWO_SIDED, FLAT, BY_FACE = SIDES = ("both sides", "one side, flat", "one side, face by face")
"""How the faces of a mesh light emit: to either side; to one side all at once, as planar textured lights; each of its own."""


class Plan(NamedTuple):
    """Sizes to measure."""

    order: int = ORDER
    scale: float = 1.0
    """Of the scenes' triangles."""
    scenes: tuple = tuple(W20)
    subset: int = 1 << 15
    """Vertices of a scene at which the exact values are found and timed."""
    w18_subset: int = 1 << 11
    """The same for all coefficients by the recurrence."""
    rounds: int = 3
    samples: tuple = (5, 10, 20, 40, 80, 160)
    light_counts: tuple = (1, 2, 8, 32, 72, 128, 288, 512)
    resolutions: tuple = (4, 6, 8, 12, 16, 24, 32)
    sweep_points: int = 1 << 15
    """Vertices lit by grids of all resolutions."""
    shared_side: int = 16
    shared_points: int = 1 << 15
    moving_points: int = 100_000
    frames: int = 9
    picture: int = 256
    pictured: tuple = (4, 8, 16, 32)
    """Resolutions."""


QUICK = Plan(order=3, scale=0.01, scenes=("Plants",), subset=256, w18_subset=32, rounds=1, samples=(5, 10, 20, 40), light_counts=(1, 8),
             resolutions=(4,), sweep_points=256, shared_side=4, shared_points=64, moving_points=256, frames=1, picture=32, pictured=(4,))


class Receivers(NamedTuple):
    """Points to be shaded with the cosine transfer of their normals."""

    positions: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray

    def taken(self, rows) -> "Receivers":
        return Receivers(*(part[rows] for part in self))

    def chunks(self):
        """(positions, normals) of successive parts, on the device."""
        for k in range(0, len(self.positions), CHUNK):
            part = [vectors(table[k:k + CHUNK]) for table in (self.positions, self.normals)]
            dr.eval(part)
            yield part


def vectors(rows: np.ndarray):
    """3-vectors, from an (N, 3) table."""
    return dr.gather(Array3f, aligned(rows.ravel()), dr.arange(UInt32, len(rows)))


def aligned(values: np.ndarray):
    """Floats in memory that Dr.Jit allocated: other alignments, as of NumPy's, compile kernels of their own."""
    copy = dr.zeros(Float, len(values))
    dr.scatter(copy, Float(np.ascontiguousarray(values, np.float32)), dr.arange(UInt32, len(values)))
    dr.eval(copy)
    dr.sync_thread()
    return copy


def receivers(scene: Scene, count: int | None = None) -> Receivers:
    """All vertices of a scene, or `count` random ones, in the order of the mesh: neighbours are shaded together, as in a picture."""
    points = Receivers(scene.points.positions, scene.points.normals, scene.points.albedo)
    total = len(points.positions)
    return points if count is None or count >= total else points.taken(np.sort(np.random.default_rng(5).choice(total, count, False)))


# Ways to light a point: functions (x, transfer) -> colour.

def light_table(lights: Lights):
    emitted, channels = aligned(lights.radiance.ravel()), lights.radiance.shape[1]
    return facet_table(Float, [np.asarray(face) for face in lights.faces]).placed(aligned(lights.vertices.ravel()), emitted, channels)


def over_lights(table, add, colours: list, x) -> list:
    """``colours + sum of radiance times values``, the values ``add(light, x, apex)``, in a symbolic loop over the lights."""
    def body(k, total, x):
        values = add(table.edges(k, x, True), x, table.apex(k, x))
        radiance = type(total[0])(*table.radiance(k))
        return k + 1, [dr.fma(radiance, value, t) for value, t in zip(values, total)], x

    return dr.while_loop((UInt32(0), colours, x), lambda k, *_: k < table.count, body, mode="symbolic")[1]


def exact_shading(lights: Lights, method: str = "edge"):
    """One dot product of the transfer with each light, as ``shprt`` does without a grid; by default in the way that costs least here."""
    table = light_table(lights)

    def shade(x, transfer):
        shader = light_shader(transfer, ORDER, method)
        return over_lights(table, lambda *light: [shader(*light)], [Array3f(0)], x)[0]

    return shade


def exact_coefficients(lights: Lights, method: str):
    """All coefficients of all lights at `x`, a list of colours, by one method of projection."""
    table = light_table(lights)
    colours = lambda: [Array3f(0) for _ in range((ORDER + 1) ** 2)]
    return lambda x: over_lights(table, lambda light, x, apex: project_light(light, x, apex, ORDER, method), colours(), x)


def make_grid(lights: Lights, bounds: tuple, interpolation: str, max_error, resolution: int = RESOLUTION) -> LightGrid:
    lower, upper = (Array3f(*map(float, corner)) for corner in bounds)
    return LightGrid(aligned(lights.vertices.ravel()), lights.faces, lights.radiance, lower, upper, resolution, ORDER, interpolation,
                     max_error=max_error)


def shade_all(shade, points: Receivers) -> np.ndarray:
    """Radiance (N, 3) of all points, chunk by chunk."""
    parts = []
    for x, normal in points.chunks():
        colour = shade(x, cosine_transfer(normal, ORDER))
        dr.eval(colour)
        parts.append(np.array(colour).T)
    return np.concatenate(parts) * points.albedo


# Measures.

def spent_by(function) -> tuple:
    """(seconds of CPU, result) of one run: other programs do not stretch them."""
    start = time.process_time()
    result = function()
    dr.sync_thread()
    return time.process_time() - start, result


def timed(rounds: int, function) -> tuple:
    """(median seconds over `rounds` runs after one that compiles, result of the last)."""
    runs = [spent_by(function) for _ in range(rounds + 1)]
    return float(np.median([spent for spent, _ in runs[1:]])), runs[-1][1]


def exposure(values: np.ndarray) -> float:
    """Factor that makes the mean of ``srgb(factor * values)`` DISPLAY_MEAN."""
    low, high = 1e-6 / values.mean(), 1e6 / values.mean()
    for _ in range(60):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if srgb(middle * values).mean() < DISPLAY_MEAN else (low, middle)
    return middle


def errors(values: np.ndarray, exact: np.ndarray) -> dict:
    """Mean absolute error over points and channels: as displayed (0 to 1, sRGB) and in linear light, of the same exposure."""
    factor = exposure(exact)
    return {"mae": significant(np.abs(srgb(factor * values) - srgb(factor * exact)).mean()),
            "mae_linear": significant(factor * np.abs(values - exact).mean()),
            "p99": significant(np.quantile(np.abs(srgb(factor * values) - srgb(factor * exact)), 0.99))}


def milliseconds(value: float) -> float:
    return significant(1e3 * value)


def peak_gib() -> float:
    """Largest memory of this process so far."""
    return significant(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)


def measure_table(record: Record, plan: Plan) -> None:
    for name in plan.scenes:
        print(f"table: {name}", file=sys.stderr, flush=True)
        record.attempt(f"table, {name}", measure_scene, record, plan, table_scene(name, plan.scale))


def measure_scene(record: Record, plan: Plan, scene: Scene) -> None:
    points, part = receivers(scene), receivers(scene, plan.subset)
    lights, total = scene.lights, len(points.positions)
    shade = exact_shading(lights)
    exact_time, exact = timed(plan.rounds, lambda: shade_all(shade, part))
    auto = exact_shading(lights, "auto")
    auto_time = timed(1, lambda: shade_all(auto, part))[0]
    exact_time, auto_time = (seconds * total / len(part.positions) for seconds in (exact_time, auto_time))

    few = part.taken(slice(None, None, max(1, len(part.positions) // plan.w18_subset)))
    project = exact_coefficients(lights, "recurrence")
    dot = lambda x, transfer: sum(t * c for t, c in zip(transfer, project(x)))
    w18_time = timed(1, lambda: shade_all(dot, few))[0] * total / len(few.positions)

    nodes, values = node_points(scene), exact_coefficients(lights, "auto")
    coefficients = timed(plan.rounds, lambda: dr.eval(values(nodes)))[0]
    record.rows["scenes"].append({
        "scene": scene.name, "triangles": len(scene.points.faces), "vertices": total, "lights": len(lights.faces),
        "coefficients_ms": milliseconds(coefficients), "exact_ms": milliseconds(exact_time), "exact_auto_ms": milliseconds(auto_time),
        "exact_measured": len(part.positions), "w18_ms": milliseconds(w18_time), "w18_measured": len(few.positions)})
    for variant, (interpolation, max_error) in VARIANTS.items():
        build, grid = timed(plan.rounds, lambda: make_grid(lights, scene.bounds, interpolation, max_error))
        row = {"scene": scene.name, "variant": variant, "build_ms": milliseconds(build), "near_faces": significant(grid.near_faces),
               **errors(shade_all(grid.shade, part), exact)}
        if variant in TARGETED:
            spent = timed(plan.rounds, lambda: shade_all(grid.shade, points))[0]
            row.update(interpolation_ms=milliseconds(spent), total_ms=milliseconds(build + spent),
                       speedup=significant(exact_time / (build + spent)), speedup_w18=significant(w18_time / (build + spent)))
        record.rows["variants"].append(row)
    record.rows["scenes"][-1]["peak_gib"] = peak_gib()


def node_points(scene: Scene, resolution: int = RESOLUTION):
    axes = [np.linspace(low, high, resolution) for low, high in zip(*scene.bounds)]
    z, y, x = (c.ravel() for c in np.meshgrid(*axes[::-1], indexing="ij"))
    return vectors(np.column_stack([x, y, z]))


def measure_light_counts(record: Record, plan: Plan) -> None:
    """[W20] Fig. 8: all vertices lit by one rectangle in more and more pieces."""
    scene = table_scene("Plants", plan.scale)
    points = receivers(scene)
    for count in plan.light_counts:
        print(f"lights: {count}", file=sys.stderr, flush=True)
        lights = rectangle(count)
        shade = exact_shading(lights)
        exact = timed(plan.rounds, lambda: shade_all(shade, points))[0]
        row = {"lights": count, "points": len(points.positions), "exact_ms": milliseconds(exact)}
        for variant in TARGETED:
            build, grid = timed(plan.rounds, lambda: make_grid(lights, scene.bounds, *VARIANTS[variant]))
            spent = timed(plan.rounds, lambda: shade_all(grid.shade, points))[0]
            record.rows["light_counts"].append({**row, "variant": variant, "build_ms": milliseconds(build),
                                                "interpolation_ms": milliseconds(spent), "near_faces": significant(grid.near_faces)})


def rectangle(count: int) -> Lights:
    """A rectangle over the plants as one polygon, or in `count` triangles, two times a square number."""
    place, size = ((-1.5, 2.6, 1.5), (0, 0.6, 0)), (1.6, 1.2)
    if count == 1:
        corners = 0.5 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * size
        return placed(corners, np.array([[0, 1, 2, 3]]), np.array([[6.0, 5.5, 5.0]]), *place)
    side = round((count / 2) ** 0.5)
    return textured(*place, *size, side, side, count, [(6, 5.5, 5)] * 4)


def measure_resolutions(record: Record, plan: Plan) -> None:
    """[W20] Fig. 9."""
    scene = table_scene("Asian Dragon", plan.scale)
    points = receivers(scene, plan.sweep_points)
    exact = shade_all(exact_shading(scene.lights), points)
    for resolution in plan.resolutions:
        print(f"resolution: {resolution}", file=sys.stderr, flush=True)
        for variant in (*TARGETED, "tricubic", "trilinear"):
            build, grid = timed(1, lambda: make_grid(scene.lights, scene.bounds, *VARIANTS[variant], resolution))
            spent, values = timed(plan.rounds, lambda: shade_all(grid.shade, points))
            record.rows["resolutions"].append({
                "resolution": resolution, "variant": variant, "points": len(points.positions), "build_ms": milliseconds(build),
                "interpolation_ms": milliseconds(spent), "near_faces": significant(grid.near_faces), **errors(values, exact)})


def measure_shared_edges(record: Record, plan: Plan) -> None:
    """A textured quadrilateral in triangles: its edges once, against one triangle after the other."""
    side = plan.shared_side
    rng = np.random.default_rng(8)
    quad = textured((0, 0, 0), (0, 0, 1), 2, 2, side, side, 2 * side * side, [(1, 1, 1)] * 4)
    quad = quad._replace(radiance=rng.uniform(0.1, 1, (len(quad.faces), 3)))
    x = rng.uniform([-1.5, -1.5, 0.5], [1.5, 1.5, 3], (plan.shared_points, 3))
    normals = rng.normal(size=x.shape)
    points = Receivers(x, normals / np.linalg.norm(normals, axis=1, keepdims=True), np.ones_like(x))
    (x, normal), topology = next(points.chunks()), mesh_topology([np.asarray(face) for face in quad.faces])
    for channels in (3, 1):
        radiance, black = quad.radiance[:, :channels], (Array3f if channels == 3 else Float)(0)
        table = light_table(quad._replace(radiance=radiance))
        for sides in SIDES:
            tables = MeshTables(UInt32, topology, flat=True) if sides == FLAT else topology
            mesh = MeshLight(aligned(quad.vertices.ravel()), tables, radiance, sides != TWO_SIDED)
            transfer = lambda: cosine_transfer(normal, ORDER)
            pairs = {"coefficients": (lambda: project_mesh_light(mesh, x, ORDER, "edge"),
                                      lambda: over_lights(table, project_each, [black] * (ORDER + 1) ** 2, x)),
                     "shading": (lambda: [mesh_shader(transfer(), ORDER, "edge")(mesh, x)],
                                 lambda: over_lights(table, shade_each(transfer()), [black], x))}
            for what, runs in pairs.items():
                found = [evaluated(run()) for run in runs]
                spent = np.array([[spent_by(lambda: dr.eval(run()))[0] for run in runs] for _ in range(plan.rounds + 2)])
                shared, separate = np.median(spent, axis=0)
                record.rows["shared_edges"].append({
                    "what": what, "sides": sides, "channels": channels, "triangles": len(quad.faces), "edges": len(topology.edges),
                    "points": plan.shared_points, "shared_ms": milliseconds(shared), "separate_ms": milliseconds(separate),
                    "ratio": significant(np.median(spent[:, 1] / spent[:, 0])),
                    "difference": significant(np.linalg.norm(found[0] - found[1]) / np.linalg.norm(found[1]))})


def project_each(light, x, apex) -> list:
    return project_light(light, x, apex, ORDER, "edge")


def shade_each(transfer: list):
    shader = light_shader(transfer, ORDER, "edge")
    return lambda *light: [shader(*light)]


def evaluated(colours: list) -> np.ndarray:
    """Their numbers in one array, colour by colour."""
    dr.eval(colours)
    return np.concatenate([np.atleast_2d(np.array(colour, dtype=np.float64)) for colour in colours])


def measure_moving_lights(record: Record, plan: Plan) -> None:
    """Frames in which every light of the first scene turns about its own centre and changes colour."""
    scene = table_scene("Dragon & Bunny", plan.scale)
    points = receivers(scene, plan.moving_points)
    for variant in TARGETED:
        times = {"move": [], "build": [], "shade": []}
        for frame in range(plan.frames + 1):
            start = time.process_time()
            lights = moved(scene.lights, 0.1 * frame)
            after_move = time.process_time()
            grid = make_grid(lights, scene.bounds, *VARIANTS[variant])
            dr.sync_thread()
            after_build = time.process_time()
            shade_all(grid.shade, points)
            for name, spent in zip(times, (after_move - start, after_build - after_move, time.process_time() - after_build)):
                times[name].append(spent)
        parts = {f"{name}_ms": milliseconds(np.median(spent[1:])) for name, spent in times.items()}
        record.rows["moving"].append({"variant": variant, "lights": len(scene.lights.faces), "points": len(points.positions), **parts,
                                      "frame_ms": significant(sum(parts.values())), "near_faces": significant(grid.near_faces),
                                      "first_frame_ms": milliseconds(sum(spent[0] for spent in times.values()))})


def moved(lights: Lights, angle: float) -> Lights:
    """Every triangle turned about the x axis through its centre, by an angle of its own, in another colour."""
    corners = lights.vertices[lights.faces]
    centre = corners.mean(axis=1, keepdims=True)
    turn = angle * np.sin(np.arange(len(corners)))
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    x, y, z = np.moveaxis(corners - centre, 2, 0)
    turned = centre + np.stack([x, c * y - s * z, s * y + c * z], axis=2)
    colours = lights.radiance * (1 + 0.3 * np.sin(angle + np.arange(len(corners)))[:, None])
    return Lights(turned.reshape(-1, 3), np.arange(turned.size // 3).reshape(-1, 3), colours)
