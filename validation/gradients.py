"""Claim: the analytic gradients are the derivatives of the coefficients, to the accuracy of the coefficients; [W20] Fig. 6 anew.

    python -m validation.gradients [--quick] [--out DIR] [--size N] [--order N]

writes ``gradients.json``, ``gradients.png`` and ``gradients_accuracy.png`` and prints the table of errors and the list of targets:

- **figure 6**: derivatives with respect to the shading point of the coefficients (6, -3) and (7, 2) of [W20] section 7.1: light
  (-5, -5, 1)-(5, 5, 1), points on the square (3, 3, 0)-(6, 6, 0), one per pixel. Central differences with the paper's step of 1e-3
  in float64, the analytic gradients by ``edge`` and ``recurrence``, and their differences; also from differences of fourth order with the
  same step, which tell the error of the paper's differences from that of the gradients. Errors are relative to the
  largest derivative of the image. Pixels lie on a grid, so that corner minus point is exact in float32.
- **steps**: a quadrilateral of the reference set; error of central differences of the coefficients with respect to all vertex
  coordinates against the step, and of the analytic vertex gradients, which have none.
- **classes**: relative L2 error of all vertex gradients together of the 62 reference polygons, order 14 unless another is asked for, by
  class: the largest of the class, for each method and precision. Oracle: 50-digit arithmetic (tests/data/generate_reference.py).

The kernels of the classes take six minutes of one core to compile, the first time.
"""
from __future__ import annotations

import pathlib
import sys

import drjit as dr
import matplotlib
import numpy as np
from drjit.llvm.ad import Array3f, Array3f64

from mi_shlight import project_polygon, project_polygon_gradient, project_polygon_spatial_gradient
from mi_shlight.light.project import METHODS
from tests import reference
from validation import experiment
from validation.experiment import print_targets, significant, verdict

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

LIGHT = np.array([[-5, -5, 1], [5, -5, 1], [5, 5, 1], [-5, 5, 1]], dtype=float)
RECEIVER = 3.0, 6.0
"""Of x and y, at z = 0."""
SHOWN = ((6, -3), (7, 2))
CLOSED_FORMS = ("edge", "recurrence")
PAPER_STEP = 1e-3

PRECISIONS = {"float32": Array3f, "float64": Array3f64}
STEPS = 10.0 ** np.arange(-12, -0.4, 0.5)
STEP_ORDER = 8
QUICK_CORNERS = 4
GENERIC = ("triangle", "quad", "heptagon", "star", "axis-aligned")
LIMITS = (("float64", "generic", 1e-11), ("float32", "generic", 1e-5), ("float32", "distance", 1e-4))
"""(precision, classes, largest relative L2 error) promised of ``auto``."""


def wide(rows: np.ndarray, kind):
    """3-vector of Dr.Jit type `kind`, one lane per row."""
    vector = kind(*(dr.value_t(kind)(column.tolist()) for column in rows.T))
    dr.make_opaque(vector)
    return vector


def corners_of(polygons: np.ndarray, kind) -> list:
    """Vertices of polygons (lanes, N, 3)."""
    return [wide(polygons[:, i], kind) for i in range(polygons.shape[1])]


def values_of(numbers: list) -> np.ndarray:
    """(lanes, len(numbers)) in float64."""
    return np.array([np.array(n, dtype=np.float64) for n in numbers]).T


def coefficients(vertices: list, x, order: int, method: str) -> np.ndarray:
    """(lanes, C)."""
    coeffs = project_polygon(vertices, x, order, method)
    dr.eval(coeffs)
    return values_of(coeffs)


def spatial_gradient(vertices: list, x, order: int, method: str) -> np.ndarray:
    """(lanes, 3, C)."""
    result = project_polygon_spatial_gradient(vertices, x, order, method)
    dr.eval(result)
    return np.stack([values_of([g[k] for g in result[1]]) for k in range(3)], axis=1)


def vertex_gradients(vertices: list, x, order: int, method: str) -> np.ndarray:
    """(lanes, N, 3, C)."""
    result = project_polygon_gradient(vertices, x, order, method)
    dr.eval(result)
    return np.stack([np.stack([values_of([g[k] for g in gradient]) for k in range(3)], axis=1) for gradient in result[1]], axis=1)


# Fig. 6 of W20.

def receiver(size: int) -> np.ndarray:
    """Centres of the pixels, (size * size, 3), by rows of increasing y."""
    low, high = RECEIVER
    centre = low + (high - low) * (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(centre, centre)
    return np.stack([x.ravel(), y.ravel(), np.zeros(size * size)], axis=1)


def central_differences(points: np.ndarray, order: int, step: float) -> np.ndarray:
    """Derivatives with respect to the points, (lanes, 3, C), in float64, by the zonal recurrence as in the paper."""
    moved = np.concatenate([points + sign * step * axis for axis in np.eye(3) for sign in (1, -1)])
    values = coefficients(corners_of(LIGHT[None], Array3f64), wide(moved, Array3f64), order, "recurrence")
    values = values.reshape(3, 2, len(points), -1)
    return np.moveaxis(values[:, 0] - values[:, 1], 0, 1) / (2 * step)


def measure_images(size: int) -> dict:
    """Images (size, size) by (l, m, axis): differences, gradients by method in float64, in float32, differences of fourth order."""
    points, order = receiver(size), max(l for l, _ in SHOWN)
    second = central_differences(points, order, PAPER_STEP)
    fields = {"differences": second, "fourth order": (4 * central_differences(points, order, PAPER_STEP / 2) - second) / 3}
    for precision, kind in PRECISIONS.items():
        for method in CLOSED_FORMS:
            fields[f"{method} {precision}"] = spatial_gradient(corners_of(LIGHT[None], kind), wide(points, kind), order, method)
    return {(l, m, axis): {name: field[:, axis, l * (l + 1) + m].reshape(size, size) for name, field in fields.items()}
            for l, m in SHOWN for axis in range(3)}


def image_errors(images: dict) -> list:
    """One row per image and closed form: largest differences, relative to the largest derivative."""
    rows = []
    for (l, m, axis), image in images.items():
        largest = abs(image["fourth order"]).max()
        between = lambda a, b: significant(abs(image[a] - image[b]).max() / largest)
        for method in CLOSED_FORMS:
            analytic = f"{method} float64"
            rows.append({"l": l, "m": m, "axis": "xyz"[axis], "method": method, "largest": significant(largest),
                         "from_differences": between(analytic, "differences"), "from_fourth_order": between(analytic, "fourth order"),
                         "float32": between(f"{method} float32", analytic)})
    return rows


def plot_images(images: dict, path: pathlib.Path) -> None:
    columns = ("central differences", "analytic, edge", "|edge - differences|", "|edge - 4th order|", "|recurrence - 4th order|",
               "edge, |float32 - float64|")
    figure, axes = plt.subplots(len(images), len(columns), figsize=(2.6 * len(columns), 2.25 * len(images)), layout="constrained")
    extent = [*RECEIVER, *RECEIVER]
    for row, ((l, m, axis), image) in zip(axes, images.items()):
        exact, analytic = image["fourth order"], image["edge float64"]
        largest = abs(exact).max()
        signed = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
        logarithm = {"cmap": "viridis", "norm": matplotlib.colors.LogNorm(1e-15, 1e-5)}
        errors = [image["differences"] - analytic, analytic - exact, image["recurrence float64"] - exact, image["edge float32"] - analytic]
        shown = [(image["differences"], signed), (analytic, signed)]
        shown += [(np.maximum(abs(error) / largest, 1e-15), logarithm) for error in errors]
        for k, (cell, (values, style)) in enumerate(zip(row, shown)):
            drawn = cell.imshow(values, origin="lower", extent=extent, **style)
            cell.set(xticks=RECEIVER, yticks=RECEIVER)
            if k in (1, len(shown) - 1):
                figure.colorbar(drawn, ax=cell, label="" if k == 1 else "/ largest derivative")
        row[0].set_ylabel(rf"$\partial L_{{{l},{m}}} / \partial {'xyz'[axis]}$")
    for cell, title in zip(axes[0], columns):
        cell.set_title(title, fontsize=10)
    figure.savefig(path, dpi=60)
    plt.close(figure)


# Steps and classes.

def relative(values: np.ndarray, exact: np.ndarray) -> float:
    return float(np.linalg.norm(values - exact) / np.linalg.norm(exact))


def measure_steps(case: reference.ReferenceCase, order: int, steps: np.ndarray) -> dict:
    """Errors of central differences by step, and of the analytic gradients by method, in both precisions."""
    count, flat = case.vertices.size, (order + 1) ** 2
    exact, report = case.gradients[..., :flat], {"case": case.name, "order": order, "steps": steps.tolist()}
    signed = np.concatenate([steps, -steps])
    moved = case.vertices + signed[:, None, None, None] * np.eye(count).reshape(count, *case.vertices.shape)
    for precision, kind in PRECISIONS.items():
        lanes = corners_of(moved.reshape(-1, *case.vertices.shape), kind)
        values = coefficients(lanes, kind(0), order, "edge").reshape(2, len(steps), count, flat)
        quotients = (values[0] - values[1]) / (2 * steps[:, None, None])
        corners = corners_of(case.vertices[None], kind)
        report[precision] = {"differences": [significant(relative(q.reshape(exact.shape), exact)) for q in quotients],
                             **{method: significant(relative(vertex_gradients(corners, kind(0), order, method)[0], exact))
                                for method in METHODS}}
    return report


def measure_classes(cases: tuple, order: int) -> list:
    """Rows (class, method, precision, largest error, not finite), classes in the order of `cases`."""
    flat, errors = (order + 1) ** 2, {}
    for precision, kind in PRECISIONS.items():
        for corners in sorted({len(case.vertices) for case in cases}):
            alike = [case for case in cases if len(case.vertices) == corners]
            lanes = corners_of(np.array([case.vertices for case in alike]), kind)
            for method in METHODS:
                print(f"classes: {corners} vertices, {method}, {precision}", file=sys.stderr, flush=True)
                for case, values in zip(alike, vertex_gradients(lanes, kind(0), order, method)):
                    errors.setdefault((case.name, method, precision), []).append(relative(values, case.gradients[..., :flat]))
    return [{"class": name, "method": method, "precision": precision, "max": significant(np.nanmax([*errors[name, method, precision], 0])),
             "not_finite": int(np.sum(~np.isfinite(errors[name, method, precision])))}
            for name in dict.fromkeys(case.name for case in cases) for method in METHODS for precision in PRECISIONS]


def targets(classes: list) -> list:
    """Verdicts on the errors of the gradients."""
    lines = []
    for precision, group, limit in LIMITS:
        found = [row["max"] for row in classes if row["method"] == "auto" and row["precision"] == precision
                 and (row["class"] in GENERIC if group == "generic" else row["class"].startswith(group))]
        lines.append(verdict(f"vertex gradients by auto, {precision}, {group} classes: relative L2 error at most {limit:g}",
                             max(found, default=None), limit))
    lines.append(verdict("vertex gradients of all classes, methods and precisions: polygons that are not finite",
                         sum(row["not_finite"] for row in classes), 0))
    return lines


def plot_accuracy(steps: dict, classes: list, path: pathlib.Path) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(17, 5.2), layout="constrained", width_ratios=(1.1, 1, 1))
    for precision, colour in zip(PRECISIONS, ("tab:orange", "tab:blue")):
        axes[0].loglog(steps["steps"], np.minimum(steps[precision]["differences"], 10), "o-", ms=3, color=colour,
                       label=f"central differences, {precision}")
        analytic = [steps[precision][method] for method in METHODS]
        axes[0].axhspan(min(analytic), max(analytic), color=colour, alpha=0.4, label=f"analytic, all methods, {precision}")
    axes[0].set(xlabel="step", ylabel="relative L2 error", title=f"vertex gradients of a {steps['case']}, order {steps['order']}")
    axes[0].legend(fontsize=8, loc="lower right", bbox_to_anchor=(1, 0.07))
    names = list(dict.fromkeys(row["class"] for row in classes))
    for axis, precision in zip(axes[1:], PRECISIONS):
        for method, marker in zip(METHODS, "os^v"):
            errors = {row["class"]: row["max"] for row in classes if row["method"] == method and row["precision"] == precision}
            axis.semilogy(names, np.clip([errors[name] for name in names], 1e-17, 10), marker, ms=5, alpha=0.8, label=method)
        for limited, group, limit in LIMITS:
            where = [k for k, name in enumerate(names) if (name in GENERIC if group == "generic" else name.startswith(group))]
            if limited == precision:
                axis.plot(where, [limit] * len(where), "k_", ms=12, label="promised of auto" if group == "generic" else None)
        axis.set(title=f"vertex gradients of the reference polygons, {precision}", ylabel="largest relative L2 error")
        axis.tick_params(axis="x", rotation=90)
        axis.grid(True, axis="y", alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def print_report(images: list, classes: list, lines: list) -> None:
    print("Derivatives with respect to the shading point, [W20] Fig. 6: largest difference / largest derivative")
    print(f"{'l, m':>7s} {'axis':>4s} {'method':10s} | differences, step {PAPER_STEP:g} | fourth order | float32")
    for row in images:
        print(f"{row['l']:3d}, {row['m']:2d} {row['axis']:>4s} {row['method']:10s} | {row['from_differences']:23.1e} | "
              f"{row['from_fourth_order']:12.1e} | {row['float32']:7.1e}")
    print("\nVertex gradients of the reference polygons: largest relative L2 error of a class, float32 float64")
    print(f"{'class':14s} " + " ".join(f"{method:>17s}" for method in METHODS))
    found = {(row["class"], row["method"], row["precision"]): row["max"] for row in classes}
    for name in dict.fromkeys(row["class"] for row in classes):
        print(f"{name:14s} " + " ".join(" " + " ".join(f"{found[name, method, p]:8.1e}" for p in PRECISIONS) for method in METHODS))
    print_targets(lines)


def main(arguments=None) -> None:
    options = experiment.options(
        __doc__, arguments, size={"type": int, "default": 64, "help": "pixels along a side of the images (default: %(default)s)"},
        order={"type": int, "default": 14, "help": "of the classes, at most 14 (default: %(default)s)"})
    cases, size, order, steps = reference.reference_cases(), options.size, options.order, STEPS
    if options.quick:
        cases, size, order, steps = [case for case in cases if len(case.vertices) == QUICK_CORNERS], 16, 3, STEPS[::4]
    images = measure_images(size)
    steps = measure_steps(next(case for case in cases if case.name == "quad"), min(order, STEP_ORDER), steps)
    rows, classes = image_errors(images), measure_classes(cases, order)
    lines = targets(classes)
    print_report(rows, classes, lines)
    plot_images(images, options.out / "gradients.png")
    plot_accuracy(steps, classes, options.out / "gradients_accuracy.png")
    report = {"size": size, "step": PAPER_STEP, "order": order, "targets": lines, "images": rows, "steps": steps, "classes": classes}
    experiment.write(options.out / "gradients.json", report, options.quick)


if __name__ == "__main__":
    main()
