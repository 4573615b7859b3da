"""The figures of the planner's validation: scenes that are what they say, verdicts that can fail, a picture."""
import mitsuba as mi
import numpy as np
import pytest

from mi_shlight.plugins import register
from validation import planner


def test_scenes_differ_in_kind():
    register()
    scenes = {name: make(8) for name, make in planner.SCENES.items()}
    lights = {name: sum(shape.is_emitter() for shape in scene.shapes()) for name, scene in scenes.items()}
    assert lights == {"open floor": 1, "stairs": 2, "room": 1, "dome": 200, "gloss": 1}
    assert scenes["gloss"].environment() is not None and "max_depth = 6" in str(scenes["room"].integrator())


def test_all_lights_of_the_dome_face_the_scene():
    lamps = [shape for shape in planner.SCENES["dome"](8).shapes() if shape.is_emitter()]
    for lamp in lamps[::23]:
        corners = np.array(lamp.vertex_position(mi.UInt32(0, 1, 2))).T
        assert np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ corners.mean(axis=0) < 0


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
    assert 0.014 < noise < 0.018 and 0.024 < error < 0.032
    monkeypatch.setattr(planner, "picture", noisy(1.0))
    assert reference.error(None, 2)[0] < 0.4 * noise


def test_errors_at_few_pixels_count_by_their_mean(monkeypatch):
    """Not by its square, which would be five times as much here."""
    random = np.random.default_rng(0)
    noisy = lambda mean: mean + 0.001 * random.standard_normal((64, 64, 3))
    spots = 1 + 0.2 * (random.random((64, 64, 1)) < 0.02)
    reference = planner.Reference.__new__(planner.Reference)
    reference.scene, reference.halves, reference.mask = None, [noisy(1.0) for _ in range(2)], np.ones((64, 64), bool)
    monkeypatch.setattr(planner, "picture", lambda *_: noisy(spots))
    assert reference.error(None, 2)[0] == pytest.approx(spots.mean() - 1, rel=0.25)


def test_picture_of_the_figures(tmp_path):
    rows = [{"scene": name, "asked": asked, "error": asked, "predicted error": 0.7 * asked, "seconds": 1.0, "predicted seconds": 1.2}
            for name in planner.SCENES for asked in planner.TARGETS]
    planner.draw(rows, tmp_path / "planner.png")
    assert (tmp_path / "planner.png").stat().st_size > 10_000


def test_verdicts_ask_for_all():
    row = {"met": True, "promised": True, "error within 2x": True, "time within 2x": False, "seconds": 1.0, "largest seconds": 3.0}
    met = lambda rows: [line["met"] for line in planner.judged(rows)]
    assert met([row]) == [True, True, False, True]
    assert met([row, {**row, "met": False, "time within 2x": True}]) == [False, True, False, True]
    assert met([{**row, "promised": False, "largest seconds": 1.5}]) == [None, True, False, False]
