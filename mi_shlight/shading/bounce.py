"""Light that reaches surface points by way of other diffuse surfaces."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..errors import message
from ..scene import shape_name
from ..transfer.bounce import MAX_BOUNCES, BakedPoints, bounced_at, solve_bounces, trace_bounces
from ..transfer.cosine import cosine_transfer
from .hits import BakedTransfer
from .near import Points

PIXEL_SAMPLES = 64
"""Rays per camera hit on a shape without baked points."""

SPECTRAL_NODES = 24
"""Wavelengths, about 20 nm apart, at which bounced light is held in spectral variants."""


class Bounces:
    """What stays of a scene's interreflection as long as its transfer does.

    Parameters
    ----------
    scene : mi.Scene
    transfer : Transfer
        Its rows exchange light.
    state : SceneState
        With the look-up of `transfer`.
    settings : Settings
    complain : callable
        Gets a sentence about shapes that do not take part.
    progress : callable, optional
    """

    DRJIT_STRUCT = dict.fromkeys(("_points", "_gather", "_rows", "transfer", "_reflectance"), object)

    def __init__(self, scene, transfer, state, settings, complain, progress=None):
        self.scene, self.state, self._settings, self._complain = scene, state, settings, complain
        self._points = BakedPoints(transfer, state.receivers)
        self._gather = trace_bounces(scene, state.lookup, self._points, settings.bounce_samples, progress)
        self.spectrum = type(mi.unpolarized_spectrum(mi.Spectrum(0)))
        self.channels = SPECTRAL_NODES if mi.is_spectral else len(self.spectrum(0))
        self.count, self.size = self._points.count, (settings.order + 1) ** 2
        self._rows = dr.arange(mi.UInt32, self.count)
        dr.eval(self._rows)
        self._bounces = settings.bounces or MAX_BOUNCES
        self.transfer = self._reflectance = None
        if settings.bounce_lighting == "transfer" and state.distant.delta_count:
            complain("light from emitters without an extent is not reflected between surfaces with bounce_lighting='transfer'. Choose "
                     "'gather'.")
        lacking = [shape_name(r.shape) for r in state.receivers if not (r.baked or r.black)]
        if lacking:
            complain(f"{len(lacking)} shape(s) without vertices, such as '{lacking[0]}': they receive light from other surfaces but "
                     "reflect none towards them. Make them meshes.")

    def prepare(self) -> None:
        """Bake interreflected transfer ([G03] diffuse interreflected transfer) for the present reflectances, if the settings ask for it and
        it is not at hand. While `dr.freeze` records, what was baked before is kept.
        """
        if self._settings.bounce_lighting == "transfer" and not dr.flag(dr.JitFlag.FreezingScope):
            with dr.suspend_grad():
                reflectance = self._at_rows(self._reflecting)
                if self.transfer is None or not dr.all(reflectance == self._reflectance):
                    self.transfer, self._reflectance = self._interreflected(reflectance), reflectance

    def picture(self, lighting, direct=None) -> "BouncedLight":
        """Bounced light for the lights, of class `Lighting`, and reflectances as they are now.

        `direct(points, transfer)`: what reaches the baked points, in place of ``lighting.white``; not negative.
        """
        if self._settings.bounce_lighting == "transfer":
            self.prepare()
            return BouncedLight(self, None, None)
        reflectance = self._at_rows(self._reflecting)
        arriving = direct or lighting.white
        direct = self._at_rows(lambda rows, wavelengths: self._direct(arriving, rows, wavelengths))
        bounced = self._solve(direct, reflectance, self.channels)
        sent = None
        if not self.state.all_baked:                  # others are one bounce further on
            sent = reflectance * self._shown(direct + bounced.total - bounced.last, self.channels)
        return BouncedLight(self, self._shown(bounced.total, self.channels), sent)

    def _at_rows(self, spectrum_at):
        """Flat values of all channels of all rows: `spectrum_at(rows, wavelengths)`."""
        wavelengths = dr.zeros(mi.SurfaceInteraction3f).wavelengths
        if not mi.is_spectral:
            return dr.ravel(spectrum_at(self._rows, wavelengths))
        packs = self.channels // len(wavelengths)
        lane = dr.arange(mi.UInt32, self.count * packs)
        row = lane // packs
        node = mi.Float((lane - row * packs) * len(wavelengths))
        nodes = [mi.MI_CIE_MIN + _spectral_step() * (node + k) for k in range(len(wavelengths))]
        return dr.ravel(spectrum_at(row, type(wavelengths)(nodes)))

    def _reflecting(self, rows, wavelengths):
        return self._points.reflectance(rows, wavelengths, self.state.gloss and self.state.gloss.share)

    def _direct(self, arriving, rows, wavelengths):
        p, n = (dr.gather(type(v), dr.ravel(v), rows) for v in (self._points.positions, self._points.normals))
        points = Points(p, n, wavelengths, mi.Bool(True))
        return arriving(points, BakedTransfer(self.state.lookup, [rows], [mi.Float(1)], True, self._settings.order))

    def _solve(self, direct, reflectance, channels: int):
        frozen = dr.flag(dr.JitFlag.FreezingScope)    # nothing can be measured there
        tolerance = 0 if self._settings.bounces or frozen else self._settings.bounce_tolerance
        bounces = self._bounces if frozen else self._settings.bounces or MAX_BOUNCES
        bounced = solve_bounces(self._gather, direct, reflectance, channels, bounces, tolerance)
        self._bounces = bounced.count
        if not bounced.converged:
            self._complain(f"light between surfaces has not died down after {MAX_BOUNCES} bounces; the rest, more than bounce_tolerance, "
                           "is left out. Closed rooms of reflectance near 1 do that: lower the reflectance.")
        return bounced

    def _shown(self, field, channels: int):
        """Values of the rows that stand in for others, in the others' place."""
        value = dr.arange(mi.UInt32, self.count * channels)
        row = value // channels
        return dr.gather(mi.Float, field, dr.gather(mi.UInt32, self._gather.stand_in, row) * channels + (value - row * channels))

    def _interreflected(self, reflectance):
        """Transfer vectors of all light groups, rows and channels, one after the other."""
        lookup, count, size = self.state.lookup, self.count, self.size
        floats = len(lookup.coeffs) // lookup.count * self.channels * size
        if floats >= 2 ** 32:                         # the look-up counts them in 32 bits
            raise ValueError(message("shprt", "bounce_lighting", "be 'gather' for so many baked points", "transfer",
                                     f"Interreflected transfer of {count} points would be {floats} numbers."))
        value = dr.arange(mi.UInt32, count * self.channels * size)
        row, coefficient = value // (self.channels * size), value % size
        colours = dr.gather(mi.Float, reflectance, value // size)
        groups = []
        for g in range(len(lookup.coeffs) // (count * lookup.count)):
            start = dr.gather(mi.Float, lookup.coeffs, (row + g * count) * lookup.count + coefficient)
            if lookup.kind == "exact" and g < self.state.group_count:      # whose vectors hold what the mean visibility leaves
                cosine = dr.concat(cosine_transfer(self._points.normals, self._settings.order))
                start += dr.gather(mi.Float, lookup.means, row + g * count) * dr.gather(mi.Float, cosine, coefficient * count + row)
            groups.append(self._shown(self._solve(start, colours, self.channels * size).total, self.channels * size))
            dr.eval(groups)
        return dr.concat(groups) if groups else dr.zeros(mi.Float, 1)


class BouncedLight:
    """Bounced light for one picture: :py:meth:`Bounces.picture`."""

    def __init__(self, bounces: Bounces, arriving, sent):
        self._bounces, self._arriving, self._sent = bounces, arriving, sent

    def white(self, lighting, points: Points, pi, shape, back_side, sampler):
        """Radiance that a white diffuse surface sends for light that comes from other surfaces; spectrum.

        Parameters
        ----------
        lighting : Lighting
            For the wavelengths of `points`.
        pi, shape : preliminary intersection and shape of the hits
        points : Points
        back_side : Bool
            True where the back is seen.
        """
        bounces = self._bounces
        state, lit, wavelengths = bounces.state, points.active, points.wavelengths
        rows, weights, baked = state.lookup.rows_at(pi, shape, back_side, lit)
        if self._arriving is None:
            return self._by_transfer(lighting, points, rows, weights, baked)
        total = self._value(self._arriving, rows, weights, baked, wavelengths)
        if self._sent is None:
            return total
        shift = mi.Point3f(*sampler.next_2d(lit), sampler.next_1d(lit))
        sent_by = lambda rows, weights, active: self._value(self._sent, rows, weights, active, wavelengths)
        return total + bounced_at(bounces.scene, state.lookup, sent_by, points.p, points.n, PIXEL_SAMPLES, shift, lit & ~baked)

    def _value(self, field, rows, weights, active, wavelengths):
        """Values of rows, interpolated; spectrum."""
        channels = self._bounces.channels
        at = lambda node: sum(dr.gather(mi.Float, field, row * channels + node, active) * w for row, w in zip(rows, weights))
        return self._bounces.spectrum(*(sum(at(node) * w for node, w in nodes) for nodes in self._nodes(wavelengths)))

    def _nodes(self, wavelengths) -> list:
        """For each entry of a spectrum the channels, with weights, that make it."""
        if not mi.is_spectral:
            return [[(mi.UInt32(c), mi.Float(1))] for c in range(self._bounces.channels)]
        places = [dr.clip((w - mi.MI_CIE_MIN) / _spectral_step(), 0, SPECTRAL_NODES - 1) for w in wavelengths]
        first = [dr.minimum(mi.UInt32(place), SPECTRAL_NODES - 2) for place in places]
        return [[(i, 1 - (place - i)), (i + 1, place - i)] for i, place in zip(first, places)]

    def _by_transfer(self, lighting, points: Points, rows, weights, baked):
        """The same by interreflected transfer vectors, as if lights looked the same from where light bounces."""
        def channel(nodes):
            return lighting.transferred(points, lambda g, lights: (self._vector(g, nodes, rows, weights, baked), None))

        nodes = self._nodes(points.wavelengths)
        return self._bounces.spectrum(*(channel(nodes[c])[c] for c in range(len(nodes))))

    def _vector(self, g, nodes, rows, weights, active) -> list:
        bounces = self._bounces
        value = [mi.Float(0)] * bounces.size
        for row, w in zip(rows, weights):
            for node, v in nodes:
                start = ((row + g * bounces.count) * bounces.channels + node) * bounces.size
                value = [dr.fma(dr.gather(mi.Float, bounces.transfer, start + i, active), w * v, t) for i, t in enumerate(value)]
        return value


def _spectral_step() -> float:
    return (mi.MI_CIE_MAX - mi.MI_CIE_MIN) / (SPECTRAL_NODES - 1)
