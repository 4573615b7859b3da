"""All light that reaches a surface point without another surface in between."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..sh.windows import window_factors
from ..transfer.cosine import cosine_transfer
from .near import NearLights, Points


class Lighting:
    """The lights of a scene for one picture: polygonal ones, distant ones, and those without an extent.

    Parameters
    ----------
    state : SceneState
    settings : Settings
    nodes : NodeTable or None
        The light grid for this picture, if there is one.
    table : LightTable or None
        Attached; None without polygonal lights.
    wavelengths
        Of the rays.
    """

    def __init__(self, state, settings, table, nodes, wavelengths):
        self._state, self._settings, self.table = state, settings, table
        self.near = NearLights(state, table, nodes, settings.order, settings.method)
        self.distant = state.distant.coefficients(wavelengths) if state.distant.projected else None

    def white(self, points: Points, transfer_of=None):
        """Radiance that a white diffuse surface sends; spectrum.

        `transfer_of(g, first, last)` gives the transfer vectors of light group g, lights `first` to `last` - 1; the group of distant lights
        comes after those of the polygonal ones. Without it nothing casts shadows.
        """
        direct = self._settings.parts.direct
        if direct == "unshadowed":
            total = self.near.unshadowed(points)
        else:
            total = self.near.shadowed(points, transfer_of)
        if direct == "exact":
            total = self.near.exact(points) - total
        if self.distant is not None:
            total += self._far(points, transfer_of)
        return total + self._state.distant.delta_irradiance(points.p, points.n, points.wavelengths, points.active, direct != "unshadowed")

    def transferred(self, points: Points, transfer_of):
        """``sum_lm T_lm L_lm`` over all lights but those without an extent, for any transfer vectors; spectrum."""
        total = self.near.shadowed(points, transfer_of)
        return total if self.distant is None else total + self._far(points, transfer_of)

    def coefficients(self, points: Points, weigh=list) -> list:
        """SH coefficients of all lights but those without an extent, at the points: one list for each of the floats that `weigh` makes of
        a radiance.
        """
        coeffs = self.near.coefficients(points, weigh)
        if self.distant is None:
            return coeffs
        return [[c + d for c, d in zip(*lists)] for lists in zip(coeffs, zip(*(weigh(d) for d in self.distant)))]

    def _far(self, points: Points, transfer_of):
        if transfer_of is None:
            transfer = cosine_transfer(points.n, self._settings.order)
        else:
            none = mi.UInt32(0)
            transfer = [dr.detach(t) for t in transfer_of(mi.UInt32(self._state.group_count), none, none)]
        if self._settings.window != "none":
            factors = window_factors(self._settings.window, self._settings.order)
            transfer = [t * factors[int(i ** 0.5)] for i, t in enumerate(transfer)]
        return sum((c * t for c, t in zip(self.distant, transfer)), type(self.distant[0])(0))
