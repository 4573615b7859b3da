"""Claim: ``auto`` is accurate wherever a light may be: near and far, edge-on, thin, at any scale; what is left, and where, in pictures.

    python -m validation.stability_maps [--quick] [--out DIR]

writes ``stability_maps.json`` and, as pictures, ``stability_maps_float32.png``, ``stability_maps_float64.png`` (coefficients) and
``stability_maps_gradients.png`` (derivatives by the vertices, float32); prints the worst of every map and the list of targets. Exit
status 1 if a result was not finite; a missed target is a result.

**Maps**: relative L2 error over all coefficients, and over the derivatives of all of them by all vertices; order 8, and coefficients in
float32 also at order 14, without pictures. Lights are random triangles of diameter 1 in random orientation. Their corners relative to
the point are rounded to the precision under test, and that is the light: nothing but the method errs, and the light is flat to the
last bit.

- *distance and angle*: distance from the light, against the sine of the direction's angle with the light's plane, 1 in front of it.
  Nearer than half a size the point is over the light.
- *sliver*: distance against the width of a light of length 1, in directions at least 6 degrees out of its plane.
- *border*: height over the plane against distance from an edge's line, on either side and up to a fifth beyond the edge's ends.
- *scale*: unit of length, 1e-30 to 1e30, against distance. Derivatives beyond 1e-30 and 1e30 per unit of length are left out.

In float32 each cell has LIGHTS lights and shows the worst, judged by float64: ``auto`` for coefficients, ``edge`` for derivatives. In
float64 each cell has one light, judged by 50-digit arithmetic (``tests.reference``): these maps also say how far the judge of the
others can be trusted. The first column of the pictures is the closed form alone, what ``auto`` would be without its rule; the second is
``auto``; the last is where it takes the cubature.

**Law**: the absolute error of the closed form over ``eps sum 2 tan(T / 2)``, T the angles under which the edges are seen and eps half the
spacing of numbers at 1.

**Regret**: share of the lights for which ``auto`` misses its aim and errs by more than ten times the better of ``edge`` and ``quadrature``.

**Limits**: the point exactly in the light's plane, inside and outside, on an edge, on a corner, in line with an edge, in sizes of 2^-100, 1
and 2^100: solid angle, and whether all coefficients and derivatives are finite.
"""
from __future__ import annotations

import sys
from typing import NamedTuple

import drjit as dr
import matplotlib
import numpy as np
from drjit.llvm.ad import Array3f64

from mi_shlight.light.polygon import VertexList
from mi_shlight.light.project import METHODS, default_error, prefers_cubature
from tests import reference
from validation import experiment
from validation.gradients import PRECISIONS, coefficients, corners_of, vertex_gradients
from validation.stability import rotations

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

LIGHTS = {"float32": 16, "float64": 1}
"""Of a cell."""
DTYPES = {"float32": np.float32, "float64": np.float64}
DIGITS = 50
ORDERS = (8, 14)
COLUMNS = ("edge", "auto", "recurrence", "quadrature")
LARGEST_SLOPE = 1e30
ACCURATE = {"float32": 1e-5, "float64": 1e-11}
"""Relative error of coefficients up to which a cell counts as accurate."""
ACCURATE_SLOPES = {"float32": 5e-6, "float64": 1e-14}
"""The same of derivatives."""
LAW = lambda order: max(4, 0.6 * (order + 1))
REGRET = 0.01


# The lights.

class Family(NamedTuple):
    """Lights over two parameters: ``lights(rng, row, column)`` makes triangles (lanes, 3, 3) seen from the origin of an array of each."""

    lights: object
    row: str
    rows: np.ndarray
    column: str
    columns: np.ndarray


def decades(low: float, high: float, step: float = 0.5) -> np.ndarray:
    return 10.0 ** np.arange(low, high + step / 2, step)


def triangles(rng, count: int) -> np.ndarray:
    """Corners (count, 3, 3) on the circle of diameter 1 in the plane z = 0, at least 60 degrees apart."""
    angle = (np.arange(3) + rng.uniform(-0.25, 0.25, (count, 3))) * (2 * np.pi / 3)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=2) / 2


def turned(rng, corners: np.ndarray) -> np.ndarray:
    return np.einsum("lij,lnj->lni", rotations(rng, len(corners)), corners)


def directions(rng, sine: np.ndarray) -> np.ndarray:
    """Unit vectors (lanes, 3) whose angle with the plane z = 0 has this sine, on either side."""
    azimuth, flat = rng.uniform(0, 2 * np.pi, len(sine)), np.sqrt(1 - sine ** 2)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), sine * rng.choice([-1, 1], len(sine))], axis=1)


def distance_and_angle(rng, distance, sine):
    return turned(rng, triangles(rng, len(sine)) - (distance[:, None] * directions(rng, sine))[:, None])


def sliver(rng, distance, width):
    outline = triangles(rng, len(width))
    outline[..., 1] *= width[:, None]
    return turned(rng, outline - (distance[:, None] * directions(rng, rng.uniform(0.1, 1, len(width))))[:, None])


def border(rng, height, sideways):
    outline = triangles(rng, len(height))
    a, along = outline[:, 0], outline[:, 1] - outline[:, 0]
    outward = np.cross(along, [0, 0, 1]) / np.linalg.norm(along, axis=1, keepdims=True)
    side, up = rng.choice([-1, 1], (2, len(height), 1))
    foot = a + rng.uniform(-0.2, 1.2, (len(height), 1)) * along + side * sideways[:, None] * outward
    return turned(rng, outline - (foot + up * height[:, None] * [0, 0, 1])[:, None])


def scaled(rng, unit, distance):
    return unit[:, None, None] * distance_and_angle(rng, distance, rng.uniform(0.1, 1, len(unit)))


FAMILIES = {
    "distance and angle": Family(distance_and_angle, "distance", decades(-2, 6), "sine of the angle with the plane", decades(-6, 0)),
    "sliver": Family(sliver, "distance", decades(-6, 4), "width", decades(-6, 0)),
    "border": Family(border, "height over the plane", decades(-6, 0), "distance from the border", decades(-6, 0)),
    "scale": Family(scaled, "unit of length", decades(-30, 30, 5), "distance", decades(-2, 6, 1)),
}
QUICK_FAMILIES = {name: family._replace(rows=family.rows[::4], columns=family.columns[::4]) for name, family in FAMILIES.items()}


def lights_of(family: Family, precision: str, per_cell: int) -> np.ndarray:
    """Triangles (rows * columns * per_cell, 3, 3), in float64, of numbers of this precision."""
    row, column = np.meshgrid(family.rows, family.columns, indexing="ij")
    polygons = family.lights(np.random.default_rng(1), np.repeat(row, per_cell), np.repeat(column, per_cell))
    return polygons.astype(DTYPES[precision]).astype(np.float64)


def reach(polygons: np.ndarray) -> np.ndarray:
    """``sum 2 tan(T / 2)`` over the angles T under which the edges are seen."""
    unit = polygons / np.linalg.norm(polygons, axis=2, keepdims=True)
    after = np.roll(unit, -1, axis=1)
    return (2 * np.tan(np.arctan2(np.linalg.norm(np.cross(unit, after), axis=2), (unit * after).sum(axis=2)) / 2)).sum(axis=1)


def from_one_size(family: Family) -> np.ndarray:
    """Mask of the cells (rows, columns) whose lights are no nearer than their size."""
    far = lambda name, values: (values >= 1) & (name == "distance")
    return far(family.row, family.rows)[:, None] | far(family.column, family.columns)


# Their errors.

class Computed(NamedTuple):
    """Coefficients (lanes, C) and derivatives (lanes, 3, 3, C) of lights by method, and where ``auto`` takes the cubature (lanes,)."""

    coefficients: dict
    gradients: dict
    cubature: np.ndarray


def compute(polygons: np.ndarray, kind, order: int, methods=METHODS, gradients=METHODS) -> Computed:
    vertices, x = corners_of(polygons, kind), kind(0)
    dr.make_opaque(x)
    cubature = prefers_cubature(VertexList(vertices), x, order, default_error(x))
    return Computed({method: coefficients(vertices, x, order, method) for method in methods},
                    {method: vertex_gradients(vertices, x, order, method) for method in gradients}, np.array(cubature))


def exact_of(polygons: np.ndarray, order: int) -> tuple:
    """Coefficients and derivatives in DIGITS-digit arithmetic."""
    values = [reference.edge_moments_mp(polygon, (0, 0, 0), order, DIGITS) for polygon in polygons]
    return np.array([v[0] for v in values]), np.array([reference.expand_gradients(*v[1:]) for v in values])


def norms(values: np.ndarray) -> np.ndarray:
    """L2 norm of each lane; NaN if a number is not finite."""
    values = values.reshape(len(values), -1)
    return np.where(np.isfinite(values).all(axis=1), np.linalg.norm(values, axis=1), np.nan)


class Maps(NamedTuple):
    """What one family gave in one precision and order."""

    family: str
    precision: str
    order: int
    coefficients: dict
    """Relative errors by method (rows, columns, lights); NaN where not finite."""
    gradients: dict
    """The same of derivatives; 0 where left out. Empty if not asked for."""
    cubature: np.ndarray
    """Share of lights (rows, columns) for which ``auto`` takes it."""
    law: float
    regret: float


def measure(name: str, family: Family, precision: str, order: int, per_cell: int, gradients=METHODS) -> Maps:
    polygons, kind = lights_of(family, precision, per_cell), PRECISIONS[precision]
    found = compute(polygons, kind, order, gradients=gradients)
    if precision == "float32":
        judge = compute(polygons, Array3f64, order, ("auto",), ("edge",) if gradients else ())
        exact, slopes = judge.coefficients["auto"], judge.gradients.get("edge")
    else:
        exact, slopes = exact_of(polygons, order)
    cells = lambda lanes: lanes.reshape(len(family.rows), len(family.columns), per_cell)
    absolute = {method: norms(values - exact) for method, values in found.coefficients.items()}
    errors = {method: values / norms(exact) for method, values in absolute.items()}
    law = absolute["edge"] / (np.finfo(DTYPES[precision]).eps / 2 * reach(polygons))
    regret = errors["auto"] > 10 * np.fmax(np.fmin(errors["edge"], errors["quadrature"]), default_error(kind(0)[0]))
    slope_errors = {}
    for method, values in found.gradients.items():
        size, error = norms(slopes), norms(values - slopes)
        told = (size > 1 / LARGEST_SLOPE) & (size < LARGEST_SLOPE) | np.isnan(error)
        slope_errors[method] = cells(np.where(told, error / size, 0))
    return Maps(name, precision, order, {method: cells(values) for method, values in errors.items()}, slope_errors,
                cells(found.cubature).mean(axis=2), np.fmax.reduce(law), regret.mean())


def summary(family: Family, lights: np.ndarray, accurate: float) -> dict:
    """Of errors (rows, columns, lights): worst and where, worst from one size away, median and share above `accurate` over the cells."""
    worst, far = np.fmax.reduce(lights, axis=2), from_one_size(family)               # fmax: of the lights that are finite
    row, column = np.unravel_index(np.argmax(np.nan_to_num(worst)), worst.shape)
    return {"max": worst[row, column], "at": {family.row: family.rows[row], family.column: family.columns[column]},
            "max_from_one_size": np.fmax.reduce(worst[far]) if far.any() else None, "median": np.median(worst),
            "above": (worst > accurate).mean(), "not_finite": int(np.isnan(lights).sum())}


# Exactly in the plane.

def limit_lights() -> dict:
    """Name -> triangles (lanes, 3, 3) seen from the origin, in two orientations and three sizes, exact in float32."""
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0]], dtype=float)
    turn = np.array([[2, -1, 2], [2, 2, -1], [-1, 2, 2]], dtype=float)                    # three times a rotation
    points = {"in the plane, outside": (3, 3, 0), "in line with an edge": (6, 0, 0), "in the plane, inside": (1, 1, 0),
              "on an edge": (1, 0, 0), "on a corner": (0, 0, 0)}
    return {name: np.array([size * (corners - x) @ matrix for matrix in (np.eye(3), turn) for size in (2.0 ** -100, 1, 2.0 ** 100)])
            for name, x in points.items()}


def measure_limits(order: int) -> list:
    """Rows (point, precision, method, largest absolute solid angle, lights that are not finite)."""
    lights, rows = limit_lights(), []
    split = lambda lanes: np.split(lanes, len(lights))
    for precision, kind in PRECISIONS.items():
        found = compute(np.concatenate(list(lights.values())), kind, order)
        for method in METHODS:
            finite = np.isfinite(norms(found.coefficients[method])) & np.isfinite(norms(found.gradients[method]))
            angle = abs(found.coefficients[method][:, 0]) * np.sqrt(4 * np.pi)
            rows += [{"point": name, "precision": precision, "method": method, "solid_angle": angles.max(),
                      "not_finite": int((~good).sum())} for name, angles, good in zip(lights, split(angle), split(finite))]
    return rows


# The report.

def rows_of(families: dict, results: list) -> list:
    """A row per family, precision, order, quantity and method: its summary."""
    return [{"family": maps.family, "precision": maps.precision, "order": maps.order, "quantity": quantity, "method": method,
             **summary(families[maps.family], lights, accurate[maps.precision])}
            for maps in results for quantity, errors, accurate in (("coefficients", maps.coefficients, ACCURATE),
                                                                   ("derivatives", maps.gradients, ACCURATE_SLOPES))
            for method, lights in errors.items()]


def targets(rows: list, results: list, limits: list) -> list:
    """Verdicts on what :py:func:`rows_of` and :py:func:`measure_limits` gave."""
    at_most = lambda target, value, limit: experiment.verdict(f"{target}: at most {limit:.3g}", value, limit)
    lines = []
    for precision, order in dict.fromkeys((maps.precision, maps.order) for maps in results):
        label, here = f"{precision}, order {order}", [row for row in rows if (row["precision"], row["order"]) == (precision, order)]
        auto = [row for row in here if row["method"] == "auto" and row["quantity"] == "coefficients"]
        far = [row["max_from_one_size"] for row in auto if row["max_from_one_size"] is not None]
        accurate, maps = ACCURATE[precision], [maps for maps in results if (maps.precision, maps.order) == (precision, order)]
        lines += [at_most(f"{label}, error of auto from one size away, at any angle, width and scale", max(far), accurate),
                  at_most(f"{label}, error of auto everywhere", max(row["max"] for row in auto), accurate),
                  at_most(f"{label}, share of lights of a family for which auto chose badly", max(m.regret for m in maps), REGRET),
                  at_most(f"{label}, absolute error of edge / (eps sum 2 tan(T / 2))", max(m.law for m in maps), LAW(order))]
        slopes = [row["max"] for row in here if row["quantity"] == "derivatives" and row["method"] != "recurrence"]
        if slopes:
            lines.append(at_most(f"{label}, error of vertex derivatives by auto, edge and quadrature, everywhere", max(slopes),
                                 ACCURATE_SLOPES[precision]))
    angle = max(row["solid_angle"] for row in limits)
    return lines + [at_most("lights with a result that is not finite", sum(row["not_finite"] for row in rows + limits), 0),
                    at_most("exactly in the plane, largest solid angle / (2 pi)", angle / (2 * np.pi), 1 + 1e-6)]


def decibels(lights: np.ndarray) -> list:
    """10 log10 of the worst of each cell, rounded; None where not finite or left out."""
    return [[round(10 * float(np.log10(v))) if v > 0 else None for v in row] for row in lights.max(axis=2)]


def plot(families: dict, results: list, quantity: str, path) -> None:
    """Maps of one precision and order: a row per family, a column per method; with those of coefficients, where ``auto`` takes cubature."""
    low, high = (1e-8, 1) if results[0].precision == "float32" else (1e-17, 1e-8)
    count = len(COLUMNS) + (quantity == "coefficients")
    figure, axes = plt.subplots(len(results), count, figsize=(3.3 * count, 3.3 * len(results)), layout="constrained", squeeze=False)
    colours = plt.get_cmap("viridis").with_extremes(bad="lightgrey")
    for row, maps in zip(axes, results):
        family = families[maps.family]
        places = np.log10(family.columns), np.log10(family.rows)
        for axis, method in zip(row, COLUMNS):
            worst = getattr(maps, quantity)[method].max(axis=2)
            image = axis.pcolormesh(*places, np.where(worst > 0, worst, np.nan), cmap=colours, norm=matplotlib.colors.LogNorm(low, high))
            axis.set_title(method, fontsize=10)
        figure.colorbar(image, ax=row[len(COLUMNS) - 1], extend="max", label=f"largest relative error, {maps.precision}")
        if count > len(COLUMNS):
            share = row[-1].pcolormesh(*places, maps.cubature, cmap="Greys", vmin=0, vmax=1)
            figure.colorbar(share, ax=row[-1], label="share of cubature in auto")
        for axis in row:
            axis.set_xlabel(f"log10 {family.column}", fontsize=8)
        row[0].set_ylabel(f"{maps.family}\nlog10 {family.row}")
    figure.savefig(path, dpi=70)
    plt.close(figure)


def print_report(rows: list, results: list, limits: list, lines: list) -> None:
    print("Largest relative L2 error, median over the cells, share of cells that are not accurate; from one size away: largest")
    for row in rows:
        far = "" if row["max_from_one_size"] is None else f"{row['max_from_one_size']:8.1e}"
        where = ", ".join(f"{name} {value:.2g}" for name, value in row["at"].items())
        print(f"{row['family']:18s} {row['precision']} order {row['order']:2d} {row['quantity']:12s} {row['method']:10s} "
              f"{row['max']:8.1e} {row['median']:8.1e} {row['above']:6.1%} {far:8s} worst at {where}")
    print("\nLaw and regret")
    for maps in results:
        print(f"{maps.family:18s} {maps.precision} order {maps.order:2d} {maps.law:6.2f} {maps.regret:6.1%}")
    print("\nExactly in the plane: largest solid angle, lights not finite")
    for row in limits:
        print(f"{row['point']:22s} {row['precision']} {row['method']:10s} {row['solid_angle']:8.4f} {row['not_finite']:3d}")
    experiment.print_targets(lines)


def main(arguments=None) -> int:
    options = experiment.options(__doc__, arguments)
    families, orders = (QUICK_FAMILIES, (3, 4)) if options.quick else (FAMILIES, ORDERS)
    sets = [("float32", orders[0], METHODS), ("float64", orders[0], METHODS), ("float32", orders[1], ())]
    results = []
    for precision, order, gradients in sets:
        for name, family in families.items():
            print(f"{name}, {precision}, order {order}", file=sys.stderr, flush=True)
            results.append(measure(name, family, precision, order, LIGHTS[precision], gradients))
    rows, limits = rows_of(families, results), measure_limits(orders[0])
    lines = targets(rows, results, limits)
    print_report(rows, results, limits, lines)

    shown = {precision: [m for m in results if m.precision == precision and m.order == orders[0]] for precision in LIGHTS}
    for precision, maps in shown.items():
        plot(families, maps, "coefficients", options.out / f"stability_maps_{precision}.png")
    plot(families, shown["float32"], "gradients", options.out / "stability_maps_gradients.png")
    axes = {name: {family.row: family.rows, family.column: family.columns} for name, family in families.items()}
    pictured = {"float32": ("coefficients", "gradients"), "float64": ("coefficients",)}
    maps = [{"family": m.family, "precision": precision, "order": m.order, "law": m.law, "regret": m.regret,
             "cubature": m.cubature.round(2),
             **{f"{quantity}_db": {method: decibels(lights) for method, lights in getattr(m, quantity).items()}
                for quantity in pictured[precision]}} for precision, rows_shown in shown.items() for m in rows_shown]
    experiment.write(options.out / "stability_maps.json", {"lights_per_cell": LIGHTS, "axes": axes, "targets": lines, "rows": rows,
                                                           "limits": limits, "maps": maps}, options.quick)
    return int(any(row["not_finite"] for row in rows + limits))


if __name__ == "__main__":
    sys.exit(main())
