"""What the public functions of this folder share: coefficients, arrays and functions as the user gives them, checked."""
from __future__ import annotations

import math
import numbers

import drjit as dr
import numpy as np

from ..errors import message
from .lobes import MAX_ORDER


def coefficients_order(function: str, argument: str, coeffs) -> int:
    """Order n of a sequence of (n + 1)**2 coefficients, or of an ndarray (..., (n + 1)**2); or TypeError/ValueError."""
    rule = f"have (order + 1)**2 entries, order 0 to {MAX_ORDER}"
    try:
        count = coeffs.shape[-1] if isinstance(coeffs, np.ndarray) else len(coeffs)
    except (TypeError, IndexError):
        raise TypeError(message(function, argument, rule, coeffs, "Pass a list of floats, or a numpy array.")) from None
    order = math.isqrt(count) - 1
    if (order + 1) ** 2 != count or not 0 <= order <= MAX_ORDER:
        raise ValueError(message(function, argument, rule, coeffs, f"It has {count}; all of every degree are needed."))
    return order


def check_coefficients(function: str, argument: str, coeffs, sparse: bool = False) -> tuple:
    """``(coeffs, order)`` of a sequence of (order + 1)**2 Python or Dr.Jit floats as a list, or of an ndarray as float64 or complex128.

    Raises TypeError or ValueError otherwise. In a `sparse` sequence None is zero.
    """
    order = coefficients_order(function, argument, coeffs)
    if isinstance(coeffs, np.ndarray):
        coeffs = numeric_array(function, argument, "hold numbers", coeffs, allow_complex=True)
        return coeffs.astype(np.result_type(coeffs, np.float64)), order
    coeffs = list(coeffs)
    for value in coeffs:
        if not (_is_number(value) or _is_traced(value) or sparse and value is None):
            raise TypeError(message(function, argument, "hold Python or Dr.Jit floats", value, "Or pass a numpy array."))
    return coeffs, order


def as_arrays(function: str, **coeffs) -> list:
    """Checked coefficients of which one is an ndarray as ndarrays, None as 0; their leading axes can be broadcast."""
    arrays = []
    for argument, values in coeffs.items():
        if not isinstance(values, np.ndarray):
            for value in values:
                if _is_traced(value):
                    raise TypeError(message(function, argument, "hold Python floats beside a numpy array", value,
                                            "Pass .tolist() of the array."))
            values = np.array([0.0 if value is None else value for value in values])
        arrays.append(values)
    check_leading_axes(function, ", ".join(coeffs), *(values.shape[:-1] for values in arrays))
    return arrays


def check_leading_axes(function: str, arguments: str, *shapes: tuple):
    """Raise ValueError unless numpy broadcasts the shapes."""
    try:
        np.broadcast_shapes(*shapes)
    except ValueError:
        raise ValueError(message(function, arguments, "have leading axes that can be broadcast", shapes)) from None


def numeric_array(function: str, argument: str, rule: str, value, hint: str = "", allow_complex: bool = False) -> np.ndarray:
    """`value` as an ndarray of whatever type it has, or TypeError unless that is a real number, or with `allow_complex` a complex one."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):                   # rows of unlike lengths
        raise TypeError(message(function, argument, rule, value, hint)) from None
    if array.dtype.kind not in ("biufc" if allow_complex else "biuf"):
        raise TypeError(message(function, argument, rule, f"an array of {array.dtype}" if isinstance(value, np.ndarray) else value, hint))
    return array


def evaluate(function: str, argument: str, f, directions: np.ndarray, vector: type = None):
    """What the function `f`, an argument of that name, returns for the directions (N, 3): an array (N,) or (N, K) of float64, or if it
    is to be called with a Dr.Jit `vector` a float or 3-vector of width N or 1; or TypeError/ValueError.
    """
    if not callable(f):
        raise TypeError(message(function, argument, "be a function of unit vectors", f))
    count = len(directions)
    if vector is None:
        rule = f"return one number, or K numbers, for each of {count} directions"
        values = numeric_array(function, argument, rule, f(directions))
        if values.ndim not in (1, 2) or len(values) != count:
            raise ValueError(message(function, argument, rule, f"an array {values.shape}"))
        return values.astype(np.float64, copy=False)
    if not (isinstance(vector, type) and _is_traced(vector) and dr.is_jit_v(vector) and dr.is_vector_v(vector) and dr.size_v(vector) == 3):
        raise TypeError(message(function, "vector", "be the type of a Dr.Jit or Mitsuba 3-vector of floats", vector,
                                "Example: drjit.auto.Array3f."))
    number, rule = dr.value_t(vector), f"return a float or 3-vector for each of {count} directions"
    values = f(vector(*(number(component) for component in directions.T)))
    if not _is_traced(values):
        raise TypeError(message(function, argument, rule, values, "Its type has to be Dr.Jit's."))
    if dr.width(values) not in (1, count):
        raise ValueError(message(function, argument, rule, f"{dr.width(values)} values"))
    return values


def _is_number(value) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _is_traced(value) -> bool:
    """Whether it is, or is the type of, a Dr.Jit float or vector of floats."""
    return dr.is_array_v(value) and dr.is_float_v(value) and dr.depth_v(value) in (1, 2)
