"""Transfer at the points that the camera sees: interpolated from what was baked, or by rays."""
from __future__ import annotations

import drjit as dr

from ..transfer.visibility import shadowed_transfer
from .settings import DEFAULT_SAMPLES


def hit_transfer(state, settings, table, pi, shape, points, back_side, sampler):
    """Function ``(g, first, last)`` that gives the transfer of light group g, lights `first` to `last` - 1, at camera hits.

    Parameters
    ----------
    state : SceneState
        With its look-up if `settings` ask for transfer per vertex.
    table : LightTable
        Attached.
    pi, shape : preliminary intersection and shape of the hits
    points : Points
    back_side : Bool
        True where the back is seen.
    """
    lit, order = points.active, settings.order
    lookup, traced, p, n = None, lit, dr.detach(points.p), dr.detach(points.n)
    if settings.transfer_domain == "vertex":
        lookup = state.lookup
        rows, weights, baked = lookup.rows_at(pi, shape, back_side, lit)
        traced = lit & ~baked
    by_rays = lookup is None or not state.all_baked
    if by_rays:
        shift, lights = sampler.next_2d(lit), state.bake_lights.at(*table.outlines())
        samples = settings.transfer_samples if lookup is None and settings.transfer_samples else DEFAULT_SAMPLES["pixel"]

    def transfer_of(g, first, last):
        coeffs = lookup.coefficients(rows, weights, baked, g, order) if lookup else None
        if not by_rays:
            return coeffs
        found = shadowed_transfer(state.occluders, lights, (first, last), p, n, order, samples, shift, traced)[0]
        return [dr.select(traced, t, c) for t, c in zip(found, coeffs)] if coeffs else found

    return transfer_of
