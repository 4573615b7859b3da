"""Claim: what each method of the coefficient engine costs, how fast it starts and how accurate it is; [W18] Figs. 4, 6, 7 and Table 2 anew.

    python -m validation.engine [--quick] [--out DIR] [--threads N]

prints one table of ratios and the list of targets, and writes ``engine.json`` and ``engine.png``. Run it on an idle machine. Exit status 1
if a measurement failed; a missed target is a result.

**Time**: execution time of the kernels as Dr.Jit records it, without tracing and compilation; float32, one thread, 2^12 to 2^18 points, as
many as fit the time budget of one run. All methods of one size take turns, and with them the unit: one evaluation of ``dr.sh_eval`` at
order 8 dotted with a transfer vector, inside a loop of 64 with the direction changing. Ratios are medians over the rounds of ratios
within a round. *Shading* is ``sum_lm T_lm L_lm`` by the method's shader, *projection* all ``L_lm``, dotted with T. T differs from point to
point and costs one multiply-add per coefficient.

**First call**: wall time of trace, compilation and run in a fresh process with an empty kernel cache, after Dr.Jit itself has started: one
point and 1024 points, shading and projection, one after the other. The largest of the four counts, each the median of three processes.

**Error**: largest relative L2 error of the coefficients over 16 points; oracle: cubature in float64 (``tests.reference``).

**Distances**: shading, all points at nearly the same distance from a tilted parallelogram of diameter 1. Its corners and the points lie on
a grid of 1/512, so that corner minus point is exact in float32 and only the method's own error counts. Oracle: 50-digit arithmetic.
"""
from __future__ import annotations

import argparse
import functools
import json
import math
import os
import site
import subprocess
import sys
import tempfile
import time

import drjit as dr
import numpy as np
from drjit.llvm.ad import Array3f, Float, UInt32

from mi_shlight.light.polygon import EdgeBuffer, VertexList, direction, interior_direction
from mi_shlight.light.project import METHODS, default_error, light_shader, project_light
from mi_shlight.light.quadrature import demand
from tests import reference
from validation import experiment
from validation.baselines import monomial_shader, project_monomial, project_monte_carlo
from validation.engine_report import (ACCURACY, GROUPS, LIGHT_COUNT, MONOMIAL, QUAD, QUICK, STANDARD_ORDER, Plan, Record, methods_of,
                                      plot, print_distances, print_table, print_verdicts, targets)
from validation.experiment import ROOT, significant

UNIT = "sh_eval"
UNIT_LOOP = 64
BASE_POINTS, ERROR_POINTS, MANY_POINTS_MP = 4096, 16, 8
DISTANCE = 2.0
"""Of the points from the light's centre in units of its diameter, where the distance is not what is varied."""
GRID = 512


# What is measured: lights, points, evaluations.

def ellipse(edges: int) -> np.ndarray:
    """Corners of a convex polygon in a tilted plane, inscribed in an ellipse of diameter 1 about the origin."""
    angle = 0.3 + 2 * np.pi * np.arange(edges) / edges
    u, v = np.linalg.qr(np.array([[3.0, 1.0, 0.5], [-1.0, 2.0, 1.0]]).T)[0].T
    return 0.5 * np.cos(angle)[:, None] * u + 0.4 * np.sin(angle)[:, None] * v


def parallelogram() -> np.ndarray:
    """Corners on the grid, in one plane to the last bit."""
    a, b = np.array([180, 40, -60]) / GRID, np.array([-50, 170, 30]) / GRID
    return np.array([-a - b, a - b, a + b, b - a])


def points_around(corners: np.ndarray, distance: float, grid: int | None = None) -> np.ndarray:
    """BASE_POINTS points within 60 degrees of the axis of a light about the origin, on the side from which it counts as positive."""
    rng = np.random.default_rng(1)
    normal = np.cross(corners[0] - corners[1], corners[2] - corners[1])
    normal /= np.linalg.norm(normal)
    z, azimuth = rng.uniform(0.5, 1, BASE_POINTS), rng.uniform(0, 2 * np.pi, BASE_POINTS)
    tangent = np.cross(normal, [0.6, 0, 0.8])
    tangent /= np.linalg.norm(tangent)
    across = np.cos(azimuth)[:, None] * tangent + np.sin(azimuth)[:, None] * np.cross(normal, tangent)
    points = distance * rng.uniform(0.98, 1.02, (BASE_POINTS, 1)) * (z[:, None] * normal + np.sqrt(1 - z * z)[:, None] * across)
    return np.round(points * grid) / grid if grid else points.astype(np.float32).astype(np.float64)


def vectors(corners: np.ndarray) -> list:
    found = [Array3f(*map(float, corner)) for corner in corners]
    dr.make_opaque(found)
    return found


class Points:
    """`count` points that repeat `base`, and a parameter in [0, 1) that makes the transfer differ from point to point."""

    def __init__(self, base: np.ndarray, count: int):
        lane = dr.arange(UInt32, count)
        column = lambda values: dr.gather(Float, Float(values.tolist()), lane % len(base))
        self.x = Array3f(*(column(values) for values in base.T))
        self.parameter = Float(lane % 251) * (1 / 251)
        self.count = count
        dr.make_opaque(self.x, self.parameter)


def transfer_vector(parameter, order: int) -> list:
    return [dr.fma(parameter, math.cos(i), math.sin(i)) for i in range((order + 1) ** 2)]


def dot(a: list, b: list):
    """Two running sums: one would wait for the latency of its own multiply-adds."""
    sums = [Float(0), Float(0)]
    for k, (p, q) in enumerate(zip(a, b)):
        sums[k % 2] = dr.fma(p, q, sums[k % 2])
    return sums[0] + sums[1]


def evaluation(group: str, method: str, order: int):
    """Function (corners, points) -> one float per point."""
    if method == UNIT:
        return lambda corners, points: basis_loop(points)
    if group == "projection":
        return lambda corners, points: dot(transfer_vector(points.parameter, order), coefficients(method, order, corners, points.x))
    shader = monomial_shader if method == MONOMIAL else functools.partial(light_shader, method=method)
    return lambda corners, points: shader(transfer_vector(points.parameter, order), order)(
        VertexList(corners), points.x, interior_direction(corners, points.x))


def coefficients(method: str, order: int, corners: list, x) -> list:
    project = project_monomial if method == MONOMIAL else functools.partial(project_light, method=method)
    return project(VertexList(corners), x, interior_direction(corners, x), order)


def basis_loop(points: Points):
    """UNIT_LOOP evaluations of the basis of order 8 in changing directions, each dotted with the transfer."""
    transfer = transfer_vector(points.parameter, STANDARD_ORDER)

    def body(i, total, d):
        total = total + dot(transfer, dr.sh_eval(d, STANDARD_ORDER))
        return i + 1, total, Array3f(d.z, dr.fma(0.8, d.x, -0.6 * d.y), dr.fma(0.6, d.x, 0.8 * d.y))

    return dr.while_loop((UInt32(0), Float(0), dr.normalize(points.x)), lambda i, *_: i < UNIT_LOOP, body, mode="symbolic")[1]


class LightBuffers:
    """`count` lights of 3 to 12 edges, flat."""

    def __init__(self, count: int):
        edges = [3 + k % 10 for k in range(count)]
        strips = [(n - 1) // 2 for n in edges]
        offset = np.cumsum([0, *edges]).tolist()
        centre = np.random.default_rng(2).uniform(-3, 3, (count, 3)) * [1, 1, 0.2] + [0, 0, 4]
        self.count = count
        self.positions = Float(np.concatenate([(ellipse(n) + c).ravel() for n, c in zip(edges, centre)]).tolist())
        self.centre = Float(centre.ravel().tolist())
        self.start = UInt32([o + i for o, n in zip(offset, edges) for i in range(n)])
        self.end = UInt32([o + (i + 1) % n for o, n in zip(offset, edges) for i in range(n)])
        self.strips = UInt32([o + c for o, n, m in zip(offset, edges, strips) for i in range(m) for c in (i, i + 1, n - 2 - i, n - 1 - i)])
        self.first_edge, self.first_strip = UInt32(offset), UInt32(np.cumsum([0, *strips]).tolist())
        dr.make_opaque(self.positions, self.centre, self.start, self.end, self.strips, self.first_edge, self.first_strip)

    def light(self, k) -> EdgeBuffer:
        bounds = lambda table: (dr.gather(UInt32, table, k), dr.gather(UInt32, table, k + 1))
        return EdgeBuffer(self.positions, self.start, self.end, *bounds(self.first_edge), (self.strips, *bounds(self.first_strip)), False)


def shade_all(method: str, order: int, lights: LightBuffers, points: Points):
    """Shading by all `lights`, in a symbolic loop over them."""
    shade = light_shader(transfer_vector(points.parameter, order), order, method)

    def body(k, total, x):
        apex = direction(dr.gather(Array3f, lights.centre, k) - x)
        return k + 1, total + shade(lights.light(k), x, apex), x

    start = (UInt32(0), Float(0), Array3f(points.x))
    return dr.while_loop(start, lambda k, *_: k < lights.count, body, mode="symbolic", max_iterations=-1)[1]


# How it is measured.

def kernel_nanoseconds(function) -> float:
    """Execution time of all kernels that evaluating ``function()`` launches."""
    dr.kernel_history_clear()
    dr.eval(function())
    dr.sync_thread()
    return sum(kernel["execution_time"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT) * 1e6


def take_turns(record: Record, what: str, evaluations: dict, corners: np.ndarray, base: np.ndarray, plan: Plan) -> dict:
    """Nanoseconds per evaluation by name, a list over the rounds; the unit is always among them, what failed is not."""
    corners, runs = vectors(corners), {}
    probe = Points(base, BASE_POINTS)
    for name, function in {UNIT: evaluation("", UNIT, STANDARD_ORDER), **evaluations}.items():
        warm = lambda: [kernel_nanoseconds(lambda: function(corners, probe)) for _ in range(2)][1]
        spent = record.attempt(f"{what}, {name}", warm)
        if spent:
            doublings = round(math.log2(plan.budget * 1e9 / spent))
            runs[name] = function, BASE_POINTS << min(max(doublings, 0), 6)
    points = {count: Points(base, count) for count in {count for _, count in runs.values()}}
    times = {name: [] for name in runs}
    for _ in range(plan.rounds):
        for name, (function, count) in runs.items():
            spent = kernel_nanoseconds(lambda: function(corners, points[count]))
            times[name].append(spent / count / (UNIT_LOOP if name == UNIT else 1))
    return times


def ratio(numerator: list, denominator: list) -> float:
    return float(np.median(np.divide(numerator, denominator)))


def relative_errors(method: str, order: int, corners: np.ndarray, points: np.ndarray, exact: np.ndarray) -> np.ndarray:
    coeffs = coefficients(method, order, vectors(corners), Points(points, len(points)).x)
    dr.eval(coeffs)
    values = np.array([np.broadcast_to(np.array(c), len(points)) for c in coeffs], dtype=np.float64).T
    return np.linalg.norm(values - exact, axis=1) / np.linalg.norm(exact, axis=1)


def cubature_points(order: int, corners: np.ndarray, points: np.ndarray) -> float:
    """Mean number of points of method ``quadrature``."""
    x = Points(points, len(points)).x
    return float(np.mean(np.array(demand(VertexList(vectors(corners)), x, order, default_error(x)).points)))


def measure_table(record: Record, plan: Plan) -> None:
    for edges in plan.edges:
        orders = [order for order in plan.orders if edges in plan.edges_of(order)]
        corners = ellipse(edges)
        base = points_around(corners, DISTANCE)
        rounded = corners.astype(np.float32).astype(np.float64)
        exact = np.array([reference.coefficients_quadrature(rounded, x, max(orders), n=12) for x in base[:ERROR_POINTS]])
        for order in orders:
            what = f"order {order}, {edges} edges"
            print(f"table: {what}", file=sys.stderr, flush=True)
            for method in methods_of(order):
                found = record.attempt(f"error, {what}, {method}", relative_errors, method, order, corners, base[:ERROR_POINTS],
                                       exact[:, :(order + 1) ** 2])
                if found is not None:
                    record.rows["errors"].append({"method": method, "order": order, "edges": edges, "max": significant(found.max()),
                                                  "rms": significant(np.sqrt(np.mean(found ** 2)))})
            for group in GROUPS:
                evaluations = {method: evaluation(group, method, order) for method in methods_of(order)}
                times = take_turns(record, f"{group}, {what}", evaluations, corners, base, plan)
                unit = times.pop(UNIT)
                for method, values in times.items():
                    record.rows["times"].append({"group": group, "method": method, "order": order, "edges": edges,
                                                 "units": significant(ratio(values, unit)), "ns": significant(np.median(values))})


def measure_distances(record: Record, plan: Plan) -> None:
    corners = parallelogram()
    for distance in plan.distances:
        base = points_around(corners, distance, GRID)
        exact = np.array([reference.coefficients_mp(corners, x, max(plan.sweep_orders)) for x in base[:MANY_POINTS_MP]])
        for order in plan.sweep_orders:
            what = f"distance {distance:g}, order {order}"
            print(f"distances: {what}", file=sys.stderr, flush=True)
            times = take_turns(record, what, {method: evaluation("shading", method, order) for method in METHODS}, corners, base, plan)
            rows = []
            for method in METHODS:
                found = record.attempt(f"error, {what}, {method}", relative_errors, method, order, corners, base[:MANY_POINTS_MP],
                                       exact[:, :(order + 1) ** 2])
                if found is not None and method in times:
                    rows.append({"distance": distance, "order": order, "method": method, "error": significant(found.max()),
                                 "units": significant(ratio(times[method], times[UNIT])), "ns": significant(np.median(times[method]))})
            accurate = [row["method"] for row in rows if row["error"] <= ACCURACY and row["method"] != "auto"]
            if accurate and "auto" in times:
                cheapest = min(accurate, key=lambda method: np.median(times[method]))
                for row in rows:
                    if row["method"] == "auto":
                        row.update(cheapest=cheapest, over_cheapest=significant(ratio(times["auto"], times[cheapest])))
            points = record.attempt(f"points, {what}", cubature_points, order, corners, base)
            for row in rows:
                if row["method"] == "quadrature" and points:
                    row["points"] = significant(points)
            record.rows["distances"] += rows


def measure_monte_carlo(record: Record, plan: Plan) -> None:
    """Error of the coefficients of a quadrilateral and time per point against the number of samples; 64 runs at each of 16 points."""
    corners = ellipse(QUAD)
    base = points_around(corners, DISTANCE)[:ERROR_POINTS]
    exact = np.array([reference.coefficients_quadrature(corners, x, STANDARD_ORDER, n=12) for x in base])
    lights, points = vectors(corners), Points(base, 64 * ERROR_POINTS)
    for stratified in (False, True):
        for side in plan.monte_carlo_sides:
            samples = (QUAD - 2) * side ** 2
            print(f"Monte Carlo: {samples} samples", file=sys.stderr, flush=True)

            def run(seed):
                return project_monte_carlo(lights, points.x, STANDARD_ORDER, side, seed, stratified)

            coeffs = record.attempt(f"Monte Carlo, {samples} samples", run, 0)
            if coeffs is None:
                continue
            dr.eval(coeffs)
            values = np.array(coeffs).T.reshape(-1, ERROR_POINTS, exact.shape[1])
            errors = np.linalg.norm(values - exact, axis=2) / np.linalg.norm(exact, axis=1)
            spent = np.median([kernel_nanoseconds(lambda: run(seed)) for seed in range(1, 4)]) / points.count
            unit = np.median([kernel_nanoseconds(lambda: basis_loop(points)) for _ in range(3)]) / points.count / UNIT_LOOP
            record.rows["monte_carlo"].append({"samples": samples, "stratified": stratified,
                                               "rms": significant(np.sqrt(np.mean(errors ** 2))),
                                               "units": significant(spent / unit), "ns": significant(spent)})


def first_seconds(jobs: dict) -> dict:
    """Seconds of the first run of each function in this process, one after the other, once Dr.Jit itself has started."""
    dr.eval(dr.opaque(Float, 1) + 1)                          # starts Dr.Jit and LLVM
    seconds = {}
    for name, job in jobs.items():
        start = time.perf_counter()
        dr.eval(job())
        dr.sync_thread()
        seconds[name] = time.perf_counter() - start
    return seconds


def first_call(task: dict) -> dict:
    """Seconds of first calls in this process; see :py:func:`in_fresh_process`."""
    method, order, count = task["method"], task["order"], task.get("lights")
    corners = ellipse(QUAD)
    base = points_around(corners, DISTANCE)
    prepared, widths = vectors(corners), {width: Points(base, width) for width in (1, 64, 1024)}
    if count:
        jobs = {"lights": functools.partial(shade_all, method, order, LightBuffers(count), widths[64])}
    else:
        jobs = {f"{group}_{width}": functools.partial(evaluation(group, method, order), prepared, widths[width])
                for width in (1, 1024) for group in GROUPS}
    return first_seconds(jobs)


FIRST_CALL = {"type": json.loads, "help": argparse.SUPPRESS}
"""Option of the modules that :py:func:`in_fresh_process` runs."""


def in_fresh_process(threads: int, module: str = "validation.engine", **task) -> dict:
    """``first_call(task)`` of a module in a new process with a new home, where Dr.Jit keeps its kernels."""
    with tempfile.TemporaryDirectory() as home:
        environment = {**os.environ, "HOME": home, "PYTHONUSERBASE": site.getuserbase()}
        command = [sys.executable, "-m", module, "--threads", str(threads), "--first-call", json.dumps(task)]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900)
    if done.returncode:
        raise RuntimeError(f"exit status {done.returncode}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def measure_first_calls(record: Record, plan: Plan, threads: int) -> None:
    for order in plan.first_call_orders:
        for method in methods_of(order):
            print(f"first call: order {order}, {method}", file=sys.stderr, flush=True)
            found = [record.attempt(f"first call, order {order}, {method}", functools.partial(
                in_fresh_process, threads, method=method, order=order)) for _ in range(plan.first_call_repeats)]
            if all(found):
                middle = {name: significant(np.median([run[name] for run in found])) for name in found[0]}
                record.rows["first_call"].append({"method": method, "order": order, "seconds": max(middle.values()), **middle})
    for method in METHODS if plan.lights_repeats else ():
        print(f"first call: {LIGHT_COUNT} lights, {method}", file=sys.stderr, flush=True)
        found = [record.attempt(f"first call, {count} lights, {method}", functools.partial(
            in_fresh_process, threads, method=method, order=STANDARD_ORDER, lights=count))
            for _ in range(plan.lights_repeats) for count in (1, LIGHT_COUNT)]
        if all(found):
            one, many = (float(np.median([run["lights"] for run in found[k::2]])) for k in range(2))
            record.rows["lights"].append({"method": method, "one": significant(one), "many": significant(many),
                                          "ratio": significant(many / one)})


def main(arguments=None) -> int:
    options = experiment.options(__doc__, arguments, threads={"type": int, "default": 1, "help": "threads of Dr.Jit (default: 1)"},
                                 first_call=FIRST_CALL)
    dr.set_thread_count(options.threads)
    if options.first_call:
        print(json.dumps(first_call(options.first_call)))
        return 0

    plan, record = QUICK if options.quick else Plan(), Record()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        measure_table(record, plan)
        measure_distances(record, plan)
        measure_monte_carlo(record, plan)
    measure_first_calls(record, plan, options.threads)
    lines = targets(record, plan)
    print_table(record, plan)
    print_distances(record, plan)
    print_verdicts(record, lines)
    report = {"targets": lines, "failures": record.failures, **record.rows}
    experiment.write(options.out / "engine.json", report, options.quick)
    plot(record, plan, options.out / "engine.png")
    return int(bool(record.failures))


if __name__ == "__main__":
    sys.exit(main())
