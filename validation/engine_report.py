"""What a run of ``validation.engine`` is to measure, has measured, and says: sizes, rows, verdicts on the targets, tables and figures."""
from __future__ import annotations

import math
import pathlib
import sys
from typing import NamedTuple

import numpy as np

from mi_shlight.light.project import METHODS
from validation.baselines import MAX_MONOMIAL_ORDER
from validation.experiment import print_targets, verdict

GROUPS = ("shading", "projection")
MONOMIAL = "monomial"
ACCURACY = 1e-5
"""Relative L2 error, float32, below which a method is accurate."""
STANDARD_ORDER, QUAD, TRIANGLE = 8, 4, 3
LARGEST_W18_ORDER = 14
"""Of W18's Fig. 6."""
LIGHT_COUNT = 100
FIRST_CALL_LIMITS = {8: 1.5, 14: 4}
"""Seconds by order."""


class Plan(NamedTuple):
    """Sizes to measure."""

    orders: tuple = (2, 4, 6, 8, 10, 12, 14, 20)
    edges: tuple = (3, 4, 8, 16, 64)
    edge_orders: tuple = (STANDARD_ORDER, LARGEST_W18_ORDER)
    """Measured for all `edges`; the other orders for quadrilaterals alone."""
    distances: tuple = (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30, 100, 300, 1e3, 1e4)
    sweep_orders: tuple = (2, 4, 8, 14)
    first_call_orders: tuple = (2, 8, 14, 20)
    first_call_repeats: int = 3
    lights_repeats: int = 3
    rounds: int = 5
    monte_carlo_sides: tuple = (1, 2, 4, 8, 16, 32, 64, 128, 270)
    """The last gives the 146k samples of W18's comparison."""
    budget: float = 0.05
    """Seconds of one timed run."""

    def edges_of(self, order: int) -> tuple:
        return self.edges if order in self.edge_orders else (QUAD,)


QUICK = Plan(orders=(2, 8), edges=(3, 4), distances=(1, 100), sweep_orders=(2,), first_call_orders=(2,), first_call_repeats=1,
             lights_repeats=0, rounds=2, monte_carlo_sides=(1, 4), budget=0.01)


class Record:
    """All rows measured, and what failed on the way."""

    def __init__(self):
        self.rows = {name: [] for name in ("times", "errors", "first_call", "lights", "distances", "monte_carlo")}
        self.failures = []

    def attempt(self, what: str, function, *arguments):
        """`function(*arguments)`, or None with the failure on record: one method must not take the others' results with it."""
        try:
            return function(*arguments)
        except Exception as error:
            self.failures.append(f"{what}: {type(error).__name__}: {error}")
            print(f"FAILED {self.failures[-1]}", file=sys.stderr, flush=True)
            return None

    def find(self, table: str, **keys) -> list:
        return [row for row in self.rows[table] if all(row[k] == value for k, value in keys.items())]

    def units(self, group: str, method: str, order: int, edges: int) -> float:
        """Time of one evaluation in units; NaN if it was not measured."""
        found = self.find("times", group=group, method=method, order=order, edges=edges)
        return found[0]["units"] if found else math.nan


def methods_of(order: int) -> list:
    return [*METHODS, MONOMIAL] if order <= MAX_MONOMIAL_ORDER else list(METHODS)


def linear_fit(x: list, y: list) -> tuple:
    """Slope, intercept and R^2 of a straight line; NaN for fewer than three points, which say nothing of linearity."""
    if len(x) < 3:
        return math.nan, math.nan, math.nan
    slope, intercept = np.polyfit(x, y, 1)
    residual = np.asarray(y) - slope * np.asarray(x) - intercept
    return float(slope), float(intercept), 1 - float(np.sum(residual ** 2) / np.sum((y - np.mean(y)) ** 2))


def scaling(record: Record, method: str) -> dict:
    """Times of shading against the number of edges (order 8) and of coefficients (quadrilateral): (x, y) lists."""
    rows = record.find("times", group="shading", method=method)
    by_edges = sorted((row["edges"], row["units"]) for row in rows if row["order"] == STANDARD_ORDER)
    by_coeffs = sorted(((row["order"] + 1) ** 2, row["units"]) for row in rows
                       if row["edges"] == QUAD and row["order"] <= LARGEST_W18_ORDER)
    return {"edges": columns(by_edges), "coefficients": columns(by_coeffs)}


def break_even(record: Record, order: int) -> float:
    """Cubature points per edge of a quadrilateral for which ``quadrature`` takes as long as ``edge``; NaN if it never does."""
    rows = record.find("distances", order=order)
    measured = sorted((row["units"], row["points"]) for row in rows if row["method"] == "quadrature" and "points" in row)
    edge = [row["units"] for row in rows if row["method"] == "edge"]
    if not measured or not edge:
        return math.nan
    units, points = columns(measured)
    return float(np.exp(np.interp(np.log(np.median(edge)), np.log(units), np.log(points), math.nan, math.nan))) / QUAD


def targets(record: Record, plan: Plan) -> list:
    """(target, measured, met) for each target; met is None where nothing was measured."""
    out = []
    check = lambda *arguments, **options: out.append(verdict(*arguments, **options))
    standard = f"order {STANDARD_ORDER}"
    units = lambda group, method, edges=QUAD, order=STANDARD_ORDER: record.units(group, method, order, edges)
    for name, edges, limit in (("quadrilateral", QUAD, 40), ("triangle", TRIANGLE, 30)):
        for group in GROUPS:
            check(f"{group}, {standard}, {name} by edge: at most {limit} fused dr.sh_eval({STANDARD_ORDER})",
                  units(group, "edge", edges), limit)
    for group in GROUPS:
        check(f"{group}, {standard}, quadrilateral: edge at least 2.5 times faster than recurrence",
              units(group, "recurrence") / units(group, "edge"), 2.5, at_most=False)
    for order in (order for order in plan.orders if order <= MAX_MONOMIAL_ORDER):
        for group in GROUPS:
            check(f"{group}, order {order}, quadrilateral: recurrence at least 2 times faster than monomials",
                  units(group, MONOMIAL, order=order) / units(group, "recurrence", order=order), 2, at_most=False)
    for order in plan.sweep_orders:
        rows = record.find("distances", method="auto", order=order)
        failed = [math.inf] * (len(plan.distances) - len(rows))
        ratios = [row["over_cheapest"] for row in rows if "over_cheapest" in row] + failed
        check(f"order {order}: auto at most 1.15 times the cheapest accurate method, at every distance", max(ratios, default=None), 1.15)
        check(f"order {order}: error of auto at most 1e-5 at every distance", max([row["error"] for row in rows] + failed), ACCURACY)
    for method in (method for method in METHODS if method != "quadrature"):     # whose cost follows strips and angles
        for what, line in scaling(record, method).items():
            check(f"{method}: time linear in the number of {what}, R^2 at least 0.99", linear_fit(*line)[2], 0.99, at_most=False,
                  text="{:.4f}")
    for order, limit in FIRST_CALL_LIMITS.items():
        for method in METHODS:
            found = record.find("first_call", method=method, order=order)
            check(f"{method}, order {order}: first call at most {limit} s", found[0]["seconds"] if found else None, limit)
    for method in METHODS:
        found = record.find("lights", method=method)
        check(f"{method}, {standard}: first call with {LIGHT_COUNT} lights of 3 to 12 edges at most 1.1 times that with one",
              found[0]["ratio"] if found else None, 1.1)
    return out


def print_table(record: Record, plan: Plan) -> None:
    print(f"\nTime of one evaluation / time of one fused dr.sh_eval({STANDARD_ORDER}); largest float32 error over the polygons; first call")
    head = " ".join(f"{edges:>7d}" for edges in plan.edges)
    print(f"{'group':10s} {'method':10s} {'order':>5s} | {head} edges |   error | first call")
    for group in GROUPS:
        for order in plan.orders:
            for method in methods_of(order):
                cells = {edges: record.units(group, method, order, edges) for edges in plan.edges_of(order)}
                cells = {edges: "failed" if math.isnan(cell) else f"{cell:.1f}" for edges, cell in cells.items()}
                cells = " ".join(cells.get(edges, "").rjust(7) for edges in plan.edges)
                error = max((row["max"] for row in record.find("errors", method=method, order=order)), default=math.nan)
                call = record.find("first_call", method=method, order=order)
                seconds = f"{call[0]['seconds']:6.2f} s" if call else ""
                print(f"{group:10s} {method:10s} {order:5d} | {cells}       | {error:7.1e} | {seconds}")


def print_distances(record: Record, plan: Plan) -> None:
    print("\nShading at a distance, time as above; * error above 1e-5; last: the cheapest accurate method, and auto over it")
    for order in plan.sweep_orders:
        print(f"order {order:<9d} " + " ".join(f"{method:>12s}" for method in METHODS))
        for distance in plan.distances:
            rows = {row["method"]: row for row in record.find("distances", order=order, distance=distance)}
            cells = (f"{rows[m]['units']:11.1f}{' *'[rows[m]['error'] > ACCURACY]}" if m in rows else "failed".rjust(12) for m in METHODS)
            auto = rows.get("auto", {})
            print(f"{distance:14g}  " + " ".join(cells) + f"  {auto.get('cheapest', 'none')} {auto.get('over_cheapest', '')}")
        equal = break_even(record, order)
        if not math.isnan(equal):
            print(f"cubature costs as much as the edge form when it has {equal:.2g} points per edge")


def print_verdicts(record: Record, lines: list) -> None:
    print_targets(lines)
    print("".join(f"\nFAILED {failure}" for failure in record.failures))


def plot(record: Record, plan: Plan, path: pathlib.Path) -> None:
    import matplotlib
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(16, 9), constrained_layout=True)
    by_edges, by_coeffs, by_order, by_distance, errors, samples = axes.flat
    for k, method in enumerate([*METHODS, MONOMIAL]):
        style = {"color": f"C{k}", "markersize": 4, "label": method}
        for axis, (x, y) in zip((by_edges, by_coeffs), scaling(record, method).values()):
            slope, intercept, r2 = linear_fit(x, y)
            axis.plot(x, y, "o", **{**style, "label": method if math.isnan(r2) else f"{method}, $R^2$ = {r2:.4f}"})
            axis.plot(x, np.multiply(slope, x) + intercept, "-", color=f"C{k}", linewidth=0.8)
        calls = sorted((row["order"], row["seconds"]) for row in record.find("first_call", method=method))
        by_order.plot(*columns(calls), "o-", **style)
        rows = sorted(record.find("distances", method=method, order=STANDARD_ORDER), key=lambda row: row["distance"])
        if rows:
            good = [(row["distance"], row["units"]) for row in rows if row["error"] <= ACCURACY]
            by_distance.plot(*columns([(row["distance"], row["units"]) for row in rows]), "o-", fillstyle="none", **style)
            by_distance.plot(*columns(good), "o", **{**style, "label": None})
            errors.plot(*columns([(row["distance"], row["error"]) for row in rows]), "o-", **style)
    by_order.plot(*columns(list(FIRST_CALL_LIMITS.items())), "kv", label="limit")
    errors.axhline(ACCURACY, color="k", linestyle="--", linewidth=0.8, label="limit")
    for stratified, name, style in ((False, "independent", "s-"), (True, "stratified", "o-")):
        rows = record.find("monte_carlo", stratified=stratified)
        samples.plot(*columns([(row["samples"], row["rms"]) for row in rows]), style, markersize=4, label=name)
    analytic = {"method": "edge", "order": STANDARD_ORDER, "edges": QUAD}
    time_of, error_of = record.find("times", group="projection", **analytic), record.find("errors", **analytic)
    if rows and time_of and error_of:
        cost = np.log([row["units"] for row in rows])
        equal = np.exp(np.interp(np.log(time_of[0]["units"]), cost, np.log([row["samples"] for row in rows])))
        samples.plot([equal], [error_of[0]["rms"]], "k*", markersize=10, label=f"edge form, takes as long as {equal:.0f} samples")
    unit, standard = f"time / time of dr.sh_eval({STANDARD_ORDER})", f"order {STANDARD_ORDER}"
    for axis, title, x, y, scale in (
            (by_edges, f"{standard}, shading ([W18] Fig. 7)", "edges", unit, "linear"),
            (by_coeffs, "quadrilateral, shading ([W18] Fig. 6)", "coefficients", unit, "linear"),
            (by_order, "first call, quadrilateral", "order", "seconds", "linear"),
            (by_distance, f"{standard}, shading; hollow: error above {ACCURACY:g}", "distance / diameter", unit, "log"),
            (errors, f"{standard}, quadrilateral, float32", "distance / diameter", "largest relative L2 error", "log"),
            (samples, f"Monte Carlo, {standard}, quadrilateral ([W18] Fig. 4)", "samples", "root mean square relative L2 error", "log")):
        axis.set(title=title, xlabel=x, ylabel=y, xscale=scale, yscale=scale)
        axis.grid(True, which="major", alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=90)
    pyplot.close(figure)


def columns(rows: list) -> tuple:
    return tuple(zip(*rows)) or ((), ())
