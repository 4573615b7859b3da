"""Lights at an infinite distance, projected to spherical harmonics, and lights without an extent, which are shaded one by one."""
from __future__ import annotations

import copy
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lights import SPECTRAL_NODES, SPECTRAL_STEP
from ..scene import aligned, warn
from ..sh.functions import map_weights
from ..sh.rotation import euler_angles, multiples, quarter_turn

SKY_ROWS = 180
"""Latitudes at which an emitter without pixels of its own is looked at; an even number, so that a horizon lies halfway between two."""

LANES = 8192
"""Pixels of a map are summed up by about so many threads side by side."""


class DistantLights:
    """The emitters of a scene that are no surfaces.

    ``constant`` and ``envmap``, and any other emitter at an infinite distance, are projected to spherical harmonics; of these Mitsuba
    allows one to a scene. An envmap's coefficients are those of the very function that Mitsuba evaluates, bilinear in both angles between
    the pixels' places, integrated without sampling; any other emitter is taken as bilinear between directions 1 degree apart.
    ``directional``, ``point``, ``spot`` and ``projector`` have no extent: light from them is exact at every point, with a ray for its
    shadow.

    Attributes
    ----------
    projected : bool
        True if there is something to project.
    delta_count : int
        Number of emitters without an extent.
    """

    DRJIT_STRUCT = dict.fromkeys(("_delta", "_map", "_table"), object)

    def __init__(self, scene, order: int, complain=warn):
        self.scene, self.order = scene, order
        self.spectrum = type(mi.unpolarized_spectrum(mi.Spectrum(0)))
        deltas, self._emitter = [], None
        for emitter in scene.emitters():
            kind, name = emitter.class_name(), emitter.id()
            if emitter.is_environment():
                self._emitter = emitter
            elif has(emitter, "DeltaPosition", "DeltaDirection") and not has(emitter, "Surface"):
                deltas.append(emitter)
            elif not has(emitter, "Surface"):
                complain(f"emitter '{name}' ({kind}): it is neither a surface nor a light that can be projected or sampled. It does not "
                         "light surfaces in this picture; remove it, or render with Mitsuba's 'path'.")
        if self._emitter is not None and mi.traverse(self._emitter).get("sun_scale", 0) > 0:
            complain(f"emitter '{self._emitter.id()}' ({self._emitter.class_name()}): the disc of its sun is too small for spherical "
                     "harmonics. It does not light surfaces in this picture; set its sun_scale to 0 and add a 'directional' light.")
            self._emitter = None
        self.projected, self.delta_count = self._emitter is not None, len(deltas)
        self._delta = aligned(mi.UInt32, [dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(e))[0] for e in deltas])
        varying = self.projected and has(self._emitter, "SpatiallyVarying")
        self._map = MapProjection(self._emitter, order, len(self.spectrum(0))) if varying else None
        self._table = None

    def attached(self) -> "DistantLights":
        """A copy that has projected the emitter as it is now; its coefficients carry derivatives if derivatives are on."""
        if self._map and self._map.grid != directions_of(self._emitter):      # pixels of another number than before
            self._map = MapProjection(self._emitter, self.order, len(self.spectrum(0)))
        lights = copy.copy(self)
        lights._table = self._map.project() if self._map else None
        return lights

    def coefficients(self, wavelengths, p) -> list:
        """SH coefficients of the light at an infinite distance, in the world's axes: ``(order + 1)**2`` spectra, radiance times steradian.

        Of an attached copy only. They are the same at all points `p`. In spectral variants those of maps are interpolated between
        wavelengths 5 nm apart, and Mitsuba's map, which there interpolates hue and scale apart, is taken as bilinear.
        """
        count = (self.order + 1) ** 2
        if self._map is None:
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.wavelengths = wavelengths
            mean = mi.unpolarized_spectrum(self._emitter.eval(si)) * math.sqrt(4 * math.pi)
            return [mean] + [self.spectrum(0) for _ in range(count - 1)]
        row = dr.width(self._table) // count
        if not mi.is_spectral:
            first = mi.UInt32(0)
            if dr.grad_enabled(self._table):
                # an index for each point: in reverse mode sums to single values would take a kernel each
                first = dr.minimum(dr.reinterpret_array(mi.UInt32, dr.detach(p.x)), first)
            return [dr.gather(self.spectrum, self._table, first + i, mode=dr.ReduceMode.Expand) for i in range(count)]
        nodes = [(mi.UInt32(dr.clip(at, 0, SPECTRAL_NODES - 2)), at) for at in (wavelengths - mi.MI_CIE_MIN) * (1 / SPECTRAL_STEP)]
        between = lambda i, k, at: dr.lerp(*(dr.gather(mi.Float, self._table, i * row + k + j) for j in (0, 1)), at - mi.Float(k))
        return [self.spectrum(*(between(i, k, at) for k, at in nodes)) for i in range(count)]

    def remainder(self):
        """L2 norm over the sphere of what the coefficients leave of the light at an infinite distance; spectrum, not in spectral variants.

        Of an attached copy only. Rather too large, as between its pixels a map is taken to be as uneven as they are.
        """
        if self._map is None:
            return self.spectrum(0)
        coeffs = [dr.gather(self.spectrum, self._table, i) for i in range((self.order + 1) ** 2)]
        return dr.sqrt(dr.maximum(self._map.energy() - sum((dr.square(c) for c in coeffs), self.spectrum(0)), 0))

    def delta_irradiance(self, p, n, wavelengths, active, shadows: bool = True):
        """Radiance that a white diffuse surface sends for light from emitters without an extent; spectrum.

        Parameters
        ----------
        p, n : mi.Point3f, mi.Normal3f
            Points and their unit normals on the side that is lit.
        shadows : bool
            False: lights shine through everything.

        Differentiable by points, normals and emitters; shadows are taken as they are.
        """
        cosine = lambda d, n: self.spectrum(dr.maximum(dr.dot(n, d), 0) * dr.inv_pi)
        return self._over_deltas(cosine, mi.Point3f(p), mi.Normal3f(n), mi.Normal3f(n), wavelengths, active, shadows)

    def delta_reflected(self, si, bsdf, active, shadows: bool = True):
        """The same, sent towards the camera by any BSDF: `bsdf` at the surface interactions `si`."""
        def scattered(d, si):
            return mi.unpolarized_spectrum(bsdf.eval(mi.BSDFContext(), si, si.to_local(d), active))

        return self._over_deltas(scattered, si.p, si.n, si, si.wavelengths, active, shadows)

    def _over_deltas(self, weigh, p, n, data, wavelengths, active, shadows: bool):
        """Sum of the lights' irradiance without the cosine, times ``weigh(direction, data)``."""
        if not self.delta_count:
            return self.spectrum(0)

        def body(k, total, p, n, data):
            emitter = dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self._delta, k))
            it = dr.zeros(mi.Interaction3f)
            it.p, it.n, it.wavelengths = p, n, wavelengths
            ds, incoming = emitter.sample_direction(it, mi.Point2f(0.5), active)
            seen = active & (dr.max(mi.unpolarized_spectrum(incoming)) > 0)
            if shadows:
                seen &= ~self.scene.ray_test(dr.detach(it.spawn_ray_to(ds.p)), seen)
            return k + 1, total + (mi.unpolarized_spectrum(incoming) * weigh(ds.d, data) & seen), p, n, data

        start = (mi.UInt32(0), self.spectrum(0), p, n, data)
        return dr.while_loop(start, lambda k, *_: k < self.delta_count, body, mode="symbolic", max_iterations=-1)[1]


class MapProjection:
    """SH coefficients of an emitter at an infinite distance, taken as bilinear in both angles between a grid of directions.

    Row by row the emitter is summed up to its Fourier terms about the pole; these meet the integrals of each row's share in the Legendre
    functions. That is ``W H (2 n + 1)`` steps where the harmonics of each pixel would be ``W H (n + 1)^2``.
    """

    DRJIT_STRUCT = dict.fromkeys(("_weights", "_wave", "_weight", "_quarters", "_m", "_partner"), object)

    def __init__(self, emitter, order: int, channels: int):
        self._emitter, self._order, self._channels = emitter, order, channels
        self.grid = directions_of(emitter)
        self._rows, self._columns, self._pixels = self.grid
        self._packs = SPECTRAL_NODES // channels if mi.is_spectral else 1
        self._parts = max(1, min(LANES // self._rows, self._columns // 8))
        self._weights = aligned(mi.Float, map_weights(self._rows, self._columns, order).ravel())
        self._quarters = [_sparse(rows) for rows in quarter_turn(order)]
        degrees = [(l, m) for l in range(order + 1) for m in range(-l, l + 1)]
        self._wave = aligned(mi.UInt32, [m if m >= 0 else order - m for _, m in degrees])
        self._weight = aligned(mi.UInt32, [l * (l + 1) // 2 + abs(m) for l, m in degrees])
        self._m, self._partner = mi.Int32([m for _, m in degrees]), mi.Int32([l * (l + 1) - m for l, m in degrees])

    def project(self):
        """Coefficients in the world's axes as one flat buffer: for each of them its channels, or its `SPECTRAL_NODES` wavelengths."""
        s, t, n = self._axes()
        waves = self._waves(s, t, n)
        count, channels, packs = (self._order + 1) ** 2, self._channels, self._packs
        slices = self._rows * self._parts
        lane = dr.arange(mi.UInt32, count * packs * channels)
        i, node = lane // (packs * channels), lane % (packs * channels)
        pack, channel = node // channels, node % channels
        first = (dr.gather(mi.UInt32, self._wave, i) * channels + channel) * (packs * slices) + pack * slices
        weight = dr.gather(mi.UInt32, self._weight, i) * self._rows

        def body(k, total):
            share = dr.gather(mi.Float, self._weights, weight + k // self._parts)
            return k + 1, dr.fma(dr.gather(mi.Float, waves, first + k), share, total)

        local = dr.while_loop((mi.UInt32(0), dr.zeros(mi.Float, len(lane))), lambda k, _: k < slices, body, mode="symbolic",
                              max_iterations=-1)[1]
        alpha, beta, gamma = (dr.atan2(sin, cos) for cos, sin in euler_angles(n, s))
        return self._about_z(self._quarter(self._about_z(self._quarter(self._about_z(local, gamma), 0), beta), 1), alpha)

    def energy(self):
        """Integral of the square over the sphere, where a bilinear map has less than this: the same sum over the squares of its pixels."""
        lane, (s, t, n) = dr.arange(mi.UInt32, self._rows * self._columns), self._axes()
        row = lane // self._columns
        (sin, cos), (sin_phi, cos_phi) = self._colatitude(row), self._azimuth(lane % self._columns)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -(sin * cos_phi * s + sin * sin_phi * t + cos * n)
        radiance = mi.unpolarized_spectrum(self._emitter.eval(si))
        weight = dr.gather(mi.Float, self._weights, row) * math.sqrt(4 * math.pi)         # those of degree 0
        return type(radiance)(*(dr.sum(c * c * weight) for c in radiance))

    def _axes(self) -> tuple:
        """The map's axes in the world: where its columns begin, a quarter of a turn on, and the pole."""
        m = dr.detach(self._emitter.world_transform())
        pole, start = ((0, 1, 0), (0, 0, -1)) if self._pixels else ((0, 0, 1), (1, 0, 0))
        n, s = m @ mi.Vector3f(pole), m @ mi.Vector3f(start)
        return s, dr.cross(n, s), n                   # the columns' places are symmetric: a mirrored map meets them in another order

    def _colatitude(self, row) -> tuple:
        """Sine and cosine of a row's angle to the pole."""
        return dr.sincos(dr.clip(mi.Float(row) * (math.pi / (self._rows - 1)), 1e-4, math.pi - 1e-4))     # poles have no azimuth

    def _azimuth(self, column) -> tuple:
        return dr.sincos((mi.Float(column) + 0.5) * (2 * math.pi / self._columns))

    def _about_z(self, coeffs, angle):
        """Flat coefficients turned about z. They are lanes here, where rotate_frame has values: compiled at once at any order."""
        i, node = self._lanes(coeffs)
        m, other = (dr.gather(mi.Int32, table, i) for table in (self._m, self._partner))
        sin, cos = dr.sincos(mi.Float(m) * angle)     # of -m the sine turns round as it has to
        row = dr.width(coeffs) // dr.width(self._m)
        return coeffs * cos - dr.gather(mi.Float, coeffs, mi.UInt32(other) * row + node) * sin

    def _quarter(self, coeffs, transposed: int):
        """Flat coefficients turned by 90 degrees about x, or back."""
        (first, column, value), (i, node) = self._quarters[transposed], self._lanes(coeffs)
        row = dr.width(coeffs) // dr.width(self._m)

        def body(k, last, total, node):
            share = dr.gather(mi.Float, coeffs, dr.gather(mi.UInt32, column, k) * row + node)
            return k + 1, last, dr.fma(dr.gather(mi.Float, value, k), share, total), node

        bounds = (dr.gather(mi.UInt32, first, i + k) for k in (0, 1))
        return dr.while_loop((*bounds, dr.zeros(mi.Float, dr.width(coeffs)), node), lambda k, last, *_: k < last, body, mode="symbolic",
                             max_iterations=-1)[2]

    def _lanes(self, coeffs) -> tuple:
        """Of each entry the number of the coefficient, and of the channel or wavelength."""
        lane, row = dr.arange(mi.UInt32, dr.width(coeffs)), dr.width(coeffs) // dr.width(self._m)
        return lane // row, lane % row

    def _waves(self, s, t, n):
        """Fourier terms of parts of all rows: flat, term by term and channel by channel."""
        order, channels, slices = self._order, self._channels, self._rows * self._parts
        lane = dr.arange(mi.UInt32, self._packs * slices)
        piece = lane % slices
        sin, cos = self._colatitude(piece // self._parts)
        length = -(-self._columns // self._parts)
        column = (piece % self._parts) * length

        def body(k, total):
            sin_phi, cos_phi = self._azimuth(column + k)
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.wi = -(sin * cos_phi * s + sin * sin_phi * t + cos * n)
            if mi.is_spectral:
                node = (lane // slices) * channels
                si.wavelengths = type(si.wavelengths)([mi.MI_CIE_MIN + SPECTRAL_STEP * mi.Float(node + c) for c in range(channels)])
            radiance = mi.unpolarized_spectrum(self._emitter.eval(si)) & (column + k < self._columns)
            cosines, sines = multiples(cos_phi, sin_phi, order)
            terms = [wave * value for wave in (*cosines, *sines[1:]) for value in radiance]
            return k + 1, [a + b for a, b in zip(total, terms)]

        start = mi.UInt32(0), [dr.zeros(mi.Float, dr.width(lane)) for _ in range((2 * order + 1) * channels)]
        total = dr.while_loop(start, lambda k, _: k < length, body, mode="symbolic", max_iterations=-1)[1]
        return dr.concat(total)


def _sparse(rows: tuple) -> tuple:
    """Rows of (column, value) as tables: where each row begins, columns, values."""
    entries = [entry for row in rows for entry in row]
    return (aligned(mi.UInt32, np.cumsum([0, *map(len, rows)])), aligned(mi.UInt32, [column for column, _ in entries]),
            aligned(mi.Float, [value for _, value in entries]))


def directions_of(emitter) -> tuple:
    """Rows and columns of the directions at which an emitter is looked at, and whether they are the places of an envmap's pixels."""
    if emitter.class_name() != "EnvironmentMapEmitter":
        return SKY_ROWS, 2 * SKY_ROWS, False
    rows, columns, _ = mi.traverse(emitter)["data"].shape
    return rows, columns - 2, True                    # Mitsuba adds a copy of the outer columns on either side


def has(emitter, *flags: str) -> bool:
    """True if the emitter has one of the flags."""
    return any(mi.has_flag(emitter.flags(), getattr(mi.EmitterFlags, flag)) for flag in flags)
