"""Transfer at surface points: interpolated from what was baked, or by rays."""
from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..transfer.localised import Quality, sample_transfer
from ..transfer.visibility import LightSight, SkySight


class BakedTransfer:
    """Transfer interpolated between rows of a bake.

    Parameters
    ----------
    lookup : TransferLookup
    rows, weights, valid
        As :py:meth:`~mi_shlight.transfer.store.TransferLookup.rows_at` gives them.
    order : int
        Highest degree wanted.
    """

    def __init__(self, lookup, rows, weights, valid, order: int):
        self._lookup, self._order, self._at = lookup, order, (rows, weights, valid)

    def __call__(self, g, lights) -> tuple:
        """(coefficients, visible) of light group `g` with `lights`, the first and one past the last, or None if they are infinitely far
        away. `visible` is None unless it is the part of the exact unshadowed light that the coefficients do not hold.
        """
        visible = self._lookup.visibility(*self._at, g) if self._lookup.kind == "exact" and lights else None
        return self._lookup.coefficients(*self._at, g, self._order), visible

    def with_quality(self, g, lights) -> tuple:
        """(the same, :py:class:`~mi_shlight.transfer.localised.Quality`)."""
        return self(g, lights), self._lookup.quality(*self._at, g)


class HitTransfer:
    """Transfer at camera hits, called as :py:class:`BakedTransfer`: of that where there is any, and by rays elsewhere.

    Parameters
    ----------
    state : SceneState
    settings : Settings
    kind : str
        As in :py:func:`~mi_shlight.transfer.localised.sample_transfer`.
    order : int
    table : LightTable
        Attached.
    points : Points
    sampler : mi.Sampler
    baked : BakedTransfer, optional
    where : Bool
        Points that have baked transfer.
    """

    def __init__(self, state, settings, kind: str, order: int, table, points, sampler, baked=None, where=False):
        self._state, self._kind, self._order, self._baked = state, kind, order, baked
        self._traced = points.active if baked is None else points.active & ~where
        self._rays = baked is None or not state.all_baked
        if not self._rays:
            return
        self._p, self._n = dr.detach(points.p), dr.detach(points.n)
        self._shift = sampler.next_1d(points.active)
        self._samples = settings.pixel_samples
        self._fit = state.blocked_fit if kind == "visibility" else state.fit
        self._lights = state.bake_lights.at(*table.outlines()) if table else None

    def __call__(self, g, lights) -> tuple:
        baked = self._baked(g, lights) if self._baked else (None, None)
        return self._joined(baked, self._trace(lights), lights) if self._rays else baked

    def with_quality(self, g, lights) -> tuple:
        """As :py:meth:`BakedTransfer.with_quality`."""
        baked, known = self._baked.with_quality(g, lights) if self._baked else ((None, None), None)
        if not self._rays:
            return baked, known
        found = self._trace(lights)
        cut = dr.select(found.angle < math.pi - 1e-3, 0, found.visibility)
        quality = Quality(found.visibility, dr.sqrt(found.residual), cut, found.axis, found.angle, dr.sqrt(found.variance), mi.Float(0),
                          mi.Float(self._samples))
        if known:
            quality = Quality(*(dr.select(self._traced, t, b) for t, b in zip(quality, known)))
        return self._joined(baked, found, lights), quality

    def _joined(self, baked: tuple, found, lights) -> tuple:
        """What was `found` where rays were traced, and what is `baked` elsewhere."""
        coeffs, visible = baked
        traced_visible = found.visibility if self._kind == "exact" and lights else None
        if not self._baked:
            return found.coeffs, traced_visible
        coeffs = [dr.select(self._traced, t, c) for t, c in zip(found.coeffs, coeffs)]
        return coeffs, None if visible is None else dr.select(self._traced, traced_visible, visible)

    def _trace(self, lights):
        sight = LightSight(self._state.occluders, self._lights, lights) if lights else SkySight(self._state.occluders.scene)
        kind = "shadowed" if self._kind == "exact" and not lights else self._kind
        return sample_transfer(sight, self._p, self._n, self._order, self._samples, self._shift, self._traced, kind=kind,
                               fit=self._fit if lights else None)
