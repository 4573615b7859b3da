"""All light that reaches a surface point without another surface in between."""
from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..sh.windows import window_factors
from ..transfer.cosine import cosine_transfer
from .glossy import arriving
from .near import NearLights, Points, added


class Lighting:
    """The lights of a scene for one picture: polygonal ones, distant ones, and those without an extent.

    Parameters
    ----------
    state : SceneState
    settings : Settings
    table : LightTable or None
        Attached; None without polygonal lights.
    nodes, gloss_nodes : NodeTable or None
        The light grids for this picture, if there are any; that for gloss has degrees of its own.
    """

    def __init__(self, state, settings, table, nodes, gloss_nodes):
        self._state, self._settings, self.table = state, settings, table
        self.near = NearLights(state, table, nodes, settings.order, settings.method)
        self._gloss_near = NearLights(state, table, gloss_nodes, settings.gloss_light_order, settings.method)
        self.distant = state.distant.attached()

    def white(self, points: Points, transfer_of=None, deltas: bool = True):
        """Radiance that a white diffuse surface sends; spectrum.

        `transfer_of(g, lights)` gives the transfer of a light group, as :py:class:`~mi_shlight.shading.hits.BakedTransfer` does; the group
        of distant lights comes after those of the polygonal ones. Without it nothing casts shadows. `deltas`: whether lights without an
        extent count.
        """
        if transfer_of is None:
            total = self.near.unshadowed(points)
            if self.distant.projected:
                total += self._far(points, cosine_transfer(points.n, self._settings.order))
        else:
            total = self.transferred(points, transfer_of, self._settings.parts.direct == "exact")
        if not deltas:
            return total
        lit = points.p, points.n, points.wavelengths, points.active
        return total + self.distant.delta_irradiance(*lit, transfer_of is not None)

    def transferred(self, points: Points, transfer_of, exact: bool = False):
        """The same by lights that have an extent, for any transfer; `exact` as in :py:meth:`NearLights.shadowed`."""
        settings, lookup = self._settings, self._state.lookup
        fitted = lookup.localised if lookup else self._state.fit is not None
        factors = window_factors(settings.window, settings.order) if settings.window != "none" else None
        total = self.near.shadowed(points, _windowed(transfer_of, None if fitted else factors), exact)
        if not self.distant.projected:
            return total
        coeffs, _ = _windowed(transfer_of, factors)(mi.UInt32(self._state.group_count), None)
        return total + self._far(points, dr.detach(coeffs))

    def arriving(self, points: Points, blocked_of=None) -> list:
        """What arrives at the points for gloss to reflect, of all lights but those without an extent: for each channel the SH coefficients
        to ``bsdf_order``.

        `blocked_of(g, lights)` gives the coefficients of the part of a light group that is blocked, as `transfer_of` of :py:meth:`white`
        does. Without it nothing is.
        """
        def shadow_of(g, lights):
            if blocked_of is None:
                return lambda light: light
            blocked = [dr.detach(b) for b in blocked_of(g, lights)[0]]
            return lambda light: arriving(blocked, light, order)

        order = self._settings.bsdf_order
        total = self._gloss_near.coefficients(points, shadow_of=shadow_of, order=order)
        if not self.distant.projected:
            return total
        far = [list(channel) for channel in zip(*self.distant.coefficients(points.wavelengths, points.p))]
        return added(total, shadow_of(mi.UInt32(self._state.group_count), None)(far))

    def coefficients(self, points: Points, weigh=list) -> list:
        """SH coefficients of all lights but those without an extent, at the points: one list for each of the floats that `weigh` makes of
        a radiance.
        """
        coeffs = self.near.coefficients(points, weigh)
        if not self.distant.projected:
            return coeffs
        distant = self.distant.coefficients(points.wavelengths, points.p)
        return [[c + d for c, d in zip(*lists)] for lists in zip(coeffs, zip(*(weigh(d) for d in distant)))]

    def _far(self, points: Points, transfer: list):
        coeffs = self.distant.coefficients(points.wavelengths, points.p)
        return sum((c * t for c, t in zip(coeffs, transfer)), self.distant.spectrum(0))


def _windowed(transfer_of, factors):
    """`transfer_of` with each band of its coefficients multiplied by its factor, if there are any."""
    if factors is None:
        return transfer_of

    def windowed(g, lights):
        coeffs, visible = transfer_of(g, lights)
        return [c * factors[math.isqrt(i)] for i, c in enumerate(coeffs)], visible

    return windowed
