"""Claim: a coarse grid of coefficients and gradients lights scenes with hundreds of lights as [W20] says, and better close to the lights.

    python -m validation.grid [--quick] [--out DIR] [--only PART ...]

prints tables and the list of targets, and writes ``grid.json``, ``grid.png`` and pictures. ``--only`` measures some parts anew and keeps
the others of an existing ``grid.json``. Run it on an idle machine. Exit status 1 if a measurement failed; a missed target is a result.

**Time**: float32, one thread, medians; CPU time of the process, Python and tracing included: the time on the clock of an idle machine.

**interpolation** ([W20] Fig. 4): the coefficient (7, 2) of order 8 of a rectangle between samples, in float64, with the weights that
``LightGrid`` uses. Errors are root mean squares over 2000 points of a line along x, or over random points of a cube, as a part of the
coefficient's range. The order of convergence is the slope from 20 samples on.

**table** ([W20] Table 1): procedural scenes with its numbers of triangles and lights (:py:mod:`validation.grid_scenes`); the shading points
are all vertices, the transfer is the unshadowed cosine, light comes in three colours. *exact* is what ``shprt`` does without a grid, one
dot product for each light, by ``edge`` (the JSON has ``auto`` too); *W18* all coefficients by the recurrence of Wang and Ramamoorthi 2018,
which is what the published speed-ups refer to. They are measured at 2^15 and 2^11 random vertices and multiplied by the number of vertices
over that. *coefficients* are all those at the grid's points without gradients.

**Mean absolute error**: over 2^15 random vertices (in pictures: pixels that show a surface) and three channels of the difference of
``srgb(e v)`` from the exact one, v the radiance, reflectance included, clipped to 0 .. 1, e such that the exact mean is 0.4.

**lights**, **resolutions** ([W20] Figs. 8 and 9): a rectangle in 1 to 512 pieces; grids of 4^3 to 32^3 points, with pictures.

**shared_edges**: a quadrilateral in 512 triangles of random radiance, by :py:class:`mi_shlight.light.mesh.MeshLight` and one triangle after
the other, in turns.

**moving**: a frame in which 723 lights turn and change colour, in NumPy: new grid, all points shaded. **first_call**: wall time of trace,
compilation and run in a fresh process with an empty kernel cache, 1024 points, median of three.

**moving_scene**: the same with ``scenes/many_lights.xml`` in Mitsuba, every light by `mi.traverse`, one sample per pixel, unshadowed.

**double_sided** ([W20] Fig. 12): ``scenes/double_sided.xml`` by ``shprt`` without a grid, with one, and with near lights exact.
"""
from __future__ import annotations

import argparse
import json
import pathlib
import sys

import drjit as dr
import mitsuba as mi
import numpy as np

from validation import experiment, grid_cost, grid_interpolation, grid_pictures, grid_report
from validation.engine import FIRST_CALL, first_seconds, in_fresh_process
from validation.engine_report import print_verdicts
from validation.experiment import significant
from validation.grid_cost import QUICK, SPLIT, VARIANTS, Plan
from validation.grid_report import GridRecord

FIRST_CALL_POINTS = 1024


def first_call(task: dict) -> dict:
    """Seconds of the first grid and of the first shading with it in this process."""
    grid_cost.ORDER = task["order"]
    scene = grid_cost.table_scene("Plants", 0.02)
    points = grid_cost.receivers(scene, FIRST_CALL_POINTS)
    made = []

    def build():
        made.append(grid_cost.make_grid(scene.lights, scene.bounds, *VARIANTS[task["variant"]]))

    return first_seconds({"build": build, "shade": lambda: grid_cost.shade_all(made[0].shade, points)})


def measure_first_calls(record: GridRecord, plan: Plan) -> None:
    for variant in grid_cost.TARGETED:
        print(f"first call: {variant}", file=sys.stderr, flush=True)
        found = [record.attempt(f"first call, {variant}", lambda: in_fresh_process(1, "validation.grid", variant=variant, order=plan.order))
                 for _ in range(plan.rounds)]
        if all(found):
            for what in found[0]:
                record.rows["first_call"].append({"what": f"{what}, {variant}", "variant": variant,
                                                  "seconds": significant(np.median([run[what] for run in found]))})


def measure_resolutions(record: GridRecord, plan: Plan, out: pathlib.Path) -> None:
    grid_cost.measure_resolutions(record, plan)
    pictures = grid_pictures.resolution_pictures(plan.picture, plan.pictured, 0.2 * plan.scale)
    grid_pictures.record_errors(record, "resolutions", pictures)
    grid_pictures.draw(pictures, grid_pictures.DIFFERENCE_SCALE["resolutions"], out / "grid_resolutions.png")


def measure_double_sided(record: GridRecord, plan: Plan, out: pathlib.Path) -> None:
    pictures = grid_pictures.double_sided_pictures(plan.picture, 16, (1e-2, VARIANTS[SPLIT][1]), order=plan.order)
    grid_pictures.record_errors(record, "double_sided", pictures)
    grid_pictures.draw(pictures, grid_pictures.DIFFERENCE_SCALE["double_sided"], out / "grid_double_sided.png")


PARTS = {
    "interpolation": (("interpolation",), lambda record, plan, _: grid_interpolation.measure_interpolation(record, plan.samples)),
    "table": (("scenes", "variants"), lambda record, plan, _: grid_cost.measure_table(record, plan)),
    "lights": (("light_counts",), lambda record, plan, _: grid_cost.measure_light_counts(record, plan)),
    "resolutions": (("resolutions", "pictures"), lambda record, plan, out: measure_resolutions(record, plan, out)),
    "shared_edges": (("shared_edges",), lambda record, plan, _: grid_cost.measure_shared_edges(record, plan)),
    "moving": (("moving",), lambda record, plan, _: grid_cost.measure_moving_lights(record, plan)),
    "moving_scene": (("moving_scene",), lambda record, plan, _: grid_pictures.measure_moving_scene(
        record, plan.moving_points, plan.frames, VARIANTS[SPLIT][1], plan.order)),
    "first_call": (("first_call",), lambda record, plan, _: measure_first_calls(record, plan)),
    "double_sided": (("pictures",), lambda record, plan, out: measure_double_sided(record, plan, out)),
}
"""Name of a part -> the tables that it fills, and what measures it."""


def main(arguments=None) -> int:
    options = experiment.options(
        __doc__, arguments,
        only={"nargs": "+", "choices": list(PARTS), "metavar": "PART", "help": "parts to measure: " + ", ".join(PARTS)},
        threads={"type": int, "default": 1, "help": argparse.SUPPRESS},           # as `in_fresh_process` passes it
        first_call=FIRST_CALL)
    dr.set_thread_count(1)
    if options.first_call:
        print(json.dumps(first_call(options.first_call)))
        return 0
    mi.set_variant("llvm_ad_rgb")

    plan, record = QUICK if options.quick else Plan(), GridRecord()
    grid_cost.ORDER = plan.order
    path, runs = options.out / "grid.json", {}
    if options.only and path.exists():
        earlier = json.loads(path.read_text())
        runs = earlier["runs"]
        record.rows.update({name: earlier.get(name, []) for name in record.rows})
    for part in options.only or PARTS:
        tables, measure = PARTS[part]
        for table in tables:
            record.rows[table] = [row for row in record.rows[table] if table == "pictures" and row["figure"] != part]
        record.attempt(part, measure, record, plan, options.out)
        runs[part] = {**experiment.versions(), "quick": options.quick}
    lines = grid_report.targets(record)
    grid_report.print_tables(record)
    print_verdicts(record, lines)
    experiment.write(path, {"runs": runs, "targets": lines, "failures": record.failures, **record.rows}, options.quick)
    grid_report.plot(record, options.out / "grid.png")
    return int(bool(record.failures))


if __name__ == "__main__":
    sys.exit(main())
