"""[G03] Figs. 11, 13 and 15 from a scene of its kind: a white cup on a red mat before a blue screen, under a hemisphere of light."""
from __future__ import annotations

import pathlib

import mitsuba as mi
import numpy as np

from validation.paper_scenes import NO_REFINEMENT, Display, View, assemble, draw_sheet

from mi_shlight import latlong, project_cap
from mi_shlight.transfer.cosine import cosine_transfer
from validation.experiment import plain
from validation.glossy import error
from validation.grid_scenes import floor, plane, shares
from validation.soft_shadows import render

ORDER = 4
"""25 coefficients, the paper's "5th order"."""
PROFILE = np.array([[0.0, 0.0], [0.3, 0.0], [0.42, 0.1], [0.5, 0.45], [0.56, 0.95], [0.6, 1.0], [0.52, 0.98], [0.45, 0.5], [0.35, 0.14],
                    [0.0, 0.1]])
"""Radius and height of the cup's wall, up the outside and down the inside."""
WHITE, RED, BLUE = (0.85, 0.85, 0.85), (0.8, 0.12, 0.08), (0.1, 0.2, 0.75)
VIEW = View((0.5, 2.0, 3.4), (0, 0.42, 0), 36)


def cup(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(PROFILE, axis=0), axis=1))])
    radius, height = (np.interp(v * length[-1], length, column) for column in PROFILE.T)
    return np.stack([radius * np.sin(2 * np.pi * u), height, radius * np.cos(2 * np.pi * u)], axis=-1)


def make_scene(triangles: float, size: int) -> mi.Scene:
    screen = plane((-1.3, 0, 0.6), (0.5, 0, -1.7), (0, 1.3, 0))
    points = shares(triangles, (floor(1.6), 0.3, RED), (cup, 0.5, WHITE), (screen, 0.2, BLUE))
    sky = latlong(lambda d: (d[..., 1] > 0) * 1.0, 65)[..., None] * np.ones(3, np.float32)
    return assemble(points, {"sky": {"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32))}}, VIEW, size)


def unshadowed_error() -> float:
    """Largest difference of ``sum T L`` from (1 + cos) / 2, what a hemisphere of light makes of a white surface, over all normals."""
    polar = np.linspace(0, np.pi, 181)
    normals = mi.Normal3f(np.sin(polar).astype(np.float32), np.cos(polar).astype(np.float32), 0)
    light = project_cap(np.pi / 2, ORDER, (0, 1, 0))
    shaded = sum(t * float(c) for t, c in zip(cosine_transfer(normals, ORDER), light))
    return float(abs(np.array(shaded) - (1 + np.cos(polar)) / 2).max())


def measure(triangles: float, size: int, spp: int, reference_spp: int, rays: int, path: pathlib.Path) -> dict:
    """Errors against path tracing, and how red the cup is (mean of red over green); draws `path`."""
    scene = make_scene(triangles, size)
    common = {"type": "shprt", "order": ORDER, "localised": False, "max_edge": NO_REFINEMENT, "transfer_samples": rays}
    images = {"unshadowed (Fig. 11)": render(scene, {**common, "transfer": "unshadowed"}, spp, 1),
              "shadowed (Fig. 13)": render(scene, {**common, "transfer": "shadowed"}, spp, 1),
              "interreflected (Fig. 15)": render(scene, {**common, "transfer": "interreflected", "bounce_lighting": "transfer"}, spp, 1)}
    path_traced = {name: [render(scene, {"type": "path", "max_depth": depth, "rr_depth": 100}, reference_spp // 2, seed)
                          for seed in (2, 3)] for name, depth in (("shadowed (Fig. 13)", 2), ("interreflected (Fig. 15)", 12))}
    albedo = render(scene, {"type": "aov", "aovs": "albedo:albedo"}, spp, 1)[..., :3]
    depth = render(scene, {"type": "aov", "aovs": "depth:depth"}, spp, 1)[..., 0]
    seen, white = depth > 0, abs(albedo - WHITE[0]).max(axis=2) < 1e-3
    redness = lambda image: float(image[white, 0].mean() / image[white, 1].mean())
    report = {"unshadowed_error": unshadowed_error(), "pictures": {}}
    display = Display(images["unshadowed (Fig. 11)"], seen)
    above, below = [("unshadowed (Fig. 11)", display(images["unshadowed (Fig. 11)"]))], [("", None)]
    for name, halves in path_traced.items():
        truth = (halves[0] + halves[1]) / 2
        row = report["pictures"][name] = {"error": error(images[name], truth, seen), "noise": 0.5 * error(*halves, seen),
                                          "redness_of_the_cup": redness(images[name]), "redness_by_path": redness(truth)}
        above.append((f"{name}: {row['error']:.1%} off path", display(images[name])))
        below.append((f"path, noise {row['noise']:.1%}", display(truth)))
    draw_sheet(path, [("SH, order 4", above), ("", below)], width=2.8)
    return plain(report)
