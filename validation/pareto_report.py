"""What a run of ``validation.pareto`` says: samples and time a path tracer needs for the same error, targets, tables for the docs."""
from __future__ import annotations

import math
import re

import numpy as np

from validation.engine_report import Record
from validation.experiment import verdict

DIRECT = ("cornell_box", "plant", "sculpture")
FLOOR, BOUNCED, GRID_SCENE = "floor", "cornell_box, all bounces", "many_lights"
SCENES = (*DIRECT, BOUNCED, GRID_SCENE)
INDEPENDENT, STRATIFIED = "independent", "multijitter"
UNSHADOWED, PROJECTED, LOCALISED, EXACT, INTERREFLECTED = "unshadowed", "projected", "localised", "exact", "interreflected"
SPLIT = "hermite, near lights exact"
PATH, TUNED = "path", "direct, 8 light samples"
RIVALS = (PATH, "direct", TUNED)
PRECISIONS = ("float32", "float64")
STANDARD_ORDER, STANDARD_SPP = 8, 16
DEFAULT = "default (localised, order 8)"
PICTURES = (1, 10, 100)
"""Over which a bake is spread."""


class ParetoRecord(Record):
    """Rows of ``validation.pareto``."""

    TABLES = ("references", "settings", "pictures", "equal_error", "precision", "first_pictures")

    def __init__(self, rows: dict | None = None):
        super().__init__()
        self.rows = {name: (rows or {}).get(name, []) for name in self.TABLES}
        self.rows["pictures"] = [picture for row in self.rows["pictures"] for picture in unpacked(row)]

    def only(self, table: str, **keys) -> dict:
        """The first such row; empty if there is none."""
        return next(iter(self.find(table, **keys)), {})


    def packed(self) -> dict:
        """All rows, those of pictures that differ only in their samples in one, with lists, which `ParetoRecord` takes as well."""
        found = {}
        for picture in self.rows["pictures"]:
            key = tuple(value for name, value in picture.items() if name not in SAMPLED)
            row = found.setdefault(key, {**picture, **{name: [] for name in SAMPLED}})
            for name in SAMPLED:
                row[name].append(picture[name])
        return {**self.rows, "pictures": list(found.values())}


SAMPLED = ("spp", "error", "blocks", "seconds")
"""What differs between pictures of one setting."""


def unpacked(row: dict) -> list:
    """The pictures of a row of :py:meth:`ParetoRecord.packed`."""
    if not isinstance(row["spp"], list):
        return [row]
    return [{**row, **dict(zip(SAMPLED, values))} for values in zip(*(row[name] for name in SAMPLED))]


# Laws.

class Rival:
    """Error and time of one of Mitsuba's integrators over its samples per pixel: a power law, and what was measured."""

    def __init__(self, rows: list, noise: dict):
        self.rows, self.noise = sorted(rows, key=lambda row: row["spp"]), noise
        self.spp = [row["spp"] for row in self.rows]
        self.times = np.maximum.accumulate([row["seconds"] for row in self.rows])

    def law(self, name: str) -> tuple:
        """(a, p) of error a spp^p; `name`: ``error`` or ``blocks``. NaN unless two errors are above the reference's noise, and fall."""
        rows = [row for row in self.rows if row[name] > self.noise[name]]
        if len(rows) < 2:
            return math.nan, math.nan
        power, logarithm = np.polyfit(np.log([row["spp"] for row in rows]), np.log([row[name] for row in rows]), 1)
        return (math.exp(logarithm), power) if power < 0 else (math.nan, math.nan)

    def samples(self, error: float, name: str = "error") -> float:
        """Samples per pixel for an error, not below one; infinite for none."""
        a, power = self.law(name)
        return max((error / a) ** (1 / power), 1.0) if error > 0 else math.inf

    def seconds(self, samples: float) -> float:
        """Between those measured on straight lines, beyond them in proportion."""
        most = self.spp[-1]
        return float(np.interp(samples, self.spp, self.times)) if samples <= most else self.times[-1] * samples / most


def rival(record: ParetoRecord, scene: str, family: str, sampler: str):
    """A `Rival`, or None if it was not measured."""
    rows = [row for row in record.find("pictures", scene=scene, family=family, sampler=sampler) if "seconds" in row]
    return Rival(rows, record.only("references", scene=scene)) if len(rows) > 1 else None


def standard(record: ParetoRecord, **keys) -> dict:
    """The row of a setting at `STANDARD_SPP`, or with the most samples that there are."""
    rows = record.find("pictures", **keys)
    return next((row for row in rows if row["spp"] == STANDARD_SPP), max(rows, key=lambda row: row["spp"], default={}))


def headline(record: ParetoRecord, scene: str) -> dict:
    """Settings of `shprt` to compare with Mitsuba, by name."""
    of = lambda family, setting, sampler=STRATIFIED: record.only("settings", scene=scene, family=family, setting=setting, sampler=sampler)
    if scene == BOUNCED:
        return {f"{INTERREFLECTED}, order {order}": of(INTERREFLECTED, order) for order in (4, STANDARD_ORDER)}
    if scene == GRID_SCENE:
        return {"grid 8, near lights exact": of(SPLIT, 8), "no grid": of("no grid", 0)}
    fitted = record.find("settings", scene=scene, family=LOCALISED, sampler=STRATIFIED)
    best = min(fitted, key=lambda row: row["floor error"], default={})
    found = {DEFAULT: of(LOCALISED, STANDARD_ORDER), "default, samples of the scene's file": of(LOCALISED, STANDARD_ORDER, INDEPENDENT),
             f"best localised, order {best.get('setting')}": best, "projected, order 8, as the papers": of(PROJECTED, STANDARD_ORDER),
             "exact, order 8": of(EXACT, STANDARD_ORDER)}
    return {name: setting for name, setting in found.items() if setting is not found[DEFAULT] or name == DEFAULT}


def compare_rivals(record: ParetoRecord) -> None:
    """Fill the table ``equal_error``: what each rival takes for the errors of the settings of `headline`."""
    for scene in SCENES:
        for name, setting in headline(record, scene).items():
            where = {key: setting.get(key) for key in ("scene", "family", "setting", "sampler")}
            picture = standard(record, **where)
            for family in RIVALS if setting and "seconds" in picture else ():
                found = rival(record, scene, family, setting["sampler"])
                if found is None:
                    continue
                row = {"scene": scene, "name": name, "rival": family, "power": found.law("error")[1], "spp": picture["spp"]}
                for kind in ("error", "blocks"):
                    samples = found.samples(picture[kind], kind)
                    row |= {f"{kind}": picture[kind], f"{kind}: samples": samples,
                            f"{kind}: faster": found.seconds(samples) / picture["seconds"],
                            f"{kind}: catches up": found.samples(setting[f"floor {kind}"], kind)}
                whole = found.seconds(row["error: samples"])
                row |= {f"faster over {n}": n * whole / (setting["bake"] + n * picture["seconds"]) for n in PICTURES}
                record.rows["equal_error"].append({**row, "ms": 1e3 * picture["seconds"], "bake": setting["bake"]})


def targets(record: ParetoRecord) -> list:
    """Verdicts; `met` is None where nothing was measured."""
    out = []
    for scene, name, against in (*((scene, DEFAULT, against) for scene in DIRECT for against in (PATH, "direct")),
                                 (BOUNCED, f"{INTERREFLECTED}, order {STANDARD_ORDER}", PATH),
                                 (GRID_SCENE, "grid 8, near lights exact", PATH)):
        row = record.only("equal_error", scene=scene, name=name, rival=against)
        for kind, what in (("error: faster", "a picture"), ("faster over 100", "100 pictures and their bake")):
            out.append(verdict(f"{scene}: {name}: {what} sooner than {against} at equal error", row.get(kind), 1, at_most=False))
    return out


# Tables.

def markdown(rows: list) -> str:
    """A table of dictionaries of text."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)] if rows else [["nothing measured"]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def percent(value) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.2%}" if value < 0.1 else f"{value:.0%}"


def count(value) -> str:
    """Samples per pixel or a ratio, two digits; "-" for what the noise of the reference hides."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.2g}" if value < 100 else f"{float(f'{value:.2g}'):,.0f}"


def duration(seconds) -> str:
    return "-" if not seconds else f"{1e3 * seconds:.2g} ms" if seconds < 0.0995 else f"{seconds:.2g} s"


def tables(record: ParetoRecord) -> dict:
    """Markdown by name."""
    made = {"equal error": equal_error_table(record, "error"), "equal error of 8 x 8 pixels": equal_error_table(record, "blocks"),
            "orders": order_table(record)}
    titles = {"transfer_samples": "rays", "max_edge": "cell", "light_margin": "margin, degrees", "transfer_domain": "rays"}
    made |= {axis: axis_table(record, axis, title) for axis, title in titles.items()}
    return made | {"grid": grid_table(record), "precision": precision_table(record), "first pictures": first_table(record)}


def equal_error_table(record: ParetoRecord, kind: str) -> str:
    """`kind`: ``error``, of pixels, with the bake spread over pictures, or ``blocks``."""
    rows = []
    for scene in SCENES:
        for name in dict.fromkeys(row["name"] for row in record.find("equal_error", scene=scene)):
            found = {row["rival"]: row for row in record.find("equal_error", scene=scene, name=name)}
            path = found.get(PATH, next(iter(found.values())))
            faster = " / ".join(count(found[family][f"{kind}: faster"]) if family in found else "-" for family in RIVALS)
            row = {"scene": scene, "setting": name, "picture": duration(path["ms"] / 1e3), "error": percent(path[kind]),
                   "samples of `path`": count(path[f"{kind}: samples"]), "times faster than `path` / `direct` / 8 light samples": faster,
                   "`path` catches up at": count(path[f"{kind}: catches up"])}
            if kind == "error":
                row |= {"bake": duration(path["bake"]),
                        "times faster than `path` with it, over 1 / 10 / 100 pictures": " / ".join(
                            count(path[f"faster over {n}"]) for n in PICTURES)}
            rows.append(row)
    return markdown(rows)


def order_table(record: ParetoRecord) -> str:
    """Floors over the order: projected, localised and exact, and what a picture takes on the Cornell box."""
    rows, families = [], (PROJECTED, LOCALISED, EXACT)
    settings = [row for row in record.rows["settings"] if row["scene"] in DIRECT and row["family"] in families]
    for order in sorted({row["setting"] for row in settings}):
        row = {"order": str(order)}
        for scene in DIRECT:
            found = [record.only("settings", scene=scene, family=family, setting=order, sampler=STRATIFIED).get("floor error")
                     for family in families]
            row[f"{scene}: {', '.join(families)}"] = " ".join(percent(value) for value in found) if any(found) else ""
        bake = record.only("settings", scene=DIRECT[0], family=LOCALISED, setting=order).get("bake")
        times = [standard(record, scene=DIRECT[0], family=family, setting=order).get("seconds") for family in (LOCALISED, PROJECTED)]
        rows.append({**row, "picture": duration(next((t for t in times if t), None)), "bake": duration(bake)})
    return markdown(rows)


def axis_table(record: ParetoRecord, axis: str, title: str) -> str:
    rows, settings = [], record.find("settings", scene=axis)
    families = list(dict.fromkeys(row["family"] for row in settings))
    for value in dict.fromkeys(row["setting"] for row in settings):
        row = {title: f"{value:g}"}
        for family in families:
            found = record.only("settings", scene=axis, family=family, setting=value)
            seconds = standard(record, scene=axis, family=family, setting=value).get("seconds")
            cost = f"picture {duration(seconds)}" if axis == "transfer_domain" else f"bake {duration(found.get('bake'))}"
            row[family] = f"{percent(found['floor error'])}, {cost}" if found else ""
        rows.append(row)
    return markdown(rows)


def grid_table(record: ParetoRecord) -> str:
    rows, settings = [], record.find("settings", scene=GRID_SCENE)
    for found in settings:
        picture = standard(record, scene=GRID_SCENE, family=found["family"], setting=found["setting"])
        rows.append({"interpolation": found["family"], "points along an axis": f"{found['setting']}" if found["setting"] else "-",
                     "picture": duration(picture.get("seconds")), "samples": str(picture.get("spp")),
                     "error of the grid": percent(found["of the grid"]) if "of the grid" in found else "",
                     "error against the reference": percent(found["floor error"])})
    return markdown(rows)


def precision_table(record: ParetoRecord) -> str:
    rows = []
    for order, distance in dict.fromkeys((row["order"], row["distance"]) for row in record.rows["precision"]):
        row = {"order": str(order), "distance in sizes": f"{distance:g}"}
        for method in dict.fromkeys(row["method"] for row in record.rows["precision"]):
            found = record.find("precision", order=order, distance=distance, method=method)
            row[f"`{method}`: {' / '.join(PRECISIONS)}"] = ", ".join((" / ".join(count(one['ns']) for one in found) + " ns",
                                                                     " / ".join(f"{one['error']:.0e}" for one in found)))
        rows.append(row)
    return markdown(rows)


def first_table(record: ParetoRecord) -> str:
    return markdown([{"integrator": row["integrator"], "bake": duration(row["bake"]), "picture": duration(row["render"]),
                      "whole process": duration(row["process"])} for row in record.rows["first_pictures"]])


MARK = "<!-- pareto: {} -->"
"""Before a table in the docs."""


def update_page(text: str, report: dict) -> str:
    """`text` with the rows after each mark replaced; ValueError unless each table has one mark."""
    made = tables(ParetoRecord(report))
    marked = re.findall(MARK.format("(.*?)"), text)
    if sorted(marked) != sorted(made):
        raise ValueError(f"update_page(): 'text' must mark each table of pareto once, got {', '.join(marked)}. "
                         f"There are: {', '.join(made)}.")
    for name, table in made.items():
        place = re.escape(MARK.format(name))
        text = re.sub(f"({place}\n)(?:[|].*(?:\n|\\Z))*", lambda match, table=table: match[1] + table.rstrip("\n") + "\n", text)
    return text
