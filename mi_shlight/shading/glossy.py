"""Gloss at the points that the camera sees: everything that BSDFs reflect besides their diffuse reflectance, by SH transfer vectors."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..light.edge_frame import MONOPOLE
from ..scene import shape_index
from ..sh.products import product
from ..sh.rotation import rotate_frame
from ..sh.windows import window_factors
from ..transfer.glossy import LobeQuadrature, from_half, interpolate, look_at


class Gloss:
    """Gloss of the BSDFs of a scene, one table for each side that has any (:py:mod:`mi_shlight.transfer.glossy`).

    Parameters
    ----------
    receivers : list of Receiver
    order : int
        Highest degree of the tables.
    window : str
        Against ringing, as in :py:func:`mi_shlight.sh.windows.window_factors`; ``none``.
    complain : function
        Called with a sentence about each BSDF that cannot be tabulated.
    """

    DRJIT_STRUCT = dict.fromkeys(("_quadrature", "_first", "_shares", "_tables"), object)

    def __init__(self, receivers: list, order: int, window: str, complain):
        self.order, self._complain, self._told = order, complain, set()
        self._factors = window_factors(window, order)
        self._quadrature = LobeQuadrature()
        self._receivers = [r for r in receivers if not r.black]
        self._size = 1 + max((shape_index(r.shape) for r in self._receivers), default=0)
        self._seen = self._tables = None
        self.prepare()

    @property
    def present(self) -> bool:
        """False if all surfaces are plainly diffuse."""
        return self._present

    def prepare(self) -> None:
        """Look at the BSDFs anew if their parameters have changed since."""
        seen = _Parameters({id(b): b for b in (r.shape.bsdf() for r in self._receivers)}.values())
        if self._seen is not None and seen.values == self._seen.values:
            return
        sides, known, first, shares = [], {}, [0] * (2 * self._size), [0.0] * (2 * self._size)
        for receiver in self._receivers:
            bsdf, entry = receiver.shape.bsdf(), 2 * shape_index(receiver.shape)
            for back in range(1 + receiver.two_sided):
                key = bsdf_index(bsdf), back
                if key not in known:
                    side = -1 if back else 1
                    found = look_at(bsdf, side, receiver.diffuse)
                    if found.complaint and (key[0], found.complaint) not in self._told:
                        self._told.add((key[0], found.complaint))
                        self._complain(f"BSDF '{bsdf.id()}' of shape '{receiver.name}' ({bsdf.class_name()}): {found.complaint}")
                    if found.rest:
                        sides.append((bsdf, side, found))
                    known[key] = len(sides) if found.rest else 0, found.share
                first[entry + back], shares[entry + back] = known[key]
        self._present = bool(sides) or any(share != 1 for _, share in known.values())
        self._sides, self._first, self._shares, self._seen = sides, mi.UInt32(first), mi.Float(shares), seen
        with dr.suspend_grad():
            self._tables = self._tabulate()

    def attached(self):
        """The tables, with derivatives by the parameters of BSDFs where these are asked for."""
        return self._tabulate() if dr.grad_enabled(self._seen.live) else self._tables

    def _tabulate(self):
        if not self._sides:
            return None
        tables = dr.concat([self._quadrature.table(*side, self.order, self._factors) for side in self._sides])
        dr.eval(tables)
        return tables

    def share(self, shape, back_side, active):
        """Part of the diffuse reflectance that is left to diffuse transfer at hits on `shape`."""
        entry, known = self._entry(shape, back_side, active)
        return dr.gather(mi.Float, self._shares, entry, known)

    def reflected(self, tables, shape, points, viewer, back_side, light: list):
        """Radiance of the gloss towards `viewer` (unit vectors) at points on `shape`; unpolarised spectrum.

        ``sum_lm T_lm L_lm``, with the transfer vectors T that :py:func:`~mi_shlight.transfer.glossy.interpolate` gives, turned into the
        world, up to the lower order of both.

        Parameters
        ----------
        tables
            Of :py:meth:`attached`; None: there is no gloss.
        light : list
            For each channel the coefficients of the light that arrives, of any order.
        """
        spectrum = type(mi.unpolarized_spectrum(mi.Spectrum(0)))
        if tables is None:
            return spectrum(0)
        entry, known = self._entry(shape, back_side, points.active)
        table = dr.gather(mi.UInt32, self._first, entry, known)
        known &= table > 0
        table = dr.select(known, table - 1, 0)

        def body(channel, value, n, viewer, light):
            cosine = dr.dot(n, viewer)
            across = viewer - n * cosine
            square = dr.squared_norm(across)
            tilted = square > 1e-12                   # else the surface is seen along its normal, and any frame will do
            sine = dr.select(tilted, dr.sqrt(dr.select(tilted, square, 1)), 0)
            s = dr.select(tilted, across / dr.select(tilted, sine, 1), mi.Frame3f(n).s)
            half = interpolate(tables, table, channel, cosine, sine, self.order, known)
            transfer = rotate_frame(from_half(half, self.order), s, dr.cross(n, s), n, self.order)
            found = sum(t * _pick(channel, colour) for t, colour in zip(transfer, zip(*light)))
            return channel + 1, [v + dr.select(channel == c, found, 0) for c, v in enumerate(value)], n, viewer, light

        # a loop over channels has a third of the code to compile
        state = mi.UInt32(0), [mi.Float(0) for _ in light], mi.Vector3f(points.n), mi.Vector3f(viewer), light
        last = dr.select(known, mi.UInt32(len(light)), 0)
        value = dr.while_loop(state, lambda channel, *_: channel < last, body, mode="symbolic", max_iterations=-1)[1]
        return spectrum(*value)

    def _entry(self, shape, back_side, active) -> tuple:
        """Where a side of `shape` stands in the tables, and where there is such an entry."""
        number = dr.reinterpret_array(mi.UInt32, shape)
        return 2 * number + dr.select(back_side, mi.UInt32(1), 0), active & (number < self._size)


def arriving(blocked: list, light: list, order: int) -> list:
    """What arrives of light from around a point of which a part is blocked: to `order`, the coefficients of ``(1 - blocked) light``.

    With `light` to the order of `blocked` more than `order` nothing of the product is cut off. The mean of `blocked` over all directions is
    no product of functions, so points that see all of the light, or nothing, cost and lose nothing.

    Parameters
    ----------
    blocked : list of floats
        Coefficients of the part that is blocked, 0 to 1. They carry no derivatives.
    light : list
        For each channel a list of coefficients.
    """
    mean = blocked[0] * MONOPOLE
    varying = sum(dr.square(c) for c in blocked[1:]) > 1e-10
    count = (order + 1) ** 2

    def body(channel, out, light, blocked):
        picked = [_pick(channel, colour) for colour in zip(*light)]
        lost = product([None, *blocked], picked, order)
        return channel + 1, [[a + dr.select(channel == c, b, 0) for a, b in zip(part, lost)] for c, part in enumerate(out)], light, blocked

    zeros = [[mi.Float(0) for _ in range(count)] for _ in light]
    last = dr.select(varying, mi.UInt32(len(light)), 0)
    state = mi.UInt32(0), zeros, light, blocked[1:]
    lost = dr.while_loop(state, lambda channel, *_: channel < last, body, mode="symbolic", max_iterations=-1)[1]
    whole = [[c * (1 - mean) for c in part[:count]] + [mi.Float(0)] * (count - len(part)) for part in light]
    return [[a - b for a, b in zip(*pair)] for pair in zip(whole, lost)]


def bsdf_index(bsdf) -> int:
    """Registry number of a BSDF."""
    return int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])


def _pick(k, values: tuple):
    """``values[k]``."""
    picked = values[0]
    for i, value in enumerate(values[1:], 1):
        picked = dr.select(k == i, value, picked)
    return picked


class _Parameters:
    """Identity of the parameters of BSDFs, as :py:class:`mi_shlight.scene.Fingerprint` has that of shapes."""

    def __init__(self, bsdfs):
        self.live, self.values = [], []
        for bsdf in bsdfs:
            for key, value in mi.traverse(bsdf).items():
                arrays = _arrays(value)               # which go along with the BSDF
                self.live += arrays
                self.values.append((key, [a.index for a in map(dr.detach, arrays)] or str(value)))
        self._held = [dr.detach(a) for a in self.live]


def _arrays(value) -> list:
    """The Dr.Jit arrays that a parameter consists of; none if it is a plain number or a transform."""
    if not dr.is_jit_v(value) or dr.is_special_v(value):
        return []
    if dr.is_tensor_v(value):
        return [value.array]
    return [value] if dr.depth_v(value) == 1 else [a for part in value for a in _arrays(part)]
