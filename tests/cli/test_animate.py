"""Animations: what a motion file says, worked out by hand; frames against renders of scenes moved by hand; refusals."""
import json
import os
import sys
import warnings

import mitsuba as mi
import numpy as np
import pytest

from mi_shlight.animation import Stage, animate, write_frame
from mi_shlight.cli import main
from mi_shlight.errors import StaleTransferWarning
from mi_shlight.exr import read_exr
from mi_shlight.motion import load_motion
from mi_shlight.panel import srgb
from mi_shlight.rendering import sh_integrator
from mi_shlight.transfer.store import Transfer

SHPRT = '<integrator type="shprt"><integer name="order" value="1"/><string name="transfer" value="unshadowed"/></integrator>'
LIGHT = """<shape type="rectangle" id="light_{name}">
        <transform name="to_world"><scale value="0.4"/><rotate x="1" angle="90"/><translate x="{x}" y="1.5" z="0"/></transform>
        <emitter type="shlight"><rgb name="radiance" value="{x}, 2, 1"/></emitter>
    </shape>"""
LIGHTS = LIGHT.format(name="a", x=1) + LIGHT.format(name="b", x=2) + """
    <shape type="cube" id="box"><transform name="to_world"><scale value="0.2"/><translate x="0.7" y="0.2"/></transform></shape>"""
SIDEWAYS = {"motions": [{"move": "light_a", "keyframes": [{"time": 0, "translate": [0, 0, 0]}, {"time": 1, "translate": [0.3, 0, 0.4]}]}]}


@pytest.fixture
def scene(scene_file):
    return mi.load_file(str(scene_file(SHPRT, LIGHTS)), optimize=False, res="8")


def moving(**entry):
    """The only motion of a file."""
    return load_motion({"motions": [entry]}).entries[0]


def at(track, *times):
    return track.at(np.array(times))[:, 0]


def vertices(scene, name):
    return np.array(mi.traverse(scene)[f"{name}.vertex_positions"]).reshape(-1, 3)


# ---- motion over time


def test_linear_keyframes_and_what_they_leave_out():
    entry = moving(move="x", keyframes=[{"time": 0.2, "rotate": 10}, {"time": 0.4, "translate": [0, 0, 1]},
                                        {"time": 0.6, "rotate": 30, "scale": 2}, {"time": 0.8, "translate": [0, 2, 1]}])
    np.testing.assert_allclose(at(entry.tracks["rotate"], 0, 0.2, 0.4, 0.6, 1), [10, 10, 20, 30, 30])
    np.testing.assert_allclose(entry.tracks["translate"].at(np.array([0.3, 0.6])), [[0, 0, 1], [0, 1, 1]], atol=1e-12)
    np.testing.assert_allclose(at(entry.tracks["scale"], 0, 1), 2)


def test_smooth_keyframes_pass_through_have_slopes_and_do_not_overshoot():
    values = [0, 1, 4, 3.9, 3.9, 0]
    times = [0, 0.1, 0.3, 0.6, 0.8, 1]
    track = moving(set="x", interpolation="smooth", keyframes=[{"time": t, "value": v} for t, v in zip(times, values)]).tracks["value"]
    np.testing.assert_allclose(at(track, *times), values, atol=1e-12)
    fine = np.linspace(0, 1, 2001)
    curve = at(track, *fine)
    for a, b, low, high in zip(times, times[1:], np.minimum(values, values[1:] + [0]), np.maximum(values, values[1:] + [0])):
        inside = curve[(fine >= a) & (fine <= b)]
        assert inside.min() >= low - 1e-9 and inside.max() <= high + 1e-9
    slopes = np.gradient(curve, fine)
    assert np.abs(np.diff(slopes)).max() < 0.5                             # no corners: a polyline's slope jumps by 5 at 0.1
    assert slopes[200] == pytest.approx(2 * 10 * 15 / 25, rel=0.02)        # harmonic mean of 10 and 15
    assert abs(slopes[0]) < 0.3 and abs(slopes[600]) < 0.1


def test_smooth_closed_motion_does_not_rest_at_its_ends():
    turn = moving(move="x", interpolation="smooth", keyframes=[{"time": 0, "rotate": 0}, {"time": 1, "rotate": 360}]).tracks["rotate"]
    np.testing.assert_allclose(at(turn, 0.1, 0.25, 0.9), [36, 90, 324])


def test_transform_scales_turns_about_a_point_and_translates():
    entry = moving(move="x", axis=[0, 0, 2], about=[1, 0, 0],
                   keyframes=[{"time": 0, "rotate": 90, "scale": [2, 1, 1], "translate": [0, 0, 5]}])
    (matrix,) = entry.matrices(np.zeros(1), 0, np.zeros(3))
    np.testing.assert_allclose(matrix @ [1, 0, 0, 1], [1, 0, 5, 1], atol=1e-12)
    np.testing.assert_allclose(matrix @ [2, 1, 3, 1], [0, 2, 8, 1], atol=1e-12)


def test_stagger_runs_each_match_ahead_and_wraps():
    entry = moving(set="x", stagger=0.25, keyframes=[{"time": 0, "value": 0}, {"time": 0.5, "value": 1}, {"time": 1, "value": 0}])
    for match, expected in enumerate([(0.2, 0.2), (0.7, 0.7), (0.8, 0.8), (0.3, 0.3)]):
        np.testing.assert_allclose(entry.at(np.array([0.1, 1.1]), match)["value"][:, 0], expected, atol=1e-12)


def test_a_loop_leaves_out_the_last_moment():
    closed = [{"set": "x", "keyframes": [{"time": 0, "value": 0}]}]
    np.testing.assert_allclose(load_motion({"loop": True, "motions": closed}).times(4), [0, 0.25, 0.5, 0.75])
    np.testing.assert_allclose(load_motion({"motions": closed}).times(5), [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(load_motion({"motions": closed}).times(1), [0])


# ---- refusals


KEYFRAMES = [{"time": 0, "rotate": 0}]


@pytest.mark.parametrize("content, parts", [
    ("[1, 2", ("m.json", "JSON", "Line 1, column")),
    ('{"motions": [], "motions": []}', ("m.json", "'motions' stands twice")),
    ([], ("m.json", "JSON object", "[]")),
    ({"motions": []}, ("m.json: motions", "at least one", "[]")),
    ({"motion": []}, ("m.json", "'motion'", "Did you mean 'motions'")),
    ({"loop": 1, "motions": []}, ("m.json: loop", "true or false", "1")),
    ({"motions": [{"keyframes": KEYFRAMES}]}, ("motions[0]", "either 'move' or 'set'")),
    ({"motions": [{"move": "light_a", "keyframe": KEYFRAMES}]}, ("motions[0]", "'keyframe'", "Did you mean 'keyframes'")),
    ({"motions": [{"set": "x", "axis": [0, 1, 0], "keyframes": [{"time": 0, "value": 1}]}]}, ("motions[0]", "'axis'", "are 'set'")),
    ({"motions": [{"move": 3, "keyframes": KEYFRAMES}]}, ("motions[0].move", "a list of names", "3")),
    ({"motions": [{"move": "light_a"}]}, ("motions[0].keyframes", "at least one keyframe", "None")),
    ({"motions": [{"move": "light_a", "keyframes": [{"time": 2, "rotate": 0}]}]}, ("keyframes[0].time", "between 0 and 1", "2")),
    ({"motions": [{"move": "light_a", "keyframes": [{"rotate": 0}]}]}, ("keyframes[0].time", "a number", "None")),
    ({"motions": [{"move": "light_a", "keyframes": [{"time": [0], "rotate": 0}]}]}, ("keyframes[0].time", "a number", "[0]")),
    ({"motions": [{"move": "light_a", "keyframes": KEYFRAMES * 2}]}, ("keyframes[1].time", "later than", "0")),
    ({"motions": [{"move": "light_a", "keyframes": [{"time": 0, "translate": [1, 2]}]}]}, ("[0].translate", "3 numbers", "[1, 2]")),
    ({"motions": [{"move": "light_a", "keyframes": [{"time": 0, "translate": [1, 2, "x"]}]}]}, ("[0].translate", "finite", "'x'")),
    ({"motions": [{"move": "light_a", "keyframes": [{"time": 0, "rotate": float("nan")}]}]}, ("[0].rotate", "finite", "nan")),
    ({"motions": [{"move": "light_a", "keyframes": [{"time": 0, "scale": 0}]}]}, ("[0].scale", "greater than 0", "0")),
    ({"motions": [{"move": "light_a", "keyframes": [{"time": 0}]}]}, ("keyframes", "'translate' or 'rotate' or 'scale'")),
    ({"motions": [{"move": "light_a", "axis": [0, 0, 0], "keyframes": KEYFRAMES}]}, ("motions[0].axis", "length", "[0, 0, 0]")),
    ({"motions": [{"move": "light_a", "about": "middle", "keyframes": KEYFRAMES}]}, ("motions[0].about", "'middle'", "centre")),
    ({"motions": [{"move": "light_a", "interpolation": "cubic", "keyframes": KEYFRAMES}]}, ("interpolation", "'smooth'", "'cubic'")),
    ({"motions": [{"move": "light_a", "stagger": 0.1, "keyframes": KEYFRAMES + [{"time": 1, "rotate": 90}]}]},
     ("motions[0].keyframes", "end with the 'rotate' they begin with", "[90.0]", "stagger")),
    ({"loop": True, "motions": SIDEWAYS["motions"]}, ("motions[0].keyframes", "'translate'", "loop")),
    ({"motions": [{"set": "x", "keyframes": [{"time": 0, "value": 1}, {"time": 1, "factor": 1}]}]}, ("either 'value' or 'factor'",)),
    ({"motions": [{"set": "x", "keyframes": [{"time": 0, "value": [1, 2]}, {"time": 1, "value": [1, 2, 3]}]}]}, ("as many", "[2, 3]")),
    # what only the scene can tell
    ({"motions": [{"move": "light_c", "keyframes": KEYFRAMES}]}, ("motions[0].move", "'light_c'", "Did you mean", "'light_a'")),
    ({"motions": [{"move": ["light_a", "?"], "keyframes": KEYFRAMES}]}, ("motions[0].move", "'?'", "The scene has", "'box'")),
    ({"motions": [{"set": "light_a.emitter.radiance", "keyframes": [{"time": 0, "value": 1}]}]}, ("'light_a.emitter.radiance.value'",)),
    ({"motions": [{"set": "light_a.to_world", "keyframes": [{"time": 0, "value": 1}]}]}, ("'light_a.to_world'", '"move": "light_a"')),
    ({"motions": [{"set": "box.faces", "keyframes": [{"time": 0, "value": 1}]}]}, ("'box.faces'", "numbers, colours or vectors", "UInt")),
    ({"motions": [{"set": "light_a.emitter.radiance.value", "keyframes": [{"time": 0, "value": [1, 2]}]}]}, ("1 or 3 numbers", "2")),
    ({"motions": [{"set": "light_*.emitter.radiance.value", "keyframes": [{"time": 0, "value": 1}]}] * 2}, ("motions[1].set", "once")),
])
def test_a_wrong_motion_is_refused_before_any_rendering(capsys, scene_file, tmp_path, monkeypatch, content, parts):
    monkeypatch.setattr("mi_shlight.animation.render", lambda *arguments, **options: pytest.fail("rendered"))
    (tmp_path / "m.json").write_text(content if isinstance(content, str) else json.dumps(content))
    code, _, err = run_animate(capsys, scene_file(SHPRT, LIGHTS), tmp_path)
    assert code == 2 and err.startswith("mi-shlight: error: animate(): ") and err.count("\n") == 1
    for part in parts:
        assert part in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options, parts", [
    (("--frames", "0"), ("'--frames'", "from 1 to 100000", "0")),
    (("--fps", "0"), ("'--fps'", "from 0.01", "0")),
    (("--exposure", "-1"), ("'--exposure'", ">= 0", "-1")),
    (("--spp", "-1"), ("'spp'", "-1")),
    (("--sensor", "1"), ("'sensor'", "from 0 to 0")),
    (("--motion", "none.json"), ("'motion'", "existing file", "'none.json'")),
    (("-o", "scene.xml"), ("name a folder", "scene.xml")),
    (("-o", "none/out"), ("existing folder", "none/out")),
    (("--frames", "2", "-o", "old"), ("no frames beyond the 2", "'frame_0012.png'", "Delete")),
])
def test_wrong_options_are_refused(capsys, scene_file, tmp_path, monkeypatch, options, parts):
    scene = scene_file(SHPRT, LIGHTS)
    (tmp_path / "m.json").write_text(json.dumps(SIDEWAYS))
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "frame_0012.png").write_text("")
    monkeypatch.chdir(tmp_path)
    code, _, err = run_animate(capsys, scene, tmp_path, *options)
    assert code == 2 and err.startswith("mi-shlight: error: ") and err.count("\n") == 1
    for part in parts:
        assert part in err
    assert not (tmp_path / "out").exists()


def test_motion_is_a_path_or_a_dict(scene):
    with pytest.raises(TypeError, match="'motion' must be the path of a motion file, or a dict"):
        animate(scene, 3, 2)


# ---- a scene in motion


def test_objects_move_in_the_order_of_the_file_and_their_centre_goes_along(scene):
    before, normals = vertices(scene, "box"), np.array(mi.traverse(scene)["box.vertex_normals"]).reshape(-1, 3)
    stage = Stage(scene, load_motion({"motions": [
        {"move": "box", "keyframes": [{"time": 0, "translate": [0, 0, 0]}, {"time": 1, "translate": [2, 0, 0]}]},
        {"move": "box", "keyframes": [{"time": 0, "rotate": 0}, {"time": 1, "rotate": 180}]}]}), 3)
    stage.show(1)
    x, y, z = (before - [0.7, 0.2, 0]).T
    np.testing.assert_allclose(vertices(scene, "box"), np.stack([z, y, -x], axis=1) + [1.7, 0.2, 0], atol=1e-6)
    x, y, z = normals.T
    np.testing.assert_allclose(np.array(mi.traverse(scene)["box.vertex_normals"]).reshape(-1, 3), np.stack([z, y, -x], axis=1), atol=1e-6)
    stage.show(2)
    np.testing.assert_allclose(vertices(scene, "box"), (before - [0.7, 0.2, 0]) * [-1, 1, -1] + [2.7, 0.2, 0], atol=1e-6)
    stage.restore()
    np.testing.assert_array_equal(vertices(scene, "box"), before)


def test_patterns_move_lights_and_the_camera_each_in_its_phase(scene):
    p = mi.traverse(scene)
    sensor = next(key for key in p.keys() if key.endswith(".to_world") and f"{key[:-9]}.x_fov" in p)[:-9]
    home = {name: np.array(p[f"{name}.to_world"].matrix).reshape(4, 4) for name in ("light_a", "light_b", sensor)}
    stage = Stage(scene, load_motion({"motions": [{"move": ["light_?", sensor], "stagger": 0.5, "keyframes": [
        {"time": 0, "translate": [0, 0, 0]}, {"time": 0.5, "translate": [0, 1, 0]}, {"time": 1, "translate": [0, 0, 0]}]}]}), 3)
    order = [key[:-9] for key in p.keys() if key[:-9] in home and key.endswith(".to_world")]
    stage.show(0)
    for match, name in enumerate(order):
        shift = np.array(p[f"{name}.to_world"].matrix).reshape(4, 4) - home[name]
        np.testing.assert_allclose(shift[:3, 3], [0, match % 2, 0], atol=1e-6)
        assert np.abs(shift[:3, :3]).max() == 0


def test_parameters_are_set_or_multiplied(scene):
    p = mi.traverse(scene)
    sensor = next(key for key in p.keys() if key.endswith(".x_fov"))
    motion = [{"set": "light_*.emitter.radiance.value", "keyframes": [{"time": 0, "factor": 1}, {"time": 1, "factor": [3, 1, 0]}]},
              {"set": sensor, "keyframes": [{"time": 0, "value": 40}, {"time": 1, "value": 20}]},
              {"set": sensor.replace("x_fov", "near_clip"), "keyframes": [{"time": 0, "value": 0.5}]}]
    stage = Stage(scene, load_motion({"motions": motion}), 3)
    stage.show(1)
    np.testing.assert_allclose(np.ravel(p["light_b.emitter.radiance.value"]), [4, 2, 0.5])
    np.testing.assert_allclose(np.ravel(p["light_a.emitter.radiance.value"]), [2, 2, 0.5])
    assert p[sensor][0] == 30 and p[sensor.replace("x_fov", "near_clip")] == 0.5
    stage.restore()
    np.testing.assert_allclose(np.ravel(p["light_b.emitter.radiance.value"]), [2, 2, 1])


def test_only_what_changes_is_updated(scene, monkeypatch):
    stage = Stage(scene, load_motion({"motions": [
        {"move": "light_*", "keyframes": [{"time": 0, "translate": [0, 0, 0]}, {"time": 0.5, "translate": [0.1, 0, 0]}]},
        {"move": "light_b", "keyframes": [{"time": 0.5, "rotate": 0}, {"time": 1, "rotate": 9}]}]}), 5)
    written, updates = [], []
    write, update = mi.SceneParameters.__setitem__, mi.SceneParameters.update
    monkeypatch.setattr(mi.SceneParameters, "__setitem__", lambda self, key, value: (written.append(key), write(self, key, value)))
    monkeypatch.setattr(mi.SceneParameters, "update", lambda self: (updates.append(list(written)), written.clear(), update(self)))
    for frame in range(5):
        stage.show(frame)
    both = ["light_a.to_world", "light_b.to_world"]
    assert [sorted(keys) for keys in updates] == [[], both, both, both[1:], both[1:]]


def test_frames_are_renders_of_the_moved_scene_with_one_seed(scene):
    frames = dict(animate(scene, SIDEWAYS, 3, spp=2, seed=7))
    assert list(frames) == [0, 1, 2] and frames[0].shape == (8, 8, 3) and frames[0].dtype == np.float32
    p = mi.traverse(scene)
    home = mi.ScalarTransform4f(np.array(p["light_a.to_world"].matrix).reshape(4, 4))
    for frame, share in ((0, 0), (2, 1)):                     # also: the scene is where it was
        p["light_a.to_world"] = mi.Transform4f(mi.ScalarTransform4f().translate([0.3 * share, 0, 0.4 * share]) @ home)
        p.update()
        np.testing.assert_allclose(frames[frame], np.array(mi.render(scene, spp=2, seed=7)), rtol=1e-5, atol=1e-6)
    assert np.abs(frames[2] - frames[0]).max() > 0.01


# ---- one bake for all frames


SHADOWED = {"transfer": "shadowed", "transfer_samples": 4, "max_edge": 10.0}


def test_one_bake_in_the_middle_of_the_way_serves_all_frames(scene, monkeypatch):
    stage = Stage(scene, load_motion(SIDEWAYS), 5)
    integrator = stage.integrator(sh_integrator(scene, SHADOWED))
    assert integrator.light_margin == pytest.approx(0.25, rel=1e-3) and integrator.max_edge == 10   # 0.5 in all, half to each side
    bakes = []
    import mi_shlight.plugins.shprt as plugin
    trace = plugin.trace_transfer
    place = lambda lights: lights[0].outline[..., 0].mean()
    monkeypatch.setattr(plugin, "trace_transfer", lambda *arguments: bakes.append(place(arguments[1])) or trace(*arguments))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(list(stage.render(integrator, spp=2))) == 5
    np.testing.assert_allclose(bakes, [1.15], atol=1e-5)


def test_a_margin_is_needed_for_moved_lights_only(scene):
    integrator = sh_integrator(scene, SHADOWED)
    colours = {"motions": [{"set": "light_a.emitter.radiance.value", "keyframes": [{"time": 0, "factor": 1}, {"time": 1, "factor": 2}]}]}
    assert Stage(scene, load_motion(colours), 3).integrator(integrator) is integrator
    assert Stage(scene, load_motion(SIDEWAYS), 3).integrator(sh_integrator(scene)).light_margin == 0       # unshadowed
    wide = sh_integrator(scene, {**SHADOWED, "light_margin": 0.3})
    assert Stage(scene, load_motion(SIDEWAYS), 3).integrator(wide) is wide


def test_more_than_one_bake_is_announced(scene):
    sideways = Stage(scene, load_motion(SIDEWAYS), 5)
    with pytest.warns(StaleTransferWarning, match=r"up to 0.25, more than light_margin = 0.1.*light_margin of 0.25"):
        sideways.integrator(sh_integrator(scene, {**SHADOWED, "light_margin": 0.1}), one_bake=False)
    with pytest.raises(ValueError, match="'strict' is true"):
        sideways.integrator(sh_integrator(scene, {**SHADOWED, "strict": True}), one_bake=False)
    box = Stage(scene, load_motion({"motions": [{**SIDEWAYS["motions"][0], "move": "box"}]}), 5)
    with pytest.warns(StaleTransferWarning, match="'box' moves and casts shadows"):
        assert box.integrator(sh_integrator(scene, SHADOWED)).light_margin == 0


def test_a_baked_file_keeps_its_margin(scene, tmp_path):
    integrator = sh_integrator(scene, {**SHADOWED, "light_margin": 0.1})
    baked = integrator.prepare_scene(scene, False)
    assert isinstance(baked, Transfer)
    baked.save(tmp_path / "t.npz")
    with_file = sh_integrator(scene, {**SHADOWED, "transfer_file": str(tmp_path / "t.npz")})
    with pytest.warns(StaleTransferWarning, match=r"up to 0.5, more than light_margin = 0.1"):
        assert Stage(scene, load_motion(SIDEWAYS), 3).integrator(with_file) is with_file
    with pytest.raises(ValueError, match="'transfer_file' must be empty if shapes that cast shadows move, as 'box' does"):
        Stage(scene, load_motion({"motions": [{**SIDEWAYS["motions"][0], "move": "box"}]}), 3).integrator(with_file)


# ---- the command


def run_animate(capsys, scene, folder, *options):
    """Exit code, stdout, stderr of the command; it reads m.json and writes to out, both in `folder`."""
    defaults = {"--frames": "3", "--motion": str(folder / "m.json"), "-o": str(folder / "out"), "-D": "res=8", "--spp": "2"}
    given = dict(zip(options[::2], options[1::2]))
    code = main(["animate", str(scene), *(word for pair in {**defaults, **given}.items() for word in pair)])
    return (code, *capsys.readouterr())


@pytest.fixture
def motion_file(tmp_path):
    (tmp_path / "m.json").write_text(json.dumps(SIDEWAYS))
    return tmp_path / "m.json"


@pytest.fixture
def program(tmp_path, monkeypatch):
    """program(text): an ffmpeg that is this Python text, the only program there is; None: there is none."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))

    def write(text):
        (folder / "ffmpeg").write_text(f"#!{sys.executable}\nimport sys\n{text}\n")
        (folder / "ffmpeg").chmod(0o755)
    return write


def test_frames_are_written_in_srgb_and_a_line_tells_how_to_make_the_video(capsys, scene_file, tmp_path, motion_file, program):
    scene = scene_file(SHPRT, LIGHTS)
    code, out, err = run_animate(capsys, scene, tmp_path, "--exposure", "0.5")
    assert (code, err) == (0, "")
    assert {file.name for file in (tmp_path / "out").iterdir()} == {f"frame_000{k}.png" for k in range(3)}
    assert main(["render", str(scene), "-o", str(tmp_path / "still.exr"), "-D", "res=8", "--spp", "2"]) == 0
    still = np.stack([read_exr(tmp_path / "still.exr")[0][name] for name in "RGB"], axis=-1)
    first = np.array(mi.Bitmap(str(tmp_path / "out" / "frame_0000.png")))
    assert first.dtype == np.uint8 and np.abs(first - 255 * srgb(0.5 * still)).max() < 0.51
    (line,) = [line for line in out.splitlines() if "ffmpeg" in line]
    assert "ffmpeg was not found" in line and f"-framerate 24 -i {tmp_path}/out/frame_%04d.png -frames:v 3" in line


@pytest.mark.skipif(os.name != "posix", reason="writes an executable script")
def test_ffmpeg_makes_the_video_in_the_folder(capsys, scene_file, tmp_path, motion_file, program):
    program("import os; assert os.path.exists('frame_0002.png'); open(sys.argv[-1], 'w').write(' '.join(sys.argv[1:-1]))")
    code, out, err = run_animate(capsys, scene_file(SHPRT, LIGHTS), tmp_path, "--fps", "12.5")
    assert (code, err) == (0, "") and "0.24 s at 12.5 frames per second" in out
    arguments = (tmp_path / "out" / "animation.mp4").read_text()
    assert "-framerate 12.5 -i frame_%04d.png -frames:v 3" in arguments and "libx264" in arguments and "ceil(iw/2)*2" in arguments


@pytest.mark.skipif(os.name != "posix", reason="writes an executable script")
def test_a_failing_ffmpeg_leaves_the_frames_and_no_video(capsys, scene_file, tmp_path, motion_file, program):
    program("open(sys.argv[-1], 'w').write('half'); sys.exit('one\\nno such encoder')")
    code, _, err = run_animate(capsys, scene_file(SHPRT, LIGHTS), tmp_path)
    assert code == 2 and "no such encoder. The frames are complete" in err and err.count("\n") == 1
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [f"frame_000{k}.png" for k in range(3)]


@pytest.mark.parametrize("error, code, text", [(KeyboardInterrupt(), 130, "interrupted; 2 of 3 frames are complete in"),
                                               (OSError("no space left"), 2, "2 of 3 frames are complete in")])
def test_an_interrupt_keeps_the_complete_frames(capsys, scene_file, tmp_path, motion_file, monkeypatch, error, code, text):
    def write(path, image, exposure):
        if path.name == "frame_0002.png":
            raise error
        write_frame(path, image, exposure)
    monkeypatch.setattr("mi_shlight.animation.write_frame", write)
    result, _, err = run_animate(capsys, scene_file(SHPRT, LIGHTS), tmp_path)
    assert result == code and text in err and "Traceback" not in err and "no output" not in err
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["frame_0000.png", "frame_0001.png"]


def test_an_interrupt_before_the_first_frame_leaves_nothing(capsys, scene_file, tmp_path, motion_file, monkeypatch):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt
    monkeypatch.setattr("mi_shlight.animation.render", interrupt)
    code, _, err = run_animate(capsys, scene_file(SHPRT, LIGHTS), tmp_path)
    assert code == 130 and "no output was written" in err and not (tmp_path / "out").exists()


def test_the_command_bakes_once_and_says_with_what_margin(capsys, scene_file, tmp_path, motion_file, program):
    scene = scene_file(SHPRT, LIGHTS)
    options = ("--transfer", "shadowed", "--transfer-samples", "4", "--max-edge", "10")
    code, out, err = run_animate(capsys, scene, tmp_path, *options)
    assert (code, err) == (0, "") and "lights move by up to 0.25: light_margin is set so that one bake serves all frames" in out
    code, out, err = run_animate(capsys, scene, tmp_path, *options, "--light-margin", "0.05")
    assert code == 0 and err.count("\n") == 1 and "warning: animate(): lights move by up to 0.25, more than light_margin = 0.05" in err
