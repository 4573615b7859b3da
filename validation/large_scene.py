"""Claim: 1.3 million triangles lit by 723 triangle lights at order 8 take less than 8 GiB, from loading to the picture.

    python -m validation.large_scene [--quick] [--out DIR] [--scale S] [--rays N]

Loads, bakes, saves, reads back and renders a procedural scene with the light grid, moves all lights and renders again; prints time and
resident memory after each step and writes ``large_scene.json``.
"""
from __future__ import annotations

import pathlib
import resource
import tempfile
import time

import drjit as dr
import mitsuba as mi
import numpy as np

from validation import experiment

LIGHTS, SIDE, LIMIT = 723, 470, 8.0


def torus(side: int, centre) -> tuple:
    """Vertices and faces, 2 side^2 triangles, of a torus with waves on it."""
    u, v = np.meshgrid(*[np.arange(side) / side * 2 * np.pi] * 2, indexing="ij")
    small = 0.45 * (1 + 0.1 * np.sin(9 * u) * np.sin(5 * v))
    points = np.stack([(1 + small * np.cos(v)) * np.cos(u), small * np.sin(v), (1 + small * np.cos(v)) * np.sin(u)], axis=-1)
    a, b = (index.ravel() for index in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    at = lambda i, j: i % side * side + j % side
    faces = np.concatenate([np.stack([at(a, b), at(a, b + 1), at(a + 1, b + 1)], axis=1),
                            np.stack([at(a, b), at(a + 1, b + 1), at(a + 1, b)], axis=1)])
    return points.reshape(-1, 3) + centre, faces


def mesh(name: str, vertices, faces, emitter=None):
    properties = mi.Properties()
    if emitter:
        properties["emitter"] = mi.load_dict(emitter)
    shape = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=emitter is None, props=properties)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(vertices, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    parameters.update()
    shape.set_id(name)
    return shape


def build(scale: float, lights: int):
    random = np.random.default_rng(0)
    shapes = {f"torus{k}": mesh(f"torus{k}", *torus(round(SIDE * scale ** 0.5), centre))
              for k, centre in enumerate([(-2, 0.8, 0), (2, 0.8, 0), (0, 0.8, 2.2)])}
    floor = np.array([[-5, 0, 5], [5, 0, 5], [5, 0, -5], [-5, 0, -5]])
    shapes["floor"] = mesh("floor", floor, np.array([[0, 1, 2], [0, 2, 3]]))
    for k in range(lights):
        corners = random.uniform([-5, 2.5, -5], [5, 4, 5]) + random.normal(size=(3, 3)) * 0.08
        emitter = {"type": "shlight", "radiance": {"type": "rgb", "value": random.uniform(1, 10, 3).tolist()}}
        shapes[f"light{k}"] = mesh(f"light{k}", corners, np.array([[0, 1, 2]]), emitter)
    view = mi.ScalarTransform4f().look_at([0, 5, 9], [0, 0.5, 0], [0, 1, 0])
    return mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "to_world": view, "film": {
        "type": "hdrfilm", "width": 256, "height": 256, "rfilter": {"type": "box"}}}, **shapes}, optimize=False)


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments, scale={"type": float, "default": 1.0, "help": "of the number of triangles"},
                                 rays={"type": int, "default": 16, "help": "per baked point"})
    lights = LIGHTS
    if options.quick:
        options.scale, options.rays, lights = 0.01, 4, 20
    mi.set_variant("llvm_ad_rgb")
    from mi_shlight import bake_transfer, load_transfer
    from mi_shlight.rendering import render

    steps, began = {}, [time.perf_counter()]

    def done(name: str) -> None:
        steps[name] = {"seconds": round(time.perf_counter() - began[0], 2), "peak_gib": round(peak(), 2)}
        print(f"{name:40s} {steps[name]['seconds']:8.2f} s   peak {steps[name]['peak_gib']:.2f} GiB", flush=True)
        began[0] = time.perf_counter()

    scene = build(options.scale, lights)
    triangles = sum(shape.face_count() for shape in scene.shapes())
    done(f"scene, {triangles} triangles")
    with tempfile.TemporaryDirectory() as folder:
        path = str(pathlib.Path(folder) / "large.npz")
        transfer = bake_transfer(scene, 8, samples=options.rays, max_edge=1e9, light_margin=0.05)
        rows = transfer.coeffs.shape[1]
        done(f"bake, {rows} points, {options.rays} rays")
        transfer.save(path)
        del transfer
        load_transfer(path)
        done("save and read back")
        plugin = mi.load_dict({"type": "shprt", "transfer_file": path, "grid_resolution": 8})
    render(scene, plugin, spp=4)
    done("first picture, 256 x 256, 4 spp, grid 8^3")
    render(scene, plugin, spp=4, seed=1)
    done("second picture")
    parameters = mi.traverse(scene)
    for k in range(lights):
        key = f"light{k}.vertex_positions"
        parameters[key] = parameters[key] + 0.01
    parameters.update()
    dr.sync_thread()
    done(f"move {lights} lights (Mitsuba's acceleration structure)")
    plugin.prepare_scene(scene)
    done("follow them")
    render(scene, plugin, spp=4, seed=2)
    done("picture after that")
    lines = [experiment.verdict(f"{triangles} triangles, {lights} lights: peak of resident memory at most {LIMIT:g} GiB", peak(), LIMIT)]
    experiment.print_targets(lines)
    record = {"targets": lines, "triangles": triangles, "lights": lights, "points": rows, "steps": steps, "peak_gib": round(peak(), 2)}
    experiment.write(options.out / "large_scene.json", record, options.quick)


def peak() -> float:
    """Largest resident memory of this process so far, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2 ** 20


if __name__ == "__main__":
    main()
