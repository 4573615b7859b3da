"""Claim: `mi-shlight plan` predicts error and time within 2x, keeps the error asked for, and saves most of the largest settings' time.

    python -m validation.planner [--quick] [--out DIR] [--only SCENE ...]

writes ``planner.json`` and ``planner.png``. Five scenes, different in kind: one light over an open floor; columns under two lights; a room
with light between its walls; 201 triangles of light over a knot; glossy things under a light and a sky. Errors are not fitted to any scene,
but the safety margin was set after a look at columns, gloss and triangles; and of the constants of time those of baked points were measured
on columns, those of gloss on the glossy scene: only the open floor, the room and the triangles are held out there. For each the planner is
asked for 5 %, 1 % and 0.2 %. Then:

- **error**: mean relative error of the picture with the planned settings against Mitsuba's ``path`` or ``direct`` (with as many bounces as
  were asked for), as ``mi-shlight compare`` has it, but without noise. There are two pictures of each, with other seeds; the product of
  both differences between planned and path-traced ones has the squared error as its mean, whatever the noise, and is averaged over 5 x 5
  pixels. A third of the noise is left. ``met`` compares it with what was asked for;
- **time**: bake and picture, the best of three after kernels are compiled, with the samples per pixel that the plan was made for; both as
  measured by the clock and by the processor, over its threads;
- **largest**: what order 14, ``exact``, 1024 rays per point and cells of half the default's size take, gloss and bounces as the scene needs
  them, no grid: measured where that is a matter of seconds, else as the planner predicts.

``within 2x`` is whether prediction and measurement differ by less than a factor of two; errors also count if both are below half the noise
or a third of what was asked for.
"""
from __future__ import annotations

import time

import matplotlib
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

import drjit as dr  # noqa: E402

from mi_shlight import plan  # noqa: E402
from mi_shlight.compare import image_errors, shaded_pixels  # noqa: E402
from validation import experiment  # noqa: E402
from validation.grid_scenes import column, knot, patch, plane, sierpinski, star, together  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

TARGETS = (0.05, 0.01, 0.002)
REPEATS = 3
LARGEST_SECONDS = 20
"""Largest settings that are predicted to take longer are not measured."""


# Scenes.

DIRECT = {"type": "direct", "emitter_samples": 4, "bsdf_samples": 0}


def rgb(*value) -> dict:
    return {"type": "rgb", "value": list(value) if len(value) > 1 else value[0]}


def diffuse(*value) -> dict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(*value)}}


def area(*value) -> dict:
    return {"type": "area", "radiance": rgb(*value)}


def mesh(name: str, vertices, faces, **nested):
    """A flat-shaded mesh with a BSDF or an emitter."""
    properties = mi.Properties()
    for key, plugin in nested.items():
        properties[key] = mi.load_dict(plugin)
    shape = mi.Mesh(name, len(vertices), len(faces), props=properties)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"], parameters["faces"] = mi.Float(np.ravel(vertices)), mi.UInt32(np.ravel(faces))
    parameters.update()
    return shape


def surface(name: str, function, triangles: int, bsdf: dict):
    points = patch(function, triangles)
    return mesh(name, points.positions, points.faces, bsdf=bsdf)


def rectangle(position, target, *size, **nested) -> dict:
    to_world = mi.ScalarTransform4f().look_at(list(position), list(target), [0.1, 0.2, 1]).scale([*size, 1])
    return {"type": "rectangle", "to_world": to_world, **nested}


def ground(bsdf: dict, size: float = 2.5) -> dict:
    return rectangle((0, 0, 0), (0, 1, 0), size, size, bsdf=bsdf)


def scene(pixels: int, origin, target, fov: float, integrator: dict, **parts):
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}
    sensor = {"type": "perspective", "fov": fov, "film": film, "sampler": {"type": "independent", "sample_count": 64},
              "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0])}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **parts}, optimize=False)


def open_floor(pixels: int):
    corners = np.array([[-0.7, 1.3, 0.2], [0.4, 1.5, -0.5], [0.9, 1.2, 0.1], [0.5, 1.1, 0.8], [-0.3, 1.2, 0.9]])
    light = mesh("pentagon", corners, [[0, 1, 2], [0, 2, 3], [0, 3, 4]], emitter=area(6, 7, 8))
    return scene(pixels, (0, 3, 4), (0, 0, 0), 32, DIRECT, floor=ground(diffuse(0.6, 0.5, 0.4)), light=light)


def columns(pixels: int):
    parts = {f"column{i}": surface(f"column{i}", column((x, 0, z), 0.22, 1.4), 3000, diffuse(0.7, 0.65, 0.6))
             for i, (x, z) in enumerate(((-0.9, -0.5), (0.0, -0.8), (0.9, -0.4), (-0.4, 0.4), (0.7, 0.6)))}
    return scene(pixels, (0.4, 2.6, 4.2), (0, 0.5, 0), 36, DIRECT, floor=ground(diffuse(0.5, 0.5, 0.55)),
                 key=rectangle((1.6, 2.6, 1.5), (0, 0.3, 0), 0.35, 0.25, emitter=area(14, 12, 9)),
                 fill=rectangle((-2.2, 1.8, 0.8), (0, 0.5, 0), 0.8, 0.6, emitter=area(0.9, 1.3, 2)), **parts)


def room(pixels: int):
    grey, red, blue = diffuse(0.7), diffuse(0.6, 0.15, 0.1), diffuse(0.15, 0.25, 0.6)
    walls = {"floor": ((-1.5, 0, 1), (3, 0, 0), (0, 0, -2.5), grey), "ceiling": ((-1.5, 1.8, 1), (0, 0, -2.5), (3, 0, 0), grey),
             "back": ((-1.5, 0, -1.5), (3, 0, 0), (0, 1.8, 0), grey), "left": ((-1.5, 0, 1), (0, 0, -2.5), (0, 1.8, 0), red),
             "right": ((1.5, 0, -1.5), (0, 0, 2.5), (0, 1.8, 0), blue)}
    parts = {name: surface(name, plane(*sides), 32, bsdf) for name, (*sides, bsdf) in walls.items()}
    turned = mi.ScalarTransform4f().translate([-0.5, 0.41, -0.5]).rotate([0, 1, 0], 25).scale(0.4)
    box = {"type": "cube", "bsdf": grey, "to_world": turned}
    return scene(pixels, (0, 0.95, 3.2), (0, 0.85, 0), 40, {"type": "path", "max_depth": 6}, box=box,
                 light=rectangle((0.5, 1.6, -0.2), (0.4, 0, -0.3), 0.4, 0.3, emitter=area(9, 8.5, 7)), **parts)


def triangles(pixels: int):
    panels = together([sierpinski(4, 0.8, (1.6, 2.2, 1.0), (0, 0.4, 0), [(2, 1, 0.5), (9, 6, 3)]),
                       star(120, 0.7, (-1.8, 1.9, 0.6), (0, 0.4, 0), (0.6, 1.0, 1.8))])
    lights = {f"light{k:03d}": mesh(f"light{k:03d}", panels.vertices[face[::-1]], [[0, 1, 2]], emitter=area(*map(float, radiance)))
              for k, (face, radiance) in enumerate(zip(panels.faces, panels.radiance))}
    return scene(pixels, (0.2, 2.4, 3.4), (0, 0.4, 0), 34, DIRECT, floor=ground(diffuse(0.6)),
                 knot=surface("knot", knot((0, 0.55, 0), 0.55), 6000, diffuse(0.7, 0.6, 0.5)), **lights)


def gloss(pixels: int):
    copper = {"type": "roughconductor", "alpha": 0.4, "material": "Cu"}
    sphere = {"type": "sphere", "center": [-0.5, 0.45, 0], "radius": 0.45, "bsdf": copper}
    plastic = {"type": "roughplastic", "alpha": 0.35, "diffuse_reflectance": rgb(0.2, 0.4, 0.25)}
    turned = mi.ScalarTransform4f().translate([0.6, 0.31, 0.2]).rotate([0, 1, 0], 35).scale(0.3)
    box = {"type": "cube", "bsdf": plastic, "to_world": turned}
    return scene(pixels, (0, 1.8, 3.2), (0, 0.35, 0), 36, {"type": "direct"}, floor=ground(plastic), ball=sphere, box=box,
                 sky={"type": "constant", "radiance": rgb(0.25, 0.3, 0.4)},
                 light=rectangle((0.9, 1.9, 0.5), (0, 0.2, 0), 0.4, 0.4, emitter=area(10, 9, 8)))


SCENES = {"open floor": open_floor, "columns": columns, "room": room, "triangles": triangles, "gloss": gloss}


# Measurements.

def picture(what, integrator, spp: int, seed: int) -> np.ndarray:
    """Mean of passes that fit into memory."""
    passes = -(-spp // 1024)
    return np.mean([np.array(mi.render(what, integrator=integrator, spp=-(-spp // passes), seed=seed + 7919 * k)) for k in range(passes)],
                   axis=0, dtype=np.float64)


class Reference:
    """Path-traced picture of a scene, in two halves."""

    def __init__(self, what, spp: int):
        self.scene = what
        self.halves = [picture(what, what.integrator(), spp // 2, seed) for seed in (1, 2)]
        self.mask = shaded_pixels(what)

    def error(self, integrator, spp: int) -> tuple:
        """(mean relative error without noise, noise)."""
        mine = [picture(self.scene, integrator, spp // 2, seed) for seed in (11, 12)]
        noise = [image_errors(half[0], np.mean(half, axis=0), self.mask)["mean_relative"] for half in (self.halves, mine)]
        total = np.mean(self.halves, axis=0)[self.mask].sum()
        a, b, c, d = *mine, *self.halves
        square = ((a - c) * (b - d) + (a - d) * (b - c)) / 2 * self.mask[..., None]
        near = windowed(square) / np.maximum(windowed(self.mask[..., None].astype(float)), 1e-9)
        return float(np.sqrt(np.maximum(near, 0))[self.mask].sum() / total), float(np.hypot(*noise))


def windowed(image: np.ndarray, reach: int = 2) -> np.ndarray:
    """Sums over the pixels around each, as far as `reach`."""
    padded = np.pad(image, ((reach, reach), (reach, reach), (0, 0)))
    return np.lib.stride_tricks.sliding_window_view(padded, (2 * reach + 1, 2 * reach + 1), axis=(0, 1)).sum(axis=(-2, -1))


def seconds(what, settings: dict, repeats: int) -> dict:
    """Time of a bake and of a picture, compiled before."""
    best = {}
    for k in range(repeats + 1):
        integrator = mi.load_dict({"type": "shprt", **settings})
        for name, work in (("bake", lambda: integrator.prepare_scene(what, False)),
                           ("render", lambda: mi.render(what, integrator=integrator, seed=3).numpy())):
            clock, processor = time.perf_counter(), time.process_time()
            work()
            dr.sync_thread()
            if k:
                now = {name: time.perf_counter() - clock, f"{name}_processor": (time.process_time() - processor) / dr.thread_count()}
                best.update({key: min(value, best.get(key, value)) for key, value in now.items()})
    return best


def measure(name: str, pixels: int, reference_spp: int, spp: int, repeats: int, targets, largest_seconds: float) -> list:
    what = SCENES[name](pixels)
    reference, rows = Reference(what, reference_spp), []
    for target in targets:
        start = time.process_time()
        found = plan(what, target)
        planning = (time.process_time() - start) / dr.thread_count()
        error, noise = reference.error(found.integrator(), spp)
        times = seconds(what, found.settings, repeats)
        largest = found.largest
        row = {"scene": name, "asked": target, "settings": {k: found.settings[k] for k in ("order", "transfer", "transfer_domain",
               "transfer_samples", "max_edge", "grid_resolution", "bounce_samples", "bsdf_order")},
               "predicted error": found.error, "spread": found.spread, "error": error, "noise": noise,
               "met": error <= target, "promised": found.met, "predicted seconds": found.seconds,
               "seconds": times["bake"] + times["render"], "times": times, "planning seconds": planning,
               "largest seconds": largest["seconds"], "largest measured": False,
               "why": [": ".join(reason) for reason in found.why]}
        if target == targets[-1] and largest["seconds"] < largest_seconds:
            slow = seconds(what, largest["settings"], 1)
            row.update({"largest seconds": slow["bake"] + slow["render"], "largest measured": True})
        row["error within 2x"] = within(row["predicted error"], error, max(noise / 2, target / 3))
        row["time within 2x"] = within(row["predicted seconds"], row["seconds"], 0)
        rows.append(row)
        print(f"{name:<11} {target:6.1%}  {error:7.2%} (predicted {found.error:7.2%}, noise {noise:.2%})  {row['seconds']:7.2f} s "
              f"(predicted {found.seconds:7.2f} s)  largest {row['largest seconds']:7.1f} s   {found.settings['transfer']}, order "
              f"{found.settings['order']}, {found.settings['transfer_domain']}", flush=True)
    return rows


def within(predicted: float, measured: float, floor: float) -> bool:
    """Whether they differ by less than a factor of 2, or are both below `floor`."""
    return max(predicted, measured) <= floor or 0.5 <= predicted / max(measured, 1e-12) <= 2


def judged(rows: list) -> list:
    """Verdicts over all rows."""
    share = lambda text, values: experiment.verdict(f"{text}: all", float(np.mean(values)) if values else None, 1.0, False, "{:.0%}")
    return [share("plans that keep the error they promise", [row["met"] for row in rows if row["promised"]]),
            share("errors predicted within 2x", [row["error within 2x"] for row in rows]),
            share("times predicted within 2x", [row["time within 2x"] for row in rows])]


def draw(rows: list, path) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.8))
    for ax, key, predicted, scale, title in ((axes[0], "error", "predicted error", 100, "mean relative error, %"),
                                             (axes[1], "seconds", "predicted seconds", 1, "bake and picture, s")):
        values = [scale * max(row[k], 1e-5) for row in rows for k in (key, predicted)]
        low, high = min(values) / 2, max(values) * 2
        line = np.array([low, high])
        ax.fill_between(line, line / 2, line * 2, color="0.92", label="within a factor of 2")
        ax.plot(line, line, color="0.6", lw=0.8)
        for k, name in enumerate(dict.fromkeys(row["scene"] for row in rows)):
            own = [row for row in rows if row["scene"] == name]
            ax.plot([scale * max(row[predicted], 1e-5) for row in own], [scale * max(row[key], 1e-5) for row in own], "os^Dv"[k % 5],
                    label=name, ms=7, alpha=0.85)
        ax.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), xlabel=f"predicted {title}", ylabel=f"measured {title}")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("")
        if key == "error":
            for target in sorted({row["asked"] for row in rows}):
                ax.axhline(100 * target, color="tab:red", lw=0.7, ls=":")
                ax.text(low * 1.1, 105 * target, f"asked for {target:.1%}", color="tab:red", fontsize=8)
        ax.legend(fontsize=8, loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments, only={"nargs": "+", "choices": list(SCENES), "metavar": "SCENE"})
    size = (24, 64, 32, 1, (0.02,), 0) if options.quick else (64, 32768, 1024, REPEATS, TARGETS, LARGEST_SECONDS)
    rows = [row for name in options.only or (("open floor", "columns") if options.quick else SCENES)
            for row in measure(name, *size)]
    saved = [row["largest seconds"] / row["seconds"] for row in rows]
    targets = judged(rows)
    report = {"rows": rows, "targets": targets, "largest over planned seconds, median": float(np.median(saved))}
    experiment.write(options.out / "planner.json", report, options.quick)
    draw(rows, options.out / "planner.png")
    print(f"the largest settings take {np.median(saved):.3g} times as long (median), {min(saved):.3g} to {max(saved):.3g}")
    experiment.print_targets(targets)


if __name__ == "__main__":
    main()
