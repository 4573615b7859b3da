"""Claim: method ``auto`` keeps float32 accurate where the closed forms cancel; how its rule was found, and what it leaves.

    python -m validation.stability [--quick] [--out DIR] [--order N] [--lanes N]

writes ``stability.json`` and ``stability.png``:

- **sweeps**: error in float32 over distance, grazing gap, width of a sliver, and distance from the light's surface; largest over
  random lights in random orientation. Relative L2 over all coefficients.
- **cancellation**: error of each method against perimeter / solid angle as seen from the point, for points spread evenly in the
  logarithm of height over the plane of the light and of distance from its border, inside and outside. The law behind
  ``prefers_cubature``: a boundary form errs by eps times this ratio.
- **nodes**: for the same lights in float64, the error of the cubature with the numbers of nodes that it chooses, over the error
  asked for. Behind WIDE_S, WIDE_T, MISMATCH and HOPELESS_* in light/quadrature.py.

The oracle is ``auto`` in float64 of the same float32 vertices: within 1e-9 of 60-digit arithmetic on every class of the reference set
(tests/light/test_project.py).
"""
from __future__ import annotations

import drjit as dr
import matplotlib
import numpy as np
from drjit.llvm.ad import Array3f, Array3f64, Float, Float64

from mi_shlight.light.polygon import VertexList, interior_direction
from mi_shlight.light.project import METHODS, MAX_ERROR, project_light
from mi_shlight.light.quadrature import demand, project_quadrature
from validation import experiment

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

COLOURS = {"auto": "black", "edge": "tab:blue", "recurrence": "tab:orange", "quadrature": "tab:green"}
BINS = np.array([1, 10, 66, 300, 1e3, 1e4, 1e5, 1e6, 1e8])
REQUESTED = (1e-3, 4e-6, 1e-10)


def rotations(rng, count: int) -> np.ndarray:
    q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return q * np.linalg.det(q)[:, None, None]


def seen(rng, outline: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Polygons (lanes, N, 2 or 3) as seen from x (lanes, 3): turned at random, rounded to float32."""
    outline = np.concatenate([outline, np.zeros((*outline.shape[:2], 3 - outline.shape[2]))], axis=2)
    return np.einsum("lij,lnj->lni", rotations(rng, len(x)), outline - x[:, None]).astype(np.float32)


def quads(rng, count: int) -> np.ndarray:
    """Convex quadrilaterals on the unit circle, (count, 4, 2)."""
    angle = (np.arange(4) + rng.uniform(-0.35, 0.35, (count, 4))) * (np.pi / 2)
    return np.stack([np.cos(angle), np.sin(angle)], axis=2)


def distances(rng, count, distance):
    direction = rotations(rng, count)[:, 0]
    direction[:, 2] = np.where(abs(direction[:, 2]) < 0.1, 0.5, direction[:, 2])
    return seen(rng, quads(rng, count), direction / np.linalg.norm(direction, axis=1, keepdims=True) * distance)


def grazing(rng, count, gap):
    azimuth = rng.uniform(0, 2 * np.pi, count)
    return seen(rng, quads(rng, count), np.stack([2.5 * np.cos(azimuth), 2.5 * np.sin(azimuth), np.full(count, gap)], axis=1))


def slivers(rng, count, width):
    outline = quads(rng, count)[:, :3] * [1, width]
    return seen(rng, outline, rotations(rng, count)[:, 0] * 1.5)


def surfaces(rng, count, gap):
    inside = rng.uniform(-0.15, 0.15, (count, 2))
    return seen(rng, quads(rng, count), np.concatenate([inside, np.full((count, 1), gap)], axis=1))


SMALL = 10.0 ** np.arange(-7, 0.1, 0.5)
SWEEPS = {"distance in sizes": (distances, 10.0 ** np.arange(0, 6.5, 0.5)), "gap, light seen edge-on": (grazing, SMALL),
          "width of a sliver": (slivers, SMALL), "height over the light": (surfaces, SMALL[2:])}


def around_the_border(rng, count: int, corners: int) -> np.ndarray:
    angle = np.sort(rng.uniform(0, 2 * np.pi, (count, corners)), axis=1)
    outline = np.stack([np.cos(angle), np.sin(angle) * 10 ** rng.uniform(-2, 0, (count, 1))], axis=2)
    edge = rng.integers(0, corners, count)
    a, b = outline[np.arange(count), edge], outline[np.arange(count), (edge + 1) % corners]
    along = b - a
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    sideways = rng.choice([-1, 1], (count, 1)) * 10 ** rng.uniform(-4, 0.7, (count, 1))
    foot = a + rng.uniform(-0.2, 1.2, (count, 1)) * along + sideways * outward
    return seen(rng, outline, np.concatenate([foot, 10 ** rng.uniform(-6, 0.7, (count, 1))], axis=1))


def light_of(polygons: np.ndarray, kind) -> tuple:
    number = Float if kind is Array3f else Float64
    column = lambda k, c: number(polygons[:, k, c].tolist())      # not NumPy's memory, whose alignment compiles kernels of its own
    vertices, x = [kind(*(column(k, c) for c in range(3))) for k in range(polygons.shape[1])], kind(0)
    dr.make_opaque(vertices, x)
    return VertexList(vertices), x, interior_direction(vertices, x)


def coefficients(polygons: np.ndarray, kind, order: int, method: str) -> np.ndarray:
    light, x, apex = light_of(polygons, kind)
    values = project_light(light, x, apex, order, method)
    dr.eval(values)
    return np.array([np.array(v, dtype=float) for v in values])


def relative(values: np.ndarray, exact: np.ndarray) -> np.ndarray:
    return np.linalg.norm(values - exact, axis=0) / np.linalg.norm(exact, axis=0)


def errors(polygons: np.ndarray, order: int) -> dict:
    exact = coefficients(polygons, Array3f64, order, "auto")
    return {method: relative(coefficients(polygons, Array3f, order, method), exact) for method in METHODS}


def cancellation(polygons: np.ndarray, order: int) -> np.ndarray:
    """Perimeter over solid angle as seen from the origin."""
    unit = polygons / np.linalg.norm(polygons.astype(float), axis=2, keepdims=True)
    perimeter = np.linalg.norm(unit - np.roll(unit, 1, axis=1), axis=2).sum(axis=1)
    return perimeter / abs(coefficients(polygons, Array3f64, 0, "auto")[0] * np.sqrt(4 * np.pi))


def node_errors(polygons: np.ndarray, order: int, requested: float) -> dict:
    """Quantiles of (error / error asked for) where the cubature holds its nodes to be enough."""
    light, x, _ = light_of(polygons, Array3f64)
    values, need = project_quadrature(light, x, order, requested), demand(light, x, order, requested)
    dr.eval(values, need)
    exact = coefficients(polygons, Array3f64, order, "edge")
    # the edge form is the judge here, so leave out what it cannot judge
    judged = np.array(need.enough) & np.array(need.possible) & (1e-16 * cancellation(polygons, order) < 0.1 * requested)
    ratio = relative(np.array([np.array(v) for v in values])[1:], exact[1:])[judged] / requested
    return {"lights": int(judged.sum()), "points_median": float(np.median(np.array(need.points)[judged])),
            **{f"quantile_{q:g}": float(np.quantile(ratio, q)) for q in (0.5, 0.99, 0.999, 1)}}


def main(arguments=None) -> None:
    options = experiment.options(
        __doc__, arguments, order={"type": int, "default": 8},
        lanes={"type": int, "default": 20000, "help": "random lights per number of corners (default: %(default)s)"})
    sweeps, corners, asked = SWEEPS, (3, 4, 12), REQUESTED
    if options.quick:
        options.order, options.lanes, corners, asked = 2, 500, (4,), REQUESTED[:1]
        sweeps = {name: (generate, values[::4]) for name, (generate, values) in SWEEPS.items() if generate is not slivers}
    rng = np.random.default_rng(1)
    report = {"order": options.order, "max_error": MAX_ERROR[0], "sweeps": {}, "cancellation": {}, "nodes": {}}
    figure, axes = plt.subplots(2, 3, figsize=(15, 8), layout="constrained")

    for (name, (generate, values)), axis in zip(sweeps.items(), axes.flat):
        rows = {method: [] for method in METHODS}
        for value in values:
            for method, error in errors(generate(rng, 1 + options.lanes // 20, value), options.order).items():
                rows[method].append(float(error.max()))
        report["sweeps"][name] = {"values": values.tolist(), **rows}
        for method, row in rows.items():
            axis.loglog(values, np.clip(row, 1e-8, 10), color=COLOURS[method], label=method, lw=3 if method == "auto" else 1.5)
        axis.axhline(MAX_ERROR[0], color="grey", ls=":")
        axis.set(xlabel=name, ylabel="largest relative error, float32", ylim=(1e-8, 10))
    axes.flat[0].legend()

    polygons = {n: around_the_border(rng, options.lanes, n) for n in corners}
    judged = [(cancellation(p, options.order), errors(p, options.order)) for p in polygons.values()]
    ratio = np.concatenate([r for r, _ in judged])
    for method in METHODS:
        error = np.concatenate([e[method] for _, e in judged])
        rows = []
        for low, high in zip(BINS, BINS[1:]):
            part = error[(ratio >= low) & (ratio < high) & np.isfinite(error)]
            rows.append({"from": low, "to": high, "lights": len(part),
                         **{f"quantile_{q:g}": float(np.quantile(part, q)) if len(part) else None for q in (0.5, 0.99, 1)}})
        report["cancellation"][method] = rows
        filled = [r for r in rows if r["lights"]]
        centre = [np.sqrt(r["from"] * r["to"]) for r in filled]
        axes.flat[4].loglog(centre, [r["quantile_0.5"] for r in filled], color=COLOURS[method], lw=3 if method == "auto" else 1.5)
        axes.flat[4].loglog(centre, [r["quantile_0.99"] for r in filled], color=COLOURS[method], ls="--")
    axes.flat[4].loglog(BINS, 2.0 ** -24 * BINS, color="grey", ls=":")
    axes.flat[4].set(xlabel="perimeter / solid angle, near the border", ylabel="error: median, 99 % (dashed), eps x (dotted)",
                     ylim=(1e-8, 10))

    for requested in asked:
        rows = {str(n): node_errors(p, options.order, requested) for n, p in polygons.items()}
        report["nodes"][f"{requested:g}"] = rows
        quantiles = ("quantile_0.5", "quantile_0.99", "quantile_0.999", "quantile_1")
        worst = [max(row[q] for row in rows.values()) for q in quantiles]
        axes.flat[5].semilogy([q[9:] for q in quantiles], worst, marker="o", label=f"asked for {requested:g}")
    axes.flat[5].axhline(1, color="grey", ls=":")
    axes.flat[5].set(xlabel="quantile", ylabel="error of the cubature / error asked for")
    axes.flat[5].legend()

    figure.savefig(options.out / "stability.png", dpi=100)
    plt.close(figure)
    report["targets"] = [experiment.verdict(f"auto, float32, over {name}: largest error at most 2e-5", max(sweep["auto"]), 2e-5)
                         for name, sweep in report["sweeps"].items()]
    experiment.write(options.out / "stability.json", report, options.quick)
    for name, sweep in report["sweeps"].items():
        print(name, *(f"{method} {max(sweep[method]):.1e}" for method in METHODS), sep="  ")
    for method, rows in report["cancellation"].items():
        print(method, *(f"{r['from']:g}: {r['quantile_0.5']:.1e} {r['quantile_0.99']:.1e}" for r in rows if r["lights"]), sep="  ")
    for requested, rows in report["nodes"].items():
        print("asked", requested, *(f"{n} corners: {r['quantile_0.99']:.1e} {r['quantile_1']:.1e}" for n, r in rows.items()), sep="  ")
    experiment.print_targets(report["targets"])


if __name__ == "__main__":
    main()
