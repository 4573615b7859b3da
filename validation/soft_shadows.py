"""Claim: transfer fitted to the lights' cone draws soft shadows many times better than transfer projected over the sphere.

    python -m validation.soft_shadows [--quick] [--out DIR]

writes ``soft_shadows.json`` and ``.png`` (curves) and ``soft_shadows_panel.png``, and prints tables.

*Points*: a ball floats between a floor and a rectangle light; the floor's irradiance is known without noise from 160 x 160 points of the
light and the ball's equation. Measured in the penumbra and umbra, as the mean absolute error over the mean: order, margin, eps and rays;
rays placed alike at all points against shifted ones; and derivatives of the shadow by the light's place, visibility held fixed as
``shprt`` does.

*Pictures*: the same ball, the plant and the Cornell box of scenes/, 128 x 128, transfer at vertices, against path tracing; margins in
degrees are lengths as seen from the middle of the scene. Errors of 8 x 8-pixel means and of pixels, all over and where some of the light
is hidden; the last are those of pixels whose path-traced value is less than 0.97 of the unshadowed one. Lights in view are left out.
"""
from __future__ import annotations

import math
import pathlib
import sys
from typing import NamedTuple

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np

import mi_shlight.plugins  # noqa: F401  registers shprt
from mi_shlight import project_polygon
from mi_shlight.panel import srgb
from mi_shlight.scene import aligned, polygon_lights
from mi_shlight.transfer.localised import ConeFit, cone_fit, sample_transfer
from mi_shlight.transfer.visibility import BakeLights, LightSight, Occluders
from validation import experiment
from validation.experiment import ROOT

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ORDERS = (2, 4, 6, 8)
MARGINS = (0, 2, 5, 15, 30)
"""Degrees."""
PLAIN = "projected"

LIGHT_AT, LIGHT_SIDE = np.array([0.3, 2.0, 0.2]), 0.8
BALL_AT, BALL_RADIUS = np.array([0.0, 0.7, 0.0]), 0.3


class Plan(NamedTuple):
    """Sizes to measure."""

    side: int = 48
    """Points along a side of the floor's middle."""
    rays: tuple = (16, 64, 256, 1024, 4096)
    eps: tuple = (1e-2, 1e-4, 1e-6, 1e-8)
    repeats: int = 8
    size: int = 128
    """Pixels along a side."""
    spp: int = 32
    reference_spp: int = 2048
    picture_rays: int = 512
    orders: tuple = ORDERS
    margins: tuple = MARGINS
    pictures: tuple = ("ball", "plant", "cornell_box")


QUICK = Plan(side=12, rays=(64, 256), eps=(1e-4, 1e-7), repeats=2, size=32, spp=4, reference_spp=64, picture_rays=64, orders=(4, 8),
             margins=(0, 5), pictures=("ball",))


# Points.

def ball_scene(size: int = 32):
    transform = mi.ScalarTransform4f
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}
    light = {"type": "rectangle", "to_world": transform().translate(LIGHT_AT.tolist()).rotate([1, 0, 0], 90).scale(LIGHT_SIDE / 2),
             "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 10.0}}}
    return mi.load_dict({"type": "scene", "light": light,
                         "sensor": {"type": "perspective", "fov": 55, "film": film, "sampler": {"type": "independent"},
                                    "to_world": transform().look_at([0, 1.7, 2.6], [0, 0.15, 0], [0, 1, 0])},
                         "floor": {"type": "rectangle", "to_world": transform().rotate([1, 0, 0], -90).scale(2), "bsdf": grey},
                         "ball": {"type": "sphere", "center": BALL_AT.tolist(), "radius": BALL_RADIUS, "bsdf": grey}}, optimize=False)


def exact_radiance(points: np.ndarray, shift=(0, 0, 0), n: int = 160) -> tuple:
    """(radiance of a white floor, visible part of the light) with the light moved by `shift`."""
    u = ((np.arange(n) + 0.5) / n - 0.5) * LIGHT_SIDE
    q = np.stack([a.ravel() for a in np.meshgrid(u, [0.0], u)], axis=1) + LIGHT_AT + shift
    radiance, visible = np.empty(len(points)), np.empty(len(points))
    for i, p in enumerate(points):
        d = q - p
        squared = (d * d).sum(axis=1)
        along = (d @ (BALL_AT - p)) / squared
        seen = (((BALL_AT - p - along[:, None] * d) ** 2).sum(axis=1) > BALL_RADIUS ** 2) | (along < 0) | (along > 1)
        weight = d[:, 1] ** 2 / squared ** 2
        radiance[i] = (weight * seen).mean() * LIGHT_SIDE ** 2 / math.pi
        visible[i] = (weight * seen).sum() / weight.sum()
    return radiance, visible


class Floor:
    """Points of the floor below the ball."""

    def __init__(self, plan: Plan):
        self.plan = plan
        u = (np.arange(plan.side) + 0.5) / plan.side * 3 - 1.5
        self.points = np.stack([a.ravel() for a in np.meshgrid(u, [0.0], u)], axis=1)
        self.truth, visible = exact_radiance(self.points)
        self.shadow = visible < 0.999
        self.p = mi.Point3f(*(aligned(mi.Float, c) for c in self.points.T))
        self.n = mi.Normal3f(0, 1, 0) + 0 * mi.Normal3f(self.p)
        self.scene = ball_scene()
        self.lights = polygon_lights(self.scene)
        self._occluders, self._coeffs = Occluders(self.scene, self.lights), {}
        dr.eval(self.p, self.n)

    def light(self, order: int, shift=(0, 0, 0)) -> np.ndarray:
        """Coefficients (P, N) of the light, moved by `shift`."""
        if (order, shift) not in self._coeffs:
            h = LIGHT_SIDE / 2
            corners = np.array([[-h, 0, h], [h, 0, h], [h, 0, -h], [-h, 0, -h]]) + LIGHT_AT + shift
            vertices = [mi.Point3f(*(dr.opaque(mi.Float, float(c)) for c in v)) for v in corners]
            coeffs = project_polygon(vertices, self.p, order)
            dr.eval(coeffs)
            self._coeffs[order, shift] = np.stack([np.array(c) for c in coeffs], axis=1)
        return self._coeffs[order, shift]

    def transfer(self, order: int, rays: int, margin: float = 0.0, eps: float | None = None, localised: bool = True, seed: int | None = 1):
        """Coefficients (P, N) with the rays shifted at random, or, without a seed, alike everywhere."""
        fit = (cone_fit(order, rays) if eps is None else ConeFit(order, eps)) if localised else None
        count = len(self.points)
        shift = np.full(count, 0.5) if seed is None else np.random.default_rng(seed).random(count)
        group = mi.UInt32(0), mi.UInt32(1)
        dr.make_opaque(group)
        sight = LightSight(self._occluders, BakeLights(self.lights, margin), group)
        found = sample_transfer(sight, self.p, self.n, order, rays, aligned(mi.Float, shift), fit=fit)
        dr.eval(found.coeffs)
        return np.stack([np.array(c) for c in found.coeffs], axis=1)

    def shaded(self, order: int, *arguments, **options) -> np.ndarray:
        return (self.transfer(order, *arguments, **options) * self.light(order)).sum(axis=1)

    def error(self, values: np.ndarray) -> float:
        """Mean absolute error in the shadow, relative to its mean."""
        return float(abs(values - self.truth)[self.shadow].mean() / self.truth[self.shadow].mean())


def length_of(degrees: float, distance: float) -> float:
    return distance * math.tan(math.radians(degrees))


def measure_points(plan: Plan) -> dict:
    floor, report = Floor(plan), {}
    most = 1024 if 1024 in plan.rays else max(plan.rays)
    distance = float(LIGHT_AT[1])
    report["order and margin"] = [
        {"transfer": PLAIN if margin is None else "localised", "order": order, "margin": margin or 0,
         "error": floor.error(floor.shaded(order, most, length_of(margin or 0, distance), localised=margin is not None))}
        for margin in (None, *plan.margins) for order in (1, *plan.orders)]
    report["eps"] = [{"order": order, "rays": rays, "margin": margin, "eps": eps,
                      "error": floor.error(floor.shaded(order, rays, length_of(margin, distance), eps))}
                     for order in (2, 4, 8) for rays in (min(plan.rays[-1], 64), most) for margin in (0, 5) for eps in plan.eps]
    report["rays"] = [{"transfer": "localised" if localised else PLAIN, "order": order, "rays": rays,
                       "error": floor.error(floor.shaded(order, rays, localised=localised))}
                      for localised in (False, True) for order in (4, 8) for rays in plan.rays]
    report["placement"] = placement(floor, plan)
    report["derivatives"] = derivatives(floor, most, distance)
    return report


def placement(floor: Floor, plan: Plan) -> list:
    """Rays alike at all points or shifted: what is left of the noise in single points and in means of 4 x 4."""
    side, rows = plan.side // 4, []
    blocks = lambda values: values.reshape(side, 4, side, 4).mean(axis=(1, 3))
    shadow = blocks(floor.shadow.astype(float).reshape(plan.side, -1)) > 0
    best = {order: floor.shaded(order, max(plan.rays) * 4) for order in (4, 8)}
    for rays in plan.rays[:3]:
        for order in (4, 8):
            for shared in (True, False):
                seeds = [None] if shared else range(plan.repeats)
                off = [floor.shaded(order, rays, seed=seed, eps=1e-8) - best[order] for seed in seeds]
                mean = floor.truth[floor.shadow].mean()
                rms = lambda values: float(np.sqrt(np.mean(np.square(values))) / mean)
                rows.append({"rays": rays, "order": order, "placed": "alike" if shared else "shifted",
                             "points": rms([o[floor.shadow] for o in off]),
                             "means of 4 x 4": rms([blocks(o.reshape(plan.side, -1))[shadow] for o in off])})
    return rows


def derivatives(floor: Floor, rays: int, distance: float, h: float = 0.02) -> list:
    """Root mean square error of the derivative by the light's place over that of the derivative, in the shadow."""
    rows = []
    for axis in range(3):
        ends = [tuple(sign * h * (k == axis) for k in range(3)) for sign in (1, -1)]
        truth = (exact_radiance(floor.points, ends[0])[0] - exact_radiance(floor.points, ends[1])[0]) / (2 * h)
        for order in (4, 8):
            rate = (floor.light(order, ends[0]) - floor.light(order, ends[1])) / (2 * h)
            for margin in (None, *floor.plan.margins):
                transfer = floor.transfer(order, rays, length_of(margin or 0, distance), localised=margin is not None)
                off = ((transfer * rate).sum(axis=1) - truth)[floor.shadow]
                rows.append({"axis": "xyz"[axis], "order": order, "transfer": PLAIN if margin is None else "localised",
                             "margin": margin or 0, "rms": float(np.sqrt((off ** 2).mean() / (truth[floor.shadow] ** 2).mean()))})
    return rows


# Pictures.

class Picture(NamedTuple):
    """A scene to render."""

    load: object
    distance: float
    """Of its lights from its middle, scene units."""
    max_edge: float = 0.0
    """Of baked triangles; 0 is the default."""


def from_file(name: str):
    return lambda size: mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), resx=size, resy=size, optimize=False)


PICTURES = {"ball": Picture(ball_scene, 2.0, 0.045), "plant": Picture(from_file("plant"), 3.0),
            "cornell_box": Picture(from_file("cornell_box"), 1.5)}


def render(scene, integrator: dict, spp: int, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=spp, seed=seed), dtype=float)


def grey(image: np.ndarray) -> np.ndarray:
    return image @ [0.2126, 0.7152, 0.0722]


def block_means(values: np.ndarray) -> np.ndarray:
    side = len(values) // 8
    return values.reshape(side, 8, side, 8).mean(axis=(1, 3))


def errors(image: np.ndarray, truth: np.ndarray, shadow: np.ndarray, lamp: np.ndarray) -> dict:
    """Mean absolute errors of luminance over its mean, but for pixels and blocks with a `lamp`."""
    off, truth = grey(image) - grey(truth), grey(truth)
    found = {}
    clean = block_means(lamp.astype(float)) == 0
    for name, off_, truth_, part in (("blocks", block_means(off), block_means(truth), clean), ("pixels", off, truth, ~lamp)):
        dim = part & ((block_means(shadow.astype(float)) > 0.5) if name == "blocks" else shadow)
        found[name] = float(abs(off_)[part].mean() / truth_[part].mean())
        found[f"{name} in shadow"] = float(abs(off_)[dim].mean() / truth_[dim].mean())
    return found


def measure_picture(name: str, plan: Plan) -> tuple:
    """(rows of errors, {title: picture}) of a scene."""
    picture = PICTURES[name]
    scene = picture.load(plan.size)
    path = {"type": "path", "max_depth": 2}
    parts = [render(scene, path, plan.reference_spp // 4, seed) for seed in range(4)]
    truth = np.mean(parts, axis=0)
    unshadowed = render(scene, {"type": "shprt", "order": 14, "transfer": "unshadowed"}, plan.spp)
    shadow = grey(truth) < 0.97 * grey(unshadowed)
    lamp = grey(render(scene, {"type": "path", "max_depth": 1}, plan.spp)) > 0
    noise = errors((parts[0] + parts[1] - parts[2] - parts[3]) / 4 + truth, truth, shadow, lamp)
    rows, shown = [{"scene": name, "transfer": "noise of the reference", "order": 0, "margin": 0, **noise}], {"path": truth}
    for margin in (None, *plan.margins):
        for order in plan.orders:
            plugin = {"type": "shprt", "order": order, "localised": margin is not None, "transfer_samples": plan.picture_rays,
                      "max_edge": picture.max_edge, "light_margin": length_of(margin or 0, picture.distance)}
            image = render(scene, plugin, plan.spp)
            kind = PLAIN if margin is None else "localised"
            rows.append({"scene": name, "transfer": kind, "order": order, "margin": margin or 0, **errors(image, truth, shadow, lamp)})
            if (order, margin) in ((8, None), (4, None), (4, 5), (8, 5)):
                shown[f"{kind}, order {order}" + ("" if margin is None else f", {margin} degrees")] = image
            print(name, rows[-1], file=sys.stderr, flush=True)
    return rows, shown


def plot_curves(report: dict, path: pathlib.Path) -> None:
    panels = ["points", *report["pictures"]]
    figure, axes = plt.subplots(1, len(panels) + 1, figsize=(3.6 * (len(panels) + 1), 3.4), layout="constrained", squeeze=False)
    for axis, key in zip(axes[0], panels):
        rows, value = (report["points"]["order and margin"], "error") if key == "points" else (report["pictures"][key], "blocks in shadow")
        for kind, margin in dict.fromkeys((row["transfer"], row["margin"]) for row in rows if row["order"]):
            line = [(row["order"], row[value]) for row in rows if (row["transfer"], row["margin"]) == (kind, margin)]
            style = {"color": "black", "linewidth": 2} if kind == PLAIN else {"color": plt.cm.viridis(MARGINS.index(margin) / 4.5)}
            axis.plot(*zip(*line), marker="o", label=PLAIN if kind == PLAIN else f"localised, {margin}°", **style)
        axis.set(title="floor under a ball, no pixels" if key == "points" else f"picture: {key}", xlabel="order", yscale="log")
        axis.grid(True, which="both", alpha=0.3)
    axes[0][0].set_ylabel("mean error in shadow, relative")
    axes[0][0].legend(fontsize=7)
    for kind, order in ((PLAIN, 8), ("localised", 4), ("localised", 8)):
        line = [(row["rays"], row["error"]) for row in report["points"]["rays"] if (row["transfer"], row["order"]) == (kind, order)]
        axes[0][-1].plot(*zip(*line), marker="o", label=f"{kind}, order {order}")
    axes[0][-1].set(title="floor: rays per point", xlabel="rays", xscale="log", yscale="log")
    axes[0][-1].grid(True, which="both", alpha=0.3)
    axes[0][-1].legend(fontsize=7)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def plot_panel(shown: dict, path: pathlib.Path) -> None:
    """Pictures of each scene, and their differences to the path tracer's, five times."""
    titles = list(next(iter(shown.values())))
    figure, axes = plt.subplots(2 * len(shown), len(titles), figsize=(1.9 * len(titles), 3.9 * len(shown)), layout="constrained",
                                squeeze=False)
    for i, found in enumerate(shown.values()):
        scale = 0.5 / np.percentile(grey(found["path"]), 80)
        for j, title in enumerate(titles):
            axes[2 * i][j].imshow(srgb(found[title] * scale))
            off = (grey(found[title]) - grey(found["path"])) * scale
            axes[2 * i + 1][j].imshow(off, cmap="RdBu_r", vmin=-0.1, vmax=0.1)
            axes[0][j].set_title(title.replace(", ", "\n", 1), fontsize=8)
    for axis in axes.ravel():
        axis.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=75)
    plt.close(figure)


def table(rows: list) -> str:
    """Markdown."""
    def show(key, value):
        return f"{value:.3%}" if isinstance(value, float) and key != "eps" else f"{value:g}" if key == "eps" else str(value)

    lines = [list(rows[0]), ["---"] * len(rows[0]), *([show(*item) for item in row.items()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def targets(report: dict) -> list:
    """Verdicts on how much better fitted transfer is than projected."""
    pick = lambda rows, value, **keys: next(row[value] for row in rows if all(row[key] == wanted for key, wanted in keys.items()))
    gain = lambda rows, value, order: (pick(rows, value, transfer=PLAIN, order=order)
                                       / pick(rows, value, transfer="localised", order=order, margin=5))
    lines = [experiment.verdict("floor under the ball, order 4, margin 5°: error at least 5 times smaller than projected",
                                gain(report["points"]["order and margin"], "error", 4), 5, at_most=False)]
    for name, rows in report["pictures"].items():
        plain = pick(rows, "blocks", transfer=PLAIN, order=8)
        for order, factor in ((8, 4), (4, 1)):
            fitted = pick(rows, "blocks", transfer="localised", order=order, margin=5)
            lines.append(experiment.verdict(f"{name}, order {order}, margin 5°: error of 8 x 8 pixels at least {factor} times smaller than "
                                            "projected at order 8", plain / fitted, factor, at_most=False))
    return lines


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments)
    mi.set_variant("llvm_ad_rgb")
    plan, report, shown = QUICK if options.quick else Plan(), {"points": {}, "pictures": {}}, {}
    report["points"] = measure_points(plan)
    for name, rows in report["points"].items():
        print(f"\n{name}\n{table(rows)}", flush=True)
    for name in plan.pictures:
        report["pictures"][name], shown[name] = measure_picture(name, plan)
        print(f"\n{name}\n{table(report['pictures'][name])}", flush=True)
    report = {"targets": targets(report), **report}
    experiment.print_targets(report["targets"])
    plot_panel(shown, options.out / "soft_shadows_panel.png")
    plot_curves(report, options.out / "soft_shadows.png")
    experiment.write(options.out / "soft_shadows.json", report, options.quick)


if __name__ == "__main__":
    main()
