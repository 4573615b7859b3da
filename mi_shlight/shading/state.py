"""What the integrator `shprt` keeps of a scene between pictures."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lights import LightTable
from ..moving import MovingLights
from ..scene import Fingerprint, aligned, polygon_lights, receivers, refuse, shape_index, warn
from ..scene_grid import SceneGrid
from ..transfer.localised import cone_fit
from ..transfer.visibility import BakeLights, Occluders, light_groups
from .distant import DistantLights
from .glossy import Gloss


class SceneState:
    """What the integrator keeps of a scene between renders: everything that stays as long as no shape moves."""

    DRJIT_STRUCT = dict.fromkeys(("two_sided", "black", "groups", "facets", "polygons", "meshes", "occluders", "table", "bake_lights",
                                  "lookup", "blocked_lookup", "grid", "gloss_grid", "distant", "bounces", "gloss", "fit",
                                  "blocked_fit", "light_facets", "light_bounds"), object)

    def __init__(self, scene, settings, seen: Fingerprint):
        self.seen = seen
        complain = refuse if settings.strict else warn
        self.lights = polygon_lights(scene, complain)
        self.distant = DistantLights(scene, max(settings.order, settings.gloss_light_order if settings.parts.glossy else 0), complain)
        if not (self.lights or self.distant.projected or self.distant.delta_count):
            raise ValueError("shprt: 'scene' must have a light, got none. Put <emitter type=\"shlight\"> or <emitter type=\"area\"> inside "
                             "a rectangle or a mesh, or add an emitter such as 'constant', 'envmap', 'directional', 'point' or 'spot'.")
        self.receivers = receivers(scene, complain, settings.parts.glossy)
        size = 1 + max((shape_index(r.shape) for r in self.receivers), default=0)
        table = np.zeros((2, size), int)
        for r in self.receivers:
            table[:, shape_index(r.shape)] = r.two_sided, r.black
        self.size = size
        self.two_sided, self.black = (mi.UInt32(row.tolist()) for row in table)
        self.all_baked = all(r.baked or r.black for r in self.receivers)
        self.gloss = Gloss(self.receivers, settings.bsdf_order, settings.window, complain) if settings.parts.glossy else None
        bounds = light_groups(len(self.lights))
        self.group_count, self.groups = len(bounds) - 1, mi.UInt32(bounds)
        self.occluders = Occluders(scene, self.lights)
        self.table = self.bake_lights = self.moving = self.facets = self.polygons = self.meshes = None
        self.light_facets = self.light_bounds = None
        self.lookup = self.blocked_lookup = self.grid = self.gloss_grid = self.bounces = self.fit = self.blocked_fit = None
        if self.lights:
            self.table = LightTable(self.lights)
            # bounds of each group among the facets, the polygons and the lights of triangles
            self.facets = aligned(mi.UInt32, self.table.first_facet[bounds])
            self.polygons = aligned(mi.UInt32, np.searchsorted(self.table.polygons, self.table.first_facet[bounds]))
            self.meshes = aligned(mi.UInt32, np.searchsorted(self.table.meshes, bounds))
            if settings.errors:                       # bounds of each light among the facets, and of all lights
                self.light_facets, self.light_bounds = aligned(mi.UInt32, self.table.first_facet), mi.UInt32([0, len(self.lights)])
            self.bake_lights = BakeLights(self.lights, 0.0)
            self.moving = MovingLights(self.lights)
            if settings.localised and not (self.all_baked and settings.transfer_domain == "vertex"):
                self.fit = cone_fit(settings.order, settings.pixel_samples)
                self.blocked_fit = cone_fit(settings.visibility_order, settings.pixel_samples) if self.gloss else None
            if settings.grid_resolution:
                grid = lambda order: SceneGrid(self.receivers, self.table.first_facet[bounds], settings.grid_resolution,
                                               settings.grid_interpolation, settings.grid_error, order, settings.method, settings.errors)
                self.grid, self.gloss_grid = grid(settings.order), grid(settings.gloss_light_order) if self.gloss else None

    @property
    def glossy(self) -> bool:
        """True if gloss is rendered and there is some."""
        return self.gloss is not None and self.gloss.present

    def follow(self, seen: Fingerprint) -> bool:
        """Go along with lights that have moved, and with nothing else; False if the scene has to be looked at anew."""
        if self.seen.geometry != seen.geometry or self.seen.light_faces != seen.light_faces:
            return False
        if self.moving and not self.moving.follow():
            return False
        self.seen = seen
        return True

    def flag(self, table, shape, active):
        """Entry of a per-shape table at a hit, as a mask."""
        number = dr.reinterpret_array(mi.UInt32, shape)
        return dr.gather(mi.UInt32, table, number, active & (number < self.size)) > 0


def moved(old: list, new: list) -> float:
    """Largest distance any vertex of the lights' outlines has moved; infinite if lights or edges were added or removed."""
    if [len(o) for o in old] != [len(n) for n in new]:
        return float("inf")
    if not old:
        return 0.0
    return float(np.linalg.norm(np.concatenate(old) - np.concatenate(new), axis=-1).max())
