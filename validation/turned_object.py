"""Claim: an object that turns keeps its bake; the light is turned into its frame instead ([G03] "Rotating Spherical Harmonics").

    python -m validation.turned_object [--quick] [--out DIR] [--samples N] [--size N]

writes ``turned_object.json`` and ``turned_object.png``. A knot under a clear sky is baked once, upright. Where it has turned by R, each
vertex is shaded by its baked transfer and ``rotate(L, R^-1)``. Against that, root of the mean square over the mean radiance:

- **against_rebake**: a new bake of the turned knot, over the vertices; for several numbers of rays, as what they differ by is the noise
  of both.
- **against_path**: Mitsuba's ``path``, direct light only, of the turned knot under the same sky as an ``envmap``; over its pixels. What is
  left is the cut of sky and transfer at the order, the same for either bake.
- seconds of processor time for a bake and for turning the light.
"""
from __future__ import annotations

import math
import pathlib
import time

import matplotlib
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

mi.set_variant("llvm_ad_rgb")

from mi_shlight import bake_transfer  # noqa: E402
from mi_shlight.environment.probe import latlong  # noqa: E402
from mi_shlight.environment.sky import cie_sky, project_sky  # noqa: E402
from mi_shlight.scene import mesh_arrays  # noqa: E402
from mi_shlight.sh import rotate  # noqa: E402
from validation import experiment  # noqa: E402
from validation.experiment import ROOT  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

KNOT = ROOT / "scenes" / "meshes" / "sculpture_knot.ply"
ORDER = 8
SUN = (-0.5, 0.55, 0.67)
TURNS = {"upright": (0, 0), "90° about the vertical": (90, 0), "200°, tilted by 35°": (200, 35), "on its head": (0, 180)}


def rotation(about: float, tilt: float) -> np.ndarray:
    return Rotation.from_euler("xy", (tilt, about), degrees=True).as_matrix()


def scene(turn: np.ndarray, size: int = 16, sky=None) -> mi.Scene:
    """The knot about the origin, turned, under a sky (any, for the bake)."""
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    camera = mi.ScalarTransform4f().look_at(origin=[0, 1.2, 5.2], target=[0, 0, 0], up=[0, 1, 0])
    return mi.load_dict({
        "type": "scene", "sky": {"type": "constant"} if sky is None else {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "sensor": {"type": "perspective", "fov": 28, "to_world": camera, "sampler": {"type": "independent"},
                   "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "rfilter": {"type": "box"}}},
        "knot": {"type": "ply", "filename": str(KNOT), "to_world": mi.ScalarTransform4f(matrix.tolist()).translate([0, -1.35, 0]),
                 "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_radiance"}}}}, optimize=False)


def bake(turn: np.ndarray, samples: int) -> np.ndarray:
    """Transfer at the vertices of the turned knot, (vertices, (ORDER + 1)**2)."""
    turned = with_radiance(scene(turn), None)
    result = bake_transfer(turned, ORDER, samples=samples, max_edge=1e3)
    faces, positions = mesh_arrays(turned.shapes()[0])[:2]
    rows = np.empty(len(positions), int)
    rows[faces.ravel()] = result.meshes[0].rows                               # no edge is cut: three to a face
    return result.coeffs[0][rows].astype(np.float64)


def with_radiance(turned: mi.Scene, radiance) -> mi.Scene:
    """The knot's reflectance set to values by vertex; 1 for None."""
    mesh = turned.shapes()[0]
    values = np.ones(mesh.vertex_count()) if radiance is None else radiance
    mesh.add_attribute("vertex_radiance", 3, np.repeat(values, 3).astype(np.float32))
    return turned


def pictures(turn: np.ndarray, radiance: np.ndarray, sky: np.ndarray, size: int) -> tuple:
    """(vertices' radiance, path traced, mask of the knot), each (size, size)."""
    view = with_radiance(scene(turn, size), radiance)
    image = np.array(mi.render(view, integrator=mi.load_dict({"type": "aov", "aovs": "a:albedo"}), spp=256, seed=1))[..., -3]
    traced = np.array(mi.render(with_radiance(scene(turn, size, sky), None), spp=1024, seed=2,
                                integrator=mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})))
    return image, traced[..., 0], traced[..., 3] > 0.999


def measure(samples: int, size: int) -> tuple:
    """(report, rows of pictures)."""
    coeffs = np.array(project_sky("clear", ORDER, SUN), dtype=np.float64)
    sky = np.repeat(latlong(lambda d: cie_sky(d, "clear", SUN), 256, vector=mi.Vector3f)[..., None], 3, axis=2)
    start = time.process_time()
    upright = bake(rotation(0, 0), samples)
    bake_cpu_seconds = time.process_time() - start
    rows, panels = [], []
    for name, turn in ((name, rotation(*angles)) for name, angles in TURNS.items()):
        start = time.process_time()
        light = rotate(coeffs, turn.T)
        turn_seconds = time.process_time() - start
        kept, new = upright @ light, bake(turn, samples) @ coeffs
        image, traced, knot = pictures(turn, kept, sky, size)
        rebaked = pictures(turn, new, sky, size)[0]
        scale = traced[knot].mean()
        error = lambda picture: float(np.sqrt(np.mean((picture - traced)[knot] ** 2)) / scale)
        rows.append({"turn": name, "against_rebake": difference(kept, new), "against_path": error(image),
                     "rebake_against_path": error(rebaked), "turn_light_cpu_seconds": turn_seconds})
        panels.append((name, image, traced, np.where(knot, (image - traced) / scale, 0)))
    turn, noise = rotation(*list(TURNS.values())[2]), {}
    for count in (samples // 16, samples // 4, samples):
        noise[count] = difference(bake(rotation(0, 0), count) @ rotate(coeffs, turn.T), bake(turn, count) @ coeffs)
    return {"order": ORDER, "samples": samples, "vertices": len(upright), "bake_cpu_seconds": bake_cpu_seconds, "turns": rows,
            "against_rebake_by_samples": noise}, panels


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return math.sqrt(np.mean((a - b) ** 2)) / np.mean(b)


def draw(panels: list, path: pathlib.Path) -> None:
    figure, axes = plt.subplots(3, len(panels), figsize=(2.6 * len(panels), 7.6), layout="constrained")
    high = max(np.quantile(traced, 0.999) for _, _, traced, _ in panels)
    for column, (name, image, traced, error) in zip(axes.T, panels):
        for axis, picture, title in zip(column, (image, traced), (f"{name}\none bake, light turned", "path traced")):
            axis.imshow((np.clip(picture / high, 0, 1)) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            axis.set_title(title, fontsize=9)
        shown = column[2].imshow(error, cmap="RdBu", vmin=-0.2, vmax=0.2)
        column[2].set_title("difference over the mean", fontsize=9)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    figure.colorbar(shown, ax=axes[2], fraction=0.02)
    figure.savefig(path, dpi=75)
    plt.close(figure)


def targets(report: dict) -> list:
    """Verdicts on the worst turn."""
    worst = lambda measure: max(measure(row) for row in report["turns"])
    return [experiment.verdict(f"one bake for all turns, {report['samples']} rays: off a new bake by at most 0.5 %",
                               worst(lambda row: row["against_rebake"]), 0.005, text="{:.2%}"),
            experiment.verdict("error against path tracing at most 1.01 times that of a new bake",
                               worst(lambda row: row["against_path"] / row["rebake_against_path"]), 1.01, text="{:.4f}")]


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments,
                                 samples={"type": int, "default": 4096, "help": "rays per vertex (default: %(default)s)"},
                                 size={"type": int, "default": 128, "help": "pixels (default: %(default)s)"})
    if options.quick:
        options.samples, options.size = 64, 16
    report, panels = measure(options.samples, options.size)
    report = {"targets": targets(report), **report}
    experiment.print_targets(report["targets"])
    experiment.write(options.out / "turned_object.json", report, options.quick)
    draw(panels, options.out / "turned_object.png")


if __name__ == "__main__":
    main()
