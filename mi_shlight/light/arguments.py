"""What the public functions of this folder share: a polygon and points as the user gives them, checked and ready for the kernels."""
from __future__ import annotations

import numbers

import drjit as dr
import numpy as np

from ..arrays import vectors3
from ..errors import check_number, message
from .polygon import VertexList, interior_direction


SCALE = 0.25
"""Factor of all lengths: differences of the largest numbers stay finite."""


def polygon_arguments(function: str, vertices, x, **vectors) -> tuple:
    """``(light, x, apex, *vectors)`` of one common type: the polygon's edges, the shading point, a unit vector from `x` into the light.

    `vertices` must be a list of three or more 3-vectors; otherwise TypeError or ValueError in the name of `function`.
    """
    if not isinstance(vertices, (list, tuple)):
        raise TypeError(message(function, "vertices", "be a list of 3-vectors", vertices, "Example: [mi.Point3f(0, 0, 1), ...]."))
    if any(isinstance(v, numbers.Number) for v in vertices):
        raise TypeError(message(function, "vertices", "be a list of 3-vectors", vertices, "Those are the coordinates of a single one."))
    if len(vertices) < 3:
        raise ValueError(message(function, "vertices", "have at least three entries", vertices, "A polygon has three or more corners."))
    vertices, *others = vectors3(function, vertices=list(vertices), x=x, **vectors)
    vertices, (x, *others) = [not_literal(v) for v in vertices], [not_literal(v) for v in others]
    vertices, x = [v * SCALE for v in vertices], x * SCALE
    return VertexList(vertices), x, interior_direction(vertices, x), *others


def not_literal(v):
    """Keep constants out of the kernel's source: otherwise each polygon would compile its own kernel."""
    literal = lambda c: dr.is_jit_v(c) and not dr.grad_enabled(c) and c.state == dr.VarState.Literal
    return type(v)(*(dr.opaque(type(c), c[0], dr.width(c)) if literal(c) else c for c in v))


def error_argument(function: str, max_error, x):
    """`max_error` as the user gives it: None, or a float from the rounding unit of `x` to 1; otherwise TypeError or ValueError."""
    if max_error is None:
        return None
    return check_number(function, "max_error", max_error, dr.epsilon(x), 1, hint="It is a relative error, such as 1e-4.")


def float_list(function: str, argument: str, values, number, least: int, most: int, hint: str) -> list:
    """Entries of a list of `least` to `most` floats: Python floats, or Dr.Jit floats as `number`; TypeError or ValueError if not."""
    rule = f"be a list of {least} floats" if least == most else f"be a list of {least} to {most} floats"
    if isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype.kind in "fiu":
        values = values.tolist()
    if not isinstance(values, (list, tuple)):
        raise TypeError(message(function, argument, rule, values, hint))
    if not least <= len(values) <= most:
        raise ValueError(message(function, argument, rule, values, hint))
    out = []
    for value in values:
        if isinstance(value, numbers.Real) and not isinstance(value, bool):
            out.append(float(value))
        elif number is not float and dr.is_array_v(value) and dr.is_float_v(value) and dr.depth_v(value) == 1:
            out.append(number(value))
        else:
            raise TypeError(message(function, argument, rule + ", Dr.Jit floats only together with Dr.Jit vectors", value))
    return out


def all_finite(*vectors):
    """Mask: no component of the vectors is infinite or NaN."""
    finite = True
    for v in vectors:
        for k in range(3):
            finite = finite & dr.isfinite(v[k])
    return finite
