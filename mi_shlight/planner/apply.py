"""Put an integrator into a scene file and leave all else as it is, to the letter."""
from __future__ import annotations

import os
import re
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from ..errors import message
from ..files import check_output, replacing

FILE_ATTRIBUTES = {"string": "value", "include": "filename", "path": "value", "default": "value"}
"""Where a scene file can name files: elements and their attributes."""


def apply_settings(scene_file, settings: dict, output) -> Path:
    """Write a scene file with `shprt` and the given parameters in place of its integrator.

    Parameters
    ----------
    scene_file : str or os.PathLike
        A Mitsuba XML file.
    settings : dict
        Parameters of `shprt`; None stands for its default and is left out.
    output : str or os.PathLike
        The file to write; it may be `scene_file` itself. It appears complete or not at all. In another folder it names the files that the
        scene uses, meshes, textures and included files, from there.

    Returns
    -------
    Path
        of the file written.

    Raises
    ------
    ValueError
        If the file is no XML with a ``<scene>`` at its top, or one that it includes has the integrator.
    OSError
        If a file cannot be read or written.

    Notes
    -----
    An integrator inside of ``aov`` or ``moment`` is the one that is replaced. Everything outside of it stays, comments included.
    """
    source = Path(scene_file)
    output = check_output("apply_settings", "output", output, ".xml")
    data = source.read_bytes()
    layout = _layout(source, data)
    if layout.integrator is None:
        for name in layout.included:
            file = source.parent / name
            if file.is_file() and _layout(file, file.read_bytes()).integrator:
                raise ValueError(message("apply_settings", "scene_file", "hold its integrator itself", str(source),
                                         f"It stands in '{name}', which the file includes: plan for a file without that."))
    begin, end = layout.integrator or (layout.after_scene, layout.after_scene)
    text = _integrator(settings, _indentation(data, begin) if layout.integrator else b"    ")
    edits = [(begin, end, text if layout.integrator else b"\n    " + text)]
    if output.resolve().parent != source.resolve().parent:
        edits += [edit for edit in _moved_files(data, layout.files, source.resolve().parent, output.resolve().parent)
                  if not begin <= edit[0] < end]
    for first, last, replacement in sorted(edits, reverse=True):
        data = data[:first] + replacement + data[last:]
    with replacing(output) as temporary:
        temporary.write_bytes(data)
    return output


class _Layout:
    """Where in the bytes of a scene file things stand."""

    def __init__(self):
        self.after_scene, self.integrator, self.included, self.files = None, None, [], []


def _layout(file: Path, data: bytes) -> _Layout:
    found, path, open_at = _Layout(), [], []
    parser = expat.ParserCreate()
    wrapped = []

    def start(name, attributes):
        at = parser.CurrentByteIndex
        path.append(name)
        open_at.append((at, attributes))
        if len(path) == 1:
            if name != "scene":
                raise ValueError(message("apply_settings", "scene_file", "have a <scene> at its top", str(file), f"It has <{name}>."))
            found.after_scene = _tag_end(data, at)
        if name == "include":
            found.included.append(attributes.get("filename", ""))
        if name in FILE_ATTRIBUTES:
            found.files.append((at, _tag_end(data, at), FILE_ATTRIBUTES[name], attributes.get(FILE_ATTRIBUTES[name], "")))

    def end(name):
        (at, _), depth = open_at.pop(), len(path)
        outer = open_at[1][1].get("type") if depth > 2 else None
        path.pop()
        if name != "integrator" or found.integrator and not wrapped:
            return
        if depth == 3 and outer in ("aov", "moment") and path[1] == "integrator":
            wrapped.append(at)
        elif depth != 2 or wrapped:
            return
        found.integrator = at, _element_end(data, at, parser.CurrentByteIndex)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ValueError(message("apply_settings", "scene_file", "be well-formed XML", str(file), f"{error}.")) from None
    return found


def _tag_end(data: bytes, at: int) -> int:
    """Position after the tag that begins at `at`; a > inside of quotes does not end it."""
    return re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""").match(data, at).end()


def _element_end(data: bytes, at: int, closing: int) -> int:
    """Position after the element that begins at `at` and has its closing tag, unless it is empty, at `closing`."""
    end = _tag_end(data, at)
    return end if data[end - 2:end] == b"/>" else _tag_end(data, closing)


def _indentation(data: bytes, at: int) -> bytes:
    line = data[data.rfind(b"\n", 0, at) + 1:at]
    return line if not line.strip() else b"    "


def _integrator(settings: dict, indentation: bytes) -> bytes:
    kinds = {bool: "boolean", int: "integer", float: "float", str: "string"}
    lines = ['<integrator type="shprt">']
    for name, value in settings.items():
        if value is not None:
            shown = str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, float) else str(value)
            lines.append(f'    <{kinds[type(value)]} name="{name}" value={quoteattr(shown)}/>')
    return (b"\n" + indentation).join(line.encode() for line in (*lines, "</integrator>"))


def _moved_files(data: bytes, files: list, old: Path, new: Path) -> list:
    """Edits (begin, end, bytes) that name existing files, relative to `old`, from `new`."""
    edits = []
    for begin, end, attribute, name in files:
        if not name or os.path.isabs(name) or not (old / name).exists():
            continue
        tag = data[begin:end]
        value = re.search(rb"\b" + attribute.encode() + rb"""\s*=\s*("[^"]*"|'[^']*')""", tag)
        moved = Path(os.path.relpath(old / name, new)).as_posix()
        edits.append((begin + value.start(1), begin + value.end(1), quoteattr(moved).encode()))
    return edits
