"""The experiments there are: what ``python -m validation`` runs and its report shows, in the order of the report.

Each is a module of this package with a ``main``; what it claims and how it measures are the module's docstring.
"""
from __future__ import annotations

import ast
import functools
import pathlib
from typing import NamedTuple

FOLDER = pathlib.Path(__file__).parent


class Experiment(NamedTuple):
    """One experiment."""

    name: str
    """Of the module."""
    title: str
    pictures: dict
    """File, relative to the folder of the results -> caption."""
    minutes: float
    """Rough duration of a full run: alone on two cores if `timed`, else on one core."""
    timed: bool = False
    """Whether it measures wall time or compares times, and so must run alone."""

    @property
    def doc(self) -> str:
        return _docstring(self.name)

    @property
    def claim(self) -> str:
        """The docstring's first paragraph, but for "Claim: "."""
        return " ".join(self.doc.split("\n\n")[0].split()).removeprefix("Claim: ")


@functools.cache
def _docstring(name: str) -> str:
    return ast.get_docstring(ast.parse((FOLDER / f"{name}.py").read_text(encoding="utf-8")))


PANELS = {"cornell_box": "the Cornell box of scenes/", "plant": "a plant under two lights", "sculpture": "a knot under three lights",
          "floor": "nothing in the way", "mi.cornell_box": "Mitsuba's own Cornell box"}

GROUPS = {
    "Speed against accuracy": (
        Experiment("pareto", "Error against time", {
            "pareto.png": "Error against time of shprt and of path and direct at growing samples, scene by scene",
            "pareto_axes.png": "What each setting costs and buys"}, 12, timed=True),
        Experiment("bounds", "Error bounds of every pixel", {
            "bounds.png": "Bound and true error by order and scene",
            "bounds_maps.png": "True error, bound and total error in pictures"}, 4),
        Experiment("planner", "Planned settings", {
            "planner.png": "Predicted against measured error and time of scenes that the planner has not seen"}, 16, timed=True),
    ),
    "The coefficients": (
        Experiment("engine", "Cost and accuracy of every method", {
            "engine.png": "Time of shading over edges and over coefficients; first call; time and float32 error over the distance; Monte "
                          "Carlo against the closed form"}, 8, timed=True),
        Experiment("stability", "Where closed forms cancel, and what auto does there", {
            "stability.png": "Largest float32 error of each method over distance, grazing gap, sliver width and height; error against "
                             "perimeter over solid angle; error of the cubature over the error asked for"}, 3),
        Experiment("stability_maps", "Maps of errors at the extremes", {
            "stability_maps_float32.png": "Largest float32 error over distance and angle, width, place near the border, and scale: closed "
                                          "form, auto, and where auto takes the cubature",
            "stability_maps_float64.png": "The same in float64",
            "stability_maps_gradients.png": "The same for derivatives by the vertices, float32"}, 2),
        Experiment("lobe_directions", "Lobe directions of the recurrence", {
            "lobe_directions.png": "Condition numbers and float32 errors of optimised, Fibonacci and random lobes by order"}, 2),
    ),
    "Derivatives": (
        Experiment("gradients", "Analytic derivatives of the coefficients", {
            "gradients.png": "[W20] Fig. 6 anew: derivatives of two coefficients by the shading point, central differences, analytic, and "
                             "what they differ by",
            "gradients_accuracy.png": "Error of differences against their step, and of the analytic derivatives by class of polygon"}, 7),
        Experiment("gradient_cost", "What derivatives cost", {
            "gradient_cost.png": "Times over that of the value alone, and first calls"}, 4, timed=True),
        Experiment("gradient_references", "Derivatives of pictures against Mitsuba's", {
            "gradient_references.png": "Derivatives of a shadowed floor by five motions of the light: exact, direct_projective, shprt at "
                                       "three orders, and its differences to the exact one"}, 9),
        Experiment("inverse", "A light from one picture", {
            "inverse_convergence.png": "Error of the light's centre over time, all starts of shprt and of direct_projective",
            "inverse_rectangle.png": "Rectangle: before, after, and the path-traced target, of the start that ended as the median",
            "inverse_pentagon.png": "Pentagon with five free vertices: the same"}, 18),
    ),
    "Many lights": (
        Experiment("grid", "The light grid", {
            "grid.png": "Error over samples, lights and resolution; time of grid and exact shading",
            "grid_resolutions.png": "Grids of growing resolution, and their differences to the exact picture",
            "grid_double_sided.png": "A two-sided light amid the scene: exact, by a grid, and with near lights exact"}, 7, timed=True),
        Experiment("grid_inverse", "723 lights from one picture", {
            "grid_inverse.png": "Grey lights at the start, the lights recovered, and the target"}, 3, timed=True),
        Experiment("large_scene", "Memory of a large scene", {}, 1),
    ),
    "Shadows, light between surfaces, gloss": (
        Experiment("panels", "Scenes against the path tracer", {
            f"panels/{name}.png": f"{what}: shprt, path, and their difference" for name, what in PANELS.items()}, 3, timed=True),
        Experiment("soft_shadows", "Localised transfer", {
            "soft_shadows.png": "Error in the shadow over order and over rays, transfer projected and localised with several margins",
            "soft_shadows_panel.png": "Ball, plant and Cornell box by path, projected and localised transfer, and their differences"}, 6),
        Experiment("exact", "Exact unblocked light", {}, 5),
        Experiment("bake_speed", "Where a bake spends its time", {}, 1, timed=True),
        Experiment("interreflection", "Light between surfaces", {
            "interreflection.png": "The Cornell box with 0, 1, 2 and all bounces by shprt and path, and their differences",
            "interreflection_curves.png": "Errors over order, bounces, rays and cells; cost; gathering against transferred bounces"}, 6),
        Experiment("furnace", "Furnaces", {
            "furnace.png": "White furnaces: direct light, and the deviation from 1 with all bounces"}, 2),
        Experiment("glossy", "Gloss", {
            "glossy.png": "Materials by bsdf_order beside path tracing"}, 6),
    ),
    "The papers' pictures": (
        Experiment("wang", "Wang and Ramamoorthi 2018 in pictures", {
            "wang_integration.png": "[W18] Fig. 4: analytic against numerical integration",
            "wang_orders.png": "[W18] Fig. 5: orders 2 to 8 beside path tracing",
            "wang_edits.png": "[W18] Fig. 8: a light that moves, turns, and whose vertex moves",
            "wang_environment.png": "[W18] Fig. 9: environment map and area light, turned",
            "wang_patterned.png": "[W18] Fig. 10: patterned lights and gloss",
            "wang_frames.png": "[W18] Table 2: the scenes whose frames are timed"}, 5),
        Experiment("wu", "Wu et al. 2020 in pictures", {
            "wu_interpolation.png": "[W20] Fig. 7: Hermite, trilinear and Taylor interpolation, with errors and a scan line",
            "wu_room.png": "[W20] Fig. 10: a room with textured lights",
            "wu_path.png": "[W20] Fig. 13: against path tracing",
            "wu_many.png": "[W20] Fig. 1: hundreds of lights that move",
            "wu_gloss.png": "[W20] Fig. 11: gloss under complex lights"}, 5),
    ),
    "Skies, lights of all kinds, spherical harmonics": (
        Experiment("light_kinds", "Lights of all kinds", {
            "light_kinds.png": "A torus in the light of a polygon, a sky with a cap, a constant sky, directional and spot lights, and all "
                               "together; SH, path traced, difference",
            "light_kinds_skies.png": "Three skies of the CIE: SH, path traced, difference",
            "light_kinds_proxy.png": "Shadow of a ball that is taken out of the sky's coefficients, by order"}, 3),
        Experiment("green", "What Green 2003 prints", {
            "green_samples.png": "Its samples with cells and without, and its rules for Legendre polynomials",
            "green_basis.png": "The first five bands",
            "green_light.png": "Its example light, and what the orders make of it",
            "green_matrices.png": "Matrices of a product and of rotations",
            "green_product.png": "The product of the light with a mask",
            "green_renders.png": "A cup by unshadowed, shadowed and interreflected transfer",
            "green_windows.png": "Windows against ringing",
            "green_skies.png": "Skies, and what the orders make of them",
            "green_probe.png": "A sky and a cap as an angle map"}, 4),
        Experiment("turned_object", "A turned object keeps its bake", {
            "turned_object.png": "One bake with the light turned, path tracing, and their difference"}, 2),
    ),
}

EXPERIMENTS = {experiment.name: experiment for group in GROUPS.values() for experiment in group}
