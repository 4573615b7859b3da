"""Motion files: what changes in an animation, as keyframes over its time.

A motion file is JSON text, an object with a list of motions that hold together::

    {
      "loop": true,
      "motions": [
        {"move": "light-*", "axis": [0, 1, 0], "about": [0, 0, 0], "stagger": 0.25,
         "keyframes": [{"time": 0, "rotate": 0}, {"time": 1, "rotate": 360}]},
        {"set": "light-*.emitter.radiance.value", "interpolation": "smooth",
         "keyframes": [{"time": 0, "factor": 1}, {"time": 0.5, "factor": 0.2}, {"time": 1, "factor": 1}]}
      ]
    }

``loop`` (false)
    True: frame k of N shows the time k / N, so that the last frame leads to the first. False: k / (N - 1).
``move``
    Name, or list of names, of shapes or sensors: what stands before ``.to_world`` or ``.vertex_positions`` in `mi.traverse`. The keyframes
    hold ``translate`` [x, y, z] in scene units, ``rotate`` in degrees counter-clockwise about ``axis`` ([0, 1, 0]), and ``scale``, a number
    or [x, y, z], all in world space. An object is scaled, turned about the point ``about``, and translated. ``about`` is a point
    [x, y, z] or "centre" (the default): the middle of a mesh's bounding box, or the origin of ``to_world``. Several motions of one object
    follow each other in the order of the file, and "centre" goes along.
``set``
    Name, or list of names, of parameters as `mi.traverse` gives them. The keyframes hold ``value``, a number or a list of numbers, or
    ``factor``, by which the value that the scene has is multiplied.
``keyframes``
    In the order of their ``time``, a fraction of the animation from 0 to 1. What a keyframe leaves out goes on from the one before to the
    one after. Before the first and after the last, values stay.
``interpolation`` ("linear")
    "smooth": monotone cubics. They do not overshoot, and come to rest where a value turns round and at the ends, unless these close.
``stagger`` (0)
    Names may be patterns with ``*``, ``?`` and ``[...]``, so that one motion holds for hundreds of lights. The i-th match, in the scene's
    order, runs i times the stagger ahead in time, wrapped into 0 to 1.

With ``loop`` or ``stagger`` a motion must end as it begins; a rotation up to whole turns.
"""
from __future__ import annotations

import difflib
import json
import math
import os
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from .errors import check_choice, message

MOVE_TRACKS = {"translate": (3,), "rotate": (1,), "scale": (1, 3)}
"""What keyframes of a ``move`` may hold, and of how many numbers it may consist."""

SET_TRACKS = ("value", "factor")
SIZES = {(1,): "a number", (3,): "a list of 3 numbers", (1, 3): "a number or a list of 3 numbers", None: "a number or a list of numbers"}
ENTRY_KEYS = {"move": ("move", "keyframes", "interpolation", "stagger", "axis", "about"),
              "set": ("set", "keyframes", "interpolation", "stagger")}


@dataclass
class Track:
    """One quantity over time, interpolated between keyframes."""

    times: np.ndarray
    """(K,), increasing, 0 to 1."""
    values: np.ndarray
    """(K, C)."""
    smooth: bool
    period: float = 0.0
    """Values that differ by a multiple of it mean the same; 0: none do."""

    @property
    def closed(self) -> bool:
        """True if the values at times 0 and 1 mean the same."""
        gap = self.values[-1] - self.values[0]
        if self.period:
            gap = gap - self.period * np.round(gap / self.period)
        return bool((np.abs(gap) <= 1e-6 * max(1.0, float(np.abs(self.values).max()))).all())

    def at(self, time) -> np.ndarray:
        """Values (T, C) at times (T,)."""
        time = np.clip(time, self.times[0], self.times[-1])
        if not self.smooth or len(self.times) == 1:
            return np.stack([np.interp(time, self.times, column) for column in self.values.T], axis=1)
        k = np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2)
        step = (self.times[k + 1] - self.times[k])[:, None]
        u = (time - self.times[k])[:, None] / step
        slopes = self._slopes()
        a, b = self.values[k], self.values[k + 1]
        return a + (b - a) * u * u * (3 - 2 * u) + step * u * (1 - u) * (slopes[k] * (1 - u) - slopes[k + 1] * u)

    def _slopes(self) -> np.ndarray:
        """Slopes at the keyframes: harmonic means of those on both sides, which keeps cubics monotone; 0 where they differ in sign."""
        chords = np.diff(self.values, axis=0) / np.diff(self.times)[:, None]
        whole = self.closed and self.times[0] == 0 and self.times[-1] == 1
        outside = chords[[-1, 0]] if whole else np.zeros_like(chords[[0, 0]])
        before, after = np.vstack([outside[:1], chords]), np.vstack([chords, outside[1:]])
        total = before + after
        return np.where(before * after > 0, 2 * before * after / np.where(total != 0, total, 1), 0)


@dataclass
class Entry:
    """One motion of the file: which names it is for, and its tracks."""

    place: str
    """How error messages call it: file and key."""
    kind: str
    """``move`` or ``set``."""
    patterns: tuple
    stagger: float
    tracks: dict = field(repr=False)
    """Name of the quantity -> :py:class:`Track`."""
    axis: np.ndarray
    about: object
    """Point (3,), or None: the centre of each object."""

    def names(self, known) -> list:
        """The names of `known`, in their order, that fit a pattern; ValueError if a pattern fits none of them."""
        for pattern in self.patterns:
            if not any(fnmatchcase(name, pattern) for name in known):
                near = difflib.get_close_matches(pattern, known, n=3, cutoff=0.5)
                what = {"move": "a shape or sensor", "set": "a parameter"}[self.kind]
                hint = ("Did you mean " + " or ".join(f"'{name}'" for name in near) + "?" if near else
                        "The scene has " + ", ".join(f"'{name}'" for name in known[:12]) + (", ..." if len(known) > 12 else "") + ".")
                raise ValueError(message("animate", f"{self.place}.{self.kind}", f"name {what} of the scene as mi.traverse does", pattern,
                                         f"{hint} Names come from the ids in the scene file."))
        return [name for name in known if any(fnmatchcase(name, pattern) for pattern in self.patterns)]

    def at(self, time, match: int) -> dict:
        """Name of each quantity -> its values (T, C) at times (T,) for match number `match`."""
        if self.stagger:
            time = (time + match * self.stagger) % 1.0
        return {name: track.at(time) for name, track in self.tracks.items()}

    def matrices(self, time, match: int, centre: np.ndarray) -> np.ndarray:
        """World transformations (T, 4, 4) of a ``move`` at times (T,); `centre` (T, 3): where the object's centre is then."""
        values = self.at(time, match)
        linear = np.broadcast_to(np.eye(3), (len(time), 3, 3))
        if "rotate" in values:
            linear = rotation(self.axis, values["rotate"][:, 0])
        if "scale" in values:
            linear = linear * np.broadcast_to(values["scale"], (len(time), 3))[:, None, :]
        pivot = centre if self.about is None else self.about
        result = np.tile(np.eye(4), (len(time), 1, 1))
        result[:, :3, :3] = linear
        result[:, :3, 3] = pivot - np.einsum("tij,tj->ti", linear, np.broadcast_to(pivot, (len(time), 3))) + values.get("translate", 0)
        return result


@dataclass
class Motion:
    """A checked motion file, not yet bound to a scene."""

    entries: list
    loop: bool

    def times(self, frames: int) -> np.ndarray:
        """Time of each frame, 0 to 1."""
        return np.arange(frames) / (frames if self.loop else max(frames - 1, 1))


def rotation(axis: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Matrices (T, 3, 3) that turn by `degrees` (T,), counter-clockwise about the unit vector `axis` (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)[:, None, None]
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


# ---- reading


def load_motion(source) -> Motion:
    """Read and check a motion file; its format is described in :py:mod:`mi_shlight.motion`.

    Parameters
    ----------
    source : str, os.PathLike or dict
        The path of a JSON file, or what such a file holds.

    Raises
    ------
    FileNotFoundError
        There is no such file.
    TypeError, ValueError
        The text is not JSON, or something in it is missing, unknown, of the wrong type or out of range. The message names file, key,
        value, rule and what to do.
    """
    if isinstance(source, dict):
        return _motion("motion", source)
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(message("animate", "motion", "be the path of a motion file, or a dict of its content", source))
    path = Path(source)
    if not path.is_file():
        raise FileNotFoundError(message("animate", "motion", "name an existing file", str(path), "Check the path."))
    try:
        content = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=_without_repetition)
    except json.JSONDecodeError as error:
        raise ValueError(message("animate", "motion", "name a file of JSON text", str(path),
                                 f"Line {error.lineno}, column {error.colno}: {error.msg}.")) from None
    except ValueError as error:                       # a repeated key, or bytes that are not text
        raise ValueError(message("animate", "motion", "name a file of JSON text", str(path), f"{error}.")) from None
    return _motion(path.name, content)


def _without_repetition(pairs) -> dict:
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"The key '{name}' stands twice in one object")
    return dict(pairs)


def _motion(place: str, content) -> Motion:
    _check_keys(place, content, ("loop", "motions"))
    loop = content.get("loop", False)
    if not isinstance(loop, bool):
        raise TypeError(message("animate", f"{place}: loop", "be true or false", loop))
    motions = content.get("motions")
    if not isinstance(motions, list) or not motions:
        raise ValueError(message("animate", f"{place}: motions", "be a list of at least one motion", motions))
    return Motion([_entry(f"{place}: motions[{i}]", entry, loop) for i, entry in enumerate(motions)], loop)


def _entry(place: str, entry, loop: bool) -> Entry:
    kinds = [kind for kind in ENTRY_KEYS if isinstance(entry, dict) and kind in entry]
    if len(kinds) != 1:
        raise ValueError(message("animate", place, "be an object with either 'move' or 'set'", entry))
    (kind,) = kinds
    _check_keys(place, entry, ENTRY_KEYS[kind])
    patterns = entry[kind] if isinstance(entry[kind], list) else [entry[kind]]
    if not patterns or not all(isinstance(pattern, str) and pattern for pattern in patterns):
        raise TypeError(message("animate", f"{place}.{kind}", "be a name or a list of names", entry[kind]))
    smooth = check_choice("animate", f"{place}.interpolation", entry.get("interpolation", "linear"), ("linear", "smooth")) == "smooth"
    stagger = float(_numbers(f"{place}.stagger", entry.get("stagger", 0), (1,))[0])
    axis = _numbers(f"{place}.axis", entry.get("axis", [0, 1, 0]), (3,))
    if not np.linalg.norm(axis) > 0:
        raise ValueError(message("animate", f"{place}.axis", "have a length", entry["axis"], "It is the axis that 'rotate' turns about."))
    about = entry.get("about", "centre")
    about = None if about == "centre" else _numbers(f"{place}.about", about, (3,), "Or give \"centre\", the middle of each object.")
    tracks = _tracks(place, kind, entry.get("keyframes"), smooth)
    for name, track in tracks.items():
        if (loop or stagger) and not track.closed:
            raise ValueError(message("animate", f"{place}.keyframes", f"end with the '{name}' they begin with, as "
                                     f"{'the file has loop' if loop else 'the motion has a stagger'}", track.values[-1].tolist(),
                                     f"It begins with {track.values[0].tolist()}: add a keyframe, or leave out "
                                     f"'{'loop' if loop else 'stagger'}'."))
    return Entry(place, kind, tuple(patterns), stagger, tracks, axis / np.linalg.norm(axis), about)


def _tracks(place: str, kind: str, keyframes, smooth: bool) -> dict:
    quantities = tuple(MOVE_TRACKS) if kind == "move" else SET_TRACKS
    if not isinstance(keyframes, list) or not keyframes:
        raise ValueError(message("animate", f"{place}.keyframes", "be a list of at least one keyframe", keyframes,
                                 f"A keyframe is an object with 'time' and {' or '.join(repr(q) for q in quantities)}."))
    points, last = {}, -1.0
    for i, keyframe in enumerate(keyframes):
        here = f"{place}.keyframes[{i}]"
        _check_keys(here, keyframe, ("time", *quantities))
        time = float(_numbers(f"{here}.time", keyframe.get("time"), (1,), "It is a fraction of the animation, from 0 to 1.")[0])
        if not 0 <= time <= 1 or not time > last:
            rule = "lie between 0 and 1" if not 0 <= time <= 1 else f"be later than that of the keyframe before, {last:g}"
            raise ValueError(message("animate", f"{here}.time", rule, keyframe["time"], "It is a fraction of the animation."))
        last = time
        for name in keyframe.keys() - {"time"}:
            value = _numbers(f"{here}.{name}", keyframe[name], MOVE_TRACKS.get(name))
            if name == "scale" and not (value > 0).all():
                raise ValueError(message("animate", f"{here}.scale", "be greater than 0", keyframe[name]))
            points.setdefault(name, []).append((time, value))
    if not points:
        raise ValueError(message("animate", f"{place}.keyframes", f"hold {' or '.join(repr(q) for q in quantities)}", keyframes))
    if kind == "set" and len(points) > 1:
        raise ValueError(message("animate", f"{place}.keyframes", "hold either 'value' or 'factor'", keyframes, "Make two motions of it."))
    tracks = {}
    for name, pairs in points.items():
        width = max(len(value) for _, value in pairs)
        if any(len(value) not in (1, width) for _, value in pairs):
            raise ValueError(message("animate", f"{place}.keyframes", f"hold as many numbers each time in '{name}'",
                                     [len(value) for _, value in pairs]))
        values = np.array([np.broadcast_to(value, width) for _, value in pairs])
        tracks[name] = Track(np.array([time for time, _ in pairs]), values, smooth, 360.0 if name == "rotate" else 0.0)
    return tracks


def _check_keys(place: str, entry, known: tuple) -> None:
    if not isinstance(entry, dict):
        raise TypeError(message("animate", place, "be a JSON object", entry))
    for name in entry:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"Did you mean '{near[0]}'?" if near else "Possible are " + ", ".join(f"'{k}'" for k in known) + "."
            raise ValueError(message("animate", place, "have no unknown keys", name, hint))


def _numbers(place: str, value, counts, hint: str = "") -> np.ndarray:
    """`value`, a number or a list of numbers, as (C,); `counts`: how many there may be, None: at least one."""
    rule = f"be {SIZES[counts]}"
    listed = value if isinstance(value, list) and counts != (1,) else [value]
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in listed):
        raise TypeError(message("animate", place, f"{rule}, finite", value, hint))
    if not listed or (counts is not None and len(listed) not in counts):
        raise ValueError(message("animate", place, rule, value, hint))
    return np.array(listed, dtype=float)
