"""Input checks of the public boundary, and the warnings the package can raise.

Messages follow one form: ``function(): 'argument' must <rule>, got <value>. <hint>``.
"""
from __future__ import annotations

import difflib
import numbers


class SHLightWarning(UserWarning):
    """Base class of all warnings raised by mi_shlight."""


class UnsupportedSceneWarning(SHLightWarning):
    """A part of the scene is left out or approximated; the message says which."""


class StaleTransferWarning(SHLightWarning):
    """The scene has changed since its transfer was baked."""


def message(function: str, argument: str, rule: str, value, hint: str = "") -> str:
    """Text of an input error: function, argument, rule, value received, and what to do instead."""
    text = f"{function}(): '{argument}' must {rule}, got {_show(value)}."
    return f"{text} {hint}" if hint else text


def _show(value) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 120 else text[:117] + "..."


def check_integer(function: str, argument: str, value, low: int, high: int, hint: str = "") -> int:
    """Return `value` as int, or raise: TypeError for a non-integer type, ValueError outside [low, high]."""
    rule = f"be an integer from {low} to {high}"
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(message(function, argument, rule, value, hint))
    if value != value or value in (float("inf"), float("-inf")) or value != int(value) or not low <= value <= high:
        raise ValueError(message(function, argument, rule, value, hint))
    return int(value)


def check_number(function: str, argument: str, value, low: float, high: float = float("inf"), hint: str = "") -> float:
    """Return `value` as a finite float in [low, high], or raise TypeError / ValueError."""
    rule = f"be a finite number >= {low:g}" if high == float("inf") else f"be a number from {low:g} to {high:g}"
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(message(function, argument, rule, value, hint))
    if not (low <= value <= high) or value == float("inf"):
        raise ValueError(message(function, argument, rule, value, hint))
    return float(value)


def check_choice(function: str, argument: str, value, choices, hint: str = "") -> str:
    """Return `value` if it is one of the strings `choices`, or raise TypeError / ValueError."""
    rule = "be one of " + ", ".join(f"'{c}'" for c in choices)
    if not isinstance(value, str):
        raise TypeError(message(function, argument, rule, value, hint))
    if value not in choices:
        raise ValueError(message(function, argument, rule, value, hint))
    return value


def check_parameters(plugin: str, props, known, given=None) -> None:
    """Raise ValueError if a Mitsuba plugin was given a parameter that is not in `known`; `given`: names to look at, default all."""
    for name in props.keys() if given is None else given:
        if name not in known:
            if name.startswith("_arg_"):
                raise ValueError(message(plugin, "nested object", f"not stand inside '{plugin}'", props.as_string(name), "Remove it."))
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"Did you mean '{near[0]}'?" if near else "Its parameters are " + ", ".join(f"'{k}'" for k in known) + "."
            raise ValueError(message(plugin, name, f"be a parameter of '{plugin}'", props.as_string(name), hint))
