"""Claim: gradients cost little more than the values they belong to, and much less than autodiff or differences; [W20] Table 1 and 7.1.

    python -m validation.gradient_cost [--quick] [--out DIR]

prints times and the list of targets and writes ``gradient_cost.json`` and ``gradient_cost.png``. Run it on an idle machine. Exit status 1
if a measurement failed; a missed target is a result.

**Time** as in :py:mod:`validation.engine`: execution time of all kernels as Dr.Jit records it, float32, one thread, all evaluations of one
size in turns, ratios within a round, medians over the rounds. A light of diameter 1 seen from twice that distance.

*Shading* is ``sum_lm T_lm L_lm``: ``shade_polygon`` and ``shade_polygon_gradient``, which adds the derivatives with respect to all vertices
at every point, by ``edge`` and by ``auto``. By ``edge``: reverse mode through ``shade_polygon``, from the vertices to their gradients
summed over the points; forward mode, for one motion of all vertices; central differences in all vertex coordinates, two values each.
Against them reverse mode, without any analytic derivative, through the zonal recurrence of [W18]. Both modes include the value.

*Projection* is all ``L_lm``, dotted with T so that memory does not count: ``project_polygon``; with its derivative with respect to the
point (``project_polygon_spatial_gradient``) and to all vertices (``project_polygon_gradient``); central differences in the point, six
projections.

**First call**: wall time of trace, compilation and run in a fresh process with an empty kernel cache, the larger of one point and 1024
points, median of the processes.
"""
from __future__ import annotations

import functools
import json
import math
import pathlib
import sys
from typing import NamedTuple

import drjit as dr
import numpy as np
from drjit.llvm.ad import Array3f, Float

from mi_shlight import (project_polygon, project_polygon_gradient, project_polygon_spatial_gradient, shade_polygon,
                        shade_polygon_gradient)
from mi_shlight.light.polygon import VertexList, interior_direction
from mi_shlight.light.recurrence import recurrence_shader
from validation import experiment
from validation.engine import (DISTANCE, FIRST_CALL, UNIT, Points, dot, ellipse, first_seconds, in_fresh_process, points_around, ratio,
                               take_turns, transfer_vector, vectors)
from validation.engine_report import QUAD, STANDARD_ORDER, TRIANGLE, Plan, Record, print_verdicts
from validation.experiment import significant, verdict

SHADERS = ("edge", "auto")
VALUE = {method: f"value, {method}" for method in SHADERS}
GRADIENT = {method: f"value + vertex gradients, {method}" for method in SHADERS}
REVERSE, FORWARD = "reverse mode", "forward mode"
RECURRENCE, DIFFERENCES = "reverse mode through recurrence", "differences in the vertices"
COEFFS, SPATIAL, VERTICES = "coefficients", "coefficients + spatial gradient", "coefficients + vertex gradients"
POINT_DIFFERENCES = "differences in the point"
PROJECTIONS = (COEFFS, SPATIAL, VERTICES, POINT_DIFFERENCES)
CLOSED_FORMS = ("edge", "recurrence")
BASES = {f"{name}, {method}": f"{COEFFS}, {method}" for name in PROJECTIONS for method in CLOSED_FORMS}
"""What the figure divides the time of an evaluation by: if not here, ``VALUE["edge"]``."""
FIRST_CALLS = (VALUE["edge"], GRADIENT["edge"], REVERSE, RECURRENCE)
WIDTHS = (1, 1024)
STEP = 1e-2
QUICK = Plan(rounds=2, budget=0.01, first_call_repeats=1)
SIZES = ((STANDARD_ORDER, QUAD), (4, TRIANGLE), (14, QUAD))
QUICK_SIZES = ((2, TRIANGLE),)
"""(order, edges); the targets are set for the first."""


class Limit(NamedTuple):
    """A target: the ratio of two evaluations, and the bound on it."""

    numerator: str
    denominator: str
    limit: float
    at_most: bool
    table: str = "times"


LIMITS = (
    *(Limit(GRADIENT[method], VALUE[method], 1.5, True) for method in SHADERS),
    *(Limit(RECURRENCE, name, 5, False, table) for table in ("times", "first_call") for name in (GRADIENT["edge"], REVERSE)),
    Limit(f"{SPATIAL}, edge", f"{COEFFS}, edge", 2.2, True),
    Limit(f"{SPATIAL}, recurrence", f"{COEFFS}, recurrence", 1.4, True),
    Limit(DIFFERENCES, GRADIENT["edge"], 3, False),
    *(Limit(f"{POINT_DIFFERENCES}, {method}", f"{SPATIAL}, {method}", 3, False) for method in CLOSED_FORMS),
)


# What is measured.

def evaluations(order: int) -> dict:
    """Functions (corners, points) -> values and gradients, by name."""
    transfer = lambda points: transfer_vector(points.parameter, order)
    shade = lambda method: lambda v, points: shade_polygon(v, points.x, transfer(points), order, method)
    gradient = lambda method: lambda v, points: shade_polygon_gradient(v, points.x, transfer(points), order, method)

    def recurrence(v, points):
        return recurrence_shader(transfer(points), order)(VertexList(v), points.x, interior_direction(v, points.x))

    found = {VALUE[method]: shade(method) for method in SHADERS} | {GRADIENT[method]: gradient(method) for method in SHADERS}
    found |= {REVERSE: reverse(shade("edge")), FORWARD: forward(shade("edge")), RECURRENCE: reverse(recurrence)}
    found[DIFFERENCES] = vertex_differences(shade("edge"))
    for method in CLOSED_FORMS:
        found |= {f"{name}, {method}": functools.partial(projection, name, order, method) for name in PROJECTIONS}
    return found


def reverse(value):
    """Gradients of the sum of ``value(corners, points)`` over the points with respect to the corners, and the value."""
    def evaluate(corners, points):
        corners = [Array3f(v) for v in corners]
        dr.enable_grad(corners)
        values = value(corners, points)
        dr.backward(values)
        return dr.detach(values), [dr.grad(v) for v in corners]

    return evaluate


def forward(value):
    """``value(corners, points)`` and its derivative for a motion of the corners, each along its own direction."""
    def evaluate(corners, points):
        t = dr.opaque(Float, 0)
        dr.enable_grad(t)
        values = value([v + t * Array3f(math.cos(i), math.sin(i), 0.5) for i, v in enumerate(corners)], points)
        dr.forward(t)
        return dr.detach(values), dr.grad(values)

    return evaluate


def vertex_differences(value):
    """Central differences of ``value(corners, points)`` in all coordinates of the corners: one kernel, launched twice for each."""
    def evaluate(corners, points):
        quotients = []
        for i, axis in np.ndindex(len(corners), 3):
            pair = []
            for step in (STEP, -STEP):
                moved = list(corners)
                moved[i] = corners[i] + along(axis, step)
                dr.make_opaque(moved)
                pair.append(value(moved, points))
                dr.eval(pair)
            quotients.append((pair[0] - pair[1]) * (0.5 / STEP))
        return quotients

    return evaluate


def projection(name: str, order: int, method: str, corners: list, points: Points):
    """One of PROJECTIONS, dotted with the transfer."""
    transfer = transfer_vector(points.parameter, order)
    onto = lambda vectors3: [dot(transfer, [v[k] for v in vectors3]) for k in range(3)]
    if name == COEFFS:
        return dot(transfer, project_polygon(corners, points.x, order, method))
    if name == SPATIAL:
        coeffs, gradient = project_polygon_spatial_gradient(corners, points.x, order, method)
        return dot(transfer, coeffs), onto(gradient)
    if name == VERTICES:
        coeffs, gradients = project_polygon_gradient(corners, points.x, order, method)
        return dot(transfer, coeffs), [onto(gradient) for gradient in gradients]
    quotients = []
    for axis in range(3):
        pair = []
        for step in (STEP, -STEP):
            moved = points.x + along(axis, step)
            dr.make_opaque(moved)
            pair.append(dot(transfer, project_polygon(corners, moved, order, method)))
            dr.eval(pair)
        quotients.append((pair[0] - pair[1]) * (0.5 / STEP))
    return quotients


def along(axis: int, step: float) -> Array3f:
    return Array3f(*(step * (k == axis) for k in range(3)))


# How it is measured.

def light(edges: int) -> tuple:
    """Corners and points of the measurements."""
    return ellipse(edges), points_around(ellipse(edges), DISTANCE)


def measure_times(record: Record, plan: Plan, order: int, edges: int) -> dict:
    """Nanoseconds per point by evaluation, a list over the rounds."""
    corners, base = light(edges)
    times = take_turns(record, f"order {order}, {edges} edges", evaluations(order), corners, base, plan)
    unit = times.pop(UNIT)
    for name, values in times.items():
        base = BASES.get(name, VALUE["edge"])
        record.rows["times"].append({"name": name, "order": order, "edges": edges, "ns": significant(np.median(values)),
                                     "units": significant(ratio(values, unit)), "base": base,
                                     "over_base": significant(ratio(values, times[base])) if base in times else None})
    return times


def first_call(task: dict) -> dict:
    """Seconds of the first calls of an evaluation in this process; see :py:func:`validation.engine.in_fresh_process`."""
    corners, base = light(task["edges"])
    function, corners = evaluations(task["order"])[task["name"]], vectors(corners)
    jobs = {f"{width}": functools.partial(function, corners, Points(base, width)) for width in WIDTHS}
    return first_seconds(jobs)


def measure_first_calls(record: Record, plan: Plan, order: int, edges: int) -> dict:
    """Seconds by evaluation, a list over the processes."""
    seconds = {}
    for name in FIRST_CALLS:
        task = functools.partial(in_fresh_process, 1, "validation.gradient_cost", name=name, order=order, edges=edges)
        found = [record.attempt(f"first call, order {order}, {edges} edges, {name}", task) for _ in range(plan.first_call_repeats)]
        if all(found):
            seconds[name] = [max(run.values()) for run in found]
            middle = significant(np.median(seconds[name]))
            record.rows["first_call"].append({"name": name, "order": order, "edges": edges, "seconds": middle})
    return seconds


def ratios(measured: dict, order: int, edges: int) -> list:
    """One row per entry of LIMITS; `measured`: by table the times by evaluation. The ratio is None where one of them failed."""
    rows = []
    for entry in LIMITS:
        times = measured[entry.table]
        known = entry.numerator in times and entry.denominator in times
        value = significant(ratio(times[entry.numerator], times[entry.denominator])) if known else None
        rows.append({"order": order, "edges": edges, "table": entry.table, "numerator": entry.numerator, "denominator": entry.denominator,
                     "ratio": value, "limit": entry.limit, "at_most": entry.at_most})
    return rows


# Report.

def targets(rows: list) -> list:
    """Verdicts on the ratios of the first size."""
    order, edges = rows[0]["order"], rows[0]["edges"]
    what = {"times": "time", "first_call": "first call"}
    return [verdict(f"order {order}, {edges} edges, {what[row['table']]}: {row['numerator']} / {row['denominator']} "
                    f"at {'most' if row['at_most'] else 'least'} {row['limit']:g}", row["ratio"], row["limit"], row["at_most"])
            for row in rows if (row["order"], row["edges"]) == (order, edges)]


def print_report(record: Record, rows: list) -> None:
    for order, edges in dict.fromkeys((row["order"], row["edges"]) for row in rows):
        print(f"\nOrder {order}, {edges} edges: nanoseconds per point; first call")
        for row in record.find("times", order=order, edges=edges):
            calls = record.find("first_call", order=order, edges=edges, name=row["name"])
            print(f"{row['name']:45s} {row['ns']:9.0f}" + (f" {calls[0]['seconds']:8.2f} s" if calls else ""))
        for row in rows:
            if (row["order"], row["edges"]) == (order, edges) and row["ratio"] is not None:
                print(f"{row['table']:10s} {row['numerator']} / {row['denominator']}: {row['ratio']:.3g}")


def plot(record: Record, path: pathlib.Path) -> None:
    import matplotlib
    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    sizes = list(dict.fromkeys((row["order"], row["edges"]) for row in record.rows["times"]))
    figure, axes = pyplot.subplots(1, 2, figsize=(15, 8), layout="constrained", width_ratios=(1.6, 1))
    names, height = [], 0.8 / len(sizes)
    for k, (order, edges) in enumerate(sizes):
        style = {"height": height, "color": f"C{k}", "label": f"order {order}, {edges} edges"}
        relative = {row["name"]: row["over_base"] for row in record.find("times", order=order, edges=edges) if row["over_base"] is not None}
        names += [name for name in relative if name not in names]
        bars = axes[0].barh([names.index(name) + k * height for name in relative], list(relative.values()), **style)
        axes[0].bar_label(bars, fmt="%.3g", fontsize=7, padding=2)
        calls = {row["name"]: row["seconds"] for row in record.find("first_call", order=order, edges=edges)}
        bars = axes[1].barh([FIRST_CALLS.index(name) + k * height for name in calls], list(calls.values()), **style)
        axes[1].bar_label(bars, fmt="%.3g", fontsize=7, padding=2)
    for axis, labels, title in ((axes[0], names, "time / time of the value by edge, or of the coefficients by the same method"),
                                (axes[1], FIRST_CALLS, "first call, seconds, empty kernel cache")):
        axis.set_yticks(np.arange(len(labels)) + height * (len(sizes) - 1) / 2, labels)
        axis.invert_yaxis()
        axis.set(title=title)
        axis.margins(x=0.15)
        axis.grid(True, axis="x", alpha=0.3)
        if axis.patches:
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
            axis.xaxis.set_minor_locator(ticker.NullLocator())
    axes[0].axvline(1, color="grey", linewidth=0.8)
    axes[0].legend(loc="lower right")
    figure.savefig(path, dpi=90)
    pyplot.close(figure)


def main(arguments=None) -> int:
    options = experiment.options(__doc__, arguments, threads={"type": int, "default": 1, "help": "threads of Dr.Jit (default: 1)"},
                                 first_call=FIRST_CALL)
    dr.set_thread_count(options.threads)
    if options.first_call:
        print(json.dumps(first_call(options.first_call)))
        return 0

    plan, record, rows = QUICK if options.quick else Plan(), Record(), []
    for order, edges in QUICK_SIZES if options.quick else SIZES:
        print(f"order {order}, {edges} edges", file=sys.stderr, flush=True)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            times = measure_times(record, plan, order, edges)
        rows += ratios({"times": times, "first_call": measure_first_calls(record, plan, order, edges)}, order, edges)
    lines = targets(rows)
    print_report(record, rows)
    print_verdicts(record, lines)
    report = {"targets": lines, "failures": record.failures, "ratios": rows, "times": record.rows["times"],
              "first_call": record.rows["first_call"]}
    experiment.write(options.out / "gradient_cost.json", report, options.quick)
    plot(record, options.out / "gradient_cost.png")
    return int(bool(record.failures))


if __name__ == "__main__":
    sys.exit(main())
