"""`mi-shlight plan`: what it prints, and scene files that `render` takes as planned with everything else as it was."""
import json
from pathlib import Path

import mitsuba as mi
import pytest

from mi_shlight import apply_settings
from mi_shlight.cli import main
from mi_shlight.exr import read_exr
from mi_shlight.planner import candidates, probe

PATH = '<!-- the old one --><integrator type="path">\n        <integer name="max_depth" value="2"/> <!-- gone -->\n    </integrator>'


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(probe, "POINTS", 64)
    monkeypatch.setattr(probe, "TRUTH_SAMPLES", 256)
    monkeypatch.setattr(candidates, "RAYS", (16, 64, 256))
    monkeypatch.setattr(candidates, "EDGES", (2, 1, 1 / 2))


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    return (code, *capsys.readouterr())


def test_plan_is_applied_and_rendered(capsys, scene_file, tmp_path):
    scene = scene_file(PATH)
    before = scene.read_text()
    code, out, err = run(capsys, "plan", scene, "--max-error", "4%", "--apply", "-D", "res=20")
    planned = tmp_path / "scene_planned.xml"
    assert (code, err) == (0, "") and str(planned) in out and scene.read_text() == before
    assert "error" in out and "s to bake" in out and "is blocked" in out
    others = [line.split(" s ")[1] for line in out.partition("what else there is\n")[2].splitlines() if "%" in line.split(" in ")[0]]
    assert len(others) > 1 and len(set(others)) == len(others)
    after = planned.read_text()
    head, tail = before.split(PATH.removeprefix("<!-- the old one -->"))
    assert after.startswith(head) and after.endswith(tail) and "<!-- the old one -->" in after and "gone" not in after
    settings = mi.load_file(str(planned), optimize=False).integrator().parameters()
    code, out, err = run(capsys, "render", planned, "-o", tmp_path / "out.exr", "-D", "res=12", "--spp", 2)
    metadata = read_exr(tmp_path / "out.exr")[1]
    assert (code, err) == (0, "") and metadata["order"] == settings["order"] and metadata["transfer"] == settings["transfer"]


def test_json_has_the_whole_plan_and_a_limit_is_kept(capsys, scene_file):
    code, out, err = run(capsys, "plan", scene_file(), "--max-error", 0.03, "--time-limit", 100, "--json", "--spp", 4, "-D", "res=16")
    found = json.loads(out)
    assert (code, err) == (0, "") and found["met"] and found["max_error"] == 0.03 and found["seconds"] <= 100
    assert found["error"] + found["spread"] <= 0.03 and found["settings"]["light_margin"] == 0 and len(found["choices"]) > 2


@pytest.mark.parametrize("arguments, text", [
    (["--max-error", "0"], "'max_error' must be a finite number >= 1e-06"),
    (["--max-error", "x%"], "must be a number"), ([], "--max-error"),
    (["--max-error", "0.1", "--apply", "out.txt"], "'--apply' must end in '.xml'"),
])
def test_bad_input_is_one_paragraph_and_writes_nothing(capsys, scene_file, tmp_path, arguments, text):
    scene = scene_file()
    code, out, err = run(capsys, "plan", scene, *arguments)
    assert code == 2 and text in err and err.startswith("mi-shlight: error: ") and err.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["scene.xml"]


SCENE = """<?xml version="1.0"?>
<!-- <integrator type="commented"/> -->
<scene version="3.0.0">
    <default name="mesh" value="meshes/a.ply"/>
    {integrator}
    <shape type="ply"><string name="filename" value='meshes/b &amp; c.ply'/> <!-- é > --></shape>
    <shape type="ply"><string name="filename" value="$mesh"/></shape>
    <shape type="ply"><string name="filename" value="meshes/none.ply"/></shape>
</scene>
"""
SETTINGS = {"order": 4, "transfer": "shadowed", "max_edge": 0.125, "localised": True, "window": None}


def written(tmp_path, integrator, output="out.xml"):
    source = tmp_path / "in.xml"
    source.write_text(SCENE.format(integrator=integrator), encoding="utf-8")
    (tmp_path / "meshes").mkdir(exist_ok=True)
    for name in ("a.ply", "b & c.ply"):
        (tmp_path / "meshes" / name).touch()
    return apply_settings(source, SETTINGS, tmp_path / output).read_text(encoding="utf-8")


@pytest.mark.parametrize("integrator", [
    '<integrator type="direct"/>', "<integrator type='path'>\n<integer name='max_depth' value='3'/></integrator>",
    '<integrator\n    type="stokes"\n><integrator type="path"/></integrator >'])
def test_only_the_integrator_changes(tmp_path, integrator):
    head, tail = SCENE.split("{integrator}")
    text = written(tmp_path, integrator)
    assert text.startswith(head) and text.endswith(tail)
    middle = text[len(head):len(text) - len(tail)]
    assert middle.split() == ('<integrator type="shprt"> <integer name="order" value="4"/> <string name="transfer" value="shadowed"/> '
                              '<float name="max_edge" value="0.125"/> <boolean name="localised" value="true"/> </integrator>').split()


def test_an_integrator_is_put_in_where_there_is_none_and_aovs_keep_theirs(tmp_path):
    text = written(tmp_path, "")
    assert text.index("<scene") < text.index('<integrator type="shprt">') < text.index("<default")
    text = written(tmp_path, '<integrator type="aov"><string name="aovs" value="d:depth"/><integrator type="path"/></integrator>')
    assert text.index('"aov"') < text.index("d:depth") < text.index('<integrator type="shprt">') and '"path"' not in text


def test_files_are_found_from_another_folder(tmp_path):
    (tmp_path / "sub").mkdir()
    text = written(tmp_path, "", "sub/out.xml")
    assert 'value="../meshes/a.ply"' in text and 'value="../meshes/b &amp; c.ply"' in text and 'value="meshes/none.ply"' in text


def test_a_file_may_be_replaced_by_itself_and_stays_whole_after_an_error(tmp_path):
    assert 'type="shprt"' in written(tmp_path, '<integrator type="path"/>', "in.xml")
    (tmp_path / "in.xml").write_text("<scene><shape></scene>")
    with pytest.raises(ValueError, match="well-formed XML"):
        apply_settings(tmp_path / "in.xml", SETTINGS, tmp_path / "in.xml")
    assert (tmp_path / "in.xml").read_text() == "<scene><shape></scene>"
    (tmp_path / "in.xml").write_text("<shape/>")
    with pytest.raises(ValueError, match="<scene> at its top"):
        apply_settings(tmp_path / "in.xml", SETTINGS, tmp_path / "x.xml")
    assert not (tmp_path / "x.xml").exists()


def test_an_integrator_in_an_included_file_is_refused(tmp_path):
    Path(tmp_path / "part.xml").write_text('<scene version="3.0.0"><integrator type="path"/></scene>')
    (tmp_path / "in.xml").write_text('<scene version="3.0.0"><include filename="part.xml"/></scene>')
    with pytest.raises(ValueError, match="'part.xml', which the file includes"):
        apply_settings(tmp_path / "in.xml", SETTINGS, tmp_path / "out.xml")
