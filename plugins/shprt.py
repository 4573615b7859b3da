r"""
.. _integrator-shprt:

SH-lit precomputed radiance transfer (:monosp:`shprt`)
------------------------------------------------------

.. pluginparameters::

 * - order
   - |int|
   - Highest degree of the spherical harmonics, 0 to 64. ``(order + 1)**2`` coefficients are used. Shading time grows with the cube
     of the order, and kernels take long to compile: one to three seconds at 20, about ten at 32. Transfer is localised up to 14. (Default:
     8)

 * - method
   - |string|
   - How polygons are projected: ``recurrence``, ``edge``, ``quadrature`` or ``auto``, see :py:func:`mi_shlight.project_polygon`.
     (Default: ``auto``)

 * - transfer
   - |string|
   - How light reaches the surfaces that are seen. ``unshadowed``: lights shine through everything; analytic, no bake, cheap at any order.
     ``shadowed``: soft shadows. ``exact``: soft shadows, where what is not blocked carries no band limit: Lambert's formula at each hit,
     less the light that is blocked. Additions, joined by ``+``: ``interreflected``, light from diffuse surface to diffuse surface, and
     ``glossy``, all that BSDFs reflect besides. For instance ``exact+interreflected+glossy``. An addition alone goes with ``shadowed``.
     (Default: ``shadowed``)

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
     own samples, edge length and margin. Its transfer must be the base of ``transfer``, its order ``order``; if it is not localised,
     that or more. What ``interreflected`` and ``glossy`` need besides is traced at the first render. (Default: empty)

 * - max_edge
   - |float|
   - Longest edge of a baked triangle in scene units; longer ones are refined for baking only. 0: 1/64 of the diagonal of the
     receivers' bounding box. (Default: 0)

 * - light_margin
   - |float|
   - Distance in scene units by which a light's vertices may move before the transfer is baked again. Optimisations of a light's
     place run faster with a margin of several steps. Of no effect with ``pixel``. (Default: 0)

 * - localised
   - |bool|
   - Fit the transfer of light from polygonal lights to the directions from which it can come, those of the lights grown by
     ``light_margin``, instead of projecting it over the whole sphere: the same number of coefficients then holds much sharper shadows.
     (Default: true)

 * - window
   - |string|
   - Factors on the bands of transfer that is projected over the whole sphere (that of distant lights, and all with ``localised`` false),
     which trade ringing for blur: ``none``, ``hann``, ``lanczos``, ``gauss``. (Default: ``none``)

 * - bounces
   - |int|
   - Number of reflections between surfaces before the one that is seen, with ``interreflected``. 0: until ``bounce_tolerance`` is met, 256
     at most. (Default: 0)

 * - bounce_tolerance
   - |float|
   - Reflections are added until the next adds less than this share of what all have. (Default: 0.001)

 * - bounce_samples
   - |int|
   - Rays per baked point that look for light from other surfaces. (Default: 256)

 * - bounce_lighting
   - |string|
   - ``gather``: the lights light all baked points, from where it is gathered. ``transfer``: as if each light looked the same from the
     points where light is reflected as from where it is seen, exact for distant lights only (Green 2003). (Default: ``gather``)

 * - visibility_order, bsdf_order
   - |int|
   - Highest degrees of visibility and of BSDFs with ``glossy``. (Default: 4 and 8)

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

 * - errors
   - |bool|
   - Output, as AOVs after these, what the picture may be off by, in luminance: ``truncation_bound``, ``grid_error``, ``transfer_error``,
     and ``total_error``, their sum. Not with ``glossy``, ``bounce_lighting`` ``transfer``, or in spectral variants. (Default: false)

Illumination by polygonal area lights: each light is projected to spherical harmonics in closed form at every shading point and
multiplied with the point's transfer vector, :math:`L_r(x) = \rho(x) \sum_{lm} T_{lm}(x) \sum_k L_k\, L_{lm}^{(k)}(x)` (Wang and
Ramamoorthi 2018, equation 4). The picture is free of noise apart from pixel sampling; its error is that of the transfer: its fit or band
limit and, for ``vertex``, its interpolation.

**Transfer.** All that counts is how well the expansion of a transfer function follows it in the directions of the lights. With
``localised`` it is fitted there by least squares, for each light group in a cone about its lights, and all rays go to the cone. Points that
see all of their lights, or nothing of them, have no error but at the lights' horizon. Shadows gain most: order 4 is more accurate than
order 8 was (validation/soft_shadows.py). The cone holds the lights grown by ``light_margin`` and by a cell of the bake; the wider it is,
the less is gained (nothing, at 30 degrees), and lights that are all around, as seen from a point, are projected after all. A fit is of use
at its own order only.

With ``exact`` a point that sees the part v of its lights gets v times Lambert's formula, and only the difference of its shadow from that by
spherical harmonics. It takes a loop over all faces of all lights more, grid or no grid.

``interreflected``: all baked points are lit by all lights and exchange what they reflect by a table of ray hits, one row of
``bounce_samples`` for each point; rows add up to one at most, so no energy comes from nothing. That is exact for near lights and for moving
ones, at once for each picture. The points' reflectance is the mean of the BSDF around them. Surfaces without vertices, such as spheres,
receive bounced light by rays at each hit but send none. Gloss sends no light to other surfaces. Compare with ``path`` at ``max_depth``
``bounces`` + 2, or -1.

``glossy``: what BSDFs reflect besides their diffuse reflectance is tabulated once for each BSDF, over the angle of view, to ``bsdf_order``;
the light's coefficients meet visibility of ``visibility_order`` in products without truncation. Isotropic BSDFs only, in rgb and mono
variants; textures of the gloss count by their means. Lobes narrower than the order can hold come out blurred (validation/glossy.py).

**Lights.** Polygonal lights are all emitters ``shlight`` and ``area`` on rectangles and meshes of any number of faces; they are seen
directly with their radiance. Of a planar mesh of uniform radiance the outline is projected (holes and concave outlines included). Of any
other, bent or closed, those faces count that turn their front to the point, and edges between two that do are left out; that a light's
faces hide one another is not modelled, so meshes should be convex. A textured light is cut into triangles of uniform radiance,
``subdivisions`` of ``shlight``, whose edges are shared. Measured, the mean error of a floor under a light with waves on it, at half its
width: 1.6 % cut in 2, 0.17 % in 32, 0.03 % in 128, the default, 0.006 % in 512. Up to four lights each have their own visibility, in which
the other lights are obstacles; more than four share one, in which no light is. In spectral variants the radiance of meshes and textures is
interpolated between wavelengths 5 nm apart.

``constant``, ``envmap`` and other emitters at an infinite distance are projected to spherical harmonics, maps exactly as Mitsuba
interpolates their pixels; their transfer, of rays that leave the scene, is projected over the sphere, for ``exact`` too. ``directional``,
``point``, ``spot`` and ``projector`` lights are exact, with a ray for the shadow at each hit (and no shadow if ``unshadowed``).

**Errors.** With ``errors`` each pixel says how far off it may be. ``truncation_bound`` bounds what the band limit costs: it is that very
error where nothing is hidden, zero where localised transfer sees all of a light or nothing of it, in shadows the residual of the fit, or
of the projection, times what the harmonics leave of the light. In localised shadows the band limit costs less, an eighth of the bound in
the median; of hundreds of lights, each of which may err by all of it, the bound says little (validation/bounds.py). It knows of an
occluder what the rays of a transfer vector have met, and holds from some 256 rays on; in projected transfer, of which a small light or one
at the horizon meets few rays, that can take more. ``transfer_error`` is an estimate, one standard deviation: of the choice of rays,
of what they may have missed (in projected transfer few of them meet a small light), and of the interpolation between baked points. A
shadow that falls between the points is unknown to it. ``grid_error`` is the estimate by which near and far lights are told apart, root
mean square over a cell, measured for ``hermite``; 0 without a grid. With ``interreflected`` the bound of what each surface gets is sent on
as its light is; the rays that gather light are not judged. Lights without an extent have no band limit. ``total_error`` covers nearly all
pixels, and so lies well above their mean error. All this takes a few times as long as the picture, with ``pixel`` all rays once more.

**Light grid.** With a grid the time for a picture hardly depends on the number of lights: it is made anew for each picture, from where the
lights are, while the transfer is kept within ``light_margin``. It pays from about 50 triangles on. ``grid_error`` is an estimate, kept in
the mean and by nearly all hits (validation/grid.py); where a light changes from near to far, at the border of a cell, values jump by about
that much. Derivatives go through the grid; that lists of near lights change with the lights is no part of them.

Left out, each with a named warning: other emitters, among them the sun's disc of ``sunsky``; specular parts of BSDFs unless ``glossy`` (a
BSDF with no diffuse part is black), mirrors, perturbed normals, opacity. Without ``interreflected`` compare with ``path`` at ``max_depth``
2.

A light counts as planar if its vertices lie within 0.001 of its extent of a plane. An optimisation that bends it goes over from the outline
to the faces, with the same picture where all of them are seen from the front, and for once compiles kernels anew.

Differentiable through ``mi.render``, in forward and reverse mode and without noise beyond that of the pixel samples, with respect to

- radiance and reflectance, spectra and textures (of a light by the means over its triangles), pixels of maps, parameters of glossy BSDFs;
- ``vertex_positions`` of lights and the ``to_world`` of rectangles; soft shadows follow the light, to the band limit of the transfer;
- the points seen: vertices and ``to_world`` of receivers and of the sensor; if ``unshadowed`` also the shading normals. (In forward mode
  Mitsuba loses the ``to_world`` of spheres, with its own integrators, too.)

In the tests they agree with differences between its own pictures to 3e-5. Those by lights and points are the ones of ``edge`` (up to order
32) for every ``method``. The order limits them more than the picture: they look at visibility along the light's outline, where it jumps.
Against exact derivatives, root mean square over the picture, order 8, projected: 0.2 to 2 % without an occluder, 13 to 45 % behind one (10
to 27 % at order 14; validation/gradient_references.py); localised transfer halves that (validation/soft_shadows.py). Optimisation gets
along with that, as sign and place are right. No ``light_margin`` is needed for the derivative; choose it by how far a light moves between
two bakes. Left out is:

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

import warnings
from dataclasses import asdict, fields

import drjit as dr
import mitsuba as mi

from ..errors import StaleTransferWarning, message
from ..light.project import default_error
from ..light.quadrature import node_tables
from ..scene import Fingerprint, refuse, warn
from ..shading.bounce import Bounces
from ..shading.errors import NAMES as ERRORS
from ..shading.errors import picture_errors
from ..shading.hits import BakedTransfer, HitTransfer
from ..shading.lighting import Lighting
from ..shading.near import Points, luminance
from ..shading.settings import DEFAULT_SAMPLES, Settings, read_settings
from ..shading.state import SceneState, moved
from ..transfer.bake import trace_transfer
from ..transfer.store import load_transfer
from .shlight import check_attached


def build():
    """Class of the integrator for Mitsuba's current variant, whose types it is bound to."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    class SHPRT(ADIntegrator):
        __doc__ = globals()["__doc__"]

        def __init__(self, props):
            self._settings = read_settings(props)
            super().__init__(mi.Properties("shprt"))
            self._transfer = load_transfer(self.transfer_file) if self.transfer_file else None
            if self._transfer is not None:
                self._check_file(self._transfer)
            self._state = self._blocked = None
            orders = [self.order] + [self._settings.gloss_light_order] * self._settings.parts.glossy
            self._nodes = [node_tables(mi.Float, n, default_error(mi.Float(0))) for n in orders]    # held for dr.freeze to see

        def _check_file(self, baked) -> None:
            """Raise ValueError unless a bake from a file is what the parameters ask for."""
            of_file = f"of '{self.transfer_file}'"
            if baked.localised and baked.order != self.order:
                raise ValueError(message("shprt", "order", f"be {baked.order}, that {of_file}", self.order,
                                         "Localised transfer is of use at its own order only. Bake it anew at this one."))
            if self.errors and baked.order != self.order:
                raise ValueError(message("shprt", "order", f"be {baked.order}, that {of_file}, with errors", self.order,
                                         "What a bake leaves out is known at its own order only."))
            if baked.order < self.order:
                raise ValueError(message("shprt", "order", f"be at most {baked.order}, that {of_file}", self.order,
                                         "Bake the file at a higher order, or lower 'order'."))
            if baked.transfer != self._settings.parts.direct:
                raise ValueError(message("shprt", "transfer", f"be {baked.transfer}, that {of_file}, or join it", self.transfer,
                                         "Bake the file with the transfer you want."))

        def parameters(self) -> dict:
            """All parameters with their values, as `mi.load_dict` takes them."""
            return asdict(self._settings)

        def to_string(self):
            lines = ",\n".join(f"  {name} = {value!r}" for name, value in self.parameters().items())
            return f"SHPRT[\n{lines}\n]"

        def aov_names(self):
            names = [f"L.{l}.{m}" for l in range(self.order + 1) for m in range(-l, l + 1)] if self.coefficients else []
            return names + (list(ERRORS) if self.errors else [])

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
                self._state = SceneState(scene, self._settings, seen)
            parts = self._settings.parts
            if self._state.gloss:
                self._state.gloss.prepare()
            if parts.direct == "unshadowed" or self.transfer_domain == "pixel":
                return None
            state = self._state
            if changed or state.lookup is None or state.glossy and state.blocked_lookup is None:
                lookup, blocked_lookup, state.lookup = old and old.lookup, old and old.blocked_lookup, None
                transfer = self._current_transfer(scene, self._transfer, parts.direct, same_geometry, progress)
                keep = same_geometry and transfer is self._transfer
                lookup = lookup if keep else transfer.look_up(state.receivers, self.errors)
                if state.glossy:
                    blocked = self._current_transfer(scene, self._blocked, "visibility", same_geometry, progress)
                    kept = same_geometry and blocked is self._blocked
                    state.blocked_lookup, self._blocked = blocked_lookup if kept else blocked.look_up(state.receivers), blocked
                state.lookup, self._transfer = lookup, transfer
                if parts.interreflected:
                    bounces = old and keep and old.bounces
                    state.bounces = bounces or Bounces(scene, transfer, state, self._settings, refuse if self.strict else warn)
                    state.bounces.state = state
            if state.bounces:
                state.bounces.prepare()
            return self._transfer

        def _current_transfer(self, scene, baked, kind: str, same_geometry, progress):
            """The transfer `baked` before, if it still fits the scene, otherwise a new bake."""
            state, from_file = self._state, self.transfer_file and kind != "visibility"
            lit = [r for r in state.receivers if kind == "visibility" or r.diffuse]
            if baked is not None and baked.distant != state.distant.projected:
                if from_file:
                    rule = f"be the bake of a scene {'with' if state.distant.projected else 'without'} light at an infinite distance"
                    raise ValueError(message("shprt", "transfer_file", rule, self.transfer_file, "Bake it anew for this scene."))
                baked = None                          # another kind of light has come or gone
            if baked is not None and from_file and not same_geometry:
                baked.check(scene, lit)
            if baked is not None and (from_file or same_geometry or baked.fits(scene, lit)):
                distance = moved(baked.outlines, [light.outline for light in self._state.lights])
                if distance <= baked.light_margin:
                    return baked
                text = (f"shprt: a light has moved by {distance:.4g} since the transfer was baked, more than light_margin = "
                        f"{baked.light_margin:g}. Raise light_margin to keep a bake while lights move" if distance < float("inf")
                        else "shprt: the lights, or their order, are not those the transfer was baked for")
                if self.strict:
                    raise ValueError(f"{text} (an error because 'strict' is true).")
                if kind != "visibility":              # once is enough
                    warnings.warn(f"{text}; baking again.", StaleTransferWarning, stacklevel=2)
            samples = self.transfer_samples or DEFAULT_SAMPLES["vertex"]
            order = self.visibility_order if kind == "visibility" else self.order
            return trace_transfer(scene, state.lights, lit, order, samples, self.max_edge, self.light_margin, progress,
                                  kind, self.localised, state.distant.projected)

        def sample(self, mode, scene, sampler, ray, active=True, **kwargs):
            self.prepare_scene(scene)
            with dr.resume_grad(when=mode != dr.ADMode.Primal):
                pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
                si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
                valid = active & si.is_valid()
                state = self._state
                table = state.table.attached() if state.table else None
                grids = state.grid, state.gloss_grid if state.glossy else None
                nodes = [self._grid_nodes(grid, table, dr.width(ray)) for grid in grids]
                lighting = Lighting(state, self._settings, table, *nodes)
                reflected, errors = self._reflected(lighting, pi, si, sampler, valid)
                emitted = si.emitter(scene).eval(si, active)
                aovs = []
                if self.coefficients:
                    weigh = lambda radiance: [luminance(radiance, si.wavelengths)]
                    aovs = lighting.coefficients(Points(si.p, si.n, si.wavelengths, valid), weigh)[0]
                return mi.depolarizer(reflected) + emitted, valid, aovs + errors, None

        def _grid_nodes(self, grid, table, points: int):
            """What a light grid holds for this picture, or None without a grid."""
            if grid is None or table is None:
                return None
            if not dr.flag(dr.JitFlag.FreezingScope):
                grid.prepare(table.facets, points)
            elif not grid.prepared:
                raise RuntimeError("shprt: with a light grid 'scene' must be rendered before dr.freeze records a function that renders it. "
                                   "Call mi.render(scene, integrator=integrator) first, and again whenever lights have moved far.")
            return grid.nodes(table.facets)

        def _reflected(self, lighting, pi, si, sampler, valid):
            """Light scattered towards the camera, unpolarised spectrum, and the AOVs of errors, if they are asked for."""
            state, parts = self._state, self._settings.parts
            front, shadows = mi.Frame3f.cos_theta(si.wi) > 0, parts.direct != "unshadowed"
            lit = valid & (front | state.flag(state.two_sided, si.shape, valid)) & ~state.flag(state.black, si.shape, valid)
            points = Points(si.p, dr.select(front, si.sh_frame.n, -si.sh_frame.n), si.wavelengths, lit)

            def transfer(kind, order, lookup):
                baked, where = None, False
                if lookup:
                    rows, weights, where = lookup.rows_at(pi, si.shape, ~front, lit)
                    baked = BakedTransfer(lookup, rows, weights, where, order)
                return HitTransfer(state, self._settings, kind, order, lighting.table, points, sampler, baked, where)

            direct = transfer(parts.direct, self.order, state.lookup) if shadows else None
            white = lighting.white(points, direct, not state.glossy)
            bounced = lambda light: light.white(lighting, points, pi, si.shape, ~front, sampler)
            if parts.interreflected:
                white = white + bounced(state.bounces.picture(lighting))
            reflectance, gloss = mi.unpolarized_spectrum(si.bsdf().eval_diffuse_reflectance(si, lit)), state.gloss
            value, errors = reflectance * white, []
            if self.errors:
                again = bounced if parts.interreflected else None
                errors = picture_errors(lighting, state, self._settings, points, reflectance, direct, again)
            if gloss:
                value *= gloss.share(si.shape, ~front, lit)
            value &= lit
            if not state.glossy:
                return value, errors
            value += state.distant.delta_reflected(si, si.bsdf(), lit, shadows)
            light = lighting.arriving(points, transfer("visibility", self.visibility_order, state.blocked_lookup) if shadows else None)
            return value + gloss.reflected(gloss.attached(), si.shape, points, si.to_world(si.wi), ~front, light), errors

    for name in (field.name for field in fields(Settings)):         # read-only: a bake and its tables depend on them
        setattr(SHPRT, name, property(lambda self, name=name: getattr(self._settings, name)))

    return SHPRT
