"""What lies between samples: [W20] Fig. 4 and orders of convergence, by the weights that ``LightGrid`` uses, in float64."""
from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr
import numpy as np
from drjit.llvm.ad import Array3f64, Float64, UInt32

from mi_shlight import project_polygon_spatial_gradient
from mi_shlight.grid.cells import CORNERS, INTERPOLATIONS, corner_weights
from validation.engine_report import Record
from validation.experiment import significant

LIGHT = ((-5, -5, 1), (5, -5, 1), (5, 5, 1), (-5, 5, 1))
"""Of [W20] section 7.1, facing down."""
ORDER, DEGREE, INDEX = 8, 7, 2
COEFFICIENT = DEGREE * (DEGREE + 1) + INDEX
ON_LINE = (0, 1)
"""Corners of a cell between which its lower edge along x runs."""


class Line(NamedTuple):
    """Points (x, y, z), x from `start` to `end`."""

    start: float
    end: float
    y: float
    z: float


LINES = {"distance 2": Line(3, 6, 3, -1), "distance 1": Line(3, 6, 3, 0)}
"""x runs as in [W20] Fig. 6, whose plane lies at distance 1 from the light; its Fig. 4 does not say. The targets are set for the first."""
OFF_AXIS = "off the axes"
SAMPLES, REFERENCE_POINTS, OFF_AXIS_POINTS = 10, 2000, 400


def field(x) -> np.ndarray:
    """The coefficient and its derivatives by x, y and z at the points `x`: (4, points)."""
    coeffs, gradient = project_polygon_spatial_gradient([Array3f64(*map(float, corner)) for corner in LIGHT], x, ORDER)
    numbers = [coeffs[COEFFICIENT], *gradient[COEFFICIENT]]
    dr.eval(numbers)
    return np.array(numbers)


def interpolate(points: np.ndarray, lower: np.ndarray, size: float, corners=range(CORNERS)) -> dict:
    """The coefficient at `points` (N, 3), each in the cubic cell from `lower` (N, 3) on, by interpolation of `corners`, by its name.

    Those of all corners count, or of the two ends of a line. Weights are scaled to the sum 1: they have it already, but for distance
    weights on a line, where corners off the line would take part.
    """
    vector = lambda rows: Array3f64(*(Float64(column.tolist()) for column in rows.T))
    at = lambda k: lower + size * np.array([k >> a & 1 for a in range(3)])
    samples = {k: field(vector(at(k))) for k in corners}
    values = {}
    for name in INTERPOLATIONS:
        weight = corner_weights(name, vector((points - lower) / size), Array3f64(size))
        weights = {k: [w + dr.zeros(Float64, len(points)) for w in weight(UInt32(k))] for k in corners}
        dr.eval(list(weights.values()))
        weights = {k: np.array(w) for k, w in weights.items()}
        total = sum(w[0] for w in weights.values())
        values[name] = sum(np.sum(weights[k] * samples[k], axis=0) for k in corners) / total
    return values


def on_line(line: Line, samples: int) -> tuple:
    """(x, reference, values by interpolation) at REFERENCE_POINTS points of a line."""
    x = np.linspace(line.start, line.end, REFERENCE_POINTS)
    points = np.column_stack([x, np.full_like(x, line.y), np.full_like(x, line.z)])
    size = (line.end - line.start) / (samples - 1)
    lower = points.copy()
    lower[:, 0] = line.start + size * np.clip(np.floor((x - line.start) / size), 0, samples - 2)
    exact = field(Array3f64(*(Float64(column.tolist()) for column in points.T)))[0]
    return x, exact, interpolate(points, lower, size, ON_LINE)


def off_axis(samples: int) -> tuple:
    """(reference, values by interpolation) at random points of a cube, in the middle of its cells as often as elsewhere."""
    line = LINES["distance 2"]
    edge = line.end - line.start
    rng = np.random.default_rng(3)
    size = edge / (samples - 1)
    origin = np.array([line.start, line.y, line.z - edge])
    points = origin + edge * rng.random((OFF_AXIS_POINTS, 3))
    lower = origin + size * np.clip(np.floor((points - origin) / size), 0, samples - 2)
    exact = field(Array3f64(*(Float64(column.tolist()) for column in points.T)))[0]
    return exact, interpolate(points, lower, size)


def convergence_order(samples, errors) -> float:
    """Slope of the error against the size of the cells in logarithms; NaN for fewer than three sizes."""
    if len(samples) < 3:
        return math.nan
    return float(np.polyfit(np.log(1 / (np.array(samples) - 1.0)), np.log(errors), 1)[0])


def measure_interpolation(record: Record, samples: tuple) -> None:
    """Errors on the lines and off the axes: largest and root mean square, of the coefficient's range there."""
    for place in (*LINES, OFF_AXIS):
        for count in sorted({SAMPLES, *samples}):
            exact, values = on_line(LINES[place], count)[1:] if place in LINES else off_axis(count)
            for name, found in values.items():
                difference = np.abs(found - exact) / np.ptp(exact)
                record.rows["interpolation"].append({"place": place, "interpolation": name, "samples": count,
                                                     "max": significant(difference.max()),
                                                     "rms": significant(np.sqrt(np.mean(difference ** 2)))})
