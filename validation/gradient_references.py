"""Claim: gradients of ``shprt`` are those of Mitsuba's own references but for the band limit, with shadows and without.

    python -m validation.gradient_references [--quick] [--out DIR] [--seeds N] [--case NAME]

writes ``gradient_references.json`` and ``.png`` and prints tables. Forward-mode derivatives of 16 x 16 pictures of a diffuse floor, light
and occluder out of view, against

- **exact**: without occluder autodiff of Lambert's formula (``polygon_irradiance``) in float64; with one the integral over the part of
  the outline that the floor sees (gradient_oracle.py). Free of noise.
- **direct AD**: Mitsuba's ``direct``, emitter sampling only, by autodiff. Valid for radiance and reflectance; for translation and
  stretch of rectangles without occluder. Not for rotation (measured: ratio -0.12 to the exact derivative for the small rectangle, 1.7 for
  the large one), single vertices of meshes, or shadows.
- **direct FD**: the same integrator by central differences over common random numbers; always valid.
- **direct_projective**: unbiased with occluders, ``guiding`` none, noisy.

What ``shprt`` should give at a finite order is computed apart from it, with visibility of its own and without its light integrals: the
difference of this "band-limited" derivative to the exact one is what the order costs. Each row gives the ratio of ``<w, gradient>`` to
that of the reference, with fixed pixel weights w, and root mean square differences of gradient pictures over that of the exact
picture. It agrees if

    | (shprt - reference) - (band-limited - exact) | <= confidence interval + differencing error + NUMERICAL <w, |exact|> ,

all but the last as ``<w, .>``: the interval of the reference from independent seeds (Student's t), and a third of the change of a
difference when its step is doubled. One in twenty 95 % intervals misses the truth by chance, so "yes*" marks what only the interval
for the table as a whole holds (95 % for all references together, Bonferroni), and "NO" what that does not hold.

Outcome: every comparison holds. Without occluder ``shprt`` follows the prediction to 1e-4. Behind one it does so to 0.2-0.8 % of the
gradient picture with 4096 rays (transfer at vertices) and 0.2-4 % with 16 x 256 (per pixel); but there the prediction itself is far from
exact. The derivative looks at visibility along the light's outline, where it jumps, and an order this low smooths the jump: gradient
pictures are off by 12-45 % at order 8 and 10-27 % at order 14, weighted means by up to a factor of 2.2 where contributions cancel (motion
towards the floor, tilting). A ``light_margin`` is not needed for the derivative at the place of the bake; a small one (a third of the
light's half side) changes little, a wide one mostly makes it worse, as it brings in more silhouettes. Visibility per pixel follows the
light: differences of such pictures are mostly nearer to the truth than the derivative, which holds it fixed ("visibility_follows_light").
"""
from __future__ import annotations

import math
import pathlib
import sys
from typing import Callable, NamedTuple

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np
from drjit.llvm.ad import Array3f64, Float64
from scipy.stats import t as student

from mi_shlight import polygon_irradiance
from validation import experiment
from validation import gradient_oracle as oracle

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

PIXELS, SUB, FINE = 16, 4, 12
"""Side of the pictures; points per side of a pixel at which `shprt` looks, and those for the exact derivative."""
REFLECTANCE = 0.5
STEP = 0.02
"""Of central differences over common random numbers, in scene units or radians."""
DIRECT_SPP, PROJECTIVE_SPP = 16384, 16384
RAYS = {"pixel": 256, "vertex": 4096}
"""Per point: a pixel has SUB x SUB of them."""
MAX_EDGE = 0.1
NUMERICAL = {"unshadowed": 1e-4, "pixel": 4e-3, "vertex": 1e-2}
"""What else may differ, relative: float32 rounding; for a shadow the rays of the transfer, those of the oracle and, at vertices,
interpolation."""


class Motion(NamedTuple):
    """What changes: for rectangles ``move(Transform, t)`` gives the factors left and right of `to_world`; for meshes the vertices have a
    `velocity`; else `key` is a parameter in which the picture is linear, with the value `scale`."""

    move: Callable = None
    velocity: np.ndarray = None
    key: str = None
    scale: float = 1.0


class Case(NamedTuple):
    """A floor at y = 0 seen straight from above, from below everything else."""

    name: str
    height: float
    """Of the light."""
    size: float
    """Half side of a rectangle, radius of a pentagon."""
    motions: dict
    view: float = 1.0
    """Half side of what the camera sees."""
    occluder: np.ndarray = None
    mesh: bool = False

    @property
    def camera(self) -> float:
        return 0.9 * (self.height if self.occluder is None else self.occluder[0, 1])


def translation(axis) -> Motion:
    return Motion(move=lambda transform, t: (transform().translate([a * t for a in axis]), transform()))


AXES = {"translation x": (1, 0, 0), "translation y": (0, 1, 0), "translation z": (0, 0, 1)}
LINEAR = {"radiance": Motion(key="light.emitter.radiance.value"),
          "reflectance": Motion(key="floor.bsdf.reflectance.value", scale=REFLECTANCE)}
RIGID = {**{name: translation(axis) for name, axis in AXES.items()},
         "stretch": Motion(move=lambda transform, t: (transform(), transform().scale([1 + t, 1, 1]))),
         "rotation": Motion(move=lambda transform, t: (transform(), transform().rotate([0.6, 0.8, 0], t * (180 / math.pi)))), **LINEAR}
CORNER = {f"vertex 1 {name[-1]}": Motion(velocity=np.outer(np.arange(5) == 1, axis)) for name, axis in AXES.items()}
BLOCKER = np.array([[-0.35, 1, 0.3], [0.2, 1, 0.4], [0.3, 1, -0.05], [-0.2, 1, -0.15]])
"""Askew: where an edge lies parallel to one of the light's, gradient pictures jump, and no grid of points gives a pixel's mean well."""
CASES = {case.name: case for case in (
    Case("small rectangle", 1.5, 0.3, RIGID), Case("large close rectangle", 0.6, 1.0, RIGID),
    Case("pentagon", 1.5, 0.5, CORNER, mesh=True),
    Case("rectangle behind occluder", 1.5, 0.3, RIGID, occluder=BLOCKER),
    Case("pentagon behind occluder", 1.5, 0.5, CORNER, occluder=BLOCKER, mesh=True))}

SHOWN = "rectangle behind occluder"


def to_world(case: Case):
    return mi.ScalarTransform4f().translate([0.1, case.height, 0]).rotate([1, 0, 0], 90).scale(case.size)


def corners(case: Case, motion: Motion = None, t: float = 0.0) -> np.ndarray:
    """Vertices of the light, moved by t; counter-clockwise as seen from the lit side."""
    if case.mesh:
        angle = 0.4 + 2 * np.pi * np.arange(5) / 5
        points = np.stack([0.1 + case.size * np.cos(angle), np.full(5, case.height), case.size * np.sin(angle)], axis=1)
        return points if motion is None else points + t * motion.velocity
    left, right = motion.move(mi.ScalarTransform4f, t) if motion else (mi.ScalarTransform4f(), mi.ScalarTransform4f())
    matrix = np.array((left @ to_world(case) @ right).matrix, dtype=float)
    return (np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]]) @ matrix.T)[:, :3]


def outline(case: Case, motion: Motion) -> tuple:
    """Vertices and their velocities, or None for these, in the order in which the floor sees a positive solid angle."""
    h = 1 / 64                                         # a power of two, as transforms are float32
    ends = lambda h: (corners(case, motion, h) - corners(case, motion, -h)) / (2 * h)
    velocity = None if motion.key else motion.velocity[::-1] if case.mesh else ((4 * ends(h) - ends(2 * h)) / 3)[::-1]
    return corners(case)[::-1], velocity


def fan(points: np.ndarray, **nested):
    properties = mi.Properties()
    for name, plugin in nested.items():
        properties[name] = mi.load_dict(plugin)
    mesh = mi.Mesh("mesh", len(points), len(points) - 2, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(points.ravel().tolist())
    parameters["faces"] = mi.UInt32([i for k in range(1, len(points) - 1) for i in (0, k, k + 1)])
    parameters.update()
    return mesh


def sensor(case: Case, sampler: str, **sampling) -> dict:
    up = mi.ScalarTransform4f().look_at([0, case.camera, 0], [0, 0, 0], [0, 0, -1])
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "pixel_format": "rgb", "component_format": "float32",
            "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": 2 * math.degrees(math.atan(case.view / case.camera)), "near_clip": 1e-3, "to_world": up,
            "film": film, "sampler": {"type": sampler, **sampling}}


def build(case: Case):
    """The scene; sensor 0 samples its pixels at random, sensor 1 at SUB x SUB fixed points."""
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": REFLECTANCE}}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    floor = 1.2 * case.view * np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])
    parts = {"floor": fan(floor, bsdf=grey), "sensor_0": sensor(case, "independent"),
             "sensor_1": sensor(case, "stratified", sample_count=SUB ** 2, jitter=False)}
    if case.occluder is not None:
        parts["occluder"] = fan(case.occluder, bsdf=grey)
    parts["light"] = fan(corners(case), emitter=emitter) if case.mesh else {"type": "rectangle", "to_world": to_world(case),
                                                                             "emitter": emitter}
    return mi.load_dict({"type": "scene", **parts}, optimize=False)


class Attachment:
    """Sets the light of a scene to where a motion takes it."""

    def __init__(self, scene, case: Case, motion: Motion):
        self.case, self.motion, self.parameters = case, motion, mi.traverse(scene)
        self.key = motion.key or ("light.vertex_positions" if case.mesh else "light.to_world")
        self.start = type(self.parameters[self.key])(dr.detach(self.parameters[self.key]))

    def __call__(self, t):
        if self.motion.key:
            self.parameters[self.key] = self.start + t
        elif self.case.mesh:
            self.parameters[self.key] = self.start + mi.Float(self.motion.velocity.ravel().tolist()) * t
        else:
            left, right = self.motion.move(mi.Transform4f, t)
            self.parameters[self.key] = left @ self.start @ right
        self.parameters.update()


def forward(case: Case, motion: Motion, integrator, seed: int, spp: int, sensor: int = 0) -> np.ndarray:
    """Derivative of the picture (PIXELS, PIXELS) by forward mode."""
    scene = build(case)
    attach = Attachment(scene, case, motion)
    t = mi.Float(0)
    dr.enable_grad(t)
    attach(t)
    image = mi.render(scene, attach.parameters, integrator=integrator, sensor=sensor, spp=spp, seed=seed)
    dr.forward(t)
    return np.array(dr.grad(image))[..., 0].astype(float)


def differences(case: Case, motion: Motion, integrator, seed: int, spp: int, step: float, sensor: int = 0) -> np.ndarray:
    """Derivative of the picture by central differences over common random numbers."""
    scene = build(case)
    attach, ends = Attachment(scene, case, motion), []
    for t in (step, -step):
        attach(mi.Float(t))
        ends.append(np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=seed))[..., 0].astype(float))
    return (ends[0] - ends[1]) / (2 * step)


def points_of(case: Case, sub: int) -> np.ndarray:
    """Floor points ((PIXELS * sub)**2, 3) at the centres of sub x sub parts of each pixel, in the picture's order."""
    side = PIXELS * sub
    centre = case.view * ((2 * np.arange(side) + 1) / side - 1)
    v, u = np.meshgrid(centre, centre, indexing="ij")
    return np.stack([u.ravel(), np.zeros(side ** 2), v.ravel()], axis=1)


def picture(radiance: np.ndarray) -> np.ndarray:
    """Pixels from the radiance of a white floor at all points."""
    sub = math.isqrt(len(radiance)) // PIXELS
    return REFLECTANCE * radiance.reshape(PIXELS, sub, PIXELS, sub).mean(axis=(1, 3))


def lambert(vertices, velocity, points) -> np.ndarray:
    """Unshadowed radiance of a white floor, or its derivative by autodiff if there is a velocity; float64."""
    t = Float64(0)
    dr.enable_grad(t)
    velocity_or_zero = np.zeros_like(vertices) if velocity is None else velocity
    light = [Array3f64(*map(float, v)) + Array3f64(*map(float, u)) * t for v, u in zip(vertices, velocity_or_zero)]
    value = polygon_irradiance(light, oracle.columns(points), Array3f64(0, 1, 0))
    if velocity is not None:
        dr.forward(t)
    return np.array(dr.detach(value) if velocity is None else dr.grad(value)) / np.pi


def exact(case: Case, motion: Motion) -> np.ndarray:
    """Derivative of the picture, free of noise."""
    points = points_of(case, FINE)
    vertices, velocity = outline(case, motion)
    rate = lambda vertices, velocity: oracle.exact_rate(vertices, velocity, points, case.occluder)
    if case.occluder is None:
        radiance = lambert(vertices, velocity, points)
    else:
        radiance = oracle.grown(rate, vertices) if motion.key else rate(vertices, velocity)
    return picture(radiance) / motion.scale


def coefficient_gradient(case: Case, motion: Motion, order: int) -> np.ndarray:
    """Derivative of the light's coefficients at the points of `shprt`."""
    points = points_of(case, SUB)
    vertices, velocity = outline(case, motion)
    rate = lambda vertices, velocity: oracle.coefficient_rate(vertices, velocity, points, order)
    return (oracle.grown(rate, vertices) if motion.key else rate(vertices, velocity)) / motion.scale


def band_limited(transfer: np.ndarray, coefficients: np.ndarray, order: int) -> np.ndarray:
    """What `shprt` should give at an order."""
    count = (order + 1) ** 2
    return picture((transfer[:, :count] * coefficients[:, :count]).sum(axis=1))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def weights() -> np.ndarray:
    """Fixed and uneven, so that no symmetry of a scene cancels a derivative."""
    u, v = np.meshgrid(np.linspace(0, 1, PIXELS), np.linspace(0, 1, PIXELS))
    return np.random.default_rng(4).uniform(0.5, 1, (PIXELS, PIXELS)) * (0.1 + u ** 2 + 0.6 * (1 - v) ** 3) / PIXELS ** 2


WEIGHTS = weights()


def weighted(image: np.ndarray) -> float:
    return float((WEIGHTS * image).sum())


class Reference(NamedTuple):
    """Gradient pictures of independent seeds (S, PIXELS, PIXELS), and the systematic error of <w, .>."""

    pictures: np.ndarray
    systematic: float = 0.0

    @property
    def mean(self) -> np.ndarray:
        return self.pictures.mean(axis=0)

    def interval(self, confidence: float = 0.95) -> float:
        """Half of the confidence interval of <w, mean>."""
        values, count = [weighted(p) for p in self.pictures], len(self.pictures)
        return 0.0 if count == 1 else float(student.ppf((1 + confidence) / 2, count - 1) * np.std(values, ddof=1) / math.sqrt(count))

    @property
    def noise(self) -> float:
        """Standard error of the mean picture, root mean square over that of the picture."""
        count = len(self.pictures)
        return 0.0 if count == 1 else rms(self.pictures.std(axis=0, ddof=1)) / math.sqrt(count) / rms(self.mean)


def valid(case: Case, name: str) -> list:
    """Noisy references that are right for a motion."""
    if case.motions[name].key:
        return ["direct AD"]
    if case.occluder is not None:
        return ["direct FD", "direct_projective"]
    return ["direct FD"] if case.mesh or name == "rotation" else ["direct AD", "direct FD"]


def references(case: Case, name: str, seeds: int) -> dict:
    """All references that are right for a motion, by name."""
    motion, kinds = case.motions[name], valid(case, name)
    direct = mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0})
    found = {"exact": Reference(exact(case, motion)[None])}
    if "direct AD" in kinds:
        found["direct AD"] = Reference(np.array([forward(case, motion, direct, s, DIRECT_SPP) for s in range(seeds)]))
    if "direct FD" in kinds:
        fine, coarse = (np.array([differences(case, motion, direct, s, DIRECT_SPP, step) for s in range(seeds)])
                        for step in (STEP, 2 * STEP))
        found["direct FD"] = Reference(fine, abs(weighted((coarse - fine).mean(axis=0))) / 3)
    if "direct_projective" in kinds:
        projective = mi.load_dict({"type": "direct_projective", "guiding": "none"})
        found["direct_projective"] = Reference(np.array([forward(case, motion, projective, s, PROJECTIVE_SPP) for s in range(seeds)]))
    return found


TABLE_CONFIDENCE = 1 - 0.05 / sum(len(valid(case, name)) for case in CASES.values() for name in case.motions)
"""Of each interval, if all of them together are to hold with 95 %."""


class Setting(NamedTuple):
    """How `shprt` is run: with projected transfer, whose band limit is what is predicted."""

    order: int
    transfer: str
    """``unshadowed``, or the transfer_domain."""
    margin: float = 0.0

    def integrator(self):
        if self.transfer == "unshadowed":
            return mi.load_dict({"type": "shprt", "order": self.order, "transfer": "unshadowed"})
        return mi.load_dict({"type": "shprt", "order": self.order, "localised": False, "transfer_domain": self.transfer,
                             "light_margin": self.margin, "transfer_samples": RAYS[self.transfer], "max_edge": MAX_EDGE})


ORDERS = (4, 8, 14)
MARGINS = (0.0, 0.1, 0.5)
"""Of the bakes at vertices; transfer per pixel has none."""


def settings(case: Case) -> list:
    if case.occluder is None:
        return [Setting(order, "unshadowed") for order in ORDERS]
    return [Setting(order, "pixel") for order in ORDERS] + [Setting(8, "vertex", margin) for margin in MARGINS]


VERDICTS = "yes", "yes*", "NO"


class Row(NamedTuple):
    """One comparison: ratios and intervals of <w, gradient> to the reference's, root mean squares of pictures to the exact one's."""

    case: str
    motion: str
    transfer: str
    margin: float
    order: int
    reference: str
    ratio: float
    band_limit: float
    """Ratio that the band limit predicts: band-limited over exact."""
    interval: float
    systematic: float
    deviation: float
    """(`shprt` - reference) - (band-limited - exact), over the reference."""
    allowed: float
    rms_difference: float
    rms_band_limit: float
    rms_beyond: float
    """Of `shprt` - band-limited."""
    noise: float
    agrees: str
    """One of VERDICTS."""


def judge(case: Case, name: str, setting: Setting, gradient, predicted, found: dict) -> list:
    """A row for each reference."""
    truth, rows = found["exact"].mean, []
    numerical = NUMERICAL[setting.transfer] * float((WEIGHTS * abs(truth)).sum())
    for kind, reference in found.items():
        value = weighted(reference.mean)
        deviation = weighted(gradient - reference.mean - (predicted - truth))
        allowed = reference.interval() + reference.systematic + numerical
        widest = reference.interval(TABLE_CONFIDENCE) + reference.systematic + numerical
        verdict = VERDICTS[(abs(deviation) > allowed) + (abs(deviation) > widest)]
        rows.append(Row(case.name, name, setting.transfer, setting.margin, setting.order, kind, weighted(gradient) / value,
                        weighted(predicted) / weighted(truth), reference.interval() / abs(value), reference.systematic / abs(value),
                        deviation / value, allowed / abs(value), rms(gradient - reference.mean) / rms(truth),
                        rms(predicted - truth) / rms(truth), rms(gradient - predicted) / rms(truth), reference.noise, verdict))
    return rows


def compare(case: Case, seeds: int, motions=None, chosen=None) -> tuple:
    """Rows of a case, and its pictures: {motion: {reference or setting: picture}}."""
    rows, pictures, transfer = [], {}, {}
    motions, chosen = motions or list(case.motions), chosen or settings(case)
    highest = max(setting.order for setting in chosen)
    for margin in {setting.margin for setting in chosen}:
        transfer[margin] = oracle.transfer(points_of(case, SUB), highest, corners(case)[::-1], case.occluder, margin)
    plugins = {setting: setting.integrator() for setting in chosen}
    for name in motions:
        motion = case.motions[name]
        found, coefficients = references(case, name, seeds), coefficient_gradient(case, motion, highest)
        pictures[name] = {kind: reference.mean for kind, reference in found.items()}
        for setting, plugin in plugins.items():
            gradient = forward(case, motion, plugin, 0, SUB ** 2, sensor=1)
            rows += judge(case, name, setting, gradient, band_limited(transfer[setting.margin], coefficients, setting.order), found)
            pictures[name][setting] = gradient
        print(f"{case.name}, {name}", file=sys.stderr, flush=True)
    return rows, pictures


def table(rows: list) -> str:
    """Markdown: one line for each motion and setting, the references side by side."""
    kinds = ("exact", "direct AD", "direct FD", "direct_projective")
    lines = ["| scene | motion | transfer | margin | order | band limit | " + " | ".join(f"/ {k}" for k in kinds)
             + " | rms | rms beyond band limit | agrees |", "|" + "---|" * (9 + len(kinds))]
    groups = {}
    for row in rows:
        groups.setdefault((row.case, row.motion, row.transfer, row.margin, row.order), {})[row.reference] = row
    for (case, motion, transfer, margin, order), found in groups.items():
        first, verdict = found["exact"], max((row.agrees for row in found.values()), key=VERDICTS.index)
        ratios = [f"{found[k].ratio:.4f}" + (f" +- {found[k].interval + found[k].systematic:.4f}" if k != "exact" else "") if k in found
                  else "" for k in kinds]
        lines.append(f"| {case} | {motion} | {transfer} | {margin:g} | {order} | {first.band_limit:.4f} | " + " | ".join(ratios)
                     + f" | {first.rms_difference:.2%} | {first.rms_beyond:.3%} | {verdict} |")
    return "\n".join(lines)


def rebaked(case: Case, names: list) -> list:
    """`shprt` per pixel, whose visibility follows the light: its derivative, which holds visibility fixed, and differences of its pictures,
    both as ratio to the exact <w, .>."""
    rows = []
    for order in ORDERS:
        plugin = Setting(order, "pixel").integrator()
        for name in names:
            motion = case.motions[name]
            truth = exact(case, motion)
            found = {"derivative": forward(case, motion, plugin, 0, SUB ** 2, sensor=1),
                     "difference": differences(case, motion, plugin, mi.sample_tea_32(0, 1)[0], SUB ** 2, 4 * STEP, sensor=1)}
            rows.append({"order": order, "motion": name} | {f"{what}_{key}": value for what, image in found.items() for key, value in
                                                            (("ratio", weighted(image) / weighted(truth)),
                                                             ("rms", rms(image - truth) / rms(truth)))})
    return rows


def targets(rows: list) -> list:
    """Verdicts on all comparisons, and on `shprt` where nothing is in the way."""
    open_floor = [row.rms_difference for row in rows if (row.transfer, row.order, row.reference) == ("unshadowed", 8, "exact")]
    return [experiment.verdict("comparisons with Mitsuba's and exact derivatives that do not hold, the band limit predicted apart",
                               sum(row.agrees == VERDICTS[-1] for row in rows), 0),
            experiment.verdict("order 8, no occluder: derivative pictures off the exact ones by at most 2.5 %",
                               max(open_floor, default=None), 0.025, text="{:.2%}")]


def plot(pictures: dict, path: pathlib.Path) -> None:
    """Gradient pictures behind the occluder: references, `shprt` at each order, and the differences to the exact one."""
    orders = [n for n in ORDERS if Setting(n, "pixel") in next(iter(pictures.values()))]
    titles = ["exact", "direct_projective", *(f"shprt, order {n}" for n in orders), *(f"difference, order {n}" for n in orders)]
    figure, axes = plt.subplots(len(pictures), len(titles), figsize=(16.5, 2 * len(pictures)), layout="constrained", squeeze=False)
    for line, (name, found) in zip(axes, pictures.items()):
        scale = abs(found["exact"]).max()
        computed = [found[Setting(n, "pixel")] for n in orders]
        shown = [found["exact"], found["direct_projective"], *computed, *(image - found["exact"] for image in computed)]
        for axis, image in zip(line, shown):
            mappable = axis.imshow(image, cmap="RdBu_r", vmin=-scale, vmax=scale)
            axis.set(xticks=[], yticks=[])
        figure.colorbar(mappable, ax=line[-1])
        line[0].set_ylabel(name)
    for axis, title in zip(axes[0], titles):
        axis.set_title(title, fontsize=10)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main(arguments=None) -> None:
    options = experiment.options(
        __doc__, arguments,
        seeds={"type": int, "default": 8, "help": "independent runs of each of Mitsuba's references (default: %(default)s)"},
        case={"action": "append", "choices": list(CASES), "help": "only this scene; may be given more than once"})
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)              # a warning about shapes that enter the view; none does
    rows, names = [], options.case or list(CASES)
    chosen = seeds = motions = None
    if options.quick:
        names, seeds, motions, chosen = [SHOWN], 2, list(CASES[SHOWN].motions)[:1], [Setting(min(ORDERS), "pixel")]
    for name in names:
        found, pictures = compare(CASES[name], seeds or options.seeds, motions, chosen)
        rows += found
        print(f"{table(found)}\n", flush=True)
        if name == SHOWN:
            moving = {motion: found for motion, found in pictures.items() if not CASES[name].motions[motion].key}
            plot(moving, options.out / "gradient_references.png")
    again = rebaked(CASES[SHOWN], list(AXES)) if SHOWN in names and not options.quick else []
    verdicts = {v: sum(r.agrees == v for r in rows) for v in VERDICTS}
    lines = targets(rows)
    report = {"targets": lines, "seeds": seeds or options.seeds, "verdicts": verdicts, "rows": [r._asdict() for r in rows],
              "visibility_follows_light": again}
    experiment.write(options.out / "gradient_references.json", report, options.quick)
    for row in again:
        print(*(f"{key} {value:.4f}" if isinstance(value, float) else value for key, value in row.items()), sep="  ")
    print(verdicts)
    experiment.print_targets(lines)


if __name__ == "__main__":
    main()
