"""Light probes: angle maps to coefficients and to the latitude-longitude maps of Mitsuba's ``envmap``; functions to such maps.

An angle map holds the sphere in the circle inscribed in a square image ([G03] "Creating Light Sources", after Debevec): at the distance
r of its middle, 0 to 1, it shows what stands pi r off the forward axis; the rim is the direction behind. A pixel of size ``du dv`` covers

    d omega = pi sin(pi r) / r du dv .                                                                                              (1)

[G03]'s code has forward = z, and y growing with the rows, so ``forward=(0, 0, 1), up=(0, -1, 0)``; Debevec's probes look along -z, y up on
top, which is the default.
"""
from __future__ import annotations

import math

import numpy as np

from ..arrays import vectors3
from ..errors import check_integer, message
from ..sh.arguments import evaluate, numeric_array
from ..sh.basis import check_order
from ..sh.lobes import sh_matrix
from .cap import unit_vector

_SAMPLES = 256
"""Places across an angle map, at least, at which it is looked at: small maps at several in each pixel."""

_ROWS_PER_STEP = 64


def project_angle_map(image, order: int, forward=(0.0, 0.0, -1.0), up=(0.0, 1.0, 0.0)) -> np.ndarray:
    """SH coefficients of a light probe given as an angle map.

    Pixels are constant, as in [G03]'s look-up, and weighted by the solid angle (1) of their parts.

    Parameters
    ----------
    image : array_like (N, N) or (N, N, K)
        Finite values, first row on top; those outside the inscribed circle do not matter.
    order : int
        Highest degree, 0 to 64.
    forward, up : 3-vectors
        Directions, of any length but 0, of the map's middle and, at right angles to it, of what stands above the middle. The right is
        ``forward x up``.

    Returns
    -------
    ndarray ((order + 1)**2,) or (K, (order + 1)**2), float64, in the unit of the image times steradian.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as above.

    Notes
    -----
    Error for a constant map 1e-5 of its mean at most. Next to the rim a pixel stands for a wide arc of directions: light from behind is
    blurred in the map already.
    """
    name = "project_angle_map"
    order = check_order(name, order)
    pixels, frame = _square(name, image), _frame(name, forward, up)
    size = len(pixels)
    parts = -(-_SAMPLES // size)
    places = (np.arange(size * parts) + 0.5) * (2 / (size * parts)) - 1
    coeffs = 0
    for begin in range(0, len(places), _ROWS_PER_STEP):
        v = places[begin:begin + _ROWS_PER_STEP]
        right, down = np.meshgrid(places, v)
        r = np.hypot(right, down)
        inside = r < 1
        along = np.sinc(r[inside])                                        # sin(pi r) / (pi r)
        local = np.stack([right[inside] * along, -down[inside] * along, np.cos(math.pi * r[inside]) / math.pi], axis=1) * math.pi
        basis = sh_matrix(local @ frame, order) * (math.pi ** 2 * along * (2 / len(places)) ** 2)[:, None]
        row, column = ((np.nonzero(inside)[axis] + offset) // parts for axis, offset in ((0, begin), (1, 0)))
        coeffs = coeffs + pixels[row, column].T @ basis
    return coeffs


def angle_map_to_latlong(image, height: int, forward=(0.0, 0.0, -1.0), up=(0.0, 1.0, 0.0)) -> np.ndarray:
    """A light probe as the latitude-longitude map of an ``envmap``.

    ``mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(angle_map_to_latlong(probe, 512))})`` shows the probe in the world's axes.

    Parameters
    ----------
    image, forward, up
        As in :py:func:`project_angle_map`.
    height : int
        Rows of the result, 3 to 16384; it has twice as many columns. Each is the mean of the probe over the pixel.

    Returns
    -------
    ndarray (height, 2 * height[, K]), float32.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as above.
    """
    name = "angle_map_to_latlong"
    height = _height(name, height)
    pixels, frame = _square(name, image), _frame(name, forward, up)
    size = len(pixels)
    parts = max(2, -(-size // (2 * height)))          # at most a pixel of the probe apart
    offsets = (np.arange(parts) + 0.5) / parts - 0.5
    out = np.zeros((height, 2 * height, *pixels.shape[2:]))
    for i in offsets:
        for j in offsets:
            right, top, ahead = frame @ _directions(height, i, j)
            r = np.arctan2(np.hypot(right, top), ahead) / math.pi
            scale = r / np.maximum(np.hypot(right, top), 1e-300)
            row, column = (np.clip(((c * scale + 1) * (size / 2)).astype(int), 0, size - 1) for c in (-top, right))
            out += pixels[row, column].reshape(out.shape)
    return (out / parts ** 2).astype(np.float32)


def latlong(function, height: int, vector: type = None) -> np.ndarray:
    """A function of direction as the latitude-longitude map of an ``envmap``, such as a sky that the path tracer is to see, too.

    Parameters
    ----------
    function : callable
        Takes unit vectors as an ndarray (N, 3) and returns values (N,) or (N, K).
    height : int
        Rows of the result, 3 to 16384; it has twice as many columns. Row i stands at ``theta = pi i / (height - 1)`` from the y axis,
        column j at ``phi = 2 pi (j + 1/2) / (2 height)``, direction ``(sin phi sin theta, cos theta, -cos phi sin theta)``; in between
        ``envmap`` interpolates.
    vector : type
        Dr.Jit or Mitsuba 3-vector to call `function` with instead, as ``drjit.auto.Array3f``; it returns a float or 3-vector (colour).

    Returns
    -------
    ndarray (height, 2 * height[, K]), float32.

    Raises
    ------
    TypeError, ValueError
        If `height` is out of range, `function` does not return one value or colour per direction, or `vector` is no such type.
    """
    height = _height("latlong", height)
    directions = _directions(height).T
    values = np.array(evaluate("latlong", "function", function, directions, vector))
    if vector is not None:
        values = np.broadcast_to(values.T, (len(directions), *values.shape[:-1]))
    return values.reshape(height, 2 * height, *values.shape[1:]).astype(np.float32)


def _directions(height: int, row_offset: float = 0.0, column_offset: float = 0.0) -> np.ndarray:
    """Directions (3, 2 height**2) of the pixels of an ``envmap``, moved by parts of a pixel; at the poles at most to the pole."""
    theta = np.clip((np.arange(height) + row_offset) * (math.pi / (height - 1)), 0, math.pi)
    phi = (np.arange(2 * height) + 0.5 + column_offset) * (math.pi / height)
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    return np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)])


def _square(name: str, image) -> np.ndarray:
    """The pixels of an angle map as float64, 0 where they lie outside the inscribed circle."""
    rule = "be a square array (N, N) or (N, N, K) of finite numbers"
    pixels = numeric_array(name, "image", rule, image, "Pass numpy.array() of a mi.Bitmap.").astype(np.float64)
    if pixels.ndim not in (2, 3) or pixels.shape[0] != pixels.shape[1] or pixels.size == 0:
        raise ValueError(message(name, "image", rule, f"an array {pixels.shape}", "The probe is the circle inscribed in it."))
    edges = np.linspace(-1, 1, len(pixels) + 1)
    nearest = np.maximum(np.maximum(edges[:-1], -edges[1:]), 0)           # to the middle, in a row or column
    pixels[np.hypot(nearest[:, None], nearest) > 1 + 1e-9] = 0
    if not np.isfinite(pixels).all():
        raise ValueError(message(name, "image", rule, "one with inf or nan"))
    return pixels


def _frame(name: str, forward, up) -> np.ndarray:
    """Unit vectors to the right, up and forward by rows."""
    given = {"forward": np.ravel(forward), "up": np.ravel(up)}
    forward, top = (np.array(unit_vector(name, argument, vector)) for argument, vector in zip(given, vectors3(name, **given)))
    if abs(forward @ top) > 1e-5:
        raise ValueError(message(name, "up", "stand at right angles to 'forward'", up))
    return np.stack([np.cross(forward, top), top, forward])


def _height(name: str, height) -> int:
    return check_integer(name, "height", height, 3, 16384, "It is the number of rows; there are twice as many columns.")
