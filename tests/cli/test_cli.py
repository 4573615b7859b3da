"""The command line: results, metadata, and errors in one paragraph with the right exit code."""
import os
import signal
import subprocess
import sys
import time
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_shlight
from mi_shlight.cli import main, paragraph, root_cause
from mi_shlight.errors import UnsupportedSceneWarning
from mi_shlight.exr import read_exr

SHPRT = '<integrator type="shprt"><integer name="order" value="$order"/><string name="transfer" value="unshadowed"/></integrator>'
PATH = '<integrator type="path"/>'


def run(capsys, *arguments):
    """Exit code, stdout, stderr of the command in this process."""
    code = main([str(argument) for argument in arguments])
    return (code, *capsys.readouterr())


def command(*arguments, **options):
    """The command in a process of its own."""
    environment = {name: value for name, value in os.environ.items() if name != "MI_SHLIGHT_DEBUG"}
    return subprocess.run([sys.executable, "-m", "mi_shlight", *map(str, arguments)], capture_output=True, text=True,
                          env=environment, **options)


# ---- render


def test_render_equals_mitsuba_and_carries_the_settings(capsys, scene_file, tmp_path):
    scene, output = scene_file(SHPRT), tmp_path / "out.exr"
    code, out, err = run(capsys, "render", scene, "-o", output, "-D", "res=16", "--spp", 3, "--seed", 5)
    assert (code, err) == (0, "") and str(output) in out
    channels, metadata = read_exr(output)
    loaded = mi.load_file(str(scene), optimize=False, res="16")
    expected = np.array(mi.render(loaded, spp=3, seed=5))
    np.testing.assert_allclose(np.stack([channels[name] for name in "RGB"], axis=-1), expected, rtol=1e-5, atol=1e-6)
    assert expected.shape == (16, 16, 3) and expected.max() > 0
    wanted = {"order": 3, "method": "auto", "transfer": "unshadowed", "transfer_domain": "vertex", "spp": 3, "seed": 5,
              "variant": "llvm_ad_rgb", "scene": "scene.xml", "integrator": "shprt", "mi_shlight": mi_shlight.__version__,
              "mitsuba": mi.__version__, "drjit": dr.__version__}
    assert {name: metadata.get(name) for name in wanted} == wanted
    assert {file.name for file in tmp_path.iterdir()} == {"scene.xml", "out.exr"}


def test_options_override_the_scenes_own_integrator_and_keep_the_rest(capsys, scene_file, tmp_path):
    code, _, err = run(capsys, "render", scene_file(SHPRT), "-o", tmp_path / "out.exr", "--order", 2, "-D", "order=5")
    assert (code, err) == (0, "")
    metadata = read_exr(tmp_path / "out.exr")[1]
    assert (metadata["order"], metadata["transfer"], metadata["spp"]) == (2, "unshadowed", 4)


def test_define_reaches_the_integrator(capsys, scene_file, tmp_path):
    assert run(capsys, "render", scene_file(SHPRT), "-o", tmp_path / "out.exr", "-D", "order=1")[0] == 0
    assert read_exr(tmp_path / "out.exr")[1]["order"] == 1


def test_scene_with_another_integrator_gets_shprt_and_says_so(capsys, scene_file, tmp_path):
    code, out, _ = run(capsys, "render", scene_file(PATH, kind="area"), "-o", tmp_path / "out.exr", "--transfer", "unshadowed")
    assert code == 0 and "the scene names another integrator" in out
    assert read_exr(tmp_path / "out.exr")[1]["order"] == 8


def test_coefficients_are_layers(capsys, scene_file, tmp_path):
    assert run(capsys, "render", scene_file(SHPRT), "-o", tmp_path / "out.exr", "--order", 2, "--coefficients")[0] == 0
    channels, metadata = read_exr(tmp_path / "out.exr")
    assert set(channels) == {"R", "G", "B"} | {f"L.{l}.{m}" for l in range(3) for m in range(-l, l + 1)}
    assert metadata["coefficients"] == 1 and channels["L.0.0"].max() > 0


def test_quiet_prints_nothing(capsys, scene_file, tmp_path):
    assert run(capsys, "render", scene_file(SHPRT), "-o", tmp_path / "out.exr", "-q") == (0, "", "")


def test_large_images_are_averaged_over_passes(capsys, scene_file, tmp_path, monkeypatch):
    scene = scene_file(SHPRT)
    assert run(capsys, "render", scene, "-o", tmp_path / "one.exr", "--spp", 256)[0] == 0
    monkeypatch.setattr("mi_shlight.rendering.PASS_FLOATS", 24 * 24 * 5 * 100)  # 100 + 100 + 56 samples
    assert run(capsys, "render", scene, "-o", tmp_path / "many.exr", "--spp", 256)[0] == 0
    one, many = (read_exr(tmp_path / name)[0]["G"] for name in ("one.exr", "many.exr"))
    assert not np.array_equal(one, many)
    assert abs(many.mean() / one.mean() - 1) < 0.01


# ---- bake


def test_baked_file_gives_the_same_image(capsys, scene_file, tmp_path):
    scene = scene_file(SHPRT)
    code, out, err = run(capsys, "bake", scene, "-o", tmp_path / "scene.npz", "--samples", 64, "--order", 4)
    options = ("--order", 4, "--transfer", "shadowed")
    assert (code, err) == (0, "") and "scene.npz" in out
    assert run(capsys, "render", scene, "-o", tmp_path / "file.exr", "--transfer-file", tmp_path / "scene.npz", *options)[0] == 0
    assert run(capsys, "render", scene, "-o", tmp_path / "direct.exr", "--transfer-samples", 64, *options)[0] == 0
    one, two = (read_exr(tmp_path / name)[0]["G"] for name in ("file.exr", "direct.exr"))
    np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-5)
    assert {file.name for file in tmp_path.iterdir()} == {"scene.xml", "scene.npz", "file.exr", "direct.exr"}


# ---- errors


@pytest.mark.parametrize("arguments, parts", [
    (("render", "none.xml", "-o", "out.exr"), ("'SCENE'", "existing", "'none.xml'")),
    (("render", ".", "-o", "out.exr"), ("'SCENE'", "It is a folder")),
    (("render", "scene.xml"), ("-o", "required", "--help")),
    (("render", "scene.xml", "-o", "none/out.exr"), ("existing folder", "none/out.exr", "Create 'none'")),
    (("render", "scene.xml", "-o", "out.png"), ("'.exr'", "out.png", "out.exr")),
    (("render", "scene.xml", "-o", "out.exr", "-D", "bogus=3"), ("bogus=3", "declares res, spp, order")),
    (("render", "scene.xml", "-o", "out.exr", "-D", "bogus"), ("name=value", "'bogus'")),
    (("render", "scene.xml", "-o", "out.exr", "-D", "optimize=1"), ("'optimize'", "reserves", "another name")),
    (("render", "scene.xml", "-o", "out.exr", "-D", "spp=many"), ("scene.xml", "line", "many", "Correct")),
    (("render", "scene.xml", "-o", "out.exr", "-D", "order=-1"), ("scene.xml", "'order'", "integer", "-1")),
    (("render", "scene.xml", "-o", "out.exr", "--order", "-1"), ("'order'", "integer from 0", "-1")),
    (("render", "scene.xml", "-o", "out.exr", "--order", "3.5"), ("'order'", "integer from 0", "3.5")),
    (("render", "scene.xml", "-o", "out.exr", "--order", "10_000"), ("'order'", "integer from 0", "10000")),
    (("render", "scene.xml", "-o", "out.exr", "--order", "high"), ("--order", "must be a number", "'high'")),
    (("render", "scene.xml", "-o", "out.exr", "--method", "magic"), ("'method'", "'auto'", "'magic'")),
    (("render", "scene.xml", "-o", "out.exr", "--transfer", "magic"), ("'transfer'", "'shadowed'", "'magic'")),
    (("render", "scene.xml", "-o", "out.exr", "--transfer-domain", "face"), ("'transfer_domain'", "'vertex'", "'face'")),
    (("render", "scene.xml", "-o", "out.exr", "--transfer-samples", "-2"), ("'transfer_samples'", "-2")),
    (("render", "scene.xml", "-o", "out.exr", "--transfer-file", "none.npz"), ("none.npz",)),
    (("render", "scene.xml", "-o", "out.exr", "--spp", "-4"), ("'spp'", "integer from 0", "-4")),
    (("render", "scene.xml", "-o", "out.exr", "--spp", "1.5"), ("'spp'", "1.5")),
    (("render", "scene.xml", "-o", "out.exr", "--seed", "-1"), ("'seed'", "-1")),
    (("render", "scene.xml", "-o", "out.exr", "--sensor", "2"), ("'sensor'", "from 0 to 0", "2")),
    (("render", "scene.xml", "-o", "out.exr", "--variant", "metal"), ("'--variant'", "'metal'", "llvm_ad_rgb")),
    (("render", "scene.xml", "-o", "out.exr", "--variant", "scalar_rgb"), ("'--variant'", "JIT", "'scalar_rgb'")),
    (("render", "scene.xml", "-o", "out.exr", "--colour"), ("--colour", "--help")),
    (("bake", "scene.xml", "-o", "none/a.npz"), ("existing folder", "none/a.npz")),
    (("bake", "scene.xml", "-o", "a.npz", "--samples", "0.5"), ("samples'", "0.5")),
    (("bake", "scene.xml", "-o", "a.npz", "--transfer", "unshadowed"), ("--transfer", "'unshadowed'", "Choose 'shadowed'")),
    (("compare", "scene.xml", "-o", "scene.xml"), ("name a folder", "'scene.xml'")),
    (("compare", "scene.xml", "-o", "new", "--spp", "0"), ("'spp'", "from 1", "0")),
    (("compare", "scene.xml", "-o", "new", "--reference-spp", "1"), ("'reference_spp'", "from 2", "1")),
    (("compare", "scene.xml", "-o", "none/new"), ("existing folder", "none/new")),
    (("paint",), ("'paint'", "render", "bake", "compare", "info")),
    ((), ("COMMAND",)),
], ids=lambda value: " ".join(value) if isinstance(value, tuple) and value and value[0] in ("render", "bake", "compare") else None)
def test_bad_input_is_one_paragraph_with_value_rule_and_fix(capsys, scene_file, tmp_path, monkeypatch, arguments, parts):
    scene_file(SHPRT)
    monkeypatch.chdir(tmp_path)
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert err.startswith("mi-shlight: error: ") and err.count("\n") == 1 and "Traceback" not in err and ".cpp:" not in err
    for part in parts:
        assert part in err
    assert [file.name for file in tmp_path.iterdir()] == ["scene.xml"]


@pytest.mark.parametrize("integrator, lights, parts", [
    (SHPRT, "", ("light",)),
    (SHPRT.replace("transfer", "transfre"), None, ("transfre", "scene.xml", "line")),
    (SHPRT.replace('<integer name="order" value="$order"/>', '<string name="order" value="high"/>'), None, ("order", "'high'", "line")),
    (SHPRT, '<emitter type="shlight"><rgb name="radiance" value="1"/></emitter>', ("shlight", "shape")),
    (SHPRT, '<shape type="rectangle"><emitter type="shlight">', ("scene.xml", "line")),
    (SHPRT, '<shape type="rectangle"><emitter type="shlamp"/></shape>', ("shlamp", "not found", "line")),
    (SHPRT, '<shape type="ply"><string name="filename" value="none.ply"/></shape>', ("none.ply", "line")),
], ids=["no-lights", "unknown-parameter", "wrong-type", "emitter-outside-shape", "broken-xml", "unknown-plugin", "missing-mesh"])
def test_bad_scenes_are_one_paragraph(capsys, scene_file, tmp_path, integrator, lights, parts):
    scene = scene_file(integrator) if lights is None else scene_file(integrator, lights)
    code, _, err = run(capsys, "render", scene, "-o", tmp_path / "out.exr")
    assert code == 2
    assert err.startswith("mi-shlight: error: ") and err.count("\n") == 1 and "Traceback" not in err
    for part in parts:
        assert part in err
    assert not (tmp_path / "out.exr").exists()


def test_failing_render_keeps_an_older_output(capsys, scene_file, tmp_path):
    (tmp_path / "out.exr").write_text("older")
    assert run(capsys, "render", scene_file(SHPRT), "-o", tmp_path / "out.exr", "--order", -1)[0] == 2
    assert (tmp_path / "out.exr").read_text() == "older"


def test_a_bug_is_told_apart_from_bad_input(capsys, scene_file, tmp_path, monkeypatch):
    def broken(*arguments, **options):
        raise KeyError("inner")
    monkeypatch.setattr("mi_shlight.rendering.render", broken)
    code, _, err = run(capsys, "render", scene_file(SHPRT), "-o", tmp_path / "out.exr")
    assert code == 1 and "internal error: KeyError: 'inner'" in err and "report" in err
    with pytest.raises(KeyError):
        main(["render", str(scene_file(SHPRT)), "-o", str(tmp_path / "out.exr"), "--traceback"])


def test_warnings_are_one_line_and_come_once(capsys, scene_file, tmp_path, monkeypatch):
    import mi_shlight.rendering as rendering
    plain = rendering.render

    def warning(*arguments, **options):
        for _ in range(2):
            warnings.warn(UnsupportedSceneWarning("sphere 'lamp'\n  is left out"))
        return plain(*arguments, **options)
    monkeypatch.setattr(rendering, "render", warning)
    code, _, err = run(capsys, "render", scene_file(SHPRT), "-o", tmp_path / "out.exr")
    assert (code, err) == (0, "mi-shlight: warning: sphere 'lamp' is left out\n")


def test_paragraph_unwraps_what_mitsuba_adds():
    text = ('[parser.cpp:1718] At s.xml (line 2, col 2): failed to instantiate integrator plugin of type "shprt": '
            "Traceback (most recent call last):\n  File \"a.py\", line 7, in <module>\n    raise\nValueError: shprt(): 'order' "
            "must be\n an integer")
    assert paragraph(text) == ("At s.xml (line 2, col 2): failed to instantiate integrator plugin of type \"shprt\": shprt(): "
                               "'order' must be an integer")
    assert paragraph('[x.cpp:1] At dictionary node "root": failed to instantiate unknown plugin of type "shprt": shprt(): no') == (
        "shprt(): no")
    assert paragraph(MemoryError()) == "MemoryError"


def test_root_cause_opens_wrappers_but_not_explanations():
    inner, wrapper, explanation = OSError("raw"), RuntimeError("drjit.custom(<X>): error (see above)."), ImportError("install it")
    explanation.__cause__ = inner
    wrapper.__cause__ = explanation
    assert root_cause(wrapper) is explanation


# ---- processes


def test_module_runs_and_fails_without_traceback(scene_file, tmp_path):
    done = command("render", scene_file(SHPRT), "-o", tmp_path / "out.exr", "--order", 10000)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("mi-shlight: error: ") and done.stderr.count("\n") == 1
    done = command("render", scene_file(SHPRT), "-o", tmp_path / "out.exr", "--order", 10000, "--traceback")
    assert done.returncode == 1 and "Traceback (most recent call last)" in done.stderr


def test_info_names_versions_and_llvm():
    done = command("info")
    assert (done.returncode, done.stderr) == (0, "")
    lines = dict(line.split(maxsplit=1) for line in done.stdout.splitlines())
    assert lines["mi_shlight"] == mi_shlight.__version__ and lines["mitsuba"] == mi.__version__
    assert lines["drjit"] == dr.__version__ and "llvm_ad_rgb" in lines["variants"]
    assert int(lines["LLVM"].split(".")[0]) >= 19


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_interrupt_leaves_no_file(scene_file, tmp_path):
    arguments = ["render", scene_file(SHPRT), "-o", tmp_path / "out.exr", "--spp", 2**24, "-D", "res=64"]
    # A shell's background job ignores interrupts, and its children would too.
    process = subprocess.Popen([sys.executable, "-m", "mi_shlight", *map(str, arguments)], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    assert process.stdout.readline().startswith("shprt")  # rendering begins, and would take hours
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130 and "interrupted" in err and "Traceback" not in err
    assert [file.name for file in tmp_path.iterdir()] == ["scene.xml"]
