r"""
.. _integrator-shprt:

SH-lit precomputed radiance transfer (:monosp:`shprt`)
------------------------------------------------------

.. pluginparameters::

 * - order
   - |int|
   - Highest degree of the spherical harmonics, 0 to 64. ``(order + 1)**2`` coefficients are used. Shading time grows with the cube
     of the order, and kernels take long to compile: one to three seconds at 20, about ten at 32. (Default: 8)

 * - method
   - |string|
   - How polygons are projected: ``recurrence``, ``edge``, ``quadrature`` or ``auto``, see :py:func:`mi_shlight.project_polygon`.
     (Default: ``auto``)

 * - transfer
   - |string|
   - ``unshadowed``: lights shine through everything; analytic, no bake, cheap at any order.
     ``shadowed``: soft shadows. (Default: ``shadowed``)

 * - transfer_domain
   - |string|
   - Where shadowed transfer is computed. ``vertex``: baked once at the vertices of (refined) meshes and interpolated; shapes
     that are not meshes fall back to ``pixel``. ``pixel``: rays are traced at every camera hit, nothing is baked. (Default:
     ``vertex``)

 * - transfer_samples
   - |int|
   - Visibility rays per baked point (``vertex``) or per camera hit (``pixel``). 0 means 1024 and 64. (Default: 0)

 * - transfer_file
   - |string|
   - File with a bake of this scene, written by ``mi-shlight bake`` or :py:meth:`mi_shlight.Transfer.save`, relative to the
     scene's folder. Empty: bake at the first render and keep the result as long as the geometry stays. The file holds its
     own order, which must not be lower than ``order``, and its own samples, edge length and margin. (Default: empty)

 * - max_edge
   - |float|
   - Longest edge of a baked triangle in scene units; longer ones are refined for baking only. 0: 1/64 of the diagonal of the
     receivers' bounding box. (Default: 0)

 * - light_margin
   - |float|
   - Distance in scene units by which a light's vertices may move before the transfer is baked again. Optimisations of a light's
     place run faster with a margin of several steps. Of no effect with ``pixel``. (Default: 0)

 * - grid_resolution
   - |int| or |string|
   - For scenes with dozens of lights or more: coefficients of all lights together, and their gradients, at so many points along each axis
     of the receivers' bounding box, 2 to 256, interpolated in between (Wu et al. 2020, who take 8). ``auto``: what costs least, or none.
     0: no grid, all lights are evaluated at each hit. Not in spectral variants. (Default: 0)

 * - grid_interpolation
   - |string|
   - ``hermite``; for comparison ``tricubic`` (Wu et al., algorithm 4), ``trilinear``, ``taylor``, ``inverse_distance``, see
     :py:class:`mi_shlight.LightGrid`. (Default: ``hermite``)

 * - grid_error
   - |float|
   - Error that interpolation may cause, as a part of what a surface that faces the light sends. Lights that would cause more in a cell of
     the grid, those close to it and those in whose plane it lies, are evaluated at the hit itself. 0: none is, as in the paper.
     (Default: 0.001)

 * - strict
   - |bool|
   - Turn warnings about what is left out of the picture, and about stale transfer, into errors. (Default: false)

 * - coefficients
   - |bool|
   - Output the SH coefficients of the light at the visible points as AOVs ``L.l.m``, in steradians times the luminance of the
     radiance. (Default: false)

Direct illumination of diffuse surfaces by polygonal area lights: each light is projected to spherical harmonics in
closed form at every shading point and multiplied with the point's transfer vector, :math:`L_r(x) = \rho(x) \sum_{lm} T_{lm}(x)
\sum_k L_k\, L_{lm}^{(k)}(x)` (Wang and Ramamoorthi 2018, equation 4). The picture is free of noise apart from pixel sampling;
its error is the band limit of the transfer and, for ``vertex``, its interpolation.

Lights are all emitters ``shlight`` and ``area`` on rectangles and meshes of any number of faces, and are seen directly with their radiance.
Of a planar mesh of uniform radiance the outline is projected (holes and concave outlines included). Of any other, bent or closed, those
faces count that turn their front to the point, and edges between two that do are left out; that a light's faces hide one another is not
modelled, so meshes should be convex. A textured light is cut into triangles of uniform radiance, ``subdivisions`` of ``shlight``, whose
edges are shared. Measured, the mean error of a floor under a light with waves on it, at half its width: 1.6 % cut in 2, 0.17 % in 32,
0.03 % in 128, the default, 0.006 % in 512.
Up to four lights each have their own visibility, in which the other lights are obstacles; more than four share one, in which no light is.
In spectral variants the radiance of meshes and textures is interpolated between wavelengths 5 nm apart.

With a grid the time for a picture hardly depends on the number of lights: it is made anew for each picture, from where the lights are,
while the transfer is kept within ``light_margin``. It pays from about 50 triangles on. ``grid_error`` is an estimate, kept in the mean and
by nearly all hits (validation/grid.py); where a light changes from near to far, at the border of a cell, values jump by about that much.
Derivatives go through the grid; that lists of near lights change with the lights is no part of them.

Left out, each with a named warning: other emitters, specular parts of BSDFs (a BSDF with no diffuse part is black), perturbed
normals, opacity. Interreflection is not computed: compare with ``path`` at ``max_depth`` 2.

A light counts as planar if its vertices lie within 0.001 of its extent of a plane. An optimisation that bends it goes over from the outline
to the faces, with the same picture where all of them are seen from the front, and for once compiles kernels anew.

Differentiable through ``mi.render``, in forward and reverse mode and without noise beyond that of the pixel samples, with respect to

- radiance and reflectance, spectra and textures (of a light by the means over its triangles);
- ``vertex_positions`` of lights and the ``to_world`` of rectangles; soft shadows follow the light, to the band limit of the transfer;
- the points seen: vertices and ``to_world`` of receivers and of the sensor; if ``unshadowed`` also the shading normals. (In forward mode
  Mitsuba loses the ``to_world`` of spheres, with its own integrators, too.)

In the tests they agree with differences between its own pictures to 3e-5. Those by lights and points are the ones of ``edge`` (up to order
32) for every ``method``. The order limits them more than the picture: they look at visibility along the light's outline, where it jumps.
Against exact derivatives, root mean square over the picture, order 8: 0.2 to 2 % without an occluder, 13 to 45 % behind one (10 to 27 %
at order 14; validation/gradient_references.py). Optimisation gets along with that, as sign and place are right. No ``light_margin`` is
needed for the derivative; choose it by how far a light moves between two bakes. Left out is:

- The change of shadowed transfer, which is a constant of each pixel: occluders have no derivative, and a receiver or sensor that moves
  takes along the visibility and the cosine that each pixel has. A light beyond ``light_margin`` is baked anew before the next picture,
  which is no part of any derivative; with ``pixel`` neither is the change of the rays' directions.
- Outlines that the camera sees, of lights and all other shapes: keep those that move out of view.

``dr.freeze`` records functions that render and differentiate. Update the scene outside the function. Transfer per vertex is not
baked inside either: call the integrator's ``prepare_scene(scene)`` before the first call and after each change of geometry. Otherwise the
function keeps the transfer it has (``unshadowed`` and ``pixel`` need no more than the first call). With a grid render a picture first:
lists of near lights are those of the last picture outside the function.

.. tabs::
    .. code-tab:: xml

        <integrator type="shprt">
            <integer name="order" value="8"/>
            <string name="transfer" value="shadowed"/>
        </integrator>

    .. code-tab:: python

        'type': 'shprt',
        'order': 8,
        'transfer': 'shadowed'

JIT variants (``llvm_*``, ``cuda_*``) only.
"""
from __future__ import annotations

import os
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import StaleTransferWarning, check_choice, check_integer, check_number, check_parameters, message
from ..grid.cells import INTERPOLATIONS, MAX_RESOLUTION
from ..light.mesh import mesh_shader, project_mesh_light, zonal_mesh_shader
from ..light.project import METHODS, default_error, light_shader, project_light
from ..light.quadrature import node_tables
from ..light.zonal import times_pole_value, zonal_lambert, zonal_light_shader, zonal_shader
from ..lights import LightTable
from ..moving import MovingLights
from ..scene import Fingerprint, aligned, polygon_lights, receivers, refuse, shape_index, warn
from ..scene_grid import SceneGrid
from ..sh.basis import check_order
from ..transfer.bake import trace_transfer
from ..transfer.cosine import cosine_transfer
from ..transfer.store import load_transfer
from ..transfer.visibility import BakeLights, Occluders, light_groups, shadowed_transfer
from .shlight import check_attached

DEFAULT_SAMPLES = {"vertex": 1024, "pixel": 64}

DEFAULTS = {"order": 8, "method": "auto", "transfer": "shadowed", "transfer_domain": "vertex", "transfer_samples": 0,
            "transfer_file": "", "max_edge": 0.0, "light_margin": 0.0, "grid_resolution": 0, "grid_interpolation": "hermite",
            "grid_error": 1e-3, "strict": False, "coefficients": False}


def read_parameters(props) -> dict:
    """Checked parameters of the plugin; TypeError or ValueError names a bad one, its rule and the fix."""
    check_parameters("shprt", props, tuple(DEFAULTS))
    value = {name: props.get(name, default) for name, default in DEFAULTS.items()}
    value["order"] = check_order("shprt", value["order"])
    check_choice("shprt", "method", value["method"], METHODS)
    check_choice("shprt", "transfer", value["transfer"], ("unshadowed", "shadowed"))
    check_choice("shprt", "transfer_domain", value["transfer_domain"], tuple(DEFAULT_SAMPLES))
    hint = "It is a number of rays; 0 chooses by transfer_domain."
    value["transfer_samples"] = check_integer("shprt", "transfer_samples", value["transfer_samples"], 0, 65536, hint)
    for name in ("max_edge", "light_margin"):
        value[name] = check_number("shprt", name, value[name], 0, hint="It is a length in scene units.")
    if isinstance(value["grid_resolution"], str) and value["grid_resolution"].isdigit():       # -D name=value gives text
        value["grid_resolution"] = int(value["grid_resolution"])
    if value["grid_resolution"] != "auto":
        hint = "It is a number of grid points along an axis; 0: no grid, 'auto': what costs least."
        value["grid_resolution"] = check_integer("shprt", "grid_resolution", value["grid_resolution"], 0, MAX_RESOLUTION, hint)
        if value["grid_resolution"] == 1:
            raise ValueError(message("shprt", "grid_resolution", "be 0, 'auto', or two or more", 1, hint))
    if value["grid_resolution"] != 0 and mi.is_spectral:
        raise ValueError(message("shprt", "grid_resolution", "be 0 in spectral variants", value["grid_resolution"],
                                 "A grid holds sums over lights for a few channels. Use an rgb or mono variant."))
    check_choice("shprt", "grid_interpolation", value["grid_interpolation"], INTERPOLATIONS)
    hint = "It is a relative error; 0 interpolates all lights."
    value["grid_error"] = check_number("shprt", "grid_error", value["grid_error"], 0, 1, hint)
    if value["grid_resolution"] == "auto" and value["grid_error"] == 0:
        rule = "be above 0 with grid_resolution='auto', which chooses by it"
        raise ValueError(message("shprt", "grid_error", rule, value["grid_error"], "For instance 1e-3."))
    for name in ("strict", "coefficients"):
        if not isinstance(value[name], bool):
            raise TypeError(message("shprt", name, "be true or false", value[name]))
    if not isinstance(value["transfer_file"], str):
        raise TypeError(message("shprt", "transfer_file", "be the path of a baked file", value["transfer_file"]))
    if value["transfer_file"]:
        if value["transfer"] != "shadowed" or value["transfer_domain"] != "vertex":
            raise ValueError(message("shprt", "transfer_file", "go with transfer='shadowed' and transfer_domain='vertex'",
                                     value["transfer_file"], "Leave it out, or change those."))
        path = str(mi.file_resolver().resolve(value["transfer_file"]))
        if not os.path.isfile(path):
            raise FileNotFoundError(message("shprt", "transfer_file", "name an existing file", value["transfer_file"],
                                            "Bake one with 'mi-shlight bake SCENE -o FILE', or leave it out to bake at the first render."))
        value["transfer_file"] = path
    return value


class SceneState:
    """What the integrator keeps of a scene between renders: everything that stays as long as no shape moves."""

    DRJIT_STRUCT = dict.fromkeys(("two_sided", "black", "groups", "polygons", "meshes", "occluders", "table", "bake_lights", "lookup",
                                  "grid"), object)

    def __init__(self, scene, strict: bool, seen: Fingerprint):
        self.seen = seen
        complain = refuse if strict else warn
        self.lights = polygon_lights(scene, complain)
        self.receivers = receivers(scene, complain)
        size = 1 + max((shape_index(r.shape) for r in self.receivers), default=0)
        table = np.zeros((2, size), int)
        for r in self.receivers:
            table[:, shape_index(r.shape)] = r.two_sided, r.black
        self.size = size
        self.two_sided, self.black = (mi.UInt32(row.tolist()) for row in table)
        self.all_baked = all(r.baked or r.black for r in self.receivers)
        bounds = light_groups(len(self.lights))
        self.group_count, self.groups = len(bounds) - 1, mi.UInt32(bounds)
        self.occluders = Occluders(scene, self.lights)
        self.table = LightTable(self.lights)
        # bounds of each group among the polygons and the lights of triangles
        self.polygons = aligned(mi.UInt32, np.searchsorted(self.table.polygons, self.table.first_facet[bounds]))
        self.meshes = aligned(mi.UInt32, np.searchsorted(self.table.meshes, bounds))
        self.bake_lights = BakeLights(self.lights, 0.0)
        self.moving = MovingLights(self.lights)
        self.lookup = self.grid = None

    def follow(self, seen: Fingerprint) -> bool:
        """Go along with lights that have moved, and with nothing else; False if the scene has to be looked at anew."""
        if self.seen.geometry != seen.geometry or self.seen.light_faces != seen.light_faces or not self.moving.follow():
            return False
        self.seen = seen
        return True

    def make_grid(self, resolution, interpolation: str, max_error: float, order: int, method: str) -> None:
        """Set up the light grid."""
        facets = self.table.first_facet[light_groups(len(self.lights))]
        self.grid = SceneGrid(self.receivers, facets, resolution, interpolation, max_error, order, method)

    def flag(self, table, shape, active):
        """Entry of a per-shape table at a hit, as a mask."""
        number = dr.reinterpret_array(mi.UInt32, shape)
        return dr.gather(mi.UInt32, table, number, active & (number < self.size)) > 0


def moved(old: list, new: list) -> float:
    """Largest distance any vertex of the lights' outlines has moved; infinite if lights or edges were added or removed."""
    if [len(o) for o in old] != [len(n) for n in new]:
        return float("inf")
    return float(np.linalg.norm(np.concatenate(old) - np.concatenate(new), axis=-1).max())


def build():
    """Class of the integrator for Mitsuba's current variant, whose types it is bound to."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    class SHPRT(ADIntegrator):
        __doc__ = globals()["__doc__"]

        def __init__(self, props):
            self._parameters = read_parameters(props)
            super().__init__(mi.Properties("shprt"))
            self._transfer = load_transfer(self.transfer_file) if self.transfer_file else None
            if self._transfer is not None and self._transfer.order < self.order:
                rule = f"be at most {self._transfer.order}, the order of '{self.transfer_file}'"
                raise ValueError(message("shprt", "order", rule, self.order, "Bake the file at a higher order, or lower 'order'."))
            self._state = None
            self._nodes = node_tables(mi.Float, self.order, default_error(mi.Float(0)))     # held for dr.freeze to see

        def parameters(self) -> dict:
            """All parameters with their values, as `mi.load_dict` takes them."""
            return dict(self._parameters)

        def to_string(self):
            lines = ",\n".join(f"  {name} = {value!r}" for name, value in self._parameters.items())
            return f"SHPRT[\n{lines}\n]"

        def aov_names(self):
            if not self.coefficients:
                return []
            return [f"L.{l}.{m}" for l in range(self.order + 1) for m in range(-l, l + 1)]

        def prepare_scene(self, scene, progress=True):
            """Find the lights and bake the transfer if that is due; rendering calls it. Returns the baked transfer or None.

            `progress`: as in :py:func:`mi_shlight.bake_transfer`.

            While `dr.freeze` records a function nothing can be looked at or baked: what was prepared before is used as it is.
            """
            if dr.flag(dr.JitFlag.FreezingScope):
                if self._state is None or self._state.occluders.scene is not scene:
                    raise RuntimeError("shprt: 'scene' must be prepared before dr.freeze records a function that renders it. Call "
                                       "integrator.prepare_scene(scene) first, and again whenever a shape has moved.")
                return self._transfer
            seen = Fingerprint(scene)
            old = self._state
            changed = old is None or (old.seen.geometry, old.seen.lights) != (seen.geometry, seen.lights)
            # Without a look-up the last attempt failed, and what it found out about the transfer does not count.
            same_geometry = old is not None and old.lookup is not None and old.seen.geometry == seen.geometry
            if changed and not (old and old.follow(seen)):
                check_attached(scene)
                self._state = SceneState(scene, self.strict, seen)
                if self.grid_resolution:
                    self._state.make_grid(self.grid_resolution, self.grid_interpolation, self.grid_error, self.order, self.method)
            if self.transfer == "unshadowed" or self.transfer_domain == "pixel":
                return None
            if changed or self._state.lookup is None:
                lookup, self._state.lookup = old and old.lookup, None
                transfer = self._current_transfer(scene, same_geometry, progress)
                keep = same_geometry and transfer is self._transfer
                self._state.lookup = lookup if keep else transfer.look_up(scene)
                self._transfer = transfer
            return self._transfer

        def _current_transfer(self, scene, same_geometry, progress):
            """The transfer at hand if it still fits the scene, otherwise a new bake."""
            baked = self._transfer
            if baked is not None and self.transfer_file and not same_geometry:
                baked.check(scene)
            if baked is not None and (self.transfer_file or same_geometry or baked.fits(scene)):
                distance = moved(baked.outlines, [light.outline for light in self._state.lights])
                if distance <= baked.light_margin:
                    return baked
                text = (f"shprt: a light has moved by {distance:.4g} since the transfer was baked, more than light_margin = "
                        f"{baked.light_margin:g}. Raise light_margin to keep a bake while lights move" if distance < float("inf")
                        else "shprt: the lights, or their order, are not those the transfer was baked for")
                if self.strict:
                    raise ValueError(f"{text} (an error because 'strict' is true).")
                warnings.warn(f"{text}; baking again.", StaleTransferWarning, stacklevel=2)
            samples = self.transfer_samples or DEFAULT_SAMPLES["vertex"]
            return trace_transfer(scene, self._state.lights, self._state.receivers, self.order, samples, self.max_edge,
                                  self.light_margin, progress)

        def sample(self, mode, scene, sampler, ray, active=True, **kwargs):
            self.prepare_scene(scene)
            with dr.resume_grad(when=mode != dr.ADMode.Primal):
                pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
                si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
                valid = active & si.is_valid()
                table = self._state.table.attached()
                nodes = self._grid_nodes(table, dr.width(ray))
                reflected = self._reflected(table, nodes, pi, si, sampler, valid)
                emitted = si.emitter(scene).eval(si, active)
                aovs = self._coefficients(table, nodes, si, valid) if self.coefficients else []
                return mi.depolarizer(reflected) + emitted, valid, aovs, None

        def _grid_nodes(self, table, points: int):
            """What the light grid holds for this picture, or None without a grid."""
            grid = self._state.grid
            if grid is None:
                return None
            if not dr.flag(dr.JitFlag.FreezingScope):
                grid.prepare(table.facets, points)
            elif not grid.prepared:
                raise RuntimeError("shprt: with a light grid 'scene' must be rendered before dr.freeze records a function that renders it. "
                                   "Call mi.render(scene, integrator=integrator) first, and again whenever lights have moved far.")
            return grid.nodes(table.facets)

        def _reflected(self, table, nodes, pi, si, sampler, valid):
            """Light scattered towards the camera; unpolarised spectrum."""
            state = self._state
            front = mi.Frame3f.cos_theta(si.wi) > 0
            lit = valid & (front | state.flag(state.two_sided, si.shape, valid)) & ~state.flag(state.black, si.shape, valid)
            n = dr.select(front, si.sh_frame.n, -si.sh_frame.n)
            method = self.method if nodes is None else nodes.method
            shading_of = self._shading_source(table, method, pi, si, n, ~front, sampler, lit)
            irradiance = self._lighting(table, nodes, shading_of, si, n, lit)
            return mi.unpolarized_spectrum(si.bsdf().eval_diffuse_reflectance(si, lit)) * irradiance & lit

        def _shading_source(self, table, method: str, pi, si, n, back_side, sampler, lit):
            """Function from a light group's number to the transfer at each hit, and the shaders, for polygons and for meshes, that meet the
            group's lights with it.

            All are given the normal, too: only unshadowed transfer follows it, and only from a loop's state come derivatives.
            """
            if self.transfer == "unshadowed":
                shading = lambda n: cosine_transfer(n, self.order), *self._unshadowed_shaders(n, method)
                return lambda g, first, last: shading
            state, lookup, traced, p, n = self._state, None, lit, dr.detach(si.p), dr.detach(n)
            if self.transfer_domain == "vertex":
                lookup = state.lookup
                rows, weights, baked = lookup.rows_at(pi, si.shape, back_side, lit)
                traced = lit & ~baked
            if lookup is None or not state.all_baked:
                shift, lights = sampler.next_2d(lit), state.bake_lights.at(*table.outlines())
                samples = self.transfer_samples if lookup is None and self.transfer_samples else DEFAULT_SAMPLES["pixel"]

            def shading_of(g, first, last):
                coeffs = lookup.coefficients(rows, weights, baked, g, self.order) if lookup else None
                if lookup is None or not state.all_baked:
                    by_rays = shadowed_transfer(state.occluders, lights, (first, last), p, n, self.order, samples,
                                                shift, traced)[0]
                    coeffs = [dr.select(traced, t, c) for t, c in zip(by_rays, coeffs)] if coeffs else by_rays
                coeffs = [dr.detach(t) for t in coeffs]
                shade, shade_mesh = light_shader(coeffs, self.order, method), mesh_shader(coeffs, self.order, method)
                return lambda n: coeffs, lambda light, x, apex, n: shade(light, x, apex), lambda light, x, n: shade_mesh(light, x)

            return shading_of

        def _unshadowed_shaders(self, n, method: str):
            """Shaders for hits with normal `n` where nothing casts shadows."""
            weights = times_pole_value(zonal_lambert(self.order))       # symmetric about n: order + 1 numbers instead of (order + 1)^2
            by_zones = zonal_shader if method == "edge" else zonal_light_shader
            zonal = lambda light, x, apex, n: by_zones(n, weights)(light, x, apex)
            if method in ("auto", "edge"):
                return zonal, zonal_mesh_shader(weights, method)
            transfer = cosine_transfer(dr.detach(n), self.order)
            full, full_mesh = (make(transfer, self.order, method) for make in (light_shader, mesh_shader))
            if not dr.grad_enabled(n):
                return lambda light, x, apex, n: full(light, x, apex), lambda light, x, n: full_mesh(light, x)

            def shade(light, x, apex, n):
                turned = zonal(light.detached(), dr.detach(x), apex, n)
                return full(light, x, apex) + dr.replace_grad(mi.Float(0), turned)

            def shade_mesh(light, x, n):
                value, turned = full_mesh(light, x), zonal_mesh_shader(weights)(light.detached(), dr.detach(x), n)
                return value + dr.replace_grad(type(value)(0), turned)

            return shade, shade_mesh

        def _lighting(self, table, nodes, shading_of, si, n, lit):
            """``sum_k L_k sum_lm T_lm L_lm`` over all lights: the radiance a white surface would send to the camera."""
            state, wavelengths, Spectrum = self._state, si.wavelengths, table.spectrum
            meshes = table.mesh_light(wavelengths) if len(table.meshes) and nodes is None else None

            def each(body, first, last, x, n):
                step = lambda k, total, x, n: (k + 1, total + body(k, x, n), x, n)
                return dr.while_loop((first, Spectrum(0), x, n), lambda k, *_: k < last, step, mode="symbolic", max_iterations=-1)[1]

            def group_body(g, total, x, n):
                bounds = lambda table: (dr.gather(mi.UInt32, table, g), dr.gather(mi.UInt32, table, g + 1))
                transfer, shade, shade_mesh = shading_of(g, *bounds(state.groups))
                if nodes is not None:
                    return g + 1, total + Spectrum(*nodes.shade(x, transfer(n), shade, g, lit, (n,))), x, n

                def polygon(i, x, n):
                    k = table.polygon(i)
                    return table.radiance(k, wavelengths) * shade(table.facets.edges(k, x, lit), x, table.facets.apex(k, x), n)

                def mesh(k, x, n):
                    value = shade_mesh(meshes.part(k), x, n)
                    return Spectrum(value) if dr.depth_v(value) == 1 else Spectrum(*value)

                if len(table.polygons):
                    total = total + each(polygon, *bounds(state.polygons), x, n)
                if meshes:
                    total = total + each(mesh, *bounds(state.meshes), x, n)
                return g + 1, total, x, n

            start = (mi.UInt32(0), Spectrum(0), mi.Point3f(si.p), mi.Normal3f(n))
            return dr.while_loop(start, lambda g, *_: g < state.group_count, group_body, mode="symbolic", max_iterations=-1)[1]

        def _coefficients(self, table, nodes, si, valid):
            """SH coefficients of all lights at the hits, weighted by the luminance of their radiance."""
            wavelengths = si.wavelengths
            weigh = lambda radiance: luminance(radiance, wavelengths)
            if nodes is not None:
                groups = [nodes.eval(mi.Point3f(si.p), mi.UInt32(g), valid) for g in range(self._state.group_count)]
                return [sum(weigh(table.spectrum(*colour)) for colour in colours) for colours in zip(*groups)]

            def each(body, count):
                def step(k, total, x):
                    weight, coeffs = body(k, x)
                    return k + 1, [dr.fma(weight, c, t) for c, t in zip(coeffs, total)], x

                start = (mi.UInt32(0), [mi.Float(0) for _ in range((self.order + 1) ** 2)], mi.Point3f(si.p))
                return dr.while_loop(start, lambda k, *_: k < count, step, mode="symbolic", max_iterations=-1)[1]

            def polygon(i, x):
                k = table.polygon(i)
                coeffs = project_light(table.facets.edges(k, x, valid), x, table.facets.apex(k, x), self.order, self.method)
                return weigh(table.radiance(k, wavelengths)), coeffs

            sums = []
            if len(table.polygons):
                sums.append(each(polygon, len(table.polygons)))
            if len(table.meshes):
                meshes = table.mesh_light(wavelengths, weigh)
                mesh = lambda k, x: (1, project_mesh_light(meshes.part(k), x, self.order, self.method))
                sums.append(each(mesh, len(table.meshes)))
            return [sum(values) for values in zip(*sums)]

    for name in DEFAULTS:                             # read-only: a bake and its tables depend on them
        setattr(SHPRT, name, property(lambda self, name=name: self._parameters[name]))

    def luminance(radiance, wavelengths):
        if mi.is_monochromatic:
            return radiance[0]
        return mi.luminance(radiance, wavelengths) if mi.is_spectral else mi.luminance(radiance)

    return SHPRT
