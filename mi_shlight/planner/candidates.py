"""Error and time of every setting that comes into question, at the points of the probe."""
from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene import shape_index
from ..scene_grid import SceneGrid
from ..shading.settings import DEFAULT_SAMPLES, Settings
from ..transfer.localised import LEVELS, half_angle
from ..transfer.mesh import automatic_edge
from .cost import (Sizes, bake_seconds, baked_points, bounce_seconds, gloss_seconds, lights_nanoseconds, measure_machine,
                   picture_seconds)
from .probe import ORDER, Probe
from .simulate import Shaded, interpolated, shade

ORDERS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14)
EDGES = (4, 2, 1, 1 / 2, 1 / 4)
"""Lengths of `max_edge`, in the default's."""

BASE = 256
RAYS = (16, 64, 256, 1024, 4096)
"""Rays per point: all cell sizes are looked at with all numbers to `BASE`; what more would change is taken from the points themselves."""

PIXEL_RAYS = (16, 64, 256)
PIXEL_REPEATS = 8
"""Times that rays are turned to tell what samples of a pixel average out from what they do not: rings have the same radii in all."""

LARGEST = (("pixel", 0, 256), ("vertex", 2, 1024), ("vertex", 3, 1024))
"""Of these the last that is possible is the largest setting: domain, number of the cell size, rays."""

BOUNCE_RAYS = (64, 256, 1024)
BSDF_ORDERS = (4, 8, 14)

BOUNCE_ERROR = 0.012
"""Error that rays cause in light between surfaces, as a part of it, with 256 of them per point; falls with their square root
(validation/interreflection)."""

ROUNDING = 2e-6
"""Error of single precision."""

MARGIN = 1.3
"""Safety factor on predicted errors: of many candidates those look cheapest whose error is underestimated."""

GRID_ERROR = 0.35
"""Mean error that the light grid causes, as a part of `grid_error` (validation/grid)."""


class Candidate(NamedTuple):
    """One setting."""

    direct: str
    order: int
    domain: str
    rays: int
    edge: float
    resolution: int
    grid_error: float
    bounce_rays: int
    bsdf_order: int
    """0: without gloss."""
    error: float
    spread: float
    """Standard error of `error`, which comes from a few hundred points."""
    parts: dict
    """Errors by cause."""
    bake: float
    picture: float

    @property
    def seconds(self) -> float:
        return self.bake + self.picture

    @property
    def avoidable(self) -> float:
        """Error without what no setting renders, or this one does not."""
        return self.error - self.parts["left out"]

    @property
    def safe(self) -> float:
        """An error that is not likely to be exceeded."""
        return MARGIN * self.error + 2 * self.spread


class Findings:
    """All that is known of a scene, from which candidates are made.

    Parameters
    ----------
    probe : Probe
    hits : int
        Camera hits of the picture, all samples.
    spp : int
    bounces : int or None
        Reflections that the scene asks for before the one that is seen: 0 none, None without a limit.
    max_error : float
    gloss : bool
        Whether gloss may be rendered.
    """

    def __init__(self, probe: Probe, hits: int, spp: int, bounces, max_error: float, gloss: bool = True):
        state, self.probe, self.spp, self.max_error = probe.state, probe, spp, max_error
        self.glossy = state.glossy
        self.truth = truth = probe.truth(self.glossy)
        albedo, self.lights = probe.hits.albedo, (truth.open * truth.seen).sum(axis=0)
        direct = albedo * (self.lights + truth.other + truth.missing) + truth.gloss
        between, black = self._between(bounces), self._black()
        self.total = (direct + between + black).sum()
        if not self.total > 0:
            raise ValueError("plan(): 'scene' must light something that the camera sees, got a dark view. Check its camera and lights.")
        share = lambda part: float(np.sum(part) / self.total)
        self.between, self.gloss = share(between), share(abs(truth.gloss))
        self.missing, self.black = share(albedo * truth.missing), share(black)
        unblocked = (albedo * (truth.open.sum(axis=0) + truth.other_open)).sum()
        self.blocked = 1 - float((albedo * (self.lights + truth.other)).sum() / unblocked) if unblocked > 0 else 0.0
        self.partly = float(((truth.seen > 0.002) & (truth.seen < 0.998) & (truth.open > 0)).any(axis=0).mean())
        boxes = np.array([[np.ravel(r.shape.bbox().min), np.ravel(r.shape.bbox().max)] for r in state.receivers if r.light < 0], float)
        corners = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)]) if len(boxes) else np.array([[0.0] * 3, [1.0] * 3])
        self.edges = [max(automatic_edge(corners), 1e-30) * factor for factor in EDGES]
        self.points = baked_points(state.receivers, self.edges)
        self.machine = measure_machine()
        self._measure()
        self.between_cells = self._between_cells(bounces)
        table, self._groups = probe.table, [int(b) for b in np.array(state.facets)] if probe.table else [0, 0]
        self._facets = table.facets if table else None
        edges = dr.width(self._facets.start) if table else 0
        meshed = float(np.isin(probe.hits.shape, [shape_index(r.shape) for r in state.receivers if r.baked]).mean())
        self.sizes = Sizes(hits, edges, max(probe.group_count, 1), meshed, [s.seconds for s in self.sights] or [1e-7], self.glossy)
        self.grid_error = min(max(max_error / 2, 1e-5), 0.05)
        self._grids = self._grid_sizes()
        self.gloss_errors = self._gloss_errors() if gloss and self.gloss > max_error / 20 else {}

    def _between(self, bounces):
        """(P,) radiance by way of other surfaces, as far as it is asked for; paths of equal random numbers leave no noise where there is
        none.
        """
        if bounces == 0:
            return np.zeros(len(self.probe.hits.p))
        return self.probe.radiance(-1 if bounces is None else bounces + 2) - self.probe.radiance(2)

    def _black(self):
        """(P,) radiance of surfaces that `shprt` shows black."""
        lit = self.probe.hits.lit
        return np.zeros(len(lit)) if lit.all() else np.where(lit, 0, self.probe.radiance(2))

    def _between_cells(self, bounces) -> list:
        """Errors, by size of the cells, of interpolating light between surfaces in them."""
        if self.between <= self.max_error / 20 or not self.sights:
            return [0.0] * len(self.edges)
        rows, albedo, errors = self.rows, self.probe.hits.albedo, []
        twice = self.probe.arriving(rows, bounces).T
        for cells in range(len(self.edges)):
            off = interpolated(rows, cells, twice, self._dark) - twice[-len(albedo):]
            error, noise = ((albedo * abs(value)).sum() / (2 * self.total) for value in (off[:, 0] + off[:, 1], off[:, 0] - off[:, 1]))
            errors.append(math.sqrt(max(error ** 2 - noise ** 2, 0)))
        return errors

    def _measure(self) -> None:
        """Errors at all points, by order."""
        probe, truth = self.probe, self.truth
        self.rows = rows = probe.rows(self.edges)
        self.sights = probe.sights(rows, BASE)
        self._base = {}
        for rays in (rays for rays in RAYS if rays <= BASE):
            shaded = [shade(sight) for sight in (self.sights if rays == BASE else probe.sights_again(rows, self.sights, rays))]
            dark = np.all([s.mean == 0 for s in shaded], axis=0) if shaded else np.zeros(0, bool)
            for direct in ("shadowed", "exact"):
                for cells in range(len(self.edges) + 1):
                    self._base[direct, cells, rays] = self._errors(direct, shaded, rows, cells, dark)
        self._dark = dark
        last = len(self.edges)
        own = rows._replace(corner=rows.corner[last:] - len(rows.cell) + len(self.lights), weight=rows.weight[last:],
                            buried=rows.buried[-len(self.lights):])
        self._own, self._steady = {}, {}
        for rays in RAYS:
            repeats = PIXEL_REPEATS if rays in PIXEL_RAYS else 1
            turned = [shade(sight) for sight in probe.sights_again(rows, self.sights, rays, repeats)]
            once = [[Shaded(*(values.reshape(repeats, -1, *values.shape[1:])[k] for values in s)) for s in turned] for k in range(repeats)]
            mean = [Shaded(*(values.reshape(repeats, -1, *values.shape[1:]).mean(axis=0) for values in s)) for s in turned]
            for direct in ("shadowed", "exact"):
                alone = [self._errors(direct, shaded, own, 0, own.buried) for shaded in once]
                self._own[direct, rays] = tuple(np.mean(figures, axis=0) for figures in zip(*alone))
                self._steady[direct, rays] = self._errors(direct, mean, own, 0, own.buried)
        open_light = sum((s.open[-len(self.lights):] for s in shaded), np.zeros((1, ORDER + 1)))
        self.unshadowed = self._figures(open_light + (truth.other_open - truth.other)[:, None])
        self.noise = float((probe.hits.albedo * (truth.open * truth.noise).sum(axis=0)).sum() / self.total)

    def _errors(self, direct: str, shaded: list, rows, cells: int, dark) -> tuple:
        """(errors, standard errors) by order."""
        value = np.zeros((len(self.lights), ORDER + 1))
        for g, s in enumerate(shaded):
            if direct == "exact" and g < self.probe.near_count:
                value += interpolated(rows, cells, s.rest, dark)
                value += (interpolated(rows, cells, s.mean, dark) * self.truth.open[g])[:, None]
            else:
                value += interpolated(rows, cells, s.shadowed, dark)
        return self._figures(value)

    def _figures(self, value) -> tuple:
        off = abs(value - self.lights[:, None]) * self.probe.hits.albedo[:, None]
        return off.sum(axis=0) / self.total, off.std(axis=0) * math.sqrt(len(off)) / self.total

    # What else there is

    def _grid_sizes(self) -> list:
        """Light grids that come into question."""
        if self._facets is None or mi.is_spectral or self._facets.count < 8:
            return []
        grid = SceneGrid(self.probe.state.receivers, self._groups, "auto", "hermite", self.grid_error, 8, "auto")
        return [(cells, near, mean) for cells, near, mean in grid.sizes(self._facets)]

    def lights_cost(self, order: int) -> tuple:
        """(nanoseconds of all lights at all hits, grid resolution): the least."""
        return min(((lights_nanoseconds(self._facets, self._groups, order, self.sizes.hits, grid), grid[0].resolution if grid else 0)
                    for grid in (None, *self._grids)), key=lambda option: option[0])

    def _gloss_errors(self) -> dict:
        """By `bsdf_order`, the error of gloss at the points: `shprt` itself, as far as needed."""
        probe, errors = self.probe, {}
        white = self._own["exact", BASE][0][8]
        expected = probe.hits.albedo * (self.lights + self.truth.other) + self.truth.gloss
        for order in BSDF_ORDERS:
            found = probe.shaded_by({"type": "shprt", "transfer": "exact+glossy", "transfer_domain": "pixel", "transfer_samples": BASE,
                                     "order": 8, "bsdf_order": order})
            error = float((abs(found - expected) * probe.hits.lit).sum() / self.total)
            errors[order] = math.sqrt(max(error ** 2 - white ** 2, (error / 4) ** 2))
            if errors[order] < self.max_error / 2:
                break
        return errors

    # For those who ask why

    def cone(self):
        """Median half-angle of the cones of lights as the points see them, in degrees; None if lights are all around them."""
        level = np.concatenate([s.level[-len(self.lights):] for s in self.sights]) if self.sights else np.zeros(0)
        level = level[level < LEVELS]
        return math.degrees(half_angle(float(np.median(level)))) if len(level) else None

    def apparent_sizes(self):
        """Least and largest angle, in degrees, at which lights are seen from the points, 95 % of them; None without such lights."""
        lights = self.probe.state.lights
        if not lights:
            return None
        centres = np.array([light.vertices.mean(axis=0) for light in lights])
        radii = np.array([np.linalg.norm(light.vertices - c, axis=1).max() for light, c in zip(lights, centres)])
        distance = np.linalg.norm(self.probe.hits.p[:, None] - centres, axis=2)
        return np.degrees(np.percentile(2 * np.arctan(radii / np.maximum(distance, 1e-30)), [2.5, 97.5])).tolist()

    def exact_seconds(self, order: int) -> float:
        """Time of all lights at all hits, without a grid."""
        return self.machine.seconds(lights_nanoseconds(self._facets, self._groups, order, self.sizes.hits))

    # Candidates

    def candidates(self) -> list:
        """All settings, with error and time."""
        return [self._candidate(order, direct, bouncing, glossing, self.lights_cost(order))
                for order in ORDERS for direct in self._direct(order) if math.isfinite(self._baked(*direct))
                for bouncing in self._bouncing(*direct) for glossing in self._glossing()]

    def largest(self) -> Candidate:
        """What those take who do not ask: the highest order, many rays, small cells, everything that the scene has, and no grid."""
        lights = lights_nanoseconds(self._facets, self._groups, ORDER, self.sizes.hits), 0
        direct = [d for d in self._direct(ORDER) if d[0] != "unshadowed" and d[1:4] in LARGEST and math.isfinite(self._baked(*d))]
        bouncing, glossing = (list(options)[-1] for options in (self._bouncing(*direct[-1]), self._glossing()))
        return self._candidate(ORDER, direct[-1], bouncing, glossing, lights)

    def _baked(self, direct: str, domain: str, cells: int, *_) -> float:
        """Points to bake."""
        return 0 if direct == "unshadowed" or domain == "pixel" else self.points[cells]

    def _candidate(self, order: int, direct: tuple, bouncing: tuple, glossing: tuple, lights: tuple) -> Candidate:
        """The setting, of what `_direct`, `_bouncing`, `_glossing` and `lights_cost` give."""
        direct, domain, cells, rays, (error, spread) = direct
        bounce_rays, bounce_error, kept_back = bouncing
        bsdf_order, gloss_error, dull = glossing
        nanoseconds, resolution = lights
        points, shadows = self._baked(direct, domain, cells), direct != "unshadowed"
        parts = {"direct light": error, "light grid": GRID_ERROR * self.grid_error if resolution else 0.0,
                 "light between surfaces": bounce_error, "gloss": gloss_error,
                 "left out": kept_back + dull + self.missing + self.black, "rounding": ROUNDING}
        total = math.sqrt(sum(value ** 2 for name, value in parts.items() if name != "left out")) + parts["left out"]
        traced = rays if domain == "pixel" else DEFAULT_SAMPLES["pixel"] * (1 - self.sizes.meshed) * shadows
        bake = bake_seconds(self.machine, self.sizes, points, order, rays)
        picture = picture_seconds(self.machine, self.sizes, direct, order, nanoseconds * (shadows or resolution > 0), traced)
        if bounce_rays:
            bake += bounce_seconds(self.machine, self.sizes, points, bounce_rays)
        if bsdf_order:
            visibility = Settings().visibility_order * shadows
            picture += gloss_seconds(self.machine, self.sizes, bsdf_order, visibility, self.lights_cost(bsdf_order + visibility)[0])
            bake += bake_seconds(self.machine, self.sizes, points, visibility, rays)
        return Candidate(direct, order, domain, rays, self.edges[cells] if points else 0.0, resolution, self.grid_error, bounce_rays,
                         bsdf_order, total, spread, parts, float(bake), float(picture))

    def _direct(self, order: int):
        """(direct, domain, number of the cell size, rays, (error, standard error)) of direct light."""
        error, spread = (float(v[order]) for v in self.unshadowed)
        yield "unshadowed", "vertex", 0, 0, (self._less_noise(error), spread)
        if not self.sights:                           # shadows of lights without an extent are exact
            for rays in (PIXEL_RAYS[0], PIXEL_RAYS[-1]):
                yield "exact", "pixel", 0, rays, (0.0, 0.0)
            return
        for direct in ("shadowed", "exact"):
            own = {rays: float(self._own[direct, rays][0][order]) ** 2 for rays in RAYS}
            spread = float(self._own[direct, BASE][1][order])
            for rays in PIXEL_RAYS:
                steady = float(self._steady[direct, rays][0][order]) ** 2
                noise = max(own[rays] - steady, 0) / (1 - 1 / PIXEL_REPEATS)
                square = max(steady - noise / PIXEL_REPEATS, 0) + noise / self.spp
                yield direct, "pixel", 0, rays, (self._less_noise(math.sqrt(square)), spread)
            for cells in range(len(self.edges)):
                for rays in RAYS:
                    error, spread = (float(v[order]) for v in self._base[direct, cells, min(rays, BASE)])
                    if rays > BASE:
                        error = math.sqrt(max(error ** 2 + own[rays] - own[BASE], (error / 3) ** 2))
                    yield direct, "vertex", cells, rays, (self._less_noise(error), spread)

    def _less_noise(self, error: float) -> float:
        """Without what the truth itself is uncertain by; less than that cannot be told."""
        return max(math.sqrt(max(error ** 2 - self.noise ** 2, 0)), min(error, self.noise))

    def _bouncing(self, direct: str, domain: str, cells: int, *_):
        """(rays between surfaces, error, light left out)."""
        yield 0, 0.0, self.between
        if self._baked(direct, domain, cells) > 0 and self.between > 0:
            for rays in BOUNCE_RAYS:
                yield rays, math.hypot(self.between * BOUNCE_ERROR * math.sqrt(256 / rays), self.between_cells[cells]), 0.0

    def _glossing(self):
        """(bsdf_order, error, gloss left out)."""
        yield 0, 0.0, self.gloss
        for order, error in self.gloss_errors.items():
            yield order, error, 0.0

