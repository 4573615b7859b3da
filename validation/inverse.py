"""Claim: the example of inverse rendering finds a light from ten random starts; how Mitsuba's own gradients fare in the same time.

    python -m validation.inverse [--quick] [--out DIR] [--starts N] [--rivals N] [--iterations N]

runs ``scenes/inverse_rendering.py`` for the rectangle and the pentagon from `starts` random starts, then from the first `rivals` of them
the same optimisation by ``direct_projective`` (``guiding`` none), which takes as many steps as fit into the time `shprt` took; steps are
timed in the same run, one thread.
Steps of `shprt` are replayed by `dr.freeze`; Mitsuba refuses that for its projective integrators, whose steps are traced anew (two fifths
of their time). It writes ``inverse.json``, ``inverse_convergence.png`` and, for the start that ended as the median,
``inverse_rectangle.png`` and ``inverse_pentagon.png``.

A start has found the light if the centre is within 2 % of its distance from the scene. Size and radiance of a light show in the
penumbras only, and what the picture tells for certain is their product: both are in the table, and so is the product.

The pentagon's corners need not be found: half a turn in its plane moves them by a fifth of the light's distance, but changes the loss by
less than 1 % of itself at order 8, even with 16 samples of 128 rays per pixel. The picture does not tell such outlines apart.
"""
from __future__ import annotations

import importlib.util
import time

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

from mi_shlight.files import replacing  # noqa: E402
from validation import experiment  # noqa: E402
from validation.experiment import ROOT  # noqa: E402

PROBLEMS = ("rectangle", "pentagon")
FOUND = 0.02
"""Largest error of the centre, in parts of its distance."""

RESOLUTION, ORDER = 64, 8
SPP = {"shprt": 4, "direct_projective": 16}
"""Samples per pixel of a step; for `direct_projective` the best of 4, 16, 64 and 256 at equal time (rectangle, start 2)."""

TIMED_STEPS = 4
MAX_STEPS = 1000
FIGURES = ("centre", "angle", "area", "radiance", "power", "corners")


def load_example():
    """The example script as a module: scenes/ is no package."""
    spec = importlib.util.spec_from_file_location("inverse_rendering", ROOT / "scenes" / "inverse_rendering.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def integrators() -> dict:
    """Mitsuba's integrator by the name of each method; None: the scene's own `shprt`."""
    boundary = {"sppc": SPP["direct_projective"], "sppp": 0, "sppi": SPP["direct_projective"]}     # the camera sees no edge that moves
    return {"shprt": None, "direct_projective": mi.load_dict({"type": "direct_projective", "guiding": "none", **boundary})}


def follow(example, problem, start, method, iterations) -> dict:
    """One optimisation: errors of the light and time at each step, and pictures before and after."""
    scene, truth, target = problem
    true_outline = truth.outline(truth.start)
    start.apply(start.start, mi.traverse(scene))
    before = np.array(mi.render(scene, spp=64))
    track = {"loss": [], "seconds": [], **{figure: [] for figure in FIGURES}}
    begin = time.perf_counter()
    projective = method == "direct_projective"
    for loss, *found in example.optimise(scene, start, target, integrators()[method], iterations=iterations, spp=SPP[method],
                                         resample=projective, freeze=not projective):
        track["seconds"].append(time.perf_counter() - begin)
        track["loss"].append(float(loss))
        for figure, value in example.light_errors(found, true_outline).items():
            track[figure].append(value)
    return {"track": track, "pictures": {"before": before, "after": np.array(mi.render(scene, spp=64))}}


def steps_in(example, problem, start, method, seconds) -> int:
    """How many steps of a method fit into a time, from a few that are timed after those that compile."""
    track = follow(example, problem, start, method, 2 * TIMED_STEPS)["track"]["seconds"]
    return int(np.clip(seconds * TIMED_STEPS / (track[-1] - track[TIMED_STEPS - 1]), 2, MAX_STEPS))


def verdict(track) -> dict:
    """Figures of the last step, and whether the light was found."""
    last = {figure: track[figure][-1] for figure in FIGURES}
    return {"found": bool(last["centre"] <= FOUND), "steps": len(track["loss"]), "seconds": track["seconds"][-1], "loss": track["loss"][-1],
            **last}


def run(problems, starts: int, rivals: int, iterations: int, resolution: int = RESOLUTION, order: int = ORDER) -> tuple:
    """(report, tracks by problem and method, pictures by problem)."""
    example = load_example()
    report, tracks, pictures = {}, {}, {}
    for name in problems:
        problem = example.set_up(name, resolution, order)
        scene, truth, target = problem
        lights = [example.random_start(truth, scene, np.random.default_rng(seed)) for seed in range(starts)]
        steps_in(example, problem, lights[0], "shprt", 1)           # compiles
        tracks[name], runs = {}, {}
        for method in SPP:
            if method == "shprt":
                steps = iterations
            else:
                seconds = np.median([r["track"]["seconds"][-1] for r in runs["shprt"]])
                steps = steps_in(example, problem, lights[0], method, seconds)
            runs[method] = []
            for seed, light in enumerate(lights if method == "shprt" else lights[:rivals]):
                runs[method].append(follow(example, problem, light, method, steps))
                print(f"{name} {method} start {seed}: {describe(verdict(runs[method][-1]['track']))}", flush=True)
            tracks[name][method] = [r["track"] for r in runs[method]]
        report[name] = {method: [verdict(track) for track in tracks[name][method]] for method in SPP}
        middle = int(np.argsort([entry["centre"] for entry in report[name]["shprt"]])[(starts - 1) // 2])
        pictures[name] = {**runs["shprt"][middle]["pictures"], "target, path traced": np.array(target)}
    return report, tracks, pictures


def describe(entry) -> str:
    return (f"{'found' if entry['found'] else 'MISSED'}: centre {entry['centre']:.2%}, normal {entry['angle']:.1f} degrees, area "
            f"{entry['area']:+.1%}, radiance {entry['radiance']:.1%}, power {entry['power']:+.2%}, corners {entry['corners']:.1%}; "
            f"{entry['steps']} steps in {entry['seconds']:.1f} s")


def draw_convergence(tracks, path) -> None:
    """Error of the light's centre over time, all starts of both methods, and their median in bold."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (problem, methods) in zip(figure.subplots(1, len(tracks), sharey=True, squeeze=False)[0], tracks.items()):
        for colour, (method, runs) in zip(("C0", "C1"), methods.items()):
            for track in runs:
                axes.semilogy(track["seconds"], track["centre"], color=colour, alpha=0.3, linewidth=0.8)
            common = [np.median(values) for values in zip(*(track["seconds"] for track in runs))]
            middle = [np.median(values) for values in zip(*(track["centre"] for track in runs))]
            label = f"{method}, {len(common)} steps, {SPP[method]} spp"
            axes.semilogy(common, middle, color=colour, linewidth=2.5, label=label)
        axes.axhline(FOUND, color="0.4", linestyle=":")
        axes.set_title(problem)
        axes.set_xlabel("seconds")
        axes.legend()
    figure.axes[0].set_ylabel("error of the light's centre / its distance")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def main(arguments=None) -> None:
    options = experiment.options(
        __doc__, arguments, starts={"type": int, "default": 10, "help": "random starts of each problem (default: %(default)s)"},
        rivals={"type": int, "default": 4, "help": "of them also by direct_projective (default: %(default)s)"},
        iterations={"type": int, "default": 240, "help": "steps of shprt (default: %(default)s)"})
    dr.set_thread_count(1)
    found = run(PROBLEMS[:1], 1, 1, 2, 16, 2) if options.quick else run(PROBLEMS, options.starts, options.rivals, options.iterations)
    write(*found, options)


def targets(summary: dict) -> list:
    """Verdicts on the starts from which `shprt` found the light."""
    return [experiment.verdict(f"{name}: starts of {methods['shprt']['of']} from which shprt finds the light", methods["shprt"]["found"],
                               methods["shprt"]["of"], at_most=False) for name, methods in summary.items()]


def write(report, tracks, pictures, options) -> None:
    """Write what :py:func:`run` gave, and print the summary."""
    summary = {name: {method: {"found": sum(e["found"] for e in entries), "of": len(entries),
                               **{f"median {figure}": float(np.median(np.abs([e[figure] for e in entries]))) for figure in FIGURES}}
                      for method, entries in methods.items()} for name, methods in report.items()}
    lines = targets(summary)
    content = {"targets": lines, "settings": {"resolution": RESOLUTION, "order": ORDER, "spp": SPP, "found": FOUND}, "summary": summary,
               "starts": report}
    experiment.write(options.out / "inverse.json", content, options.quick)
    draw_convergence(tracks, options.out / "inverse_convergence.png")
    for name, shown in pictures.items():
        load_example().draw(options.out / f"inverse_{name}.png", shown)
    for name, methods in summary.items():
        for method, entry in methods.items():
            print(f"{name}, {method}: {entry['found']} of {entry['of']} found; median error of the centre {entry['median centre']:.2%}")
    experiment.print_targets(lines)


if __name__ == "__main__":
    main()
