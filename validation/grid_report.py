"""What a run of ``validation.grid`` says: verdicts on the targets, tables and figures."""
from __future__ import annotations

import math
import pathlib

import numpy as np

from mi_shlight.grid.cells import INTERPOLATIONS
from validation import grid_cost
from validation.engine_report import Record, columns, linear_fit
from validation.experiment import verdict
from validation.grid_cost import BY_FACE, RESOLUTION, TARGETED
from validation.grid_interpolation import DEGREE, INDEX, LINES, OFF_AXIS, SAMPLES, convergence_order, on_line
from validation.grid_scenes import W20

ASYMPTOTIC_SAMPLES = 20
"""From here on errors follow a power of the cells' size; with fewer samples the coefficient is not resolved."""
PUBLISHED_ERROR, SPLIT_TARGET = 1.4e-3, 3e-4
MEMORY_GIB = 8
SHARED_RATIO, SHARED_DIFFERENCE = 1.8, 2e-6


class GridRecord(Record):
    """Rows of ``validation.grid``."""

    TABLES = ("interpolation", "scenes", "variants", "light_counts", "resolutions", "shared_edges", "moving", "moving_scene",
              "first_call", "pictures")

    def __init__(self):
        super().__init__()
        self.rows = {name: [] for name in self.TABLES}

    def only(self, table: str, **keys) -> dict:
        """The first such row; empty if there is none."""
        return next(iter(self.find(table, **keys)), {})


def targets(record: GridRecord) -> list:
    """Verdicts; `met` is None where nothing was measured."""
    out = []
    check = lambda *arguments, **options: out.append(verdict(*arguments, **options))
    at_least = {"at_most": False}
    for place in LINES:
        error = {name: record.only("interpolation", place=place, interpolation=name, samples=SAMPLES).get("rms", math.nan)
                 for name in INTERPOLATIONS}
        for name in ("trilinear", "taylor"):
            check(f"[W20] Fig. 4, {place}: error of hermite at least 10 times below {name}, {SAMPLES} samples",
                  error[name] / error["hermite"], 10, **at_least)
    for place in (*LINES, OFF_AXIS):
        check(f"coefficient ({DEGREE}, {INDEX}), {place}: hermite converges with order 3.8 at least",
              fitted_order(record, place, "hermite"), 3.8, **at_least)
    for name in W20:
        unsplit, split = (record.only("variants", scene=name, variant=variant) for variant in TARGETED)
        check(f"{name}: mean absolute error of the {RESOLUTION}^3 grid at most 1.4e-3", unsplit.get("mae"), PUBLISHED_ERROR)
        check(f"{name}: at most 3e-4 with near lights exact", split.get("mae"), SPLIT_TARGET)
    memory = [row["peak_gib"] for row in record.rows["scenes"]]
    check("largest memory of the process over all scenes: at most 8 GiB", max(memory, default=None), MEMORY_GIB)
    counts = sorted((row["lights"], row["exact_ms"]) for row in record.find("light_counts", variant="hermite"))
    check("[W20] Fig. 8: exact time linear in the number of lights, R^2 at least 0.99", linear_fit(*columns(counts))[2], 0.99,
          text="{:.4f}", **at_least)
    for variant in TARGETED:
        rows = sorted(record.find("light_counts", variant=variant), key=lambda row: row["lights"])
        grid = [row["build_ms"] + row["interpolation_ms"] for row in rows]
        check(f"[W20] Fig. 8: time of {variant} with {rows[-1]['lights'] if rows else 512} lights at most twice that with one",
              grid[-1] / grid[0] if len(grid) > 1 else None, 2)
    for row in record.rows["shared_edges"]:
        what = f"{row['triangles']} triangles, {row['what']}, {row['channels']} channels, {row['sides']}"
        if row["sides"] != BY_FACE:                   # which planar lights do without
            check(f"{what}: shared edges at least 1.8 times cheaper than separate triangles", row["ratio"], SHARED_RATIO, **at_least)
        check(f"{what}: the same to rounding (2e-6)", row["difference"], SHARED_DIFFERENCE)
    return out


def fitted_order(record: GridRecord, place: str, interpolation: str) -> float:
    rows = [row for row in record.find("interpolation", place=place, interpolation=interpolation) if row["samples"] >= ASYMPTOTIC_SAMPLES]
    return convergence_order([row["samples"] for row in rows], [row["rms"] for row in rows])


def print_tables(record: GridRecord) -> None:
    print(f"\n[W20] Table 1 anew: {RESOLUTION}^3 points, order {grid_cost.ORDER}; milliseconds of ours, in brackets theirs (on a GPU)")
    heads = "".join(f"{head:>20s}" for head in ("coefficients", "with gradients", "interpolation", "total"))
    print(f"{'scene':16s} {'triangles':>9s} {'lights':>6s}{heads}")
    for row in record.rows["scenes"]:
        theirs, ours = W20[row["scene"]], record.only("variants", scene=row["scene"], variant="hermite")
        pairs = ((row, "coefficients", theirs.coefficients), (ours, "build", theirs.gradients),
                 (ours, "interpolation", theirs.interpolation), (ours, "total", theirs.total))
        cells = "".join(f"{source.get(f'{name}_ms', math.nan):.4g} ({value:g})".rjust(20) for source, name, value in pairs)
        print(f"{row['scene']:16s} {row['triangles']:9d} {row['lights']:6d}{cells}")
    print("\nSpeed-up of the grid over exact lighting at every vertex, and over all coefficients there as in [W18]; "
          "their speed-up over [W18]; mean absolute error")
    print(f"{'scene':16s} {'grid':28s} {'near':>6s} {'total':>9s} {'exact':>9s} {'ratio':>7s} {'W18':>10s} {'ratio':>7s} {'theirs':>7s} "
          f"{'error':>8s} {'theirs':>8s}")
    for row in record.rows["variants"]:
        scene, theirs = record.only("scenes", scene=row["scene"]), W20[row["scene"]]
        number = lambda source, name, width: f"{source.get(name, math.nan):{width}.4g}"
        print(f"{row['scene']:16s} {row['variant']:28s} {number(row, 'near_faces', 6)} {number(row, 'total_ms', 9)} "
              f"{number(scene, 'exact_ms', 9)} {number(row, 'speedup', 7)} {number(scene, 'w18_ms', 10)} {number(row, 'speedup_w18', 7)} "
              f"{theirs.speedup:7g} {row['mae']:8.2g} {theirs.error:8.2g}")
    print("\nLight in triangles that share edges, against separate triangles")
    for row in record.rows["shared_edges"]:
        print(f"{row['what']:12s} {row['channels']} channels, {row['sides']:22s}: {row['shared_ms']:.4g} ms against "
              f"{row['separate_ms']:.4g}, ratio {row['ratio']:.3g}, difference {row['difference']:.2g}")
    print("\nMoving lights, milliseconds of a frame")
    for row in record.rows["moving"]:
        print(f"{row['variant']:28s} {row['lights']} lights, {row['points']} points: move {row['move_ms']:.4g}, "
              f"grid {row['build_ms']:.4g}, shade {row['shade_ms']:.4g}, together {row['frame_ms']:.4g}; "
              f"first frame {row['first_frame_ms']:.4g}")
    for row in record.rows["moving_scene"]:
        print(f"{row['variant']:28s} {row['lights']} lights in Mitsuba, {row['pixels']} pixels: move {row['move_ms']:.4g}, "
              f"render {row['render_ms']:.4g}, together {row['frame_ms']:.4g}; first frame {row['first_frame_ms']:.4g}")
    for row in record.rows["first_call"]:
        print(f"first call of {row['what']}: {row['seconds']:.3g} s")
    for row in record.rows["pictures"]:
        print(f"picture {row['figure']}, {row['picture']}: mean absolute error {row['mae']:.2g}")


def plot(record: GridRecord, path: pathlib.Path) -> None:
    import matplotlib
    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import ScalarFormatter

    figure, axes = pyplot.subplots(2, 4, figsize=(22, 9.5), constrained_layout=True)
    curves, convergence, counts, parts, quality, costs, speedups, frames = axes.flat
    style = {name: {"color": f"C{k}"} for k, name in enumerate(INTERPOLATIONS)}

    if record.rows["interpolation"]:
        line = LINES["distance 2"]
        x, exact, values = on_line(line, SAMPLES)
        curves.plot(x, exact, "k", linewidth=3, alpha=0.4, label="exact, 2000 points")
        for name in ("hermite", "trilinear", "taylor", "inverse_distance"):
            curves.plot(x, values[name], "--", **style[name], label=name)
        nodes = np.linspace(line.start, line.end, SAMPLES)
        curves.plot(nodes, np.interp(nodes, x, exact), "ko", markersize=4, label=f"{SAMPLES} samples")
        for name in INTERPOLATIONS:
            rows = record.find("interpolation", place=OFF_AXIS, interpolation=name)
            convergence.plot(*columns([(row["samples"], row["rms"]) for row in rows]), "o-", markersize=4, **style[name],
                             label=f"{name}, order {fitted_order(record, OFF_AXIS, name):.2f}")
        rows = record.find("interpolation", place="distance 2", interpolation="hermite")
        convergence.plot(*columns([(row["samples"], row["rms"]) for row in rows]), "k*:", markersize=7,
                         label=f"hermite along an axis, order {fitted_order(record, 'distance 2', 'hermite'):.2f}")
    rows = record.find("light_counts", variant="hermite")
    counts.plot(*columns([(row["lights"], row["exact_ms"]) for row in rows]), "o-", color="C3", label="exact at every point")
    for k, variant in enumerate(TARGETED):
        rows = record.find("light_counts", variant=variant)
        total = [(row["lights"], row["build_ms"] + row["interpolation_ms"]) for row in rows]
        counts.plot(*columns(total), "o-", color=f"C{k}", label=f"grid, {variant}")
        for part, mark in (("build", "^"), ("interpolation", "s")):
            parts.plot(*columns([(row["lights"], row[f"{part}_ms"]) for row in rows]), f"{mark}-", color=f"C{k}",
                       fillstyle="full" if part == "build" else "none", label=f"{part}, {variant}")
        rows = record.find("resolutions", variant=variant)
        for part, mark in (("build", "^"), ("interpolation", "s")):
            costs.plot(*columns([(row["resolution"], row[f"{part}_ms"]) for row in rows]), f"{mark}-", color=f"C{k}",
                       fillstyle="full" if part == "build" else "none", label=f"{part}, {variant}")
    for k, variant in enumerate((*TARGETED, "tricubic", "trilinear")):
        rows = record.find("resolutions", variant=variant)
        quality.plot(*columns([(row["resolution"], row["mae"]) for row in rows]), "o-", color=f"C{k}", label=variant)

    names = [row["scene"] for row in record.rows["scenes"]]
    place = np.arange(len(names))
    bars = {f"{variant}, over {what}": [record.only("variants", scene=name, variant=variant).get(key, 0) for name in names]
            for variant in TARGETED for key, what in (("speedup", "exact"), ("speedup_w18", "W18"))}
    bars["W20, on a GPU, over W18"] = [W20[name].speedup for name in names]
    for k, (label, heights) in enumerate(bars.items()):
        speedups.bar(place + 0.16 * (k - 2), heights, 0.16, color="0.6" if label.startswith("W20") else f"C{k}", label=label)
    speedups.set_xticks(place, names, rotation=20)
    stages = {"move": "C0", "build": "C1", "shade": "C2", "render": "C4"}
    bars = [(f"{row['variant']}\n{what}", row) for table, what in (("moving", "grid alone"), ("moving_scene", "in Mitsuba"))
            for row in record.rows[table]]
    for k, (_, row) in enumerate(bars):
        bottom = 0
        for stage, colour in stages.items():
            frames.bar(k, row.get(f"{stage}_ms", 0), bottom=bottom, color=colour, label=None if k else stage)
            bottom += row.get(f"{stage}_ms", 0)
    frames.set_xticks(range(len(bars)), [label for label, _ in bars], fontsize=8, rotation=20)

    pieces, per_axis = "lights (a rectangle in pieces)", "grid points along an axis"
    for axis, title, x, y, x_scale, y_scale in (
            (curves, f"coefficient ({DEGREE}, {INDEX}) along x ([W20] Fig. 4)", "x", "coefficient", "linear", "linear"),
            (convergence, "interpolation off the axes", "samples along an axis", "rms error / range", "log", "log"),
            (counts, "[W20] Fig. 8 (a)", pieces, "ms", "linear", "linear"), (parts, "[W20] Fig. 8 (b)", pieces, "ms", "log", "log"),
            (quality, "[W20] Fig. 9", per_axis, "mean absolute error", "log", "log"), (costs, "[W20] Fig. 9", per_axis, "ms", "log", "log"),
            (speedups, "[W20] Table 1", "", "speed-up", "linear", "log"),
            (frames, "a frame with moving lights", "", "ms", "linear", "linear")):
        axis.set(title=title, xlabel=x, ylabel=y)
        axis.grid(True, which="major", alpha=0.3)
        if not axis.patches and not any(len(line.get_xdata()) for line in axis.lines):          # a part that was not measured
            continue
        axis.set_yscale(y_scale)
        if x_scale == "log":
            axis.set_xscale("log", base=2)
            axis.xaxis.set_major_formatter(ScalarFormatter())
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=70)
    pyplot.close(figure)
