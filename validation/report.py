"""The report on all experiments: one HTML file with every picture in it, which needs no script and nothing from elsewhere.

``write(folder)`` composes what the experiments wrote into `folder`: their JSON, their pictures, and ``runs.json``, the record of how they
went. Pictures are shrunk so far that the file stays below `LIMIT`; the originals lie beside it.
"""
from __future__ import annotations

import base64
import bisect
import functools
import io
import json
import math
import pathlib
import re
from html import escape

from PIL import Image

from mi_shlight.files import replacing
from validation import papers
from validation.experiment import VERDICT
from validation.experiments import EXPERIMENTS, GROUPS, Experiment

RUNS = "runs.json"
REPORT = "report.html"
LIMIT = 980_000
"""Bytes."""
QUALITIES = ((1000, 60), (1000, 45), (900, 40), (840, 36), (800, 32), (760, 29), (720, 26), (690, 24), (660, 22), (600, 18), (520, 14),
             (440, 10))
"""(largest width in pixels, quality of WebP), best first."""
ROWS, COLUMNS = 12, 12
"""Of a table; the rest is in the JSON."""
RUN_KEYS = ("status", "seconds", "cpu_seconds", "quick", "commit", "output")
NOT_TABLES = ("versions", "quick", "targets", "failures", "runs")
CHANGING = ("date", "load", "threads")
"""Of the versions: what differs from run to run on one machine."""

SOURCES = ("[W18] Wang, Ramamoorthi, <i>Analytic Spherical Harmonic Coefficients for Polygonal Area Lights</i>, 2018. [W20] Wu, Cai, Zhao, "
           "Ramamoorthi, <i>Analytic Spherical Harmonic Gradients for Real-Time Rendering with Many Polygonal Area Lights</i>, 2020. "
           "[G03] Green, <i>Spherical Harmonic Lighting: The Gritty Details</i>, 2003.")
STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --soft: #5b6570; --line: #d5dae0; --paper: #fff; --tint: #f4f6f8;
  --good: #137333; --bad: #b3261e; --link: #0b57d0; }
@media (prefers-color-scheme: dark) { :root { --ink: #e3e6ea; --soft: #9aa4af; --line: #3a424b; --paper: #15181c; --tint: #1f242a;
  --good: #7bd88f; --bad: #ff8a80; --link: #8ab4f8; } }
body { margin: 0 auto; max-width: 64rem; padding: 1.5rem; font: 16px/1.5 system-ui, sans-serif; color: var(--ink);
  background: var(--paper); }
h1 { margin-bottom: .2rem; } h2 { margin-top: 3rem; border-bottom: 2px solid var(--line); } h3 { margin: 2.5rem 0 .3rem; }
a { color: var(--link); } .soft, figcaption, caption { color: var(--soft); font-size: .9rem; }
.claim { font-size: 1.08rem; margin: .3rem 0; } .met { color: var(--good); } .missed, .failed { color: var(--bad); font-weight: 600; }
table { border-collapse: collapse; font-size: .88rem; margin: .6rem 0; } caption { text-align: left; caption-side: top; }
td, th { padding: .15rem .7rem .15rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line); }
td.n { text-align: right; font-variant-numeric: tabular-nums; } .scroll { overflow-x: auto; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; background: #fff; border-radius: 4px; display: block; }
details { margin: .5rem 0; } summary { cursor: pointer; color: var(--link); }
pre { overflow-x: auto; background: var(--tint); padding: .7rem; font-size: .82rem; line-height: 1.4; white-space: pre-wrap; }
.box { border: 2px solid var(--bad); border-radius: 6px; padding: .2rem .9rem; margin: .8rem 0; }
code { background: var(--tint); padding: .05rem .25rem; border-radius: 3px; }
"""


def write(folder: pathlib.Path) -> pathlib.Path:
    """Compose ``report.html`` in `folder`, at the best quality of pictures with which it stays below `LIMIT`.

    Raises ValueError if it does not even at the lowest.
    """
    text = Report(folder).html()
    names = [name for entry in EXPERIMENTS.values() for name in entry.pictures if (folder / name).is_file()]
    pictures = {name: opened(folder / name) for name in names}
    encoded = functools.cache(lambda step: {name: data_uri(picture, *QUALITIES[step]) for name, picture in pictures.items()})
    fits = lambda step: len(text.encode()) + sum(map(len, encoded(step).values())) <= LIMIT
    best = bisect.bisect_left(range(len(QUALITIES)), True, key=fits)
    if best == len(QUALITIES):
        raise ValueError(f"write(): the report of '{folder}' does not fit into {LIMIT} bytes")
    for name, uri in encoded(best).items():
        text = text.replace(placeholder(name), uri)
    with replacing(folder / REPORT) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return folder / REPORT


def placeholder(name: str) -> str:
    return f"picture:{name}"


def opened(path: pathlib.Path) -> Image.Image:
    """Without transparency, which becomes white."""
    with Image.open(path) as picture:
        picture = picture.convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture).convert("RGB")


def data_uri(picture: Image.Image, width: int, quality: int) -> str:
    if picture.width > width:
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
    encoded = io.BytesIO()
    picture.save(encoded, "WEBP", quality=quality, method=4)
    return "data:image/webp;base64," + base64.b64encode(encoded.getvalue()).decode()


def read(path: pathlib.Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def results(path: pathlib.Path) -> dict:
    """Of an experiment; nothing if they are of a form that it no longer writes."""
    data = read(path)
    return data if all(isinstance(line.get("target"), str) and "met" in line for line in data.get("targets", [])) else {}


class Report:
    """The report of one folder, with placeholders for the pictures."""

    def __init__(self, folder: pathlib.Path):
        self.folder, self.runs = folder, read(folder / RUNS)
        self.data = {name: results(folder / f"{name}.json") for name in EXPERIMENTS}
        self.machines = []
        for name in EXPERIMENTS:
            machine = self.machine(name)
            if machine and machine not in self.machines:
                self.machines.append(machine)

    def versions(self, name: str) -> dict:
        """Of the run whose results there are, as far as it is known."""
        run = {key: value for key, value in self.runs.get(name, {}).items() if key not in RUN_KEYS}
        return self.data[name].get("versions", run)

    def machine(self, name: str) -> dict:
        return {key: value for key, value in self.versions(name).items() if key not in CHANGING}

    def failure(self, name: str) -> str | None:
        """Why there is no result to rely on: None if there is."""
        run, data = self.runs.get(name), self.data[name]
        if run and run["status"]:
            return f"The last run failed with exit status {run['status']}."
        if not data and run:
            return f"It has written no {name}.json."
        if not data:
            return "It has not been run."
        return "Measurements failed." if data.get("failures") else None

    def quick(self, name: str) -> bool:
        return bool(self.data[name].get("quick", self.runs.get(name, {}).get("quick", False)))

    def html(self) -> str:
        failed = [name for name in EXPERIMENTS if self.failure(name)]
        lines = [line for data in self.data.values() for line in data.get("targets", [])]
        dates = sorted({self.versions(name)["date"] for name in EXPERIMENTS if "date" in self.versions(name)})
        period = " to ".join(dict.fromkeys((dates or ["never"])[::len(dates) - 1 or 1]))
        quick = [name for name in EXPERIMENTS if self.quick(name)]
        parts = ["<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><meta name='viewport' content='width=device-width'>",
                 f"<title>mi_shlight: validation</title><style>{STYLE}</style></head><body>",
                 "<h1>mi_shlight: validation</h1>",
                 f"<p class='soft'>{len(EXPERIMENTS)} experiments, run {period} by <code>python -m validation</code>; one alone by "
                 "<code>python -m validation.NAME</code>.</p>",
                 f"<p>{chips(lines)}. " + (f"<span class='failed'>{len(failed)} experiments without a sound result: "
                                           f"{', '.join(link(name) for name in failed)}.</span>" if failed else "No experiment failed.")
                 + " A target that is missed is a result, and stays.</p>",
                 f"<p class='soft'>{SOURCES}</p>"]
        if quick:
            parts.append("<p class='box'><strong>Quick runs</strong> try everything at tiny sizes; their figures and verdicts mean little: "
                         f"{'all' if len(quick) == len(EXPERIMENTS) else ', '.join(link(name) for name in quick)}.</p>")
        parts += [self._machines(), self._contents()]
        for group, entries in GROUPS.items():
            parts.append(f"<h2>{escape(group)}</h2>")
            parts += [self._section(entry) for entry in entries]
        parts += [self._papers(), "</body></html>\n"]
        return "\n".join(parts)

    def _machines(self) -> str:
        keys = list(dict.fromkeys(key for machine in self.machines for key in machine))
        rows = [{"": k + 1 if len(self.machines) > 1 else "", **{key.replace("_", " "): machine.get(key) for key in keys}}
                for k, machine in enumerate(self.machines)]
        return table(rows, "Machine and versions", columns=len(keys) + 1) if rows else ""

    def _contents(self) -> str:
        rows = []
        for group, entries in GROUPS.items():
            rows.append(f"<tr><th colspan='3'>{escape(group)}</th></tr>")
            for entry in entries:
                state = "<span class='failed'>no sound result</span>" if self.failure(entry.name) else chips(
                    self.data[entry.name].get("targets", []))
                rows.append(f"<tr><td>{link(entry.name, entry.title)}</td><td>{prose(entry.claim)}</td><td>{state}</td></tr>")
        rows.append("<tr><th colspan='3'><a href='#papers'>The papers, figure by figure</a></th></tr>")
        return f"<h2>Contents</h2><table>{''.join(rows)}</table>"

    def _section(self, entry: Experiment) -> str:
        data, run, failure = self.data[entry.name], self.runs.get(entry.name, {}), self.failure(entry.name)
        parts = [f"<section id='{entry.name}'><h3>{escape(entry.title)}</h3>", f"<p class='claim'>{prose(entry.claim)}</p>",
                 f"<p class='soft'><code>python -m validation.{entry.name}</code>{self._circumstances(entry.name, run)}</p>"]
        if failure:
            said = "\n".join(run.get("output", []) or data.get("failures", []))
            earlier = " What follows is of an earlier run." if data and run.get("status") else ""
            parts.append(f"<div class='box'><p class='failed'>{escape(failure)}{earlier}</p>"
                         + (f"<pre>{escape(said)}</pre>" if said else "") + "</div>")
        if data.get("targets"):
            parts.append(verdicts(data["targets"]))
        for name, caption in entry.pictures.items():
            if (self.folder / name).is_file():
                parts.append(f"<figure id='{anchor(name)}'><img src='{placeholder(name)}' alt='{escape(caption, quote=True)}'>"
                             f"<figcaption>{escape(caption)} ({escape(name)})</figcaption></figure>")
            elif data:
                parts.append(f"<p class='{'soft' if self.quick(entry.name) else 'failed'}'>Not made: {escape(name)}</p>")
        tables = "".join(tables_of(data, f"{entry.name}.json"))
        if tables:
            parts.append(f"<details><summary>Numbers</summary>{tables}</details>")
        parts.append(f"<details><summary>How it is measured</summary><pre>{escape(entry.doc)}</pre></details></section>")
        return "\n".join(parts)

    def _circumstances(self, name: str, run: dict) -> str:
        versions, said = self.versions(name), []
        if "date" in versions:
            said.append(versions["date"])
        if "seconds" in run:
            said.append(duration(run["seconds"]))
        if versions.get("threads"):
            said.append(f"{versions['threads']} thread{'s' * (versions['threads'] > 1)}")
        if run.get("commit"):
            said.append(f"commit {run['commit']}")
        if len(self.machines) > 1 and self.machine(name):
            said.append(f"machine {self.machines.index(self.machine(name)) + 1}")
        if self.quick(name):
            said.append("<strong>quick</strong>")
        return "".join(f" · {part}" for part in said)

    def _papers(self) -> str:
        rows = []
        for row in papers.rows(self.folder):
            pictures = ", ".join(f"<a href='#{anchor(name)}'>{escape(name)}</a>" if (self.folder / name).is_file() else escape(name)
                                 for name in row["pictures"])
            state = "met" if row["reproduced"] == "yes" else ""
            command = f"<code>{escape(row['command'])}</code><br>" if row["command"] else ""
            rows.append(f"<tr><td>{escape(row['paper'])}</td><td>{escape(row['item'])}</td><td>{escape(row['shows'])}</td>"
                        f"<td>{command}{pictures}</td><td class='{state}'>{escape(row['reproduced'])}</td>"
                        f"<td>{escape(row['verdict'])}</td></tr>")
        head = "<tr><th>paper</th><th>item</th><th>shows</th><th>command, our figure</th><th>reproduced</th><th>verdict</th></tr>"
        return f"<h2 id='papers'>The papers, figure by figure</h2><div class='scroll'><table>{head}{''.join(rows)}</table></div>"


def anchor(name: str) -> str:
    return "picture-" + "".join(c if c.isalnum() else "-" for c in name)


def link(name: str, text: str | None = None) -> str:
    return f"<a href='#{name}'>{escape(text or name)}</a>"


def prose(text: str) -> str:
    """A sentence of a docstring."""
    return re.sub("(`+)(.+?)\\1", r"<code>\2</code>", escape(text[:1].upper() + text[1:]))


def duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def chips(lines: list) -> str:
    """How many of the targets are met."""
    met, missed, unknown = (sum(line["met"] is state for line in lines) for state in (True, False, None))
    said = [f"<span class='met'>{met} met</span>"] * bool(met) + [f"<span class='missed'>{missed} missed</span>"] * bool(missed)
    return ", ".join(said + [f"{unknown} not measured"] * bool(unknown)) or "no targets"


def verdicts(lines: list) -> str:
    rows = "".join(f"<tr><td class='{'met' if line['met'] else 'missed' if line['met'] is False else ''}'>{VERDICT[line['met']]}</td>"
                   f"<td>{escape(line['target'])}</td><td>{escape(str(line['measured']))}</td></tr>" for line in lines)
    whole = f"<table><tr><th></th><th>target</th><th>measured</th></tr>{rows}</table>"
    return whole if len(lines) <= ROWS else f"<details><summary>{len(lines)} targets: {chips(lines)}</summary>{whole}</details>"


def tables_of(value, file: str, title: str = "") -> list:
    """Tables of all lists and groups of rows in a JSON value, however deep; what is neither is a table of one row."""
    if is_rows(value):
        return [table(value, title, file)]
    if not isinstance(value, dict):
        return []
    inner = {key: item for key, item in value.items() if title or key not in NOT_TABLES}
    if inner and all(isinstance(item, dict) and plain_row(item) for item in inner.values()):
        return [table([{"": key, **item} for key, item in inner.items()], title, file)]
    alone = {key: item for key, item in inner.items() if not isinstance(item, (dict, list))}
    found = [table([alone], title, file)] if alone else []
    for key, item in inner.items():
        found += tables_of(item, file, f"{title}, {key}" if title else key)
    return found


def is_rows(value) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def plain_row(row: dict) -> bool:
    return not any(isinstance(item, (dict, list)) for item in row.values())


def table(rows: list, title: str, file: str = "", columns: int = COLUMNS) -> str:
    rows = [flat(row) for row in rows]
    keys = list(dict.fromkeys(key for row in rows for key in row))
    shown = keys[:columns]
    head = "".join(f"<th>{escape(key.replace('_', ' '))}</th>" for key in shown)
    body = "".join("<tr>" + "".join(cell(row.get(key)) for key in shown) + "</tr>" for row in rows[:ROWS])
    cut = [f"{ROWS} of {len(rows)} rows"] * (len(rows) > ROWS) + [f"{columns} of {len(keys)} columns"] * (len(keys) > columns)
    caption = title + (f" ({', '.join(cut)}; all in {file})" if cut else "")
    return f"<div class='scroll'><table><caption>{escape(caption)}</caption><tr>{head}</tr>{body}</table></div>"


def flat(row: dict) -> dict:
    """With dictionaries in it spread over columns."""
    found = {}
    for key, value in row.items():
        if isinstance(value, dict):
            found.update({f"{key}, {inner}": item for inner, item in flat(value).items()})
        else:
            found[key] = value
    return found


def cell(value) -> str:
    if value is None:
        return "<td></td>"
    if isinstance(value, bool):
        return f"<td>{'yes' if value else 'no'}</td>"
    if isinstance(value, (int, float)):
        whole = isinstance(value, int) or value.is_integer() and abs(value) < 1e6
        return f"<td class='n'>{value:.0f}</td>" if whole else f"<td class='n'>{value:.3g}</td>" if math.isfinite(value) else "<td></td>"
    if isinstance(value, list):
        return f"<td>{escape(', '.join(map(str, value)))}</td>" if len(value) <= 4 and not is_rows(value) else f"<td>[{len(value)}]</td>"
    return f"<td>{escape(str(value))}</td>"
