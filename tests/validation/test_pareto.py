"""Error against time: laws, errors without noise, tables; and what docs/how_to_choose.md names exists. No timing decides a test."""
import json
import math
import re
import shlex
from dataclasses import fields
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
pytest.importorskip("matplotlib")

import mi_shlight
from mi_shlight import cli
from mi_shlight.shading import errors
from mi_shlight.shading.settings import Settings
from validation import pareto
from validation.pareto_figures import front
from validation.pareto_report import (DIRECT, INDEPENDENT, LOCALISED, PATH, STANDARD_ORDER, STANDARD_SPP, STRATIFIED, ParetoRecord, Rival,
                                      compare_rivals, count, duration, percent, tables, targets, update_page)

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "how_to_choose.md").read_text()
NOISE = {"error": 1e-3, "blocks": 1e-4}


def rival_rows(error=0.32, seconds=0.001, power=-0.5):
    """Pictures of a rival of which all is known."""
    return [{"spp": spp, "error": error * spp ** power, "blocks": 0.25 * error * spp ** power, "seconds": 0.01 + seconds * spp}
            for spp in (1, 4, 16, 64, 256, 1024)]


def test_rival():
    rival = Rival(rival_rows(), NOISE)
    assert rival.law("error") == pytest.approx((0.32, -0.5))
    assert rival.samples(0.032) == pytest.approx(100) and rival.samples(0.032, "blocks") == pytest.approx(6.25)
    assert rival.samples(0.9) == 1 and rival.samples(0.0) == math.inf
    assert rival.seconds(16) == pytest.approx(0.026) and rival.seconds(40) == pytest.approx(0.05)
    assert rival.seconds(4096) == pytest.approx(4 * (0.01 + 1.024))


def test_errors_that_the_reference_cannot_tell_are_no_part_of_the_law():
    rows = rival_rows()
    rows[-1]["error"] = rows[-2]["error"] = 0.9e-3
    assert Rival(rows, NOISE).law("error") == pytest.approx((0.32, -0.5))
    assert math.isnan(Rival(rival_rows(power=0.1), NOISE).samples(0.01))            # does not converge


def filled_record():
    """A default that takes 20 ms and 1 s for its bake, with the error that `path` has at 100 samples and a floor as at 400."""
    record = ParetoRecord()
    for scene in DIRECT:
        record.rows["references"].append({"scene": scene, **NOISE})
        for sampler in (STRATIFIED, INDEPENDENT):
            where = {"scene": scene, "sampler": sampler}
            record.rows["pictures"] += [{**where, "family": PATH, "setting": None, **row} for row in rival_rows()]
            where |= {"family": LOCALISED, "setting": STANDARD_ORDER}
            record.rows["settings"].append({**where, "bake": 1.0, "floor error": 0.016, "floor blocks": 0.0})
            record.rows["pictures"] += [{**where, "spp": spp, "error": 0.032, "blocks": 0.02, "seconds": 0.00125 * spp}
                                        for spp in (4, STANDARD_SPP, 64)]
    compare_rivals(record)
    return record


def test_equal_error():
    record = filled_record()
    row = record.only("equal_error", scene="plant", name="default (localised, order 8)", rival=PATH)
    assert (row["error: samples"], row["error: catches up"]) == pytest.approx((100, 400))
    assert row["error: faster"] == pytest.approx(0.11 / 0.02) and row["blocks: samples"] == pytest.approx(16)
    assert row["blocks: catches up"] == math.inf
    assert row["faster over 10"] == pytest.approx(10 * 0.11 / (1 + 10 * 0.02))
    met = {line["target"]: line["met"] for line in targets(record)}
    assert all(met[f"{scene}: default (localised, order 8): {what} sooner than path at equal error"]
               for scene in DIRECT for what in ("a picture", "100 pictures and their bake"))
    assert met["cornell_box, all bounces: interreflected, order 8: a picture sooner than path at equal error"] is None


def test_tables_of_a_file_are_those_of_the_run():
    """JSON turns infinities into null and keys into text."""
    record = filled_record()
    made = tables(record)
    assert ("| plant | default (localised, order 8) | 20 ms | 3.20% | 100 | 5.5 / - / - | 400 | 1 s | 0.11 / 0.92 / 3.7 |"
            in made["equal error"].splitlines())
    assert ("| plant | default (localised, order 8) | 20 ms | 2.00% | 16 | 1.3 / - / - | - |"
            in made["equal error of 8 x 8 pixels"].splitlines())
    assert "| 8 |" in made["orders"] and made["grid"] == "| nothing measured |"
    from validation.experiment import plain
    assert tables(ParetoRecord(json.loads(json.dumps(plain(record.rows))))) == made


def test_whole_run(tmp_path, monkeypatch, capsys):
    """All that is measured is tried; a part that fails is on record, takes no other with it, and makes the exit status 1."""
    called = []

    def fill(record, plan):
        called.append("direct")
        record.rows.update(filled_record().rows, equal_error=[])

    def broken(record, plan):
        called.append("grid")
        raise RuntimeError("no such lights")

    monkeypatch.setattr(pareto, "measure_direct", fill)
    for name in ("unshadowed", "bounces", "grid", "precision"):
        monkeypatch.setattr(pareto, f"measure_{name}", broken if name == "grid" else lambda record, plan, name=name: called.append(name))
    monkeypatch.setattr(broken, "__name__", "measure_grid")
    assert pareto.main(["--quick", "--out", str(tmp_path)]) == 1
    assert called == ["direct", "unshadowed", "bounces", "grid", "precision"]
    report = json.loads((tmp_path / "pareto.json").read_text())
    assert report["quick"] is True and report["failures"] == ["measure_grid: RuntimeError: no such lights"]
    assert tables(ParetoRecord(report)) == tables(filled_record())
    assert all((tmp_path / name).stat().st_size > 1e4 for name in ("pareto.png", "pareto_axes.png"))
    printed = capsys.readouterr().out
    assert "met    plant: default (localised, order 8): a picture sooner than path at equal error: 5.5" in printed
    assert "FAILED measure_grid: RuntimeError: no such lights" in printed


def test_numbers():
    assert [percent(v) for v in (0.00123, 0.5, None)] == ["0.12%", "50%", "-"]
    assert [count(v) for v in (1.234, 123, 12345, None, math.inf)] == ["1.2", "120", "12,000", "-", "-"]
    assert [duration(v) for v in (0.0123, 1.234, None)] == ["12 ms", "1.2 s", "-"]


def test_front():
    assert front([(3, 1), (1, 3), (2, 2), (2.5, 2.5), (2, 4)]) == [(1, 3), (2, 2), (3, 1)]


def test_update_page():
    report = filled_record().rows
    made = tables(ParetoRecord(report))
    page = "# Title\n\n" + "\n".join(f"<!-- pareto: {name} -->\n" for name in made) + "\nText.\n"
    filled = update_page(page, report)
    assert filled == "# Title\n\n" + "\n".join(f"<!-- pareto: {name} -->\n{table}\n" for name, table in made.items()) + "\nText.\n"
    assert update_page(filled.replace("| ", "| old "), report) == filled
    for wrong in (page + "<!-- pareto: prices -->\n", page.replace("<!-- pareto: orders -->", "")):
        with pytest.raises(ValueError, match="must mark each table of pareto once"):
            update_page(wrong, report)


def test_sensors_differ_in_nothing_but_the_sampler():
    file = ROOT / "scenes" / "floor.xml"
    scene = mi.load_file(str(file), resx=8, resy=8, optimize=False)
    plugin = mi.load_dict({"type": "direct"})
    own, same, other = (np.array(mi.render(scene, integrator=plugin, sensor=sensor, spp=4)) for sensor in (
        0, pareto.sensor_of(file, 8, INDEPENDENT), pareto.sensor_of(file, 8, STRATIFIED)))
    np.testing.assert_array_equal(own, same)
    assert abs(own - other).max() > 1e-3


def test_errors_of_a_subject():
    """A picture that is 10 % too bright, and one that is noise, of which means over blocks have an eighth."""
    subject = pareto.Subject("floor", 32, 64, 32)
    assert 0 < subject.noise["blocks"] < subject.noise["error"] < 0.02
    assert subject.errors(1.1 * subject.truth) == pytest.approx({"error": 0.1, "blocks": 0.1}, rel=0.02)
    noisy = subject.truth * (1 + 0.2 * np.random.default_rng(0).normal(size=subject.truth.shape[:2])[..., None])
    found = subject.errors(noisy)
    assert found["error"] == pytest.approx(0.2 * math.sqrt(2 / math.pi), rel=0.1) and 0.08 < found["blocks"] / found["error"] < 0.18
    assert subject.errors(noisy, subject.difference(noisy, subject.truth)) == {"error": 0, "blocks": 0}
    plugin = mi.load_dict({"type": "shprt", "transfer": "unshadowed", "order": 2})
    floor = subject.floor(plugin, 16)
    assert 0.02 < floor["floor error"] < 0.06                           # the band limit of projected transfer, order 2
    contender = pareto.shprt(pareto.QUICK, pareto.UNSHADOWED, 2, (16,), order=2)
    record = ParetoRecord()
    pareto.measure(record, "floor", subject, [contender], pareto.QUICK)
    setting, picture = record.only("settings", scene="floor", setting=2), record.only("pictures", scene="floor", setting=2)
    assert not record.failures and setting["floor error"] == pytest.approx(floor["floor error"], rel=0.1)
    assert picture["error"] == pytest.approx(setting["floor error"], rel=0.2) and picture["seconds"] > 0


def test_precision():
    """float64 is better by the ratio of the rounding units, by any method."""
    record = ParetoRecord()
    plan = pareto.QUICK._replace(precision_orders=(1,), points=64)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        pareto.measure_precision(record, plan)
    assert len(record.rows["precision"]) == 8
    for row in record.rows["precision"]:
        assert row["ns"] > 0 and row["error"] < (2e-6 if row["precision"] == "float32" else 1e-12)


# The page.

def test_examples_of_the_page_work(monkeypatch):
    plugins = [mi.load_string(f'<scene version="3.0.0">{xml}</scene>', optimize=False).integrator()
               for xml in re.findall(r"```xml\n(.*?)```", PAGE, re.DOTALL)]
    assert len(plugins) >= 5
    monkeypatch.chdir(ROOT)
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(block.replace("\"transfer_samples\": 256", "\"transfer_samples\": 4"), {})


def test_commands_of_the_page_exist():
    commands = re.findall(r"^\$ mi-shlight (.*)$", PAGE, re.MULTILINE)
    assert commands
    for command in commands:
        assert cli._parser().parse_args(shlex.split(command)).scene.startswith("scenes/")
    for verb in set(re.findall(r"`mi-shlight (\w+)", PAGE)):
        with pytest.raises(SystemExit) as stopped:
            cli._parser().parse_args([verb, "--help"])
        assert stopped.value.code == 0, verb
    modules = set(re.findall(r"python -m validation\.(\w+)", PAGE))
    assert len(modules) >= 5
    for module in modules:
        assert (ROOT / "validation" / f"{module}.py").exists(), module


def test_names_on_the_page_exist():
    """Parameters of shprt, with values if any; functions of the package; files and links."""
    known, plugin = {field.name for field in fields(Settings)}, mi.load_dict({"type": "shprt"})
    mitsuba = {"max_depth", "emitter_samples", "bsdf_samples", "direct_projective"}
    for name in set(re.findall(r"`([a-z]+(?:_[a-z]+)+)(?:=[^`]*)?`", PAGE)):
        found = name in known | set(errors.NAMES) | mitsuba or hasattr(mi_shlight, name) or hasattr(plugin, name)
        assert found or (ROOT / "scenes" / f"{name}.xml").exists(), name
    for link in re.findall(r"\]\(([^)#]+)\)", PAGE):
        assert link.startswith("https://") or (ROOT / "docs" / link).exists(), link
    headings = {re.sub(r"[^\w\- ]", "", line.lstrip("# ").lower()).replace(" ", "-") for line in re.findall("^#.*", PAGE, re.MULTILINE)}
    assert headings >= set(re.findall(r"\]\(#([^)]+)\)", PAGE))


def test_tables_of_the_page_are_the_recorded_ones():
    """`python -m validation.pareto --page` puts them there."""
    report = json.loads((ROOT / "validation" / "results" / "pareto.json").read_text())
    assert not report["quick"] and update_page(PAGE, report) == PAGE
