"""What all experiments share: their options, the folder they write to, and their JSON with the machine and versions behind it.

An experiment is a module of this package with a function ``main(arguments=None)``: it measures, writes ``NAME*.json`` and ``NAME*.png``,
prints its tables and the verdicts on its targets, and returns an exit status: 0 or None unless a measurement failed. A missed target is a
result. Its docstring begins with "Claim: ".
"""
from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import math
import os
import pathlib
import platform

import drjit as dr
import numpy as np

import mi_shlight
from mi_shlight.files import replacing
from mi_shlight.llvm import llvm_info

ROOT = pathlib.Path(__file__).parents[1]
RESULTS = ROOT / "validation" / "results"
QUICK_RESULTS = ROOT / "build" / "validation-quick"
"""Where quick runs write, unless told otherwise: their figures mean little and must not take the place of the recorded ones."""
DIGITS = 6
"""Significant digits of the numbers in a JSON file."""
WIDTH = 140
VERDICT = {True: "met", False: "MISSED", None: "-"}


def command_line(doc: str) -> argparse.ArgumentParser:
    """Parser of the options that all experiments have; the first line of `doc` becomes the description."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="try everything at tiny sizes, in seconds; the figures mean little")
    parser.add_argument("--out", type=pathlib.Path, metavar="DIR",
                        help=f"folder of the results (default: {RESULTS.relative_to(ROOT)}, --quick: {QUICK_RESULTS.relative_to(ROOT)})")
    return parser


def parse(parser: argparse.ArgumentParser, arguments=None) -> argparse.Namespace:
    """The options of a command line, by default that of the process, with ``out`` made."""
    parsed = parser.parse_args(arguments)
    parsed.out = parsed.out or (QUICK_RESULTS if parsed.quick else RESULTS)
    parsed.out.mkdir(parents=True, exist_ok=True)
    return parsed


def options(doc: str, arguments=None, **extra) -> argparse.Namespace:
    """Parse the options of an experiment, and make its folder.

    Parameters
    ----------
    doc : str
        The module's docstring.
    arguments : list of str, optional
        The command line; by default that of the process.
    **extra : dict
        Options besides ``--quick`` and ``--out``: name, ``_`` for ``-``, and keywords of `argparse.ArgumentParser.add_argument`.

    Returns
    -------
    argparse.Namespace
        With ``quick`` (bool), ``out`` (`pathlib.Path` of an existing folder), and the names in `extra`.
    """
    parser = command_line(doc)
    for name, keywords in extra.items():
        parser.add_argument(f"--{name.replace('_', '-')}", **keywords)
    return parse(parser, arguments)


def versions(threads: int | None = None) -> dict:
    """Date, machine and versions behind a measurement; `threads` of Dr.Jit are by default those that it uses now."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            processor = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        processor = platform.processor() or platform.machine()
    return {"date": datetime.date.today().isoformat(), "machine": processor, "cores": os.cpu_count(),
            "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2 ** 30, 1),
            "threads": dr.thread_count() if threads is None else threads, "load": [round(value, 2) for value in os.getloadavg()],
            "python": platform.python_version(), "numpy": np.__version__, "mi_shlight": mi_shlight.__version__,
            "drjit": dr.__version__, "mitsuba": importlib.metadata.version("mitsuba"), "llvm": ".".join(map(str, llvm_info()["version"]))}


def significant(value) -> float:
    return float(f"{value:.4g}")


def verdict(target: str, value, limit: float, at_most: bool = True, text: str = "{:.3g}") -> dict:
    """One line of a list of targets; `value` is None or NaN if it was not measured."""
    known = value is not None and not math.isnan(value)
    return {"target": target, "limit": limit, "measured": text.format(value) if known else "not measured",
            "met": bool(value <= limit if at_most else value >= limit) if known else None}


def print_targets(lines: list) -> None:
    print("\nTargets")
    for line in lines:
        print(f"{VERDICT[line['met']]:6s} {line['target']}: {line['measured']}")


def write(path: pathlib.Path, data: dict, quick: bool = False) -> None:
    """Write `data` as JSON, after ``versions`` and ``quick``; whole or not at all.

    Floats are rounded to `DIGITS` significant digits; NaN and infinities become null. NumPy's numbers and arrays are taken as Python's.
    """
    write_json(path, {"versions": versions(), "quick": quick, **data})


def write_json(path: pathlib.Path, data: dict) -> None:
    """Write `data` alone, as :py:func:`write` does."""
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines_of(plain(data))) + "\n", encoding="utf-8")


def plain(value):
    """`value` in the types of JSON."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def lines_of(value, indent: int = 0, head: str = "", tail: str = "") -> list:
    """JSON text of `value`, a line for whatever fits on one: rows of tables stay rows, and so do lists of plain values."""
    line = " " * indent + head + json.dumps(value, ensure_ascii=False) + tail
    nested = isinstance(value, dict) or isinstance(value, list) and any(isinstance(item, (dict, list)) for item in value)
    if not nested or not value or len(line) <= WIDTH:
        return [line]
    if isinstance(value, dict):
        items, brackets = [(f"{json.dumps(key, ensure_ascii=False)}: ", item) for key, item in value.items()], "{}"
    else:
        items, brackets = [("", item) for item in value], "[]"
    inner = [line for k, (key, item) in enumerate(items) for line in lines_of(item, indent + 1, key, "," if k < len(items) - 1 else "")]
    return [" " * indent + head + brackets[0], *inner, " " * indent + brackets[1] + tail]
