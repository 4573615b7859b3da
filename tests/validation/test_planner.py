"""The figures of the planner's validation: scenes that are what they say, verdicts that can fail, a picture."""
import numpy as np
import pytest

from mi_shlight.plugins import register
from validation import planner


def test_scenes_differ_in_kind():
    register()
    scenes = {name: make(8) for name, make in planner.SCENES.items()}
    lights = {name: sum(shape.is_emitter() for shape in scene.shapes()) for name, scene in scenes.items()}
    assert lights == {"open floor": 1, "columns": 2, "room": 1, "triangles": 201, "gloss": 1}
    assert scenes["gloss"].environment() is not None and "max_depth = 6" in str(scenes["room"].integrator())


@pytest.mark.parametrize("predicted, measured, floor, expected", [
    (1.0, 1.9, 0, True), (1.0, 2.1, 0, False), (1.0, 0.49, 0, False), (0.001, 0.01, 0.02, True), (0.001, 0.03, 0.02, False)])
def test_within_a_factor_of_two(predicted, measured, floor, expected):
    assert planner.within(predicted, measured, floor) is expected


def test_errors_are_freed_of_noise(monkeypatch):
    """A picture that is too bright by 3 % everywhere, with noise on it and on the reference."""
    random = np.random.default_rng(0)
    noisy = lambda mean: (lambda *_: mean + 0.02 * random.standard_normal((64, 64, 3)))
    reference = planner.Reference.__new__(planner.Reference)
    reference.scene, reference.halves, reference.mask = None, [noisy(1.0)() for _ in range(2)], np.ones((64, 64), bool)
    monkeypatch.setattr(planner, "picture", noisy(1.03))
    error, noise = reference.error(None, 2)
    assert 0.014 < noise < 0.018 and 0.027 < error < 0.032
    monkeypatch.setattr(planner, "picture", noisy(1.0))
    assert reference.error(None, 2)[0] < 0.4 * noise


def test_picture_of_the_figures(tmp_path):
    rows = [{"scene": name, "asked": asked, "error": asked, "predicted error": 0.7 * asked, "seconds": 1.0, "predicted seconds": 1.2}
            for name in planner.SCENES for asked in planner.TARGETS]
    planner.draw(rows, tmp_path / "planner.png")
    assert (tmp_path / "planner.png").stat().st_size > 10_000


def test_verdicts_ask_for_all():
    row = {"met": True, "promised": True, "error within 2x": True, "time within 2x": False}
    assert [line["met"] for line in planner.judged([row])] == [True, True, False]
    assert [line["met"] for line in planner.judged([row, {**row, "met": False, "time within 2x": True}])] == [False, True, False]
    assert [line["met"] for line in planner.judged([{**row, "promised": False}])] == [None, True, False]
