"""The example of inverse rendering: figures of merit, starts, one short optimisation of each light, and its command line."""
import importlib.util
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scenes" / "inverse_rendering.py"
SIZE, STEPS = 24, 30


@pytest.fixture(scope="module")
def example():
    mi.set_variant("llvm_ad_rgb")
    spec = importlib.util.spec_from_file_location("inverse_rendering", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def problems(example):
    return {name: example.set_up(name, SIZE, order=3, target_spp=64) for name in ("rectangle", "pentagon")}


def outline_of(light):
    return light.outline(light.start)


@pytest.mark.parametrize("name, sides", [("rectangle", [1.4, 0.8, 1.4, 0.8]), ("pentagon", None)])
def test_true_light(example, problems, name, sides):
    """The light of the scene's file, planar, out of view, and facing the scene: read back from the scene it is the same."""
    scene, truth, target = problems[name]
    corners, radiance = outline_of(truth)
    centre, area = example.centroid(corners)
    assert np.allclose(radiance, (12, 10, 7))
    assert area @ (example.AIM - centre) > 0.9 * np.linalg.norm(area) * np.linalg.norm(example.AIM - centre)
    assert np.abs((corners - centre) @ area).max() < 1e-6
    assert not example.in_view(scene, corners) and example.in_view(scene, corners - centre)
    if sides:
        assert np.allclose(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1), sides)
    in_scene = next(s for s in scene.shapes() if s.is_emitter())
    positions = np.array(in_scene.vertex_positions_buffer()).reshape(-1, 3)
    assert np.abs(positions[:, None] - corners).sum(axis=2).min(axis=0).max() < 1e-5
    assert np.array(target).shape == (SIZE, SIZE, 3) and np.array(target).mean() > 0.05


def test_starts_are_what_they_say(example, problems):
    for name, (scene, truth, _) in problems.items():
        true_corners, true_radiance = outline_of(truth)
        for seed in range(5):
            start = example.random_start(truth, scene, np.random.default_rng(seed))
            corners, radiance = outline_of(start)
            errors = example.light_errors((corners, radiance), (true_corners, true_radiance))
            assert 0 < errors["centre"] <= 0.5 and errors["angle"] <= 30.01
            assert 0.25 - 1 <= errors["area"] <= 4 - 1
            assert corners[:, 1].min() > example.CLEARANCE and not example.in_view(scene, corners)
            if name == "rectangle":
                assert (np.abs(np.log2(radiance / true_radiance.mean())) <= 1).all() and np.ptp(radiance) > 0


def test_light_errors(example):
    square = np.array([(0, 3, 0), (0, 3, 1), (1, 3, 1), (1, 3, 0)], dtype=float)          # normal (0, 1, 0)
    colour = np.array([1.0, 2.0, 3.0])
    distance = np.linalg.norm(square.mean(axis=0) - example.AIM)
    shifted = example.light_errors((np.roll(square, 2, axis=0) + (0.3, 0, 0.4), colour), (square, colour))
    assert shifted == pytest.approx({"centre": 0.5 / distance, "corners": 0.5 / distance, "angle": 0, "area": 0, "radiance": 0, "power": 0},
                                    abs=1e-6)
    wide = example.light_errors((square * (2, 1, 1), colour * (1, 1, 2)), (square, colour))
    assert wide["area"] == pytest.approx(1) and wide["radiance"] == pytest.approx(1) and wide["power"] == pytest.approx(2 * 9 / 6 - 1)
    assert example.light_errors((square @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]], colour), (square, colour))["angle"] == pytest.approx(90)


def test_centroid_of_a_concave_polygon(example):
    """An L of three unit squares."""
    corners = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], dtype=float) @ [[1, 0, 0], [0, 1, 0]]
    centre, area = example.centroid(corners)
    assert np.allclose(centre, (5 / 6, 5 / 6, 0)) and np.allclose(area, (0, 0, 3))


def test_polygons_stay_planar_and_convex(example):
    """Whatever a step does to a pentagon, its fan of faces stays a light; a good one is left alone."""
    rng = np.random.default_rng(0)
    angles = 2 * np.pi * np.arange(5) / 5
    regular = np.stack([np.cos(angles), np.sin(angles), np.zeros(5)], axis=1)
    dented = 0
    for i in range(200):
        corners = regular + (i > 0) * rng.normal(size=(5, 3)) * (0.35, 0.35, 0.1)
        light = example.Polygon(corners, (1, 1, 1))
        values = dict(light.start)
        light.constrain(values)
        moved, _ = light.outline(values)
        faces = lambda points: np.cross(points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points)
        normal = example.centroid(moved)[1]
        dented += (faces(corners)[:, 2] < 0).any()
        assert (faces(moved) @ normal > 0).all()
        assert np.abs((moved - moved.mean(axis=0)) @ normal).max() < 1e-5 * np.linalg.norm(normal)
        assert i or np.abs(moved - regular).max() < 1e-6
    assert dented > 20


@pytest.mark.parametrize("name, seed", [("rectangle", 2), ("pentagon", 0)])
def test_optimisation_approaches_the_light(example, problems, name, seed):
    """Thirty steps on 24 x 24 pixels: far from done, but error of picture and of position fall, and the light stays valid."""
    scene, truth, target = problems[name]
    true_outline = outline_of(truth)
    start = example.random_start(truth, scene, np.random.default_rng(seed))
    plugin = mi.load_dict({"type": "shprt", "order": 3, "method": "edge", "transfer_domain": "pixel", "transfer_samples": 32})
    steps = list(example.optimise(scene, start, target, plugin, iterations=STEPS))
    losses = [loss for loss, *_ in steps]
    errors = [example.light_errors(found, true_outline) for _, *found in steps]
    assert len(steps) == STEPS and np.isfinite(losses).all()
    assert losses[-1] < losses[0] / 3
    assert errors[-1]["centre"] < 0.6 * errors[0]["centre"]
    for _, corners, radiance in steps:
        centre, area = example.centroid(corners)
        assert np.abs((corners - centre) @ area).max() < 1e-5 * np.linalg.norm(area) and (radiance > 0).all()
    left_in_scene = np.array(next(s for s in scene.shapes() if s.is_emitter()).vertex_positions_buffer()).reshape(-1, 3)
    assert np.linalg.norm(left_in_scene.mean(axis=0) - steps[-1][1].mean(axis=0)) < 0.1
    parameters = mi.traverse(scene)
    assert not any(dr.grad_enabled(parameters[k]) for k in ("light.vertex_positions", "light.to_world") if k in parameters)


@pytest.mark.parametrize("name", ["rectangle", "pentagon"])
def test_replayed_steps_are_those_traced_anew(example, problems, name, monkeypatch):
    """`freeze` changes nothing but time, and most steps are replays: light, learning rate and samples change without a new recording."""
    scene, truth, target = problems[name]
    start = example.random_start(truth, scene, np.random.default_rng(2))
    plugin = mi.load_dict({"type": "shprt", "order": 2, "method": "edge", "transfer_domain": "pixel", "transfer_samples": 8})
    recorded = []
    monkeypatch.setattr(dr, "freeze", lambda function, freeze=dr.freeze: recorded.append(freeze(function)) or recorded[-1])

    def run(freeze):
        return list(example.optimise(scene, start, target, plugin, iterations=6, resample=True, freeze=freeze))

    replayed, traced = run(True), run(False)
    assert len(recorded) == 1 and recorded[0].n_recordings <= 3
    assert len({loss for loss, *_ in traced}) == len(traced)
    for one, other in zip(replayed, traced, strict=True):
        for value, expected in zip(one, other, strict=True):
            np.testing.assert_allclose(value, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("arguments, complaint", [
    (["triangle"], "invalid choice: 'triangle'"),
    (["--iterations", "0"], "--iterations: must be a whole number from 1 to 100000, got '0'"),
    (["--resolution", "many"], "--resolution: must be a whole number from 8 to 1024, got 'many'"),
    (["--seed", "-1"], "--seed"),
    (["--output", "nowhere/picture.png"], "folder 'nowhere' must exist"),
])
def test_bad_command_line(example, arguments, complaint, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        example.main(arguments)
    assert stop.value.code == 2 and complaint in capsys.readouterr().err


def test_command_line(example, tmp_path, capsys):
    example.main(["pentagon", "--iterations", "2", "--resolution", "8", "--order", "2", "-o", str(tmp_path / "p.png")])
    assert capsys.readouterr().out.count("loss") == 2
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
