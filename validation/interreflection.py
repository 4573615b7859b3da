"""Claim: interreflection by gathering between baked points agrees with the path tracer, bounce by bounce, with near lights, too.

    python -m validation.interreflection [--quick] [--out DIR] [--only PART ...] [--references DIR]

prints tables and writes ``interreflection.json``, ``interreflection.png`` (panel) and ``interreflection_curves.png``. ``--only`` measures
some parts anew and keeps the others of an existing ``interreflection.json``. ``--references`` keeps the path-traced pictures in a folder.

The scene is Mitsuba's Cornell box (``scenes/cornell_box.xml``); references are Mitsuba's ``path`` without Russian roulette. All errors are
means of absolute differences over the mean of the reference, over pixels that see a surface and no part of the light.

**orders**: pictures of order 2 to 14 against `max_depth` 2 (``shadowed``), 3 and 4 (one bounce, two) and the converged path (bounces until
the tolerance). *bounced* is the error of what bounces add, against the difference of the references.

**bounces**: what is missing after N bounces, against the converged picture of ``shprt`` itself.

**samples**, **edges**: error of the bounced light over the rays per point and the size of the baked cells; CPU seconds on one thread of the
bake, of the table of hits and of a picture, with and without bounces; memory of the table.

**lighting**: gathering against interreflected transfer vectors ([G03]) in a corner of two walls and a floor, with the light at growing
distance: difference of the bounced light of the two, which is the error of the assumption that a light looks the same from both ends of
a bounce. Under an environment the two are the same sums in another order and agree to rounding.
"""
from __future__ import annotations

import functools
import json
import pathlib
import sys
import time
import warnings

import drjit as dr
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

import mi_shlight.plugins  # noqa: F401
from mi_shlight.compare import image_errors, shaded_pixels
from mi_shlight.errors import UnsupportedSceneWarning
from mi_shlight.panel import srgb
from mi_shlight.shading.bounce import Bounces
from validation import experiment

SCENE = pathlib.Path(__file__).parents[1] / "scenes" / "cornell_box.xml"
DEPTHS = {0: 2, 1: 3, 2: 4, None: -1}
"""Bounces, None for all of them -> `max_depth` of the path tracer."""
ORDERS = (2, 4, 6, 8, 10, 12, 14)
COUNTS = (1, 2, 3, 4, 6, 8, 12)
SAMPLES = (16, 64, 256, 1024)
EDGES = (0.4, 0.2, 0.1, 0.05)
HEIGHTS = (2, 4, 8, 16, 32)
SHOWN_ORDER = 8
QUICK = {"max_edge": 0.5, "transfer_samples": 64, "bounce_samples": 32}
PARTS = ("orders", "bounces", "samples", "edges", "lighting")
TARGETS = (("error of the converged picture, order 8", 0.04), ("error of the light of all bounces, order 8", 0.04),
           ("gather and transfer under an environment", 1e-4))


def box(size: int):
    return mi.load_file(str(SCENE), resx=size, resy=size, optimize=False)


def integrator(bounces, **parameters):
    """`shprt` with so many bounces: 0 for direct light, None for all."""
    parameters = {"order": SHOWN_ORDER, **parameters}
    if bounces != 0:
        parameters |= {"transfer": "interreflected", "bounces": bounces or 0}
    return mi.load_dict({"type": "shprt", **parameters})


def picture(scene, plugin, spp: int, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed))


class Box:
    """The Cornell box with its references; `settings` of all integrators that render it."""

    def __init__(self, size: int, reference_spp: int, spp: int, folder: pathlib.Path | None, **settings):
        self.scene, self.spp, self.settings = box(size), spp, settings
        self.mask = shaded_pixels(self.scene)
        self.truth = {bounces: self._reference(depth, size, reference_spp, folder) for bounces, depth in DEPTHS.items()}

    def _reference(self, depth: int, size: int, spp: int, folder) -> np.ndarray:
        file = folder and folder / f"cornell_{depth}_{size}_{spp}.npy"
        if file and file.exists():
            return np.load(file)
        plugin, passes = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000}), max(spp // 256, 1)
        image = sum(picture(self.scene, plugin, spp // passes, 1 + k) for k in range(passes)) / passes
        if file:
            np.save(file, image)
        return image

    def render(self, bounces, **parameters) -> np.ndarray:
        return picture(self.scene, integrator(bounces, **self.settings, **parameters), self.spp)

    def errors(self, image, bounces) -> dict:
        return image_errors(image, self.truth[bounces], self.mask)

    def bounced_errors(self, image, direct, bounces) -> dict:
        return image_errors(image - direct, self.truth[bounces] - self.truth[0], self.mask)


def measure_orders(cornell: Box, orders) -> tuple:
    """Rows, and the pictures of `SHOWN_ORDER`."""
    rows, shown = [], {}
    for order in orders:
        images = {bounces: cornell.render(bounces, order=order) for bounces in DEPTHS}
        for bounces, image in images.items():
            errors = cornell.errors(image, bounces)
            row = {"order": order, "bounces": "all" if bounces is None else bounces, "mean_relative": errors["mean_relative"],
                   "bias": errors["bias"], "p99": errors["p99"]}
            if bounces != 0:
                bounced = cornell.bounced_errors(image, images[0], bounces)
                row |= {"bounced": bounced["mean_relative"], "bounced_bias": bounced["bias"]}
            rows.append(row)
        shown = images if order == SHOWN_ORDER else shown
        print(f"order {order}", file=sys.stderr, flush=True)
    return rows, shown


def measure_counts(cornell: Box, counts) -> list:
    whole, rows = cornell.render(None, order=4, bounce_tolerance=1e-5), []
    for count in counts:
        missing = (whole - cornell.render(count, order=4))[cornell.mask].sum() / whole[cornell.mask].sum()
        rows.append({"bounces": count, "missing": float(missing)})
    return rows


def seconds(run) -> tuple:
    """CPU time of the process, and what `run` returns."""
    start = time.process_time()
    result = run()
    dr.sync_thread()
    return time.process_time() - start, result


def measure_cost(cornell: Box, name: str, values) -> list:
    """Error of the light of all bounces, and what it costs, over `bounce_samples` or `max_edge`."""
    rows, threads = [], dr.thread_count()
    dr.set_thread_count(1)
    for value in values:
        direct, whole = (integrator(bounces, order=4, **{name: value}) for bounces in (0, None))
        row, images = {name: value}, {}
        row["bake_seconds"], transfer = seconds(lambda: direct.prepare_scene(cornell.scene, False))
        whole.prepare_scene(cornell.scene, False)
        row["gather_seconds"], _ = seconds(lambda: Bounces(cornell.scene, transfer, whole._state, whole._settings, print))
        for column, plugin in (("picture_seconds", direct), ("bounced_picture_seconds", whole)):
            picture(cornell.scene, plugin, cornell.spp)                   # compiles
            row[column], images[column] = seconds(functools.partial(picture, cornell.scene, plugin, cornell.spp))
        errors = cornell.bounced_errors(images["bounced_picture_seconds"], images["picture_seconds"], None)
        points = transfer.coeffs.shape[1]
        rows.append({"bounced": errors["mean_relative"], "bounced_bias": errors["bias"], "points": points,
                     "megabytes": points * whole.bounce_samples * 4 / 1e6, **row})
        print(f"{name} {value}", file=sys.stderr, flush=True)
    dr.set_thread_count(threads)
    return rows


def paint(*colour):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}


def corner(size: int, emitter: dict, height: float = 2.0):
    """Two walls, one red, and a floor, all two units wide, with a light of unit solid angle above or around."""
    place = mi.ScalarTransform4f
    wall = lambda to_world, *colour: {"type": "rectangle", "to_world": to_world, "bsdf": paint(*colour)}
    scale = 0.15 * height
    lights = {"sky": emitter} if emitter["type"] in ("constant", "envmap") else {"light": {
        "type": "rectangle", "to_world": place().translate([0, height, 0]).rotate([1, 0, 0], 90).scale(scale), "emitter": emitter}}
    return mi.load_dict({
        "type": "scene", "floor": wall(place().rotate([1, 0, 0], -90), 0.7, 0.7, 0.7), **lights,
        "back": wall(place().translate([0, 1, -1]), 0.7, 0.7, 0.7),
        "left": wall(place().translate([-1, 1, 0]).rotate([0, 1, 0], 90), 0.8, 0.1, 0.1),
        "sensor": {"type": "perspective", "fov": 30, "to_world": place().look_at([2.4, 2, 4], [-0.2, 0.5, -0.2], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}}}, optimize=False)


def measure_lighting(size: int, spp: int, heights) -> list:
    rows = []
    area = {"type": "shlight", "radiance": {"type": "rgb", "value": 10.0}}
    cases = [(f"light at {height}", corner(size, area, height)) for height in heights]
    sky = np.ones((16, 32, 3), np.float32) * np.linspace(2, 0.2, 16, dtype=np.float32)[:, None, None]
    sky[2:5, 20:24] = (40, 30, 10)
    cases += [("constant", corner(size, {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}})),
              ("envmap", corner(size, {"type": "envmap", "bitmap": mi.Bitmap(sky)}))]
    for name, scene in cases:
        plain = {"localised": False, "order": 4, "max_edge": 0.1}
        direct = picture(scene, integrator(0, **plain), spp)
        gathered, vectors = (picture(scene, integrator(None, bounce_lighting=kind, bounce_tolerance=1e-6, **plain), spp) - direct
                             for kind in ("gather", "transfer"))
        plugins = [mi.load_dict({"type": "path", "max_depth": depth}) for depth in (-1, 2)]
        truth = [picture(scene, plugin, 64 * spp, 1) for plugin in plugins]
        bounced, seen = truth[0] - truth[1], (truth[1] > 0) & (direct > 0)
        seen = seen.all(axis=-1) & shaded_pixels(scene)
        row = {"light": name, "difference": image_errors(vectors, gathered, seen)["mean_relative"]}
        row |= {kind: image_errors(image, bounced, seen)["mean_relative"] for kind, image in (("gather", gathered), ("transfer", vectors))}
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
    return rows


def table(rows: list) -> str:
    """Markdown."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    show = lambda name, value: "" if value is None else value if isinstance(value, str) else (
        f"{value:.2g}" if name == "difference" else f"{value:.2%}" if abs(value) < 1 and isinstance(value, float) and "seconds" not in name
        and name not in EXACT else f"{value:.4g}")
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    return "\n".join(lines + ["| " + " | ".join(show(name, row.get(name)) for name in names) + " |" for row in rows]) + "\n"


EXACT = ("max_edge", "bounce_samples", "megabytes", "order")


def draw_panel(cornell: Box, images: dict, path: pathlib.Path) -> None:
    """Rows: shprt, path tracer, their difference; columns: bounces."""
    exposure = 0.9 / np.percentile(cornell.truth[None][cornell.mask].max(axis=-1), 99)
    columns = [*DEPTHS, "bounced"]
    pick = lambda images, column: images[None] - images[0] if column == "bounced" else images[column]
    figure, axes = plt.subplots(3, len(columns), figsize=(13.5, 8.4), layout="constrained")
    names = {0: "direct light", 1: "and one bounce", 2: "and two bounces", None: "all bounces", "bounced": "bounced light alone"}
    for k, column in enumerate(columns):
        shown, truth = (pick(where, column) for where in (images, cornell.truth))
        axes[0, k].imshow(srgb(shown * exposure))
        axes[1, k].imshow(srgb(truth * exposure))
        difference = np.where(cornell.mask, (shown - truth).mean(axis=-1) / cornell.truth[None][cornell.mask].mean(), np.nan)
        drawn = axes[2, k].imshow(difference, cmap="RdBu_r", vmin=-0.1, vmax=0.1, interpolation="nearest")
        errors = image_errors(shown, truth, cornell.mask)
        axes[0, k].set_title(names[column])
        axes[2, k].set_title(f"mean error {errors['mean_relative']:.1%}, bias {errors['bias']:+.1%}", fontsize=9)
    for axis, label in zip(axes[:, 0], (f"shprt, order {SHOWN_ORDER}", "path", "difference")):
        axis.set_ylabel(label)
    for axis in axes.ravel():
        axis.set(xticks=[], yticks=[])
    figure.colorbar(drawn, ax=axes[2], label="of the mean with all bounces", extend="both")
    figure.savefig(path, dpi=58)
    plt.close(figure)


def draw_curves(report: dict, path: pathlib.Path) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(13, 7), layout="constrained")
    for bounces in ("all", 2, 1, 0):
        rows = [row for row in report["orders"] if row["bounces"] == bounces]
        axes[0, 0].plot([r["order"] for r in rows], [r["mean_relative"] for r in rows], "o-", label=f"bounces: {bounces}")
    rows = [row for row in report["orders"] if row["bounces"] == "all"]
    axes[0, 0].plot([r["order"] for r in rows], [r["bounced"] for r in rows], "k^--", label="bounced light alone")
    axes[0, 0].set(xlabel="order", ylabel="mean error", ylim=(0, None))
    axes[0, 0].legend()
    axes[0, 1].semilogy([r["bounces"] for r in report["bounces"]], [r["missing"] for r in report["bounces"]], "o-")
    axes[0, 1].set(xlabel="bounces", ylabel="light left out")
    axes[0, 2].loglog([r["bounce_samples"] for r in report["samples"]], [r["bounced"] for r in report["samples"]], "o-")
    axes[0, 2].set(xlabel="bounce_samples", ylabel="error of bounced light")
    axes[1, 0].loglog([r["max_edge"] for r in report["edges"]], [r["bounced"] for r in report["edges"]], "o-")
    axes[1, 0].set(xlabel="max_edge (the box is 2 wide)", ylabel="error of bounced light")
    for name, label in (("gather_seconds", "gather table"), ("bounced_picture_seconds", "picture with bounces"),
                        ("picture_seconds", "picture without")):
        axes[1, 1].loglog([r["points"] for r in report["edges"]], [max(r[name], 1e-3) for r in report["edges"]], "o-", label=label)
    axes[1, 1].set(xlabel="baked points", ylabel="CPU seconds")
    axes[1, 1].legend()
    near = [row for row in report["lighting"] if row["light"].startswith("light")]
    for name, label in (("difference", "transfer against gather"), ("gather", "gather against path"),
                        ("transfer", "transfer against path")):
        axes[1, 2].loglog(HEIGHTS[:len(near)], [r[name] for r in near], "o-", label=label)
    axes[1, 2].set(xlabel="height of the light over a corner of size 2", ylabel="error of bounced light")
    axes[1, 2].legend()
    for axis, ticks in ((axes[0, 2], SAMPLES), (axes[1, 0], EDGES), (axes[1, 2], HEIGHTS)):
        axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.minorticks_off()
    for axis in axes.ravel():
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def targets(report: dict) -> list:
    """Verdicts on the converged picture and on bounces under an environment."""
    whole = next(row for row in report["orders"] if (row["order"], row["bounces"]) == (SHOWN_ORDER, "all"))
    sky = max(row["difference"] for row in report["lighting"] if not row["light"].startswith("light"))
    found = (whole["mean_relative"], whole["bounced"], sky)
    return [experiment.verdict(f"{what}: at most {limit:g}", value, limit) for (what, limit), value in zip(TARGETS, found)]


def main(arguments=None) -> None:
    options = experiment.options(
        __doc__, arguments,
        only={"nargs": "+", "choices": PARTS, "default": PARTS, "metavar": "PART", "help": "parts to measure: " + ", ".join(PARTS)},
        references={"type": pathlib.Path, "help": "folder that keeps the path-traced pictures"})
    mi.set_variant("llvm_ad_rgb")
    warnings.simplefilter("ignore", UnsupportedSceneWarning)
    size, reference_spp, spp, settings = (24, 64, 4, QUICK) if options.quick else (96, 4096, 64, {})
    cornell, path = Box(size, reference_spp, spp, options.references, **settings), options.out / "interreflection.json"
    report = json.loads(path.read_text()) if set(options.only) != set(PARTS) and path.exists() else {}
    take = lambda values: values[:1] if options.quick else values
    for part in options.only:
        if part == "orders":
            report[part], shown = measure_orders(cornell, (SHOWN_ORDER,) if options.quick else ORDERS)
            draw_panel(cornell, shown, options.out / "interreflection.png")
        elif part == "bounces":
            report[part] = measure_counts(cornell, take(COUNTS))
        elif part == "samples":
            report[part] = measure_cost(cornell, "bounce_samples", take(SAMPLES))
        elif part == "edges":
            report[part] = measure_cost(cornell, "max_edge", take(EDGES))
        else:
            report[part] = measure_lighting(16 if options.quick else 64, spp, take(HEIGHTS))
        print(f"{part}\n{table(report[part])}", flush=True)
        report.setdefault("runs", {})[part] = {"size": size, "reference_spp": reference_spp, "spp": spp, **experiment.versions()}
    if all(part in report for part in PARTS):
        report["targets"] = targets(report)
        experiment.print_targets(report["targets"])
        draw_curves(report, options.out / "interreflection_curves.png")
    experiment.write(path, report, options.quick)


if __name__ == "__main__":
    main()
