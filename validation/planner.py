"""Claim: `mi-shlight plan` predicts error and time within 2x, keeps the error asked for, and saves most of the largest settings' time.

    python -m validation.planner [--quick] [--out DIR] [--only SCENE ...]

writes ``planner.json`` and ``planner.png``. Five scenes, different in kind: one light over an open floor; stairs with posts under two
lights; a room with light between its walls; 200 triangles of light on a dome over lumps; glossy things under a light and a sky. Stairs,
dome and gloss are held out: they were made when the planner was done, and nothing was changed after they had been looked at. Errors are
computed from what rays find, not fitted to any scene; constants of time and the factor of safety were set with other scenes (columns,
triangles over a knot, other glossy things), and the room showed that interpolation of light between surfaces had to be counted. For each
the planner is asked for 5 %, 1 % and 0.2 %. Then:

- **error**: mean relative error of the picture with the planned settings against Mitsuba's ``path`` or ``direct`` (with as many bounces as
  were asked for), as ``mi-shlight compare`` has it, but without noise, of pixel samples as of paths. There are two pictures of each, with
  other seeds; the product of both differences between planned and path-traced ones has the squared error as its mean, whatever the noise.
  Its share of the squared difference, over 5 x 5 pixels, says how much of the difference there is error. Where noise prevails, an even
  error comes out low by up to a fifth, and about a third of the noise is left: errors below ``noise`` / 3 cannot be told from none.
  ``met`` compares with what was asked for, give or take that;
- **time**: bake and picture, the best of three, or one if it takes long, after kernels are compiled, with the samples per pixel that the
  plan was made for; both as measured by the clock and by the processor, over its threads. Predictions are for all threads of a machine that
  has nothing else to do;
- **largest**: what order 14, ``exact``, 1024 rays per point and cells of half the default's size take, gloss and bounces as the scene needs
  them, no grid: measured where that is a matter of seconds, else as the planner predicts.

``within 2x`` is whether prediction and measurement differ by less than a factor of two; errors also count if both are below a third of the
noise or a third of what was asked for.
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
from validation.grid_scenes import GOLDEN_ANGLE, ball, normalize, patch, plane  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

TARGETS = (0.05, 0.01, 0.002)
REPEATS = 3
LONG = 4
"""Seconds from which on one repetition will do."""
RAYS = 1 << 15
"""Rays of a pixel whose transfer is not baked; they limit its samples."""
LARGEST_SECONDS = 12
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


def box(centre, half, degrees: float, bsdf: dict) -> dict:
    to_world = mi.ScalarTransform4f().translate(list(centre)).rotate([0, 1, 0], degrees).scale(list(half))
    return {"type": "cube", "to_world": to_world, "bsdf": bsdf}


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


def stairs(pixels: int):
    stone, wood = diffuse(0.6, 0.58, 0.52), diffuse(0.55, 0.35, 0.2)
    parts = {}
    for k in range(5):
        rise, z = 0.16 * (k + 1), 0.8 - 0.36 * k
        parts[f"step{k}"] = box((-0.1, rise / 2, z), (0.9, rise / 2, 0.18), 0, stone)
        parts[f"post{k}"] = box((-0.85 + 0.04 * k, rise + 0.4, z), (0.03, 0.4, 0.03), 20 * k, wood)
    return scene(pixels, (2.2, 2.3, 3.4), (-0.1, 0.4, 0), 36, DIRECT, floor=ground(diffuse(0.5, 0.5, 0.45)),
                 key=rectangle((-2.1, 2.2, 1.2), (0, 0.2, 0), 0.3, 0.45, emitter=area(13, 11, 8)),
                 fill=rectangle((1.4, 2.9, -0.6), (0, 0.3, 0), 0.5, 0.5, emitter=area(1.5, 2.2, 3.4)), **parts)


def room(pixels: int):
    grey, red, blue = diffuse(0.7), diffuse(0.6, 0.15, 0.1), diffuse(0.15, 0.25, 0.6)
    walls = {"floor": ((-1.5, 0, 1), (3, 0, 0), (0, 0, -2.5), grey), "ceiling": ((-1.5, 1.8, 1), (0, 0, -2.5), (3, 0, 0), grey),
             "back": ((-1.5, 0, -1.5), (3, 0, 0), (0, 1.8, 0), grey), "left": ((-1.5, 0, 1), (0, 0, -2.5), (0, 1.8, 0), red),
             "right": ((1.5, 0, -1.5), (0, 0, 2.5), (0, 1.8, 0), blue)}
    parts = {name: surface(name, plane(*sides), 32, bsdf) for name, (*sides, bsdf) in walls.items()}
    return scene(pixels, (0, 0.95, 3.2), (0, 0.85, 0), 40, {"type": "path", "max_depth": 6},
                 box=box((-0.5, 0.41, -0.5), (0.4, 0.4, 0.4), 25, grey),
                 light=rectangle((0.5, 1.6, -0.2), (0.4, 0, -0.3), 0.4, 0.3, emitter=area(9, 8.5, 7)), **parts)


def dome(pixels: int):
    k = np.arange(200)
    height, angle = 0.3 + 0.7 * (k + 0.5) / 200, k * GOLDEN_ANGLE
    d = np.stack([np.sqrt(1 - height ** 2) * np.sin(angle), height, np.sqrt(1 - height ** 2) * np.cos(angle)], axis=1)
    right = normalize(np.cross(d, [0.2, 0.1, 1.0]))
    ahead = np.cross(right, d)                        # from right to ahead is clockwise, seen from outside
    lights = {}
    for i in k:
        turn = 2 * np.pi * np.array([0, 1, 2]) / 3 + i
        corners = 4 * d[i] + 0.18 * (np.cos(turn)[:, None] * right[i] + np.sin(turn)[:, None] * ahead[i])
        radiance = np.array([1.5, 2, 3]) * (1 + 4 * max(d[i, 0], 0) ** 2)
        lights[f"light{i:03d}"] = mesh(f"light{i:03d}", corners, [[0, 1, 2]], emitter=area(*map(float, radiance)))
    lumps = {f"lump{i}": surface(f"lump{i}", ball(centre, radii, bumps), 1600, diffuse(0.7, 0.55, 0.5)) for i, (centre, radii, bumps) in
             enumerate((((-0.7, 0.4, 0.1), (0.4, 0.4, 0.4), 0.15), ((0.2, 0.65, -0.5), (0.35, 0.65, 0.35), 0.1),
                        ((0.75, 0.25, 0.4), (0.5, 0.25, 0.3), 0.0)))}
    return scene(pixels, (0.2, 2.0, 3.2), (0, 0.3, 0), 34, DIRECT, floor=ground(diffuse(0.6)), **lumps, **lights)


def gloss(pixels: int):
    aluminium = {"type": "roughconductor", "alpha": 0.5, "material": "Al"}
    paint = {"type": "roughplastic", "alpha": 0.25, "diffuse_reflectance": rgb(0.5, 0.15, 0.1)}
    enamel = {"type": "roughplastic", "alpha": 0.45, "diffuse_reflectance": rgb(0.25, 0.3, 0.5)}
    return scene(pixels, (0.6, 1.7, 3.3), (0, 0.4, -0.1), 36, {"type": "direct"}, floor=ground(diffuse(0.45)),
                 wall=box((0, 0.6, -0.9), (1.3, 0.6, 0.05), 8, enamel), slab=box((0.7, 0.2, 0.25), (0.3, 0.2, 0.2), -30, aluminium),
                 egg=surface("egg", ball((-0.45, 0.5, 0.1), (0.35, 0.5, 0.35)), 3000, paint),
                 sky={"type": "constant", "radiance": rgb(0.4, 0.35, 0.3)},
                 light=rectangle((-1.2, 2.1, 1.2), (0, 0.2, 0), 0.5, 0.3, emitter=area(8, 8, 9)))


SCENES = {"open floor": open_floor, "stairs": stairs, "room": room, "dome": dome, "gloss": gloss}


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
        off = (a + b - c - d) / 2
        steady = windowed((((a - c) * (b - d) + (a - d) * (b - c)) / 2).sum(axis=2) * self.mask)
        share = np.clip(steady / np.maximum(windowed((off ** 2).sum(axis=2) * self.mask), 1e-30), 0, 1)
        return float((abs(off).sum(axis=2) * np.sqrt(share))[self.mask].sum() / total), float(np.hypot(*noise))


def windowed(image: np.ndarray, reach: int = 2) -> np.ndarray:
    """Sums over the pixels around each, as far as `reach`."""
    padded = np.pad(image, reach)
    return np.lib.stride_tricks.sliding_window_view(padded, (2 * reach + 1, 2 * reach + 1), axis=(0, 1)).sum(axis=(-2, -1))


def seconds(what, settings: dict, repeats: int) -> dict:
    """Time of a bake and of a picture, compiled before; what takes long is not repeated."""
    best = {}
    for k in range(repeats + 1):
        if k > 1 and best["bake"] + best["render"] > LONG:
            break
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
        traced = found.settings["transfer_domain"] == "pixel" and found.settings["transfer"] != "unshadowed"
        each = min(spp, max(RAYS // found.settings["transfer_samples"], 128)) if traced else spp
        error, noise = reference.error(found.integrator(), each)
        times = seconds(what, found.settings, repeats)
        largest = found.largest
        row = {"scene": name, "asked": target, "settings": {k: found.settings[k] for k in ("order", "transfer", "transfer_domain",
               "transfer_samples", "max_edge", "grid_resolution", "bounce_samples", "bsdf_order")},
               "predicted error": found.error, "spread": found.spread, "error": error, "noise": noise,
               "met": error <= target + noise / 3, "promised": found.met, "predicted seconds": found.seconds,
               "seconds": times["bake"] + times["render"], "times": times, "planning seconds": planning,
               "largest seconds": largest["seconds"], "largest measured": False,
               "why": [": ".join(reason) for reason in found.why]}
        if target == targets[-1] and largest["seconds"] < largest_seconds:
            slow = seconds(what, largest["settings"], 1)
            row.update({"largest seconds": slow["bake"] + slow["render"], "largest measured": True})
        row["error within 2x"] = within(row["predicted error"], error, max(noise, target) / 3)
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
    saved = float(np.median([row["largest seconds"] / row["seconds"] for row in rows]))
    share = lambda text, values: experiment.verdict(f"{text}: all", float(np.mean(values)) if values else None, 1.0, False, "{:.0%}")
    return [share("plans that keep the error they promise", [row["met"] for row in rows if row["promised"]]),
            share("errors predicted within 2x", [row["error within 2x"] for row in rows]),
            share("times predicted within 2x", [row["time within 2x"] for row in rows]),
            experiment.verdict("time of the largest settings, in that of the plan, median: at least 2", saved, 2, False)]


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
    size = (24, 64, 32, 1, (0.02,), 0) if options.quick else (48, 65536, 2048, REPEATS, TARGETS, LARGEST_SECONDS)
    rows = [row for name in options.only or (("open floor", "stairs") if options.quick else SCENES)
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
