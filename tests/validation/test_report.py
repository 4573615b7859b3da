"""``python -m validation`` and its report: complete, whole in one file, and shown by a browser with every picture."""
import ast
import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

from validation import __main__ as runner
from validation import experiment, experiments, report
from validation.experiments import EXPERIMENTS, Experiment

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PROBE = """<script>addEventListener("load", () => {
  const images = [...document.images].map(image => ({width: image.naturalWidth, shown: image.getBoundingClientRect().width}));
  document.body.innerHTML = "<pre id=seen></pre>";
  document.getElementById("seen").textContent = JSON.stringify(images);
})</script>"""
"""Runs in the browser, not in the report: puts the sizes of all pictures, as decoded and on the page, in the place of the page."""


class Page(HTMLParser):
    """What a report consists of."""

    def __init__(self, text: str):
        super().__init__()
        self.images, self.links, self.ids, self.tags, self.text = [], [], [], set(), ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.tags.add(tag)
        self.ids += [attributes["id"]] if "id" in attributes else []
        self.images += [attributes] if tag == "img" else []
        self.links += [attributes[key] for key in ("href", "src") if key in attributes]

    def handle_data(self, data):
        self.text += data


def modules_with_main() -> set:
    """Names of the modules of the package that define ``main``."""
    folder = Path(experiments.__file__).parent
    return {file.stem for file in folder.glob("*.py") if file.stem != "__main__"
            and any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in ast.parse(file.read_text()).body)}


def in_browser(page: Path, folder: Path) -> list:
    """What `PROBE` finds when a browser without a window opens `page`, whose text it is added to."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed, and `.ci/setup browser` could not")
    probed = folder / "probed.html"
    probed.write_text(page.read_text(encoding="utf-8").replace("</body>", f"{PROBE}</body>"), encoding="utf-8")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", f"--user-data-dir={folder / 'profile'}",
               "--virtual-time-budget=20000", "--dump-dom", probed.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180)
    found = re.search("<pre id=\"seen\">(.*?)</pre>", done.stdout)
    assert found, done.stderr[-2000:]
    return json.loads(html.unescape(found[1]))


def test_registry_holds_every_experiment():
    assert set(EXPERIMENTS) == modules_with_main() - {"papers"}
    for name, entry in EXPERIMENTS.items():
        assert entry.doc.startswith("Claim: ") and len(entry.claim) > 20, name
        assert f"python -m validation.{name}" in entry.doc, name
        assert all(re.fullmatch(rf"({name}[\w.]*|panels/[\w.]+)\.png", picture) and caption for picture, caption in entry.pictures.items())


@pytest.fixture
def two(monkeypatch):
    """A registry of two experiments: one that runs in a second or two, and one that fails."""
    working = EXPERIMENTS["lobe_directions"]
    broken = Experiment("missing", "Broken <by intent>", {"missing.png": "nothing"}, 1)
    found = {"lobe_directions": working, "missing": broken}
    claims = {"missing": "Claim: nothing & more.", "lobe_directions": working.doc}
    monkeypatch.setattr(experiments, "_docstring", claims.get)
    for module in (runner, report):
        monkeypatch.setattr(module, "EXPERIMENTS", found)
    monkeypatch.setattr(report, "GROUPS", {"Both": tuple(found.values())})
    return found


def test_runs_are_recorded_and_failures_shown(two, tmp_path, capsys):
    out = ["--quick", "--out", str(tmp_path)]
    assert runner.main(["lobe_directions", *out]) == 0
    first = json.loads((tmp_path / report.RUNS).read_text())
    assert set(first) == {"lobe_directions"} and first["lobe_directions"]["status"] == 0 and first["lobe_directions"]["seconds"] > 0
    assert {"date", "machine", "cores", "memory_gib", "python", "mitsuba", "drjit", "llvm", "numpy", "mi_shlight", "commit",
            "quick"} <= set(first["lobe_directions"])
    assert "It has not been run" in Page((tmp_path / report.REPORT).read_text()).text

    assert runner.main(["missing", *out]) == 1
    runs = json.loads((tmp_path / report.RUNS).read_text())
    assert runs["lobe_directions"] == first["lobe_directions"] and runs["missing"]["status"] == 1
    assert "No module named validation.missing" in capsys.readouterr().out
    page = Page((tmp_path / report.REPORT).read_text())
    assert "failed with exit status 1" in page.text and "No module named validation.missing" in page.text
    assert "1 experiments without a sound result" in page.text and "Broken <by intent>" in page.text and "Quick runs" in page.text
    assert [image["alt"] for image in page.images] == list(two["lobe_directions"].pictures.values())

    (tmp_path / report.REPORT).unlink()
    assert runner.main(["--report-only", *out]) == 0 and (tmp_path / report.REPORT).exists()
    assert json.loads((tmp_path / report.RUNS).read_text()) == runs

    picture, = in_browser(tmp_path / report.REPORT, tmp_path)
    assert picture["width"] > 300 and picture["shown"] > 300


def test_an_experiment_that_hangs_is_stopped(two, tmp_path, monkeypatch):
    monkeypatch.setitem(runner.TIME_LIMIT, True, 0)
    assert runner.main(["lobe_directions", "--quick", "--out", str(tmp_path)]) == 1
    run = json.loads((tmp_path / report.RUNS).read_text())["lobe_directions"]
    assert run["status"] < 0 and run["output"][-1] == "stopped after 0 s"


def test_pictures_shrink_until_the_report_fits(two, tmp_path, monkeypatch):
    (tmp_path / "lobe_directions.json").write_text(json.dumps({"targets": [experiment.verdict("a < b", 2, 1)]}))
    Image.effect_noise((1200, 400), 80).save(tmp_path / "lobe_directions.png")
    text = len(report.Report(tmp_path).html())
    sizes = []
    for limit in (10 ** 7, text + 60_000):
        monkeypatch.setattr(report, "LIMIT", limit)
        sizes.append(report.write(tmp_path).stat().st_size)
        assert sizes[-1] <= limit
    assert sizes[0] > 2 * sizes[1] and "a < b" in Page((tmp_path / report.REPORT).read_text()).text
    monkeypatch.setattr(report, "LIMIT", text)
    with pytest.raises(ValueError, match="does not fit into"):
        report.write(tmp_path)


def test_tables_hold_every_row_and_column():
    data = {"versions": {"date": "x"}, "targets": [{}], "rows": [{"a": k, "b": {"c": k / 3}, "d": [1, 2]} for k in range(20)],
            "by name": {"one": {"x": True}, "two": {"x": None}}, "number": 3.0, "nested": {"deep": [{"e": "<i>"}]}}
    text = "".join(report.tables_of(data, "file.json"))
    assert "rows (12 of 20 rows; all in file.json)" in text and "<th>b, c</th>" in text and "<td class='n'>0.333</td>" in text
    assert "<td>1, 2</td>" in text and "<td>one</td><td>yes</td>" in text and "<td class='n'>3</td>" in text and "&lt;i&gt;" in text
    assert "date" not in text


def test_numbers_are_recorded_compactly(tmp_path):
    experiment.write(tmp_path / "x.json", {"rows": [{"a": 1 / 3, "b": float("nan")}] * 2, "many": list(range(100))}, quick=True)
    text = (tmp_path / "x.json").read_text()
    found = json.loads(text)
    assert found["rows"][0] == {"a": 0.333333, "b": None} and found["many"] == list(range(100)) and found["quick"] is True
    assert found["versions"]["drjit"] and len(text.splitlines()) < 25


def test_command_line(capsys):
    assert runner.main(["--list"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed] == list(EXPERIMENTS)
    with pytest.raises(SystemExit, match="2"):
        runner.main(["nonsense"])
    assert "there is no experiment 'nonsense'" in capsys.readouterr().err


# The report of this checkout.

RECORDED = experiment.RESULTS / report.REPORT


@pytest.fixture(scope="module")
def page():
    return Page(RECORDED.read_text(encoding="utf-8"))


def test_recorded_report_is_complete(page):
    pictures = {name for entry in EXPERIMENTS.values() for name in entry.pictures}
    assert RECORDED.stat().st_size < 10 ** 6
    assert len(page.images) == len(pictures) and all(len(image["alt"]) > 10 for image in page.images)
    assert set(EXPERIMENTS) <= set(page.ids) and "papers" in page.ids and len(set(page.ids)) == len(page.ids)
    assert all(link.startswith("data:image/") or link[0] == "#" and link[1:] in page.ids for link in page.links)
    assert not {"script", "link", "iframe", "object"} & page.tags
    assert "No experiment failed." in page.text and "Not made:" not in page.text and "Quick runs" not in page.text


def test_recorded_report_is_of_the_recorded_results(page):
    for name in EXPERIMENTS:
        data = json.loads((experiment.RESULTS / f"{name}.json").read_text())
        assert not data["quick"] and not data.get("failures"), name
        for line in data["targets"]:
            assert line["target"] in page.text and str(line["measured"]) in page.text, name


def test_recorded_pictures_are_in_the_report():
    listed = {name for entry in EXPERIMENTS.values() for name in entry.pictures}
    assert {str(file.relative_to(experiment.RESULTS)) for file in experiment.RESULTS.rglob("*.png")} == listed


def test_a_browser_shows_the_recorded_report(page, tmp_path):
    found = in_browser(RECORDED, tmp_path)
    assert len(found) == len(page.images)
    assert all(image["width"] > 200 and image["shown"] > 200 for image in found)


def test_results_of_a_former_form_are_not_shown(tmp_path):
    (tmp_path / "furnace.json").write_text('{"targets": [{"what": "mean", "target": 0.01, "value": 0.2}]}')
    report_of = report.Report(tmp_path)
    assert report_of.failure("furnace") == "It has not been run." and "furnace" in report_of.html()
