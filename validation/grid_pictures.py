"""Pictures by the light grid beside exact ones, and frames of moving lights: [W20] Fig. 9 from a procedural scene, Figs. 1 and 12 from
``scenes/many_lights.xml`` and ``scenes/double_sided.xml``.
"""
from __future__ import annotations

import math
import pathlib
import time
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_shlight.panel import srgb
from validation.engine_report import Record
from validation.experiment import significant
from validation.grid_cost import SPLIT, Lights, Receivers, exact_shading, exposure, make_grid, milliseconds, moved, shade_all
from validation.grid_scenes import Scene, table_scene

ROOT = pathlib.Path(__file__).parents[1]
DIFFERENCE_SCALE = {"resolutions": 20, "double_sided": 5}
"""Factors of the differences that are shown."""


class Picture(NamedTuple):
    title: str
    image: np.ndarray
    error: float | None = None
    """Mean absolute error of the displayed picture over the pixels that show a surface; None for the reference."""


def camera_points(scene: Scene, size: int, origin, target, fov: float) -> tuple:
    """(receivers under the pixels' centres, mask of the pixels that see the scene) of a square picture."""
    mesh = mi.Mesh("scene", len(scene.points.positions), len(scene.points.faces), has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = scene.points.positions.ravel().astype(np.float32)
    parameters["vertex_normals"] = scene.points.normals.ravel().astype(np.float32)
    parameters["faces"] = scene.points.faces.ravel().astype(np.uint32)
    parameters.update()
    view = mi.load_dict({"type": "scene", "mesh": mesh, "sensor": {
        "type": "perspective", "fov": fov, "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size}}})
    i = dr.arange(mi.UInt32, size * size)
    place = (mi.Point2f(i % size, i // size) + 0.5) / size
    ray, _ = view.sensors()[0].sample_ray(0, 0, place, mi.Point2f(0.5))
    hit = view.ray_intersect(ray)
    seen = np.array(hit.is_valid())
    corner = scene.points.faces[np.array(hit.prim_index)[seen], 0]
    return Receivers(np.array(hit.p).T[seen], np.array(hit.sh_frame.n).T[seen], scene.points.albedo[corner]), seen.reshape(size, size)


def resolution_pictures(size: int, resolutions: tuple, scale: float) -> list:
    """The scene of [W20] Fig. 9 by grids without near lists, after the exact picture."""
    scene = table_scene("Asian Dragon", scale)
    points, seen = camera_points(scene, size, (0, 3.0, 5.6), (0, 0.65, 0), 38)
    exact = shade_all(exact_shading(scene.lights), points)
    factor = exposure(exact)

    def picture(title, values, reference=True):
        image = np.zeros((*seen.shape, 3))
        image[seen] = srgb(factor * values)
        return Picture(title, image, None if reference else float(np.abs(image[seen] - srgb(factor * exact)).mean()))

    found = [picture("exact", exact)]
    for resolution in resolutions:
        grid = make_grid(scene.lights, scene.bounds, "hermite", None, resolution)
        found.append(picture(f"grid {resolution}$^3$", shade_all(grid.shade, points), False))
    return found


def double_sided_pictures(size: int, spp: int, max_errors: tuple, **settings) -> list:
    """``double_sided.xml`` without a grid, by 8^3 points alone, and with near lights exact ([W20] Fig. 12); `settings` of ``shprt``.

    At small `max_errors` its only light is near to every cell.
    """
    scene = mi.load_file(str(ROOT / "scenes" / "double_sided.xml"), optimize=False, resx=size, resy=size)
    rendered = lambda **grid: np.array(mi.render(scene, spp=spp, seed=1, integrator=mi.load_dict({"type": "shprt", **settings, **grid})))
    exact = rendered()
    points = mi.load_dict({"type": "aov", "aovs": "shape:shape_index"})
    shape = np.array(mi.render(scene, spp=1, seed=1, integrator=points))[..., 0]
    lit = (shape >= 0) & ~np.isin(shape, [k for k, s in enumerate(scene.shapes()) if s.is_emitter()]) & (exact.max(axis=2) > 0)
    factor = exposure(exact[lit])
    pictures = [Picture("exact", srgb(factor * exact))]
    for error in (0, *max_errors):
        title = f"grid 8$^3$, near lights exact ({error:g})" if error else "grid 8$^3$"
        image = srgb(factor * rendered(grid_resolution=8, grid_error=error))
        pictures.append(Picture(title, image, float(np.abs(image - pictures[0].image)[lit].mean())))
    return pictures


def measure_moving_scene(record: Record, pixels: int, frames: int, max_error: float, order: int) -> None:
    """``many_lights.xml``, unshadowed, one sample per pixel: all lights are moved and coloured through `mi.traverse` in every frame."""
    size = math.ceil(math.sqrt(pixels))
    scene = mi.load_file(str(ROOT / "scenes" / "many_lights.xml"), optimize=False, resx=size, resy=size)
    parameters = mi.traverse(scene)
    names = [shape.id() for shape in scene.shapes() if shape.is_emitter()]
    corners = np.concatenate([np.array(parameters[f"{name}.vertex_positions"]) for name in names]).reshape(-1, 3)
    colours = np.array([np.ravel(np.array(parameters[f"{name}.emitter.radiance.value"])) for name in names])
    lights = Lights(corners, np.arange(len(corners)).reshape(-1, 3), colours)
    for variant, settings in (("exact", {}), ("hermite", {"grid_resolution": 8, "grid_error": 0}),
                              (SPLIT, {"grid_resolution": 8, "grid_error": max_error})):
        integrator = mi.load_dict({"type": "shprt", "order": order, "transfer": "unshadowed", **settings})
        times = {"move": [], "render": []}
        for frame in range(frames + 1):
            start = time.process_time()
            there = moved(lights, 0.1 * frame)
            for k, name in enumerate(names):
                parameters[f"{name}.vertex_positions"] = mi.Float(there.vertices[3 * k:3 * k + 3].ravel().tolist())
                parameters[f"{name}.emitter.radiance.value"] = mi.Color3f(there.radiance[k].tolist())
            parameters.update()
            middle = time.process_time()
            dr.eval(mi.render(scene, integrator=integrator, spp=1))
            dr.sync_thread()
            for name, spent in zip(times, (middle - start, time.process_time() - middle)):
                times[name].append(spent)
        parts = {f"{name}_ms": milliseconds(np.median(spent[1:])) for name, spent in times.items()}
        record.rows["moving_scene"].append({"variant": variant, "lights": len(names), "pixels": size * size, **parts,
                                            "frame_ms": significant(sum(parts.values())),
                                            "first_frame_ms": milliseconds(sum(spent[0] for spent in times.values()))})


def record_errors(record: Record, figure: str, pictures: list) -> None:
    for picture in pictures[1:]:
        record.rows["pictures"].append({"figure": figure, "picture": picture.title.replace("$", ""), "mae": significant(picture.error)})


def draw(pictures: list, scale: float, path: pathlib.Path) -> None:
    """Pictures in a row, below each its absolute difference from the first, times `scale`."""
    import matplotlib
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, len(pictures), figsize=(3.2 * len(pictures), 6.7), constrained_layout=True, squeeze=False)
    for (above, below), picture in zip(axes.T, pictures):
        above.imshow(picture.image)
        above.set_title(picture.title)
        if picture.error is not None:
            below.imshow(np.clip(scale * np.abs(picture.image - pictures[0].image), 0, 1))
            below.set_title(f"difference x {scale:g}, mean {picture.error:.1e}")
    for axis in axes.flat:
        axis.set_axis_off()
    figure.savefig(path, dpi=70)
    pyplot.close(figure)
