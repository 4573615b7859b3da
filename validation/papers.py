"""What became of every figure and table of the three papers: command, our picture, verdict from the results of the experiments.

    python -m validation.papers [DIR]

prints the table in Markdown, from the JSON files in DIR (default validation/results).
"""
from __future__ import annotations

import argparse
import json
import pathlib
from typing import Callable, NamedTuple

from validation.experiment import RESULTS

W18, W20, G03 = "Wang and Ramamoorthi 2018", "Wu et al. 2020", "Green 2003"
NOTHING_MEASURED, MISSED = "not measured yet", " (missed)"


class Results(dict):
    """The JSON files of a folder by the names of their experiments, read when asked for."""

    def __init__(self, folder: pathlib.Path):
        super().__init__()
        self.folder = folder

    def __missing__(self, name: str) -> dict:
        self[name] = json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        return self[name]

    def measured(self, name: str, start: str) -> str:
        """Value of the target that begins with `start`, and whether it was met."""
        line = next(line for line in self[name]["targets"] if line["target"].startswith(start))
        return line["measured"] + ("" if line["met"] else MISSED)

    def find(self, name: str, *path: str, **keys) -> dict:
        """The first row with `keys` of the table at `path`."""
        rows = self[name]
        for step in path:
            rows = rows[step]
        return next(row for row in rows if keys.items() <= row.items())


class Row(NamedTuple):
    """A figure or table of a paper."""

    paper: str
    item: str
    shows: str
    verdict: Callable[[Results], str] | str
    """From the results; or why it is not reproduced."""
    command: str = ""
    pictures: tuple = ()
    reproduced: str = "yes"
    """yes, in part, no."""


def diagram(paper: str, item: str, shows: str, where: str) -> Row:
    return Row(paper, item, shows, f"A diagram, nothing to measure; what it explains is {where}.", reproduced="no")


def experiment(name: str, *only: str) -> str:
    return f"python -m validation.{name}" + (f" --only {' '.join(only)}" if only else "")


# Verdicts that take more than a line. Percentages are those of the experiments.

def integration(r: Results) -> str:
    sampled, cubature = r["wang"]["integration"]["rows"]
    return (f"At most one grey level: {sampled['grey_levels']} against {sampled['samples']:,} samples a point (scan line the same to "
            f"{sampled['scan_line']:.1e}); {cubature['grey_levels']} by cubature through shprt.")


def orders(r: Results) -> str:
    rows = r["wang"]["orders"]["rows"]
    show = lambda kind, key, text: ", ".join(format(row[key], text) for row in rows if row["transfer"] == kind)
    return (f"Shadows sharpen with every order: {show('projected', 'sharpness', '.0%')} of the contrast, error in shadow "
            f"{show('projected', 'in_shadow', '.1%')}. Localised transfer: {show('localised', 'in_shadow', '.1%')}.")


def linear(what: str) -> Callable:
    return lambda r: (f"Straight line, R² {r.measured('engine', f'recurrence: time linear in the number of {what}')} by the paper's "
                      f"recurrence, {r.measured('engine', f'edge: time linear in the number of {what}')} by edge.")


def frames(r: Results) -> str:
    rows = r["wang"]["frames"]["rows"]
    shown = "; ".join(f"{row['scene']} {row['frame_ms']:.0f} ms ({1e3 / row['published_fps']:.1f} ms)" for row in rows)
    first = rows[0]
    return (f"Whole frames on one core (theirs, on a GPU): {shown}. Coefficients by monomials take {first['monomial_over_recurrence']:.2f} "
            "times as long as by the recurrence, in the paper 2.5 to 3.8: not so on this CPU, see validation/baselines.py; by edge "
            f"{first['vertices_edge_ms'] / first['vertices_recurrence_ms']:.2f} times.")


def buddha_frame(r: Results) -> str:
    row = r.find("wang", "frames", "rows", scene="Buddha")
    return (f"Three polygons over {row['triangles']:,} triangles: {row['fps']:.1f} frames/s on one core; theirs {row['published_fps']} on "
            "a GPU.")


def edits(r: Results) -> str:
    rows = [row for row in r["wang"]["edits"]["rows"] if row["transfer"] == "projected"]
    return (f"{r.measured('wang', 'Fig. 8: bakes')} bake for all; error against path "
            + ", ".join(f"{row['light']} {row['pixels']:.1%}" for row in rows) + ".")


def environment(r: Results) -> str:
    return ("Error against path " + ", ".join(f"{row['picture']} {row['pixels']:.1%}" for row in r["wang"]["environment"]["rows"])
            + f"; turned coefficients are those of the turned map to {r.measured('wang', 'Fig. 9: the turned')}.")


def patterned(r: Results) -> str:
    rows = r["wang"]["patterned"]["rows"]
    red = rows[-1]["red"]
    return (f"Floor from red to blue, share of red {red[0]:.2f} to {red[-1]:.2f}, within {rows[-1]['red_apart']:.2g} of path; error "
            + ", ".join(f"{row['pixels']:.1%} with BSDFs to order {row['bsdf_order']}" for row in rows) + ".")


def on_line(r: Results) -> str:
    times = lambda place, other: r.measured("grid", f"[W20] Fig. 4, {place}: error of hermite at least 10 times below {other}")
    ratios = "; ".join(f"{place}, {times(place, 'trilinear')} times below trilinear, {times(place, 'taylor')} below Taylor"
                       for place in ("distance 2", "distance 1"))
    return f"Error of Hermite: {ratios}. The paper does not say at which."


def gradient_images(r: Results) -> str:
    rows = [row for row in r["gradients"]["images"] if (row["axis"], row["method"]) == ("x", "recurrence")]
    return ("Largest difference from central differences, of the largest derivative: "
            + ", ".join(f"({row['l']}, {row['m']}) {row['from_differences']:.1e}, from those of fourth order {row['from_fourth_order']:.1e}"
                        for row in rows) + ".")


def interpolation(r: Results) -> str:
    rows = {row["picture"]: row["mae"] for row in r["wu"]["interpolation"]["rows"]}
    return (f"Mean absolute error {1e3 * rows['hermite']:.2g}e-3 (the paper's Algorithm 4 {1e3 * rows['tricubic']:.2g}e-3), trilinear "
            f"{1e3 * rows['trilinear']:.2g}e-3, Taylor {1e3 * rows['taylor']:.2g}e-3: an order of magnitude.")


def light_counts(r: Results) -> str:
    start = "[W20] Fig. 8: time of hermite"
    return (f"All lights: linear, R² {r.measured('grid', '[W20] Fig. 8: exact')}. Grid with 512 lights over that with one: "
            f"{r.measured('grid', f'{start} with')}; {r.measured('grid', f'{start}, near lights exact')} with near lights exact.")


def resolutions(r: Results) -> str:
    rows = [row for row in r["grid"]["pictures"] if row["figure"] == "resolutions"]
    return "Mean absolute error " + ", ".join(f"{row['picture'].replace('grid ', '')} {row['mae']:.1e}" for row in rows) + "."


def against_exact(part: str, item: str, figure: str) -> Callable:
    def text(r: Results) -> str:
        rows = r["wu"][part]["rows"]
        worst = lambda name, key: max(row[key] for row in rows if row["picture"] == name)
        error = {name: r.measured("wu", f"{item}, {name}: mean absolute error") for name in ("grid", "near lights exact")}
        return (f"Against all lights, mean absolute error {error['grid']} by the grid alone, "
                f"{error['near lights exact']} with near lights exact ({figure}); {worst('near lights exact', 'path'):.1%} off "
                f"path, all lights {worst('exact', 'path'):.1%} (its noise {worst('exact', 'noise'):.1%}).")

    return text


def double_sided(r: Results) -> str:
    rows = [row for row in r["grid"]["pictures"] if row["figure"] == "double_sided"]
    return "8³ points blur, near lights exact do not: mean absolute error " + ", ".join(f"{row['mae']:.1e}" for row in rows) + "."


def table_1(r: Results) -> str:
    rows = [row for row in r["grid"]["variants"] if row["variant"] == "hermite"]
    return ("Over [W18] on one CPU thread (theirs on a GPU: 3943, 35, 3, 254, 387, 2252): "
            + ", ".join(f"{row['scene']} {row['speedup_w18']:.0f}x, error {row['mae']:.1e}" for row in rows) + ".")


def example_light(r: Results) -> str:
    return (f"All printed coefficients within {r.measured('green', 'Figs. 7, 8: printed coefficients, their size')} standard errors of the "
            "exact ones but for one slip of sign; one is not printed.")


def render(name: str) -> Callable:
    def text(r: Results) -> str:
        row = r["green"]["renders"]["pictures"][name]
        return (f"{row['error']:.1%} off path (noise {row['noise']:.1%}); red over green of the white cup {row['redness_of_the_cup']:.3f}, "
                f"by path {row['redness_by_path']:.3f}.")

    return text


def sky(kind: str) -> Callable:
    def text(r: Results) -> str:
        row = r["green"]["skies"][kind]
        left = ", ".join(f"{value:.0%}" for value in row["relative_l2_error_by_order"].values())
        return (f"Coefficients against brute force {row['largest_difference_to_quadrature']:.1e}; orders 2, 4 and 8 leave out {left} of "
                "the sky.")

    return text


GREEN = experiment("green")

ROWS = (
    Row(W18, "Fig. 1", "Buddha under three polygonal lights", buddha_frame, experiment("wang", "frames"), ("wang_frames.png",)),
    diagram(W18, "Fig. 2", "surface and boundary integrals", "mi_shlight/light/recurrence.py"),
    diagram(W18, "Fig. 3", "sum of zonal harmonics", "mi_shlight/sh/lobes.py"),
    Row(W18, "Table 1", "notation", "Nothing to measure; the docstrings name the symbols and equations.", reproduced="no"),
    Row(W18, "Fig. 4", "analytic against numerical integration, difference, scan line", integration, experiment("wang", "integration"),
        ("wang_integration.png", "engine.png")),
    Row(W18, "Fig. 5", "orders 2, 4, 6, 8", orders, experiment("wang", "orders"), ("wang_orders.png",)),
    Row(W18, "Fig. 6", "time over the number of coefficients", linear("coefficients"), experiment("engine"), ("engine.png",)),
    Row(W18, "Fig. 7", "time over the number of edges", linear("edges"), experiment("engine"), ("engine.png",)),
    Row(W18, "Table 2", "frames per second, and by monomials", frames, experiment("wang", "frames"), ("wang_frames.png",), "in part"),
    Row(W18, "Fig. 8", "light moved, turned in and out of its plane, its outline edited", edits, experiment("wang", "edits"),
        ("wang_edits.png",)),
    Row(W18, "Fig. 9", "environment map and area light, either turned", environment, experiment("wang", "environment"),
        ("wang_environment.png", "light_kinds.png")),
    Row(W18, "Fig. 10", "patterned lights in polygons, glossy reflection", patterned, experiment("wang", "patterned"),
        ("wang_patterned.png", "glossy.png")),
    Row(W20, "Fig. 1", "723 lights, each moving alone, over glossy surfaces", against_exact("many", "Fig. 1", "theirs 1.8e-4"),
        experiment("wu", "many"), ("wu_many.png",)),
    diagram(W20, "Fig. 2", "projection of a light that moves", "mi_shlight/light/gradient.py"),
    diagram(W20, "Fig. 3", "rate of change of a direction", "mi_shlight/light/gradient.py"),
    Row(W20, "Fig. 4", "a coefficient between ten samples", on_line, experiment("grid", "interpolation"), ("grid.png",)),
    diagram(W20, "Fig. 5", "Hermite interpolation in a cell", "mi_shlight/grid/cells.py"),
    Row(W20, "Fig. 6", "spatial derivatives against differences", gradient_images, experiment("gradients"), ("gradients.png",)),
    Row(W20, "Table 1", "six scenes: times, errors, speed-ups", table_1, experiment("grid", "table"), ("grid.png",), "in part"),
    Row(W20, "Fig. 7", "Hermite, trilinear and Taylor interpolation in pictures", interpolation, experiment("wu", "interpolation"),
        ("wu_interpolation.png",)),
    Row(W20, "Fig. 8", "time over the number of lights", light_counts, experiment("grid", "lights"), ("grid.png",)),
    Row(W20, "Fig. 9", "grids of growing resolution", resolutions, experiment("grid", "resolutions"),
        ("grid_resolutions.png", "grid.png")),
    Row(W20, "Fig. 10", "room with two textured lights", against_exact("room", "Fig. 10", "theirs 3.4e-4"), experiment("wu", "room"),
        ("wu_room.png",)),
    Row(W20, "Fig. 11", "glossy reflections of lights of irregular shapes", against_exact("gloss", "Fig. 11", "theirs 0.7e-4"),
        experiment("wu", "gloss"), ("wu_gloss.png",)),
    Row(W20, "Fig. 12", "double-sided light amid the scene: what a coarse grid blurs", double_sided, experiment("grid", "double_sided"),
        ("grid_double_sided.png",)),
    Row(W20, "Fig. 13", "against path tracing and [W18]", against_exact("path", "Fig. 13", "theirs 1.7e-4"), experiment("wu", "path"),
        ("wu_path.png",)),
    diagram(G03, "Fig. 1", "projected angle", "Lambert's cosine"),
    diagram(G03, "Fig. 2", "projected solid angle", "Lambert's cosine"),
    Row(G03, "Fig. 3", "10,000 stratified samples on the sphere",
        lambda r: f"{r.measured('green', 'Fig. 3')} times nearer to an orthonormal basis than as many independent samples.", GREEN,
        ("green_samples.png",)),
    Row(G03, "Fig. 4", "first six associated Legendre polynomials",
        lambda r: f"The printed rules are our basis to {r.measured('green', 'Fig. 4')}.", GREEN, ("green_samples.png",)),
    Row(G03, "Fig. 5", "first five bands of the basis",
        lambda r: f"Printed polynomials are ours, but for the sign (-1)^m and a slip of 2 in y_2^2, to {r.measured('green', 'Fig. 5')}.",
        GREEN, ("green_basis.png",)),
    Row(G03, "Fig. 6", "a function by growing orders",
        lambda r: "Relative L2 error " + ", ".join(f"{value:.0%} (order {order})" for order, value in r["green"]["light_by_order"].items())
        + ".", GREEN, ("green_light.png",)),
    Row(G03, "Fig. 7", "the example light", example_light, GREEN, ("green_light.png",)),
    Row(G03, "Fig. 8", "its reconstruction from 16 coefficients", example_light, GREEN, ("green_light.png", "green_windows.png")),
    Row(G03, "Fig. 9", "entries of a triple-product matrix that are not 0",
        lambda r: f"{r['green']['product']['entries']} of {r['green']['product']['of']}.", GREEN, ("green_matrices.png",)),
    Row(G03, "Fig. 10", "that matrix applied to a light",
        lambda r: f"The product's projection to {r.measured('green', 'Fig. 10')} for a light of 25 coefficients; of the light itself "
        f"{r['green']['product']['difference_light_itself']:.0%} differ, as bands above are cut off.", GREEN, ("green_product.png",)),
    Row(G03, "Fig. 11", "unshadowed transfer, 25 coefficients",
        lambda r: f"Exact shading by a hemisphere of light to {r.measured('green', 'Fig. 11')}.", GREEN, ("green_renders.png",)),
    diagram(G03, "Fig. 12", "rays that start on a polygon", "mi_shlight/transfer/visibility.py"),
    Row(G03, "Fig. 13", "shadowed transfer", render("shadowed (Fig. 13)"), GREEN, ("green_renders.png",)),
    diagram(G03, "Fig. 14", "a ray of self transfer", "mi_shlight/transfer/bounce.py"),
    Row(G03, "Fig. 15", "interreflected transfer, colour bleeding", render("interreflected (Fig. 15)"), GREEN, ("green_renders.png",)),
    Row(G03, "Fig. 16", "CIE overcast sky", sky("overcast"), GREEN, ("green_skies.png", "light_kinds_skies.png")),
    Row(G03, "Fig. 17", "CIE clear sky", sky("clear"), GREEN, ("green_skies.png", "light_kinds_skies.png")),
    Row(G03, "Fig. 18", "CIE partly cloudy sky", sky("partly_cloudy"), GREEN, ("green_skies.png", "light_kinds_skies.png")),
    Row(G03, "Fig. 19", "a light probe as an angle map",
        lambda r: f"A made probe in place of the photograph: coefficients from its pixels to {r.measured('green', 'Fig. 19')}.", GREEN,
        ("green_probe.png",)),
)


def rows(folder=RESULTS) -> list:
    """The map, verdicts filled from the JSON files in `folder`.

    Parameters
    ----------
    folder : str or os.PathLike
        Folder of the results.

    Returns
    -------
    list of dict
        ``paper``, ``item``, ``shows``, ``command`` and ``pictures`` (files in the folder; empty where there is nothing to reproduce),
        ``verdict``, and ``reproduced``: yes, in part (also where a target was missed), no. Where an experiment has not run the verdict
        says so.
    """
    results, found = Results(pathlib.Path(folder)), []
    for row in ROWS:
        try:
            text = row.verdict if isinstance(row.verdict, str) else row.verdict(results)
        except (LookupError, StopIteration, TypeError, ValueError, FileNotFoundError):      # results that are missing or of a part only
            text = NOTHING_MEASURED
        reproduced = row.reproduced
        if text == NOTHING_MEASURED:
            reproduced = "no"
        elif MISSED in text and reproduced == "yes":
            reproduced = "in part"
        found.append({**row._asdict(), "pictures": list(row.pictures), "verdict": text, "reproduced": reproduced})
    return found


def markdown(folder=RESULTS) -> str:
    """The map as a table."""
    lines = ["| paper | item | shows | command | our figure | reproduced | verdict |", "|---|---|---|---|---|---|---|"]
    for row in rows(folder):
        pictures, command = ", ".join(row["pictures"]), f"`{row['command']}`" if row["command"] else ""
        cells = row["paper"], row["item"], row["shows"], command, pictures, row["reproduced"], row["verdict"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=pathlib.Path, default=RESULTS, help="of the results (default: validation/results)")
    print(markdown(parser.parse_args().folder))
