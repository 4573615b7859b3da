"""Figures of ``validation.pareto``."""
from __future__ import annotations

import pathlib

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter  # noqa: E402

from validation.engine_report import columns  # noqa: E402
from validation.pareto_report import (BOUNCED, DIRECT, EXACT, FLOOR, GRID_SCENE, INDEPENDENT, INTERREFLECTED, LOCALISED, PRECISIONS,  # noqa: E402
                                      PROJECTED, RIVALS, SCENES, SPLIT, STANDARD_ORDER, STRATIFIED, UNSHADOWED, ParetoRecord, standard)

COLOURS = {**dict(zip(RIVALS, ("black", "dimgrey", "darkgrey"))), UNSHADOWED: "C4", PROJECTED: "C1", LOCALISED: "C0", EXACT: "C2",
           INTERREFLECTED: "C0", "no grid": "C3", "hermite": "C2", "tricubic": "C1", "trilinear": "C4", SPLIT: "C0"}
KINDS = {"error": "mean error of pixels", "blocks": "mean error of 8 x 8 pixels"}


def front(points: list) -> list:
    """Those (time, error) that no other beats in both, by time."""
    found = []
    for point in sorted(points):
        if not found or point[1] < found[-1][1]:
            found.append(point)
    return found


def settings_of(record: ParetoRecord, scene: str, family: str) -> list:
    """(setting, its row in ``settings``, its picture at the standard samples) by setting."""
    rows = sorted(record.find("settings", scene=scene, family=family, sampler=STRATIFIED), key=lambda row: row["setting"])
    return [(row["setting"], row, standard(record, scene=scene, family=family, setting=row["setting"], sampler=STRATIFIED)) for row in rows]


def labelled(axis, points: list, labels: list, **style) -> None:
    """A curve with a label at each point; points with nothing to show on a logarithmic axis are left out."""
    kept = [(point, label) for point, label in zip(points, labels) if min(point) > 0]
    axis.plot(*columns([point for point, _ in kept]), **style)
    for point, label in kept:
        axis.annotate(label if isinstance(label, str) else f"{label:g}", point, textcoords="offset points", xytext=(3, 3), fontsize=6.5,
                      color=style.get("color"))


def plot(record: ParetoRecord, path: pathlib.Path) -> None:
    """Error against time by scene, of pixels above and of blocks below."""
    scenes = [scene for scene in SCENES if record.find("pictures", scene=scene)]
    figure, axes = plt.subplots(2, len(scenes), figsize=(4.4 * len(scenes), 8.8), layout="constrained", squeeze=False)
    for column, scene in enumerate(scenes):
        pictures = [row for row in record.find("pictures", scene=scene, sampler=STRATIFIED) if "seconds" in row]
        for axis, kind in zip(axes[:, column], KINDS):
            best = front([(picture["seconds"], picture[kind]) for picture in pictures if picture[kind] > 0])
            axis.plot(*columns(best), color="gold", linewidth=7, alpha=0.5, label="Pareto front", drawstyle="steps-post")
            for family in RIVALS:
                for sampler, style in ((STRATIFIED, "-"), (INDEPENDENT, ":")):
                    rows = sorted(record.find("pictures", scene=scene, family=family, sampler=sampler), key=lambda r: r["spp"])
                    main = family == RIVALS[0]
                    labelled(axis, [(r["seconds"], r[kind]) for r in rows], [str(r["spp"]) * (main and style == "-") for r in rows],
                             linestyle=style, marker="s", color=COLOURS[family], markersize=3, linewidth=1,
                             label=family if style == "-" else f"{family}, independent" if main else None)
            for family in dict.fromkeys(r["family"] for r in record.find("settings", scene=scene)):
                found = settings_of(record, scene, family)
                labelled(axis, [(p["seconds"], p[kind]) for _, _, p in found], [s for s, _, _ in found], marker="o", markersize=5,
                         linewidth=1, color=COLOURS[family], label=family)
            default = LOCALISED if scene in DIRECT else INTERREFLECTED if scene == BOUNCED else SPLIT
            rows = sorted(record.find("pictures", scene=scene, family=default, setting=STANDARD_ORDER, sampler=STRATIFIED),
                          key=lambda r: r["spp"])
            labelled(axis, [(r["seconds"], r[kind]) for r in rows], ["" for r in rows], marker="x", linestyle="--", linewidth=1, color="C3",
                     label="order 8, grid 8, with 1 or 4, 16, 64, 256 samples per pixel")
            axis.axhline(record.only("references", scene=scene)[kind], color="black", linewidth=0.6, linestyle="-.",
                         label="noise of the reference (subtracted)")
            axis.set(xlabel="seconds for a picture")
            decorate(axis)
        axes[0][column].set_title(scene)
    legend = dict(pair for axis in axes[0] for pair in zip(*axis.get_legend_handles_labels()[::-1]))
    figure.legend(legend.values(), legend.keys(), fontsize=8, loc="outside lower center", ncols=min(len(legend), 2 * len(scenes)))
    for row, label in enumerate(KINDS.values()):
        axes[row][0].set_ylabel(label)
    figure.suptitle("Error against time, without bake and compilation. shprt: 16 samples per pixel, labels are orders (with a grid: its "
                    "points along an axis); path: labels are samples per pixel; multijitter unless said otherwise", fontsize=11)
    figure.savefig(path, dpi=64)
    plt.close(figure)


def decorate(axis) -> None:
    """Logarithmic scales where there is something to show on them, and a grid."""
    axis.grid(True, which="major", alpha=0.3)
    if np.isfinite(axis.dataLim.minpos).all():
        axis.set(xscale="log", yscale="log")
        for scale in (axis.xaxis, axis.yaxis):
            low, high = scale.get_view_interval()
            scale.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 300 * low else (1,), numticks=12))
            scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            scale.set_minor_formatter(NullFormatter())


def plot_axes(record: ParetoRecord, path: pathlib.Path) -> None:
    """A panel for each setting: what it costs, and the error that it leaves."""
    figure, axes = plt.subplots(2, 5, figsize=(22, 8.6), layout="constrained")
    orders, unshadowed, rays, edges, margins, domain, grid, near, far, first = axes.flat
    shown = lambda axis, scene, families, cost, error="floor error": [labelled(
        axis, [(cost(row, picture), row.get(error, 0)) for _, row, picture in settings_of(record, scene, family)],
        [value for value, _, _ in settings_of(record, scene, family)],
        marker="o", markersize=4, linewidth=1, label=family, **({"color": COLOURS[family]} if family in COLOURS else {}))
        for family in families or dict.fromkeys(row["family"] for row in record.find("settings", scene=scene))]
    picture_time, bake_time = lambda row, picture: picture["seconds"], lambda row, picture: row["bake"]
    shown(orders, DIRECT[0], (PROJECTED, LOCALISED, EXACT), picture_time)
    shown(unshadowed, FLOOR, None, picture_time)
    shown(rays, "transfer_samples", None, bake_time)
    shown(edges, "max_edge", None, bake_time)
    shown(margins, "light_margin", None, lambda row, picture: max(row["setting"], 0.5))
    shown(domain, "transfer_domain", None, picture_time)
    shown(grid, GRID_SCENE, ("hermite", "tricubic", "trilinear", SPLIT), picture_time, "of the grid")
    picture, second = "seconds for a picture, 16 samples", "seconds for the bake"
    for axis, title, x in ((orders, "order, Cornell box", picture), (unshadowed, "order, open floor", picture),
                           (rays, "transfer_samples, Cornell box", second), (edges, "max_edge, Cornell box (default: 0.054)", second),
                           (margins, "light_margin, Cornell box", "degrees (0.5 stands for 0)"),
                           (domain, "transfer_domain: rays of pixel, vertex", picture),
                           (grid, "grid_resolution and interpolation, 723 lights", picture)):
        axis.set(title=title, xlabel=x, ylabel="mean error")
    grid.set_ylabel("difference from no grid")
    for axis, distance in zip((near, far), dict.fromkeys(row["distance"] for row in record.rows["precision"])):
        for k, method in enumerate(dict.fromkeys(row["method"] for row in record.rows["precision"])):
            for precision in PRECISIONS:
                rows = record.find("precision", distance=distance, method=method, precision=precision)
                labelled(axis, [(row["ns"], row["error"]) for row in rows], [row["order"] for row in rows], marker="o", markersize=4,
                         color=f"C{k}", linewidth=1, fillstyle="full" if precision == PRECISIONS[0] else "none",
                         label=f"{method}, {precision}")
        axis.set(title=f"method, precision, order; {distance:g} sizes away", xlabel="nanoseconds per point, one thread",
                 ylabel="largest relative error")
    rows, left = record.rows["first_pictures"][::-1], 0
    for part in ("load", "bake", "render"):
        values = [row[part] for row in rows]
        first.barh([row["integrator"] for row in rows], values, left=left, label=f"{part}, with compilation" if part != "load" else part)
        left = [a + b for a, b in zip(values, left or [0] * len(rows))]
    first.set(title="first picture, no kernels on disk, Cornell", xlabel="seconds")
    for axis in axes.flat[:-1]:
        decorate(axis)
    for axis in (axis for axis in axes.flat if axis.get_legend_handles_labels()[0]):
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=72)
    plt.close(figure)
