"""Dr.Jit types follow the arguments: conversion of 3-vectors at the public boundary."""
from __future__ import annotations

import sys

import drjit as dr

from .errors import message

_RULE = "be a 3-vector of floating point numbers"
_HINT = "Pass a Dr.Jit or Mitsuba 3-vector, or a sequence of three floats."


def vectors3(function: str, **arguments):
    """Convert named 3-vectors to plain Dr.Jit ``Array3f``/``Array3f64`` of one common backend and precision.

    Accepts Dr.Jit and Mitsuba vectors (``mi.Point3f``, ``drjit.llvm.ad.Array3f64``, ...) and sequences of three
    Python floats or Dr.Jit floats. A value that is a list of vectors is converted element by element. If no Dr.Jit
    type is among them the result is ``drjit.scalar.Array3f64``. Raises TypeError otherwise.
    """
    parts = {name: [_components(function, name, v) for v in value] if _is_list_of_vectors(value)
             else _components(function, name, value) for name, value in arguments.items()}
    flat = [c for p in parts.values() for v in (p if isinstance(p, list) else [p]) for c in v]
    try:
        number = dr.expr_t(*(type(c) for c in flat))
    except (TypeError, RuntimeError):
        number = None
    array = array3(number)
    if array is None:
        name = next(iter(arguments))
        raise TypeError(message(function, name, _RULE + " of one backend (llvm, cuda or scalar), float32 or float64",
                                sorted({type(c).__module__ + "." + type(c).__name__ for c in flat}), _HINT))
    build = lambda v: array(*v)
    return [[build(v) for v in p] if isinstance(p, list) else build(p) for p in parts.values()]


def _is_list_of_vectors(value) -> bool:
    return (isinstance(value, (list, tuple)) and len(value) > 0
            and (isinstance(value[0], (list, tuple)) or getattr(value[0], "__len__", None) is not None
                 and not (dr.is_array_v(value[0]) and dr.depth_v(value[0]) < 2 and dr.is_jit_v(value[0]))))


def _components(function: str, name: str, value) -> tuple:
    try:
        length = 3 if dr.is_array_v(value) and dr.size_v(value) == 3 else len(value)
        components = tuple(value[k] for k in range(3)) if length == 3 else ()
    except TypeError:
        components = ()
    if len(components) != 3 or any(isinstance(c, (str, bytes, bool, complex)) for c in components):
        raise TypeError(message(function, name, _RULE, value, _HINT))
    return tuple(float(c) if isinstance(c, int) or type(c).__module__ == "numpy" else c for c in components)


def array3(number):
    """The plain vector type ``Array3f`` or ``Array3f64`` whose entries are `number`, or None if there is none."""
    if number is float:
        return sys.modules["drjit"].scalar.Array3f64
    if number is None or not (dr.is_float_v(number) and dr.is_jit_v(number) and dr.depth_v(number) == 1):
        return None
    suffix = {"Float": "f", "Float32": "f", "Float64": "f64"}.get(number.__name__)
    return suffix and getattr(sys.modules[number.__module__], "Array3" + suffix)
