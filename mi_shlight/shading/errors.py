"""Errors of a picture at each of its points: what the band limit costs at most, and estimates of the grid's and the transfer's.

**Band limit.** The value of a light group is ``int f T_n`` where ``int f T`` is due, f being the radiance of its lights. Of the difference

- what is known of it counts as it is: where transfer is projected, or unshadowed, the difference between Lambert's formula and its
  spherical harmonics, times the mean visibility v; and what a window takes away;
- of the rest the norm is known, the residual of fit or projection. It meets what the harmonics leave of each light: equation (2) of
  :py:mod:`mi_shlight.transfer.localised`, for the interpolated residual and a cone that holds those of all three baked points. For one
  light and the whole sphere that is ``L_e sqrt(Omega - sum L_lm^2) sqrt(|T|^2 - sum T_lm^2)``;
- and as of no light more is seen than all of it, the true value lies between 0 and Lambert's formula.

The sum of the first two, or the third if that is less, bounds the error of a light group. Light at an infinite distance has no third
bound, and what the harmonics leave of it is that of the whole map.

**Transfer.** Three deviations, taken as independent: that of the visibility by the choice of rays, as the bake estimates it, of which the
light takes its share (noise of density s over the cone makes ``s |F L|`` of the value); that between the three baked points around,
weighted as in the interpolation, for what lies between them; and for what no ray has met, a part of the light that one of them stands for.
Those by rays are independent for the lights of a group, too.

Derived for this package; not in the papers. Nothing here carries derivatives.
"""
from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..light.irradiance import irradiance_shader
from ..light.project import project_light
from ..sh.rotation import rotate_frame
from ..sh.windows import window_factors
from ..transfer.cosine import cosine_bands, cosine_transfer
from ..transfer.localised import Quality, fused_dot
from .near import Points, luminance

NAMES = "truncation_bound", "grid_error", "transfer_error", "total_error"
"""AOVs of `shprt`."""

LEAST = 0.01
"""Smallest part of a light's square that is taken to be left of it: rounding hides less."""

NOISE = 0.4
"""Deviation by the choice of rays over that of the bake's estimate, which takes them as independent: measured 0.26 to 0.44, at 64 to 1024
rays, orders 2 and 5, projected and localised."""

UNSEEN = 0.1
"""Deviation of the visibility where all rays agree, in shares of a ray that meets the light."""

BETWEEN = 0.5
"""Error of interpolated visibility over its deviation between the baked points: measured 0.3 to 1, root mean square over a picture."""


def picture_errors(lighting, state, settings, points: Points, reflectance, transfer=None, bounced=None) -> list:
    """The values of `NAMES` at the hits of a picture, in luminance of the radiance that is seen.

    Parameters
    ----------
    lighting, state, settings
        As :py:class:`PointErrors`.
    reflectance : spectrum
    transfer : BakedTransfer or HitTransfer
        None: nothing casts shadows.
    bounced : function, optional
        Of :py:class:`~mi_shlight.shading.bounce.BouncedLight`, the light that reaches the points from other surfaces.
    """
    with dr.suspend_grad():
        points, reflectance = Points(*dr.detach((*points,))), dr.detach(reflectance)
        seen = lambda radiance: luminance(radiance * reflectance, points.wavelengths)
        (bound,), (deviation,) = PointErrors(lighting, state, settings, lambda radiance: [seen(radiance)]).bounds(points, transfer)
        if bounced:                                   # what may be wrong with the light that is sent on is sent on itself
            spectrum, every = lighting.near.spectrum, PointErrors(lighting, state, settings, list)
            bound += seen(bounced(state.bounces.picture(lighting, lambda points, transfer: spectrum(*every.bounds(points, transfer)[0]))))
        grid = state.grid.error(points.p) * seen(lighting.near.spectrum(1)) if state.grid else mi.Float(0)
        return [dr.select(points.active, value, 0) for value in (bound, grid, deviation, bound + grid + deviation)]


class PointErrors:
    """Errors at surface points, in any number of channels.

    Parameters
    ----------
    lighting : Lighting
        Of the picture.
    state : SceneState
    settings : Settings
    weigh : function
        From the radiance that white surfaces send, a spectrum, to the list of floats in question, linear and not negative.
    """

    def __init__(self, lighting, state, settings, weigh):
        self._lighting, self._state, self._settings, self._weigh = lighting, state, settings, weigh
        self._channels = range(len(weigh(lighting.near.spectrum(0))))
        self._factors = window_factors(settings.window, settings.order) if settings.window != "none" else None

    def bounds(self, points: Points, transfer=None) -> tuple:
        """(bounds of what the band limit costs, standard deviations by the transfer): a float for each channel.

        `transfer` : BakedTransfer or HitTransfer; None: nothing casts shadows.
        """
        bound, variance = [mi.Float(0) for _ in self._channels], [mi.Float(0) for _ in self._channels]
        for part in (self._near, self._far):
            for total, values in zip((bound, variance), part(points, transfer)):
                for c, value in enumerate(values):
                    total[c] = total[c] + value
        return bound, [dr.sqrt(v) for v in variance]

    def _near(self, points: Points, transfer) -> tuple:
        """The same of polygonal lights, with the deviations squared."""
        state, table, order = self._state, self._lighting.table, self._settings.order
        zeros = lambda: [mi.Float(0) for _ in self._channels]
        if table is None:
            return zeros(), zeros()
        cosine = cosine_transfer(points.n, order)
        fits = [fit for fit in (state.fit, state.lookup and state.lookup.fit) if fit and transfer]
        fit = max(fits, key=lambda fit: fit.eps, default=None)          # of points in shapes with and without a bake
        fitted = (state.lookup.fit if state.lookup else state.fit) is not None
        groups = state.groups if transfer else state.light_bounds
        count = dr.opaque(mi.UInt32, dr.width(groups) - 1)              # one kernel for scenes of any number

        def group_body(g, bound, variance):
            lights = tuple(dr.gather(mi.UInt32, groups, g + k) for k in (0, 1))
            coeffs, exact, quality = cosine, None, unshadowed(points)
            if transfer:
                (coeffs, exact), quality = transfer.with_quality(g, lights)
            shown, cut = self._windowed(coeffs, fitted), quality.cut if exact is None else 0      # Lambert's formula is cut off nowhere
            frame, level = mi.Frame3f(quality.axis), fit and fit.level(quality.angle)
            solid_angle = dr.select(quality.angle < math.pi / 2, 2 * math.pi * (1 - dr.cos(quality.angle)), 2 * math.pi)

            def light_body(k, known, rest, rays, value, lambert):
                own = self._light(k, points)
                for c, (coeffs_, energy, lambert_) in enumerate(own):
                    held = coeffs_
                    if fit:
                        held = fit.whitened(level, rotate_frame(coeffs_, frame.s, frame.t, frame.n, order, inverse=True))
                    held, sent, flux = fused_dot(held, held), fused_dot(shown, coeffs_), coeffs_[0] * math.sqrt(4 * math.pi)
                    left = dr.maximum(energy - held, LEAST * energy)
                    known[c] = known[c] + sent - fused_dot(coeffs, coeffs_) + cut * (fused_dot(cosine, coeffs_) - lambert_)
                    rest[c] = rest[c] + dr.sqrt(left) * quality.residual
                    flux = dr.select(flux > 0, flux, dr.inf)
                    noise = NOISE * quality.deviation * dr.sqrt(solid_angle * held) / flux
                    unseen = dr.minimum(UNSEEN * solid_angle * energy / (quality.samples * flux * flux), 1)
                    rays[c] = dr.fma(dr.square(lambert_), dr.square(noise) + dr.square(unseen), rays[c])
                    value[c], lambert[c] = value[c] + sent, lambert[c] + lambert_
                return k + 1, known, rest, rays, value, lambert

            start = (lights[0], zeros(), zeros(), zeros(), zeros(), zeros())
            _, known, rest, rays, value, lambert = dr.while_loop(start, lambda k, *_: k < lights[1], light_body, mode="symbolic")
            for c in self._channels:
                limit = abs(known[c]) + rest[c]
                if transfer:
                    whole = value[c] if exact is None else dr.fma(exact, lambert[c], value[c])
                    limit = dr.minimum(limit, dr.maximum(abs(whole), abs(lambert[c] - whole)))
                bound[c], variance[c] = bound[c] + limit, variance[c] + rays[c] + dr.square(BETWEEN * quality.spread * lambert[c])
            return g + 1, bound, variance

        start = mi.UInt32(0), zeros(), zeros()
        return dr.while_loop(start, lambda g, *_: g < count, group_body, mode="symbolic")[1:]

    def _light(self, k, points: Points) -> list:
        """Of light `k`, by channel: coefficients, integral of the squared radiance, and Lambert's formula over pi."""
        table, order, x = self._lighting.table, self._settings.order, points.p
        size = (order + 1) ** 2
        irradiance = irradiance_shader(points.n)

        def facet_body(i, found):
            facet, apex = table.facets.edges(i, x, points.active), table.facets.apex(i, x)
            coeffs = project_light(facet, x, apex, order, self._settings.method)
            received = irradiance(facet, x, apex) * dr.inv_pi
            radiances = self._weigh(table.radiance(i, points.wavelengths))
            return i + 1, [([dr.fma(r, new, old) for new, old in zip(coeffs, total)],
                            dr.fma(r * r, coeffs[0] * math.sqrt(4 * math.pi), energy), dr.fma(r, received, lambert))
                           for r, (total, energy, lambert) in zip(radiances, found)]

        first, last = (dr.gather(mi.UInt32, self._state.light_facets, k + j) for j in (0, 1))
        start = first, [([mi.Float(0) for _ in range(size)], mi.Float(0), mi.Float(0)) for _ in self._channels]
        return dr.while_loop(start, lambda i, _: i < last, facet_body, mode="symbolic")[1]

    def _far(self, points: Points, transfer) -> tuple:
        """The same of light at an infinite distance."""
        distant, order = self._lighting.distant, self._settings.order
        if not distant.projected:
            return [], []
        light = list(zip(*map(self._weigh, distant.coefficients(points.wavelengths, points.p))))
        left, cosine = self._weigh(distant.remainder()), cosine_transfer(points.n, order)
        coeffs, quality = cosine, unshadowed(points)
        if transfer:
            group = mi.UInt32(self._state.group_count)        # after those of polygonal lights
            (coeffs, _), quality = transfer.with_quality(group, None)
        change = [s - c for s, c in zip(self._windowed(coeffs, False), coeffs)]
        norm = quality.residual + quality.cut * cosine_remainder(order)
        bound = [abs(fused_dot(change, channel)) + norm * rest for channel, rest in zip(light, left)]
        variance = sum(map(dr.square, (NOISE * quality.deviation, UNSEEN / quality.samples, BETWEEN * quality.spread)), mi.Float(0))
        return bound, [variance * dr.square(fused_dot(cosine, channel)) for channel in light]

    def _windowed(self, coeffs: list, fitted: bool) -> list:
        if self._factors is None or fitted:
            return coeffs
        return [c * self._factors[math.isqrt(i)] for i, c in enumerate(coeffs)]


def unshadowed(points: Points) -> Quality:
    """Of the transfer of a surface on which nothing casts shadows."""
    zero = mi.Float(0)
    return Quality(mi.Float(1), zero, mi.Float(1), mi.Vector3f(points.n), mi.Float(math.pi), zero, zero, mi.Float(dr.inf))


def cosine_remainder(order: int) -> float:
    """L2 norm, 1/sqrt(sr), of what the bands to `order` leave of the clamped cosine over pi."""
    held = sum(band * band * (2 * l + 1) / (4 * math.pi) for l, band in enumerate(cosine_bands(order)))
    return math.sqrt(max(2 / (3 * math.pi) - held, 0))
