"""Claim: what [W20] shows in pictures comes out here: a grid of 8 x 8 x 8 lights as every light does, and both as path tracing.

    python -m validation.wu [--quick] [--out DIR] [--only PART ...]

writes ``wu.json`` and a picture for each part. ``--only`` measures some parts anew and keeps the others of an existing ``wu.json``.
Tables, curves and the Figs. 4, 8, 9 and 12 are those of ``validation.grid``, Fig. 6 of ``validation.gradients``. Here are whole pictures by
``shprt``, with shadows; scenes are those of grid_scenes.py, with the paper's numbers of lights and fewer triangles, and of ``scenes/``.

*exact* is without a grid, all lights at every hit, as in [W18]; *grid* has 8^3 points and nothing else, as in [W20]; *near lights exact*
is what ``shprt`` does by default. **mae** is the paper's measure: the mean absolute difference of display values, 0 to 1, exposed to a mean
of 0.4, from the exact picture, of the pixels that see a surface and no light. **path** is the mean absolute difference from Mitsuba's
``path`` at ``max_depth`` 2 over its mean, **noise** half of that between its halves.

**interpolation** (Fig. 7): 118 lights; Hermite as here, as in the paper (its Algorithm 4, *tricubic*), trilinear, and of Taylor series.
**room** (Fig. 10): ``textured_room.xml``, a blue and a pink textured light cut into 344.
**many** (Fig. 1): 723 lights over glossy surfaces, as they are, and each turned and coloured alone.
**gloss** (Fig. 11): a star and a fractal triangle of 210 lights over a glossy column, as they are and turned about their middles.
**path** (Fig. 13): plants with two lights, by ``path``, by the grid and by all lights.

Gloss: Mitsuba's principled BSDF, half diffuse, half rough metal (Phong in the paper), to order 8, and visibility to order 4, as there.
*change* is the mean difference between the two states of the lights by ``path``, over its mean: what the lights do to the picture.
"""
from __future__ import annotations

import json
import pathlib
import tempfile
import time
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from validation.paper_scenes import GLOSSY, NO_REFINEMENT, Display, View, assemble, draw_sheet, light_triangles, placed_again

from mi_shlight.compare import shaded_pixels
from validation import grid_scenes
from validation.experiment import options, print_targets, significant, verdict, versions, write
from validation.glossy import error, reference
from validation.grid_cost import moved
from validation.grid_scenes import W20, Lights
from validation.soft_shadows import from_file, grey, render

FACTOR, INTERPOLATION_FACTOR = 10, 50
"""Of the differences that are shown."""
GRID = {"grid_resolution": 8, "grid_error": 0.0}
VARIANTS = {"exact": {}, "grid": GRID, "near lights exact": {"grid_resolution": 8}}
INTERPOLATIONS = {"hermite": "Hermite", "tricubic": "Hermite as in the paper", "trilinear": "trilinear", "taylor": "Taylor series"}
VIEWS = {"Monkey": View((0.2, 2.2, 5.0), (0, 0.75, 0), 36), "Plants": View((0.2, 2.6, 5.2), (0, 0.65, 0), 38),
         "Dragon & Bunny": View((0, 2.4, 6.0), (-0.1, 0.75, 0), 36), "Buddha": View((0, 2.6, 5.2), (0, 0.95, 0), 37)}


class Plan(NamedTuple):
    """Sizes to measure."""

    triangles: float = 30_000
    size: int = 128
    spp: int = 8
    reference_spp: int = 2048
    rays: int = 512
    room_edge: float = 0.0
    """`max_edge`; 0 is the default."""
    order: int = 8
    gloss: tuple = (8, 4)
    """Orders of BSDF and visibility."""
    many: str = "Dragon & Bunny"


QUICK = Plan(triangles=1500, size=24, spp=2, reference_spp=512, rays=16, room_edge=0.4, order=3, gloss=(2, 1), many="Monkey")


class Pictures:
    """Pictures of one scene by several settings of ``shprt``, judged against the first and against path tracing."""

    def __init__(self, scene: mi.Scene, plan: Plan, traced: bool = True, **settings):
        self.scene, self.plan = scene, plan
        self.settings = {"type": "shprt", "order": plan.order, "transfer_samples": plan.rays, "max_edge": NO_REFINEMENT, **settings}
        self.truth, self.noise, self.seen = reference(scene, plan.reference_spp) if traced else (None, None, shaded_pixels(scene))
        self.images, self._folder = {}, tempfile.TemporaryDirectory()

    def measure(self, name: str, **settings) -> dict:
        settings = {**self.settings, **settings}
        image = self.images[name] = render(self.scene, {**settings, "transfer_file": self._bake(settings)}, self.plan.spp, seed=1)
        row = {"picture": name}
        if len(self.images) == 1:
            self.display = Display(image, self.seen)
        else:
            first = next(iter(self.images.values()))
            row["mae"] = significant(abs(self.display(image) - self.display(first))[self.seen].mean())
        if self.truth is not None:
            row |= {"path": significant(error(image, self.truth, self.seen)), "noise": significant(self.noise)}
        return row

    def _bake(self, settings: dict) -> str:
        """File with the direct transfer, one for all grids."""
        file = pathlib.Path(self._folder.name) / f"{settings.get('localised', True)}.npz"
        if not file.exists():
            plain = {key: value for key, value in settings.items() if not key.startswith("grid")}
            mi.load_dict(plain).prepare_scene(self.scene, progress=False).save(file)
        return str(file)

    def shown(self, name: str, title: str) -> tuple:
        return title, self.display(self.truth if name == "path" else self.images[name])

    def difference(self, name: str, other: str, title: str, factor: float = FACTOR) -> tuple:
        image, base = (self.display(self.truth if key == "path" else self.images[key]) for key in (name, other))
        return title, np.clip(factor * abs(image - base) * self.seen[..., None], 0, 1)


def table_scene(name: str, plan: Plan, bsdf: dict | None = None) -> tuple:
    """(scene, lights) with as many lights as a row of [W20] Table 1."""
    found = grid_scenes.table_scene(name, plan.triangles / W20[name].triangles)
    points = smooth_dragon_and_bunny(plan.triangles) if name == "Dragon & Bunny" else found.points
    more = {} if bsdf is None else {"bsdf": bsdf}
    return assemble(points, light_triangles(found.lights), VIEWS[name], plan.size, **more), found.lights


def smooth_dragon_and_bunny(triangles: float) -> grid_scenes.Points:
    """Those of grid_scenes.py without scales, for which so few triangles are too coarse."""
    return grid_scenes.shares(triangles, (grid_scenes.floor(3), 0.1, grid_scenes.GREY),
                              (grid_scenes.knot((0.9, 0.95, 0), 0.85), 0.6, grid_scenes.WARM),
                              (grid_scenes.ball((-1.3, 0.7, 0.3), (0.6, 0.7, 0.6), 0.15), 0.3, grid_scenes.COOL))


def put(scene: mi.Scene, lights: Lights) -> None:
    """Corners and colours of all of a scene's light triangles."""
    placed_again(scene, {f"light_{k:03d}": lights.vertices[face[::-1]] for k, face in enumerate(lights.faces)},
                 {f"light_{k:03d}": colour for k, colour in enumerate(lights.radiance)})


# Fig. 7.

def measure_interpolation(plan: Plan, out) -> dict:
    pictures = Pictures(table_scene("Monkey", plan)[0], plan, traced=False, localised=False)
    pictures.measure("exact")
    row = plan.size // 2
    line = {"exact": grey(pictures.display(pictures.images["exact"]))[row]}
    rows = []
    for name in INTERPOLATIONS:
        rows.append(pictures.measure(name, **GRID, grid_interpolation=name))
        line[name] = grey(pictures.display(pictures.images[name]))[row]
        rows[-1]["scan_line"] = significant(abs(line[name] - line["exact"]).max())
    draw_interpolation(out / "wu_interpolation.png", pictures, rows, line)
    return {"rows": rows}


def draw_interpolation(path, pictures: Pictures, rows: list, line: dict) -> None:
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(2.3 * (len(rows) + 1), 7.2), layout="constrained")
    spec = figure.add_gridspec(3, len(rows) + 1, height_ratios=(1, 1, 0.9))
    panels = [[pictures.shown("exact", "exact")], [None]]
    for found in rows:
        name = found["picture"]
        panels[0].append(pictures.shown(name, INTERPOLATIONS[name]))
        title = f"difference x {INTERPOLATION_FACTOR}, mean {1e3 * found['mae']:.2g}e-3"
        panels[1].append(pictures.difference(name, "exact", title, INTERPOLATION_FACTOR))
    for i, panel in enumerate(panels):
        for j, cell in enumerate(panel):
            if cell:
                axis = figure.add_subplot(spec[i, j])
                axis.imshow(cell[1], interpolation="nearest")
                axis.set_title(cell[0], fontsize=8)
                axis.set(xticks=[], yticks=[])
                if i == j == 0:
                    axis.axhline(len(cell[1]) // 2, color="red", linewidth=0.6)
    values, differences = figure.add_subplot(spec[2, :2]), figure.add_subplot(spec[2, 2:])
    for k, (name, curve) in enumerate(line.items()):
        style = {"color": "C0", "linewidth": 3} if name == "exact" else {"color": ("k", "C1", "C3", "c")[k - 1], "linestyle": "--"}
        values.plot(curve, label=INTERPOLATIONS.get(name, name), **style)
        if name != "exact":
            differences.semilogy(np.maximum(abs(curve - line["exact"]), 1e-7), color=style["color"], label=INTERPOLATIONS[name])
    values.set(title="scan line", xlabel="pixel", ylabel="display value")
    differences.set(title="its difference from the exact one", xlabel="pixel")
    for axis in (values, differences):
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=75)
    pyplot.close(figure)


# Figs. 10 and 13.

def measure_room(plan: Plan, out) -> dict:
    pictures = Pictures(from_file("textured_room")(plan.size), plan, max_edge=plan.room_edge)
    rows = [pictures.measure(name, **settings) for name, settings in VARIANTS.items()]
    draw_against_path(out / "wu_room.png", pictures, rows)
    return {"rows": rows}


def measure_path(plan: Plan, out) -> dict:
    pictures = Pictures(table_scene("Plants", plan)[0], plan, localised=False)
    rows = [pictures.measure(name, **settings) for name, settings in VARIANTS.items()]
    rows.append(pictures.measure("near lights exact, localised transfer", localised=True, **VARIANTS["near lights exact"]))
    draw_against_path(out / "wu_path.png", pictures, rows)
    return {"rows": rows}


def draw_against_path(file, pictures: Pictures, rows: list) -> None:
    sheet = [pictures.shown("path", f"path, noise {pictures.noise:.1%}")]
    sheet += [pictures.shown(row["picture"], f"{row['picture']}: {row['path']:.1%} off path") for row in rows]
    below = [("", None), pictures.difference(rows[0]["picture"], "path", f"exact - path, x {FACTOR}")]
    below += [pictures.difference(row["picture"], rows[0]["picture"], f"minus exact, x {FACTOR}: {1e3 * row['mae']:.2g}e-3")
              for row in rows[1:]]
    draw_sheet(file, [("", sheet), ("", below)], width=2.6, dpi=75)


# Figs. 1 and 11.

def measure_states(plan: Plan, file, name: str, states: dict) -> dict:
    """A glossy scene by all lights, by the grid and by ``path``, for states of its lights: functions of the lights."""
    scene, lights = table_scene(name, plan, GLOSSY)
    rows, sheet, truths = [], [], []
    gloss = dict(zip(("bsdf_order", "visibility_order"), plan.gloss))
    for state, change in states.items():
        put(scene, change(lights))
        pictures = Pictures(scene, plan, transfer="shadowed+glossy", **gloss)
        found = [{"lights": state, **pictures.measure(variant, **settings)} for variant, settings in VARIANTS.items()]
        rows += found
        line = [pictures.shown(row["picture"], f"{row['picture']}: {row['path']:.1%} off path") for row in found]
        sheet.append((state, [*line, pictures.shown("path", f"path, noise {pictures.noise:.1%}"),
                              pictures.difference("grid", "exact", f"grid - exact, x {FACTOR}: {1e3 * found[1]['mae']:.2g}e-3")]))
        truths.append((pictures.truth, pictures.seen))
    draw_sheet(file, sheet, width=2.6, dpi=75)
    (first, seen), (second, _) = truths
    return {"rows": rows, "light_count": len(lights.faces), "change": significant(error(second, first, seen))}


def measure_many(plan: Plan, out) -> dict:
    return measure_states(plan, out / "wu_many.png", plan.many, {"as they are": lambda lights: lights,
                                                                 "each turned and coloured": recoloured})


def recoloured(lights: Lights) -> Lights:
    """Every triangle turned alone; their colours in stripes that cross the panels, from each of the three over to the others."""
    turned = moved(lights, 0.8)
    stripe = 0.5 + 0.5 * np.sin(np.arange(len(turned.radiance)) / 7.0)[:, None]
    return turned._replace(radiance=stripe * np.roll(turned.radiance, 1, axis=1) + (1 - stripe) * turned.radiance[::-1])


def measure_gloss(plan: Plan, out) -> dict:
    return measure_states(plan, out / "wu_gloss.png", "Buddha", {"as they are": lambda lights: lights, "turned by 50°": turned_lights})


def turned_lights(lights: Lights, degrees: float = 50) -> Lights:
    """Both lights, on either side of the plane x = 0, turned about vertical axes through their middles, and their colours exchanged."""
    vertices, radiance = lights.vertices.copy(), lights.radiance.copy()
    angle = np.radians(degrees)
    for side, sign in ((vertices[:, 0] < 0, 1), (vertices[:, 0] > 0, -1)):
        middle = vertices[side].mean(axis=0)
        x, z = (vertices[side] - middle)[:, [0, 2]].T
        c, s = np.cos(angle), sign * np.sin(angle)
        vertices[side] = middle + np.column_stack([c * x + s * z, (vertices[side] - middle)[:, 1], c * z - s * x])
    return lights._replace(vertices=vertices, radiance=radiance[:, ::-1])


PARTS = {"interpolation": measure_interpolation, "room": measure_room, "path": measure_path, "gloss": measure_gloss,
         "many": measure_many}


def targets(report: dict) -> list:
    """Verdicts on what the captions say, of the parts that `report` has."""
    out = []
    check = lambda *arguments, **keywords: out.append(verdict(*arguments, **keywords))
    rows = lambda part, **keys: [row for row in report.get(part, {}).get("rows", []) if keys.items() <= row.items()]
    for name in ("trilinear", "taylor"):
        for key, what in (("mae", "mean error"), ("scan_line", "largest error on the scan line")):
            found = [rows("interpolation", picture=other) for other in (name, "hermite")]
            check(f"Fig. 7: {what} of hermite at least 10 times below {name}", found[0][0][key] / found[1][0][key] if found[0] else None,
                  10, at_most=False)
    limits = {"room": ("Fig. 10", W20["Room"].error), "path": ("Fig. 13", W20["Plants"].error), "gloss": ("Fig. 11", W20["Buddha"].error),
              "many": ("Fig. 1", W20["Dragon & Bunny"].error)}
    for part, (figure, limit) in limits.items():
        for variant in ("grid", "near lights exact"):
            largest = max((row["mae"] for row in rows(part, picture=variant)), default=None)
            check(f"{figure}, {variant}: mean absolute error at most the paper's, {limit:g}", largest, limit)
    for row in rows("room", picture="near lights exact"):
        check("Fig. 10: off path by at most 3 %", row["path"], 0.03, text="{:.2%}")
    exact, grid = (rows("path", picture=name) for name in ("exact", "near lights exact"))
    check("Fig. 13: distance of the grid from path over that of all lights from path, at most 1.02",
          grid[0]["path"] / exact[0]["path"] if grid else None, 1.02)
    for part, figure in (("gloss", "Fig. 11"), ("many", "Fig. 1")):
        worst = max((row["path"] for row in rows(part)), default=None)
        check(f"{figure}: error against path at most a quarter of what the lights' change makes",
              worst / report[part]["change"] if worst else None, 0.25)
    return out


def main(arguments=None) -> None:
    parsed = options(__doc__, arguments, only={"nargs": "+", "choices": list(PARTS), "metavar": "PART",
                                               "help": "parts to measure: " + ", ".join(PARTS)})
    plan, path = QUICK if parsed.quick else Plan(), parsed.out / "wu.json"
    report = json.loads(path.read_text()) if parsed.only and path.exists() else {}
    for part in parsed.only or PARTS:
        start = time.process_time()
        report[part] = {**PARTS[part](plan, parsed.out), "run": versions()}
        print(f"\n{part} ({time.process_time() - start:.0f} s of CPU)", *map(json.dumps, report[part]["rows"]), sep="\n", flush=True)
    lines = targets(report)
    print_targets(lines)
    write(path, {"targets": lines, **{part: report[part] for part in PARTS if part in report}}, parsed.quick)


if __name__ == "__main__":
    main()
