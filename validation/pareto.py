"""Claim: at equal error `shprt` draws soft shadows sooner than Mitsuba's path tracer, up to a number of samples that is stated.

    python -m validation.pareto [--quick] [--out DIR] [--threads N]
    python -m validation.pareto --page      # puts the tables of the recorded results into docs/how_to_choose.md, measures nothing

writes ``pareto.json``, ``pareto.png`` (error against time in five scenes) and ``pareto_axes.png`` (one panel for each setting), and prints
tables. Run it on an idle machine. Exit status 1 if a measurement failed; a missed target is a result.

**Scenes**: Cornell box, plant and sculpture of scenes/ in direct light, the Cornell box with all bounces, and the 723 lights of
``many_lights``; square pictures. Rivals: ``path`` (direct light only, or all bounces), ``direct``, and ``direct`` with 8 samples of the
light and none of the BSDF, which is Mitsuba's best way to draw diffuse surfaces in direct light.

**Error**: as ``mi-shlight compare``, the mean absolute difference over the mean of the reference, over all pixels that see a surface and
no emitter; and the same of means of 8 x 8 pixels, in which most of the path tracer's noise cancels and the error of spherical harmonics,
which is smooth, does not. The reference has the expectation of ``path`` and less noise: ``direct`` with 8 samples of the light, or ``path``
with all bounces, in two halves, whose difference tells the noise that is left; it is subtracted in quadrature.

**Samples**: both integrators have the scene's film and filter and the same samples of the pixel, whose noise is part of both errors. They
are ``independent``, as in the scenes' files, or ``multijitter``, which is better for both. The *floor* of a setting is its error with the
noise of the pixel's samples subtracted as well, found from two pictures: no number of samples brings it lower.

**Time**: repeated render, median, all integrators in turns. The bake and the first render, which compiles unless Dr.Jit has the kernel on
disk, apart; and the first picture of a fresh process with an empty kernel cache.

**Equal error**: a power law is fitted to the rival's error over its samples; where it has the error of `shprt` are the samples that it
needs, and their time lies between those measured, or beyond them in proportion. The path tracer
*catches up* where it has the error of the floor.

**Axes**: order 0 to 20, unshadowed, projected, localised and exact; rays of the bake; its cells; the margin for moving lights; vertices
or pixels; all of these on the Cornell box (the floor for unshadowed). Method and precision: one light shaded at many points by
``shade_polygon`` in float32 and float64 (Mitsuba has no such variant), one thread, error of the shaded value over the norms of light and
transfer against cubature in float64. Grid: resolution and interpolation with 723 lights, against the same picture without a grid.
"""
from __future__ import annotations

import functools
import json
import pathlib
import statistics
import sys
import tempfile
import time
import warnings
from typing import NamedTuple
from xml.etree import ElementTree

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.llvm.ad import Array3f, Array3f64, Float64

import mi_shlight
import mi_shlight.plugins  # noqa: F401
from mi_shlight.compare import image_errors, shaded_pixels
from mi_shlight.errors import UnsupportedSceneWarning
from mi_shlight.light.project import METHODS
from tests import reference
from validation.engine import (ERROR_POINTS, FIRST_CALL, GRID, Points, in_fresh_process, kernel_nanoseconds, parallelogram, points_around,
                               transfer_vector)
from validation.engine_report import print_verdicts
from validation.experiment import RESULTS, ROOT, options, write
from validation.pareto_figures import plot, plot_axes
from validation.pareto_report import (BOUNCED, DIRECT, EXACT, FLOOR, GRID_SCENE, INDEPENDENT, INTERREFLECTED, LOCALISED, PATH, PRECISIONS,
                                      PROJECTED, STANDARD_ORDER, STANDARD_SPP, STRATIFIED, TUNED, UNSHADOWED, ParetoRecord, compare_rivals,
                                      tables, targets, update_page)
from validation.soft_shadows import PICTURES, block_means, grey, length_of

BEST_DIRECT = {"type": "direct", "emitter_samples": 8, "bsdf_samples": 0}
RIVALS = {PATH: {"type": "path", "max_depth": 2}, "direct": {"type": "direct"}, TUNED: BEST_DIRECT}
KINDS = {UNSHADOWED: {"transfer": "unshadowed"}, PROJECTED: {"transfer": "shadowed", "localised": False},
         LOCALISED: {"transfer": "shadowed"}, EXACT: {"transfer": "exact"}, INTERREFLECTED: {"transfer": "interreflected"}}
PAGE = ROOT / "docs" / "how_to_choose.md"


class Plan(NamedTuple):
    """Sizes to measure."""

    size: int = 96
    """Pixels along a side; a multiple of 8."""
    grid_size: int = 64
    scenes: tuple = DIRECT
    reference_spp: tuple = (("cornell_box", 2048), ("plant", 4096), ("sculpture", 4096), (FLOOR, 2048), (BOUNCED, 8192), (GRID_SCENE, 1024))
    pass_spp: int = 256
    orders: tuple = ((UNSHADOWED, (8,)), (PROJECTED, (4, 8, 14)), (LOCALISED, (2, 4, 8, 14)), (EXACT, (8,)))
    all_orders: tuple = ((UNSHADOWED, (0, 1, 2, 3, 4, 6, 8, 11, 14, 17, 20)), (PROJECTED, (0, 1, 2, 4, 6, 8, 11, 14, 20)),
                         (LOCALISED, (0, 1, 2, 4, 6, 8, 11, 14)), (EXACT, (2, 8, 14)))
    """On the Cornell box, and unshadowed on the open floor."""
    bounce_orders: tuple = (2, 4, 8)
    spp: tuple = (4, STANDARD_SPP, 64)
    default_spp: tuple = (1, 4, STANDARD_SPP, 64, 256)
    rival_spp: tuple = ((INDEPENDENT, tuple(2 ** k for k in range(11))), (STRATIFIED, tuple(4 ** k for k in range(6))))
    floor_spp: int = 64
    rays: tuple = (16, 64, 256, 1024, 4096)
    edges: tuple = (0.4, 0.2, 0.1, 0.054, 0.027)
    """Scene units; the last but one is the default."""
    margins: tuple = (0, 2, 5, 15)
    """Degrees."""
    margin_orders: tuple = (4, STANDARD_ORDER)
    pixel_rays: tuple = (16, 64, 256)
    curves: tuple = ((LOCALISED, STANDARD_ORDER), (PROJECTED, STANDARD_ORDER))
    """Of the axes of the bake."""
    bake: tuple = ()
    """Parameters of all bakes, where they are not what is varied."""
    grid_file: str = GRID_SCENE
    grid_floor_spp: int = 16
    resolutions: tuple = (4, 8, 16)
    interpolations: tuple = ("hermite", "tricubic", "trilinear")
    grid_rays: int = 256
    grid_order: int = 8
    precision_orders: tuple = (2, 8, 14)
    distances: tuple = (2, 100)
    points: int = 1 << 14
    rounds: int = 3
    """0 takes the time of the first picture, with its compilation."""
    long: float = 0.5
    """Seconds from which a picture is not rendered more than twice."""
    first_pictures: bool = True


QUICK = Plan(size=16, grid_size=16, scenes=("cornell_box",), reference_spp=tuple((name, 64) for name, _ in Plan().reference_spp),
             pass_spp=32, orders=(), all_orders=tuple((family, (2,)) for family in (UNSHADOWED, PROJECTED, LOCALISED, EXACT)),
             bounce_orders=(2,), spp=(4,), default_spp=(16,), rival_spp=((INDEPENDENT, (4, 16)), (STRATIFIED, (4, 16))), floor_spp=4,
             rays=(64,), edges=(0.8,), margins=(5,), margin_orders=(2,), pixel_rays=(16,), curves=((LOCALISED, 2),),
             bake=(("transfer_samples", 16), ("max_edge", 0.4)), grid_file="cornell_box", grid_floor_spp=4, resolutions=(2,),
             interpolations=("hermite",), grid_rays=4, grid_order=2, precision_orders=(2,), distances=(2,), points=1 << 10, rounds=0,
             first_pictures=False)


class Contender(NamedTuple):
    """A way to draw a scene: a point on a curve `family` with a value `setting`, or as many as there are numbers of samples."""

    family: str
    setting: object
    plugin: dict
    spp: tuple
    sampler: str = STRATIFIED


# A scene, its reference, and errors.

def sensor_of(file: pathlib.Path, size: int, sampler: str):
    """The sensor of a scene's file, with another sampler."""
    root = ElementTree.parse(file).getroot()
    for child in list(root):
        if child.tag not in ("default", "sensor"):
            root.remove(child)
    root.find("sensor/sampler").set("type", sampler)
    return mi.load_string(ElementTree.tostring(root, encoding="unicode"), resx=size, resy=size, optimize=False).sensors()[0]


def beyond(error: float, *noises: float) -> float:
    """What is left of an error without independent noises."""
    return max(error ** 2 - sum(noise ** 2 for noise in noises), 0.0) ** 0.5


class Subject:
    """A scene of scenes/ with its reference of so many samples per pixel; `bounced`: with light between its surfaces."""

    def __init__(self, file: str, size: int, reference_spp: int, pass_spp: int, bounced: bool = False):
        file = ROOT / "scenes" / f"{file}.xml"
        self.scene = mi.load_file(str(file), resx=size, resy=size, optimize=False)
        self.sensors = {sampler: sensor_of(file, size, sampler) for sampler in (INDEPENDENT, STRATIFIED)}
        self.mask = shaded_pixels(self.scene)
        self.whole = (block_means(self.mask.astype(float)) == 1)
        plugin, passes = mi.load_dict({"type": "path"} if bounced else BEST_DIRECT), max(reference_spp // (2 * pass_spp), 1)
        halves = [np.mean([self.render(plugin, STRATIFIED, pass_spp, 1 + half * passes + k) for k in range(passes)], axis=0)
                  for half in range(2)]
        self.truth = np.mean(halves, axis=0)
        self.noise = self.difference(halves[0], self.truth)

    def render(self, plugin, sampler: str, spp: int, seed: int = 0) -> np.ndarray:
        return np.array(mi.render(self.scene, sensor=self.sensors[sampler], integrator=plugin, spp=spp, seed=seed), dtype=float)

    def difference(self, image: np.ndarray, truth: np.ndarray) -> dict:
        """Mean absolute difference relative to the mean, of pixels and of the luminance of whole blocks."""
        small, small_truth = (block_means(grey(picture))[..., None] for picture in (image, truth))
        return {"error": image_errors(image, truth, self.mask)["mean_relative"],
                "blocks": image_errors(small, small_truth, self.whole)["mean_relative"]}

    def errors(self, image: np.ndarray, noise=None) -> dict:
        """Errors against the reference, without its noise and the image's own as far as it is known."""
        found = self.difference(image, self.truth)
        return {name: beyond(value, self.noise[name], *([noise[name]] if noise else [])) for name, value in found.items()}

    def floor(self, plugin, spp: int) -> dict:
        """Errors that no number of samples brings lower; seeds that the reference does not have."""
        images = [self.render(plugin, STRATIFIED, spp, seed) for seed in (1 << 20, 1 << 21)]
        mean = np.mean(images, axis=0)
        return {f"floor {name}": value for name, value in self.errors(mean, self.difference(images[0], mean)).items()}


# Measurements.

def seconds(function) -> tuple:
    """Wall time, and what `function` returns."""
    start = time.perf_counter()
    result = function()
    dr.sync_thread()
    return time.perf_counter() - start, result


def measure(record: ParetoRecord, scene: str, subject: Subject, contenders: list, plan: Plan, baked: float = 0.0) -> dict:
    """Fill the tables ``settings`` and ``pictures``; `baked`: seconds of a bake that they share. Returns plugins by (family, setting)."""
    timed, plugins = [], {}
    for contender in contenders:
        where = {"scene": scene, "family": contender.family, "setting": contender.setting, "sampler": contender.sampler}
        print(*where.values(), file=sys.stderr, flush=True)
        found = record.attempt(str(where), begin, subject, contender, plan)
        if found:
            plugin, setting, pictures = found
            if setting:
                record.rows["settings"].append({**where, **setting, "bake": setting["bake"] + baked})
            rows = [{**where, **row} for row in pictures]
            record.rows["pictures"] += rows
            timed += [(row, functools.partial(subject.render, plugin, contender.sampler, row["spp"])) for row in rows]
            plugins[contender.family, contender.setting] = plugin
    times = [[] for _ in timed]
    for _ in range(plan.rounds):                      # in turns: a change of the machine's load meets all
        for spent, (_, run) in zip(times, timed):
            if not spent or spent[0] < plan.long:
                spent.append(seconds(run)[0])
    for spent, (row, _) in zip(times, timed):
        row["seconds"] = statistics.median(spent or [row["seconds"]])
    return plugins


def begin(subject: Subject, contender: Contender, plan: Plan) -> tuple:
    """(plugin, what is known of the setting, a row for each number of samples) of a contender, which compiles here."""
    plugin, setting = mi.load_dict(contender.plugin), {}
    if contender.plugin["type"] == "shprt":
        setting["bake"], _ = seconds(lambda: plugin.prepare_scene(subject.scene, False))
    rows, first_render = [], None
    for spp in contender.spp:
        spent, image = seconds(functools.partial(subject.render, plugin, contender.sampler, spp))
        first_render = first_render or spent
        rows.append({"spp": spp, **subject.errors(image), "seconds": spent})
    if setting:
        setting |= {"first render": first_render, **subject.floor(plugin, plan.floor_spp)}
    return plugin, setting, rows


def rivals(plan: Plan, plugins: dict) -> list:
    """Mitsuba's integrators. With 8 samples of the light each counts for as many: fewer are enough."""
    return [Contender(name, None, plugin, spp[:-2] if plugin is BEST_DIRECT and len(spp) > 2 else spp, sampler)
            for sampler, spp in plan.rival_spp for name, plugin in plugins.items()]


def shprt(plan: Plan, family: str, setting, spp: tuple, sampler: str = STRATIFIED, **parameters) -> Contender:
    return Contender(family, setting, {"type": "shprt", **KINDS[family], **dict(plan.bake), **parameters}, spp, sampler)


def by_order(plan: Plan, families: dict) -> list:
    """Settings that differ in order, and the default with either sampler."""
    default = LOCALISED, STANDARD_ORDER
    found = [shprt(plan, family, order, plan.spp, order=order)
             for family, orders in families.items() for order in orders if (family, order) != default]
    return [shprt(plan, *default, plan.default_spp, sampler) for sampler in (STRATIFIED, INDEPENDENT)] + found


def measure_direct(record: ParetoRecord, plan: Plan) -> None:
    """Scenes in direct light; on the Cornell box all orders, and the other settings of the bake."""
    for name in plan.scenes:
        subject = prepare(record, name, name, plan.size, plan)
        families = dict(plan.orders)
        if name == DIRECT[0]:
            families |= {family: orders for family, orders in plan.all_orders if family != UNSHADOWED}
        measure(record, name, subject, [*rivals(plan, RIVALS), *by_order(plan, families)], plan)
        if name == DIRECT[0]:
            for axis, contenders in bake_axes(plan).items():
                measure(record, axis, subject, contenders, plan)


def bake_axes(plan: Plan) -> dict:
    """Contenders by axis, each varying one setting of the bake."""
    spp, distance = (STANDARD_SPP,), PICTURES["cornell_box"].distance
    named = lambda contender, family, setting: contender._replace(family=family, setting=setting)
    vary = lambda name, values: [named(shprt(plan, kind, value, spp, order=order, **{name: value}), f"{kind} {order}", value)
                                 for kind, order in plan.curves for value in values]
    margins = [named(shprt(plan, LOCALISED, order, spp, order=order, light_margin=length_of(margin, distance) if margin else 0.0),
                     f"order {order}", margin) for order in plan.margin_orders for margin in plan.margins]
    domain = lambda name, rays, **parameters: named(
        shprt(plan, LOCALISED, name, spp, order=plan.margin_orders[-1], transfer_domain=name, **parameters), name, rays)
    return {"transfer_samples": vary("transfer_samples", plan.rays), "max_edge": vary("max_edge", plan.edges), "light_margin": margins,
            "transfer_domain": [*(domain("pixel", rays, transfer_samples=rays) for rays in plan.pixel_rays), domain("vertex", 1024)]}


def prepare(record: ParetoRecord, name: str, file: str, size: int, plan: Plan, **keywords) -> Subject:
    """The scene of a file with its reference, the noise of which goes on record."""
    print(f"reference: {name}", file=sys.stderr, flush=True)
    spp = dict(plan.reference_spp)[name]
    spent, subject = seconds(lambda: Subject(file, size, spp, plan.pass_spp, **keywords))
    record.rows["references"].append({"scene": name, "size": size, "spp": spp, "seconds": spent, **subject.noise})
    return subject


def measure_unshadowed(record: ParetoRecord, plan: Plan) -> None:
    """All orders where nothing casts a shadow."""
    subject = prepare(record, FLOOR, "floor", plan.size, plan)
    contenders = [shprt(plan, UNSHADOWED, order, (STANDARD_SPP,), order=order) for order in dict(plan.all_orders)[UNSHADOWED]]
    measure(record, FLOOR, subject, contenders, plan)


def measure_bounces(record: ParetoRecord, plan: Plan) -> None:
    """The Cornell box with all bounces."""
    subject = prepare(record, BOUNCED, "cornell_box", plan.size, plan, bounced=True)
    ours = [shprt(plan, INTERREFLECTED, order, plan.spp, order=order) for order in plan.bounce_orders]
    measure(record, BOUNCED, subject, [*rivals(plan, {PATH: {"type": "path"}}), *ours], plan)


def measure_grid(record: ParetoRecord, plan: Plan) -> None:
    """Hundreds of lights, one bake for all: error against the reference, and against the picture without a grid."""
    subject = prepare(record, GRID_SCENE, plan.grid_file, plan.grid_size, plan)
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "transfer.npz"
        spent, transfer = seconds(lambda: mi_shlight.bake_transfer(subject.scene, plan.grid_order, samples=plan.grid_rays))
        transfer.save(file)
        plain = {"type": "shprt", "order": plan.grid_order, "transfer_file": str(file)}
        ours = [Contender("no grid", 0, plain, plan.spp[:1])]
        ours += [Contender(interpolation, resolution, {**plain, "grid_resolution": resolution, "grid_interpolation": interpolation,
                                                       "grid_error": 0.0}, plan.spp)
                 for interpolation in plan.interpolations for resolution in plan.resolutions]
        ours += [Contender("hermite, near lights exact", resolution, {**plain, "grid_resolution": resolution}, plan.spp)
                 for resolution in plan.resolutions]
        measure(record, GRID_SCENE, subject, rivals(plan, {name: RIVALS[name] for name in (PATH, "direct")}), plan)
        plugins = measure(record, GRID_SCENE, subject, ours, plan._replace(floor_spp=plan.grid_floor_spp), spent)
        images = {key: subject.render(plugin, STRATIFIED, plan.spp[0]) for key, plugin in plugins.items()}
    without = images.pop(("no grid", 0))
    for (family, setting), image in images.items():
        row = record.only("settings", scene=GRID_SCENE, family=family, setting=setting)
        row["of the grid"] = subject.difference(image, without)["error"]


def measure_precision(record: ParetoRecord, plan: Plan) -> None:
    """Shading by one light: nanoseconds per point, and error, by method, order, distance and precision."""
    corners, rounds = parallelogram(), plan.rounds + 2
    for distance in plan.distances:
        base = points_around(corners, distance, GRID)
        oracle = np.array([reference.coefficients_quadrature(corners, x, max(plan.precision_orders)) for x in base[:ERROR_POINTS]])
        points = Points(base, plan.points)
        double = Array3f64(points.x), Float64(points.parameter)
        dr.eval(double)
        for order in plan.precision_orders:
            given = np.array(transfer_vector(Float64(points.parameter), order))[:, :ERROR_POINTS].T
            light = oracle[:, :(order + 1) ** 2]
            scale = np.linalg.norm(given, axis=1) * np.linalg.norm(light, axis=1)
            runs = {}
            for precision, kind, x, parameter in zip(PRECISIONS, (Array3f, Array3f64), *zip((points.x, points.parameter), double)):
                vertices = [kind(*map(float, corner)) for corner in corners]
                dr.make_opaque(vertices)
                for method in METHODS:
                    runs[precision, method] = functools.partial(shade, vertices, x, parameter, order, method)
            times = {key: [] for key in runs}
            for _ in range(rounds):
                for key, run in runs.items():
                    times[key].append(kernel_nanoseconds(run) / plan.points)
            for (precision, method), run in runs.items():
                off = np.array(run(), dtype=float)[:ERROR_POINTS] - (given * light).sum(axis=1)
                record.rows["precision"].append({"distance": distance, "order": order, "method": method, "precision": precision,
                                                 "ns": statistics.median(times[precision, method]), "error": np.max(abs(off) / scale)})


def shade(vertices: list, x, parameter, order: int, method: str):
    return mi_shlight.shade_polygon(vertices, x, transfer_vector(parameter, order), order, method)


def first_picture(task: dict) -> dict:
    """Seconds to the first picture in this process; see :py:func:`validation.engine.in_fresh_process`."""
    file = str(ROOT / "scenes" / "cornell_box.xml")
    load, scene = seconds(lambda: mi.load_file(file, resx=task["size"], resy=task["size"], optimize=False))
    plugin, bake = mi.load_dict(task["plugin"]), 0.0
    if task["plugin"]["type"] == "shprt":
        bake, _ = seconds(lambda: plugin.prepare_scene(scene, False))
    render, _ = seconds(lambda: np.array(mi.render(scene, integrator=plugin, spp=STANDARD_SPP)))
    return {"load": load, "bake": bake, "render": render}


def measure_first_pictures(record: ParetoRecord, plan: Plan) -> None:
    for name, plugin in {"default": {"type": "shprt"}, UNSHADOWED: {"type": "shprt", **KINDS[UNSHADOWED]},
                         INTERREFLECTED: {"type": "shprt", "transfer": "interreflected"}, **RIVALS}.items():
        print(f"first picture: {name}", file=sys.stderr, flush=True)
        task = functools.partial(in_fresh_process, dr.thread_count(), "validation.pareto", plugin=plugin, size=plan.size)
        found = record.attempt(f"first picture, {name}", lambda: seconds(task))
        if found:
            record.rows["first_pictures"].append({"integrator": name, "process": found[0], **found[1]})


def main(arguments=None) -> int:
    parsed = options(__doc__, arguments, threads={"type": int, "default": 0, "help": "threads of Dr.Jit (default: its own choice)"},
                     page={"action": "store_true", "help": f"only put the tables of the recorded results into {PAGE.relative_to(ROOT)}"},
                     first_call=FIRST_CALL)
    if parsed.page:
        PAGE.write_text(update_page(PAGE.read_text(), json.loads((RESULTS / "pareto.json").read_text())))
        return 0
    mi.set_variant("llvm_ad_rgb")
    if parsed.threads:
        dr.set_thread_count(parsed.threads)
    if parsed.first_call:
        print(json.dumps(first_picture(parsed.first_call)))
        return 0
    warnings.simplefilter("ignore", UnsupportedSceneWarning)
    plan, record = QUICK if parsed.quick else Plan(), ParetoRecord()
    for part in (measure_direct, measure_unshadowed, measure_bounces, measure_grid):
        record.attempt(part.__name__, part, record, plan)
    threads = dr.thread_count()
    dr.set_thread_count(1)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        record.attempt(measure_precision.__name__, measure_precision, record, plan)
    dr.set_thread_count(threads)
    if plan.first_pictures:
        measure_first_pictures(record, plan)
    compare_rivals(record)
    lines = targets(record)
    for name, table in tables(record).items():
        print(f"\n{name}\n\n{table}")
    print_verdicts(record, lines)
    plot(record, parsed.out / "pareto.png")
    plot_axes(record, parsed.out / "pareto_axes.png")
    write(parsed.out / "pareto.json", {"targets": lines, "failures": record.failures, **record.packed()}, parsed.quick)
    return int(bool(record.failures))


if __name__ == "__main__":
    sys.exit(main())
