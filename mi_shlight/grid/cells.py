"""A regular grid of points, its cells, and how values and gradients at a cell's corners are interpolated."""
from __future__ import annotations

import drjit as dr

INTERPOLATIONS = ("hermite", "tricubic", "trilinear", "taylor", "inverse_distance")

CORNERS, MAX_RESOLUTION = 8, 256

BLENDING_POWER = 10
"""Exponent of ``inverse_distance``, as in [G03]."""


class Cells:
    """`resolution` points along each axis from `lower` to `upper`, 3-vectors of width 1, and the cells between them.

    Points and cells are numbered with x running fastest. Corner 0 to 7 of a cell: bit a of the number says whether it lies at the upper end
    of axis a.
    """

    DRJIT_STRUCT = dict.fromkeys(("lower", "size", "_along"), object)

    def __init__(self, lower, upper, resolution: int):
        self.lower, self.resolution = lower, resolution
        self.size = (upper - lower) * (1 / (resolution - 1))
        self._along = dr.opaque(dr.uint32_array_t(type(lower[0])), resolution)     # kernels do not depend on its value

    @property
    def point_count(self) -> int:
        return self.resolution ** 3

    @property
    def cell_count(self) -> int:
        return (self.resolution - 1) ** 3

    def point(self, i):
        """Position of grid point `i`."""
        return self._at(*_digits(i, self._along))

    def centre(self, cell):
        """Position of the middle of a cell."""
        return self._at(*_digits(cell, self._along - 1), 0.5)

    def corner_point(self, cell, corner):
        """Number of the grid point at a corner of a cell."""
        i, j, k = _digits(cell, self._along - 1)
        return (i + (corner & 1)) + self._along * ((j + (corner >> 1 & 1)) + self._along * (k + (corner >> 2)))

    def adjacent_cell(self, point, corner) -> tuple:
        """(cell, exists): the cell that has a grid point as its corner `corner`; 0 and False beyond the border."""
        cell, exists, stride = 0, True, 1
        for a, i in enumerate(_digits(point, self._along)):
            shift = corner >> a & 1
            exists = exists & (i >= shift) & (i - shift < self._along - 1)
            cell, stride = cell + (i - shift) * stride, stride * (self._along - 1)
        return dr.select(exists, cell, 0), exists

    def locate(self, x) -> tuple:
        """(cell, t): the cell that holds `x` and the place of `x` in it, 0 to 1 along each axis.

        `cell_count` stands for all points outside; points beyond the border by rounding count as inside.
        """
        index, last, slack = type(self._along), type(x[0])(self._along - 1), 1e-3
        place = (x - self.lower) / self.size
        at, inside, cell, stride = dr.detach(place), True, 0, 1
        t = []
        for a in range(3):
            inside = inside & (at[a] >= -slack) & (at[a] <= last + slack)
            i = index(dr.clip(at[a], 0, last - 1))
            t.append(place[a] - i)
            cell, stride = cell + i * stride, stride * (self._along - 1)
        return dr.select(inside, cell, stride), type(x)(*t)

    def _at(self, i, j, k, shift=0.0):
        vector = type(self.lower)
        return dr.fma(vector(*(type(self.lower[0])(v) + shift for v in (i, j, k))), self.size, self.lower)


def _digits(i, base) -> tuple:
    return i % base, i // base % base, i // (base * base)


def corner_weights(interpolation: str, t, size):
    """Function of a corner's number that gives the weights of the value and of the three derivatives there, all linear interpolants.

    ``hermite``
        The 32 values and derivatives determine the cubic polynomials and some quartic ones (the element of Adini and Clough, in space).
        Error of fourth order. On the edges of a cell it is the cubic of [W20] eq. 33.
    ``tricubic``
        [W20] Algorithm 4: cubics along x, then y, then z, the other derivatives interpolated linearly. Not exact for ``x^2 y``, so of third
        order off the edges of the cells.
    ``trilinear``
        Values only.
    ``taylor``
        First-order expansions about the corners, weighted by inverse distance (Annen 2004).
    ``inverse_distance``
        Values only, weighted by distance to the power of -10 ([G03], local lighting).

    `t`: place in the cell, 0 to 1; `size`: lengths of the cell's edges, in the unit of the derivatives.
    """
    upper = lambda k, a: (k >> a & 1) == 1
    toward = lambda k: [dr.select(upper(k, a), t[a], 1 - t[a]) for a in range(3)]
    zero = type(t[0])(0)

    def slope(k, a, s):
        """Cubic with slope 1 at the corner and value 0 at both ends."""
        return dr.select(upper(k, a), -size[a], size[a]) * s[a] * s[a] * (1 - s[a])

    def hermite(k):
        s = toward(k)
        x, y, z = s
        bulge = sum((2 * c - 1) * (1 - c) for c in s)
        return [x * y * z * (1 + bulge), slope(k, 0, s) * y * z, slope(k, 1, s) * x * z, slope(k, 2, s) * x * y]

    def tricubic(k):
        s = toward(k)
        x, y, z = (c * c * (3 - 2 * c) for c in s)
        return [x * y * z, slope(k, 0, s) * y * z, s[0] * slope(k, 1, s) * z, s[0] * s[1] * slope(k, 2, s)]

    def trilinear(k):
        x, y, z = toward(k)
        return [x * y * z, zero, zero, zero]

    if interpolation in ("hermite", "tricubic", "trilinear"):
        return {"hermite": hermite, "tricubic": tricubic, "trilinear": trilinear}[interpolation]

    offset = lambda k: [(t[a] - dr.select(upper(k, a), 1, 0)) * size[a] for a in range(3)]
    squared = lambda k: sum(d * d for d in offset(k))
    power = 1 if interpolation == "taylor" else BLENDING_POWER
    index = dr.uint32_array_t(type(zero))
    least = squared(index(0))
    for k in range(1, CORNERS):
        least = dr.minimum(least, squared(index(k)))
    least = dr.maximum(least, 1e-12 * dr.squared_norm(size))       # at a corner its own weight is all
    closeness = lambda k: dr.power(least / dr.maximum(squared(k), least), 0.5 * power)
    total = sum(closeness(index(k)) for k in range(CORNERS))

    def blend(k):
        w = closeness(k) / total
        return [w, *(w * d for d in offset(k))] if interpolation == "taylor" else [w, zero, zero, zero]

    return blend
