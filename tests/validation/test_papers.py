"""The map of reproductions: every figure and table of the papers has a row, whose command and pictures there are, and a verdict."""
import importlib
import shlex

import pytest

from validation import papers
from validation.experiment import RESULTS

ITEMS = {papers.W18: [*(f"Fig. {k}" for k in range(1, 11)), "Table 1", "Table 2"],
         papers.W20: [*(f"Fig. {k}" for k in range(1, 14)), "Table 1"],
         papers.G03: [f"Fig. {k}" for k in range(1, 20)]}


def test_every_figure_and_table_has_one_row():
    found = [(row.paper, row.item) for row in papers.ROWS]
    assert len(set(found)) == len(found) and set(found) == {(paper, item) for paper, items in ITEMS.items() for item in items}


@pytest.mark.parametrize("row", papers.ROWS, ids=lambda row: f"{row.paper.split()[0]}, {row.item}")
def test_commands_and_pictures_exist(row):
    if row.reproduced == "no":
        assert not row.command and not row.pictures and isinstance(row.verdict, str)
        return
    python, flag, module, *arguments = shlex.split(row.command)
    assert (python, flag) == ("python", "-m") and row.reproduced in ("yes", "in part") and row.pictures
    parts = arguments[1:] if arguments else []
    assert arguments[:1] in ([], ["--only"]) and bool(parts) == bool(arguments)
    assert set(parts) <= set(getattr(importlib.import_module(module), "PARTS", {}))
    assert all((RESULTS / picture).is_file() for picture in row.pictures)


def test_verdicts_come_from_the_results():
    for row in papers.rows():
        assert row["verdict"].endswith(".") and "nan" not in row["verdict"], row["item"]
    assert papers.markdown().count("\n") == len(papers.ROWS) + 1


def test_missing_results_are_named(tmp_path):
    rows = papers.rows(tmp_path)
    assert all((row["verdict"] == papers.NOTHING_MEASURED) == (given.reproduced != "no") for row, given in zip(rows, papers.ROWS))
    assert {row["reproduced"] for row in rows} == {"no"}
    (tmp_path / "green.json").write_text('{"product": {"entries": 7, "of": 9}}')
    assert [row["verdict"] for row in papers.rows(tmp_path) if row["item"] == "Fig. 9" and row["paper"] == papers.G03] == ["7 of 9."]


def test_a_missed_target_is_not_reproduced_in_full(tmp_path, monkeypatch):
    (tmp_path / "engine.json").write_text('{"targets": [{"target": "a line", "measured": "0.9", "met": false}]}')
    row = papers.Row(papers.W18, "Fig. 6", "a line", lambda results: f"R2 {results.measured('engine', 'a line')}.", "command")
    monkeypatch.setattr(papers, "ROWS", (row,))
    assert [(row["verdict"], row["reproduced"]) for row in papers.rows(tmp_path)] == [("R2 0.9 (missed).", "in part")]
