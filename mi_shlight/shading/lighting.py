"""All light that reaches a surface point without another surface in between."""
from __future__ import annotations

import math

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

        `transfer_of(g, lights)` gives the transfer of a light group, as :py:class:`~mi_shlight.shading.hits.BakedTransfer` does; the group
        of distant lights comes after those of the polygonal ones. Without it nothing casts shadows.
        """
        if transfer_of is None:
            total = self.near.unshadowed(points)
            if self.distant is not None:
                total += self._far(cosine_transfer(points.n, self._settings.order))
        else:
            total = self.transferred(points, transfer_of)
        lit = points.p, points.n, points.wavelengths, points.active
        return total + self._state.distant.delta_irradiance(*lit, transfer_of is not None)

    def transferred(self, points: Points, transfer_of):
        """The same by lights that have an extent, for any transfer."""
        settings = self._settings
        factors = window_factors(settings.window, settings.order) if settings.window != "none" else None
        total = self.near.shadowed(points, _windowed(transfer_of, None if settings.localised else factors))
        if self.distant is None:
            return total
        coeffs, _ = _windowed(transfer_of, factors)(mi.UInt32(self._state.group_count), None)
        return total + self._far(dr.detach(coeffs))

    def coefficients(self, points: Points, weigh=list) -> list:
        """SH coefficients of all lights but those without an extent, at the points: one list for each of the floats that `weigh` makes of
        a radiance.
        """
        coeffs = self.near.coefficients(points, weigh)
        if self.distant is None:
            return coeffs
        return [[c + d for c, d in zip(*lists)] for lists in zip(coeffs, zip(*(weigh(d) for d in self.distant)))]

    def _far(self, transfer: list):
        return sum((c * t for c, t in zip(self.distant, transfer)), type(self.distant[0])(0))


def _windowed(transfer_of, factors):
    """`transfer_of` with each band of its coefficients multiplied by its factor, if there are any."""
    if factors is None:
        return transfer_of

    def windowed(g, lights):
        coeffs, visible = transfer_of(g, lights)
        return [c * factors[math.isqrt(i)] for i, c in enumerate(coeffs)], visible

    return windowed
