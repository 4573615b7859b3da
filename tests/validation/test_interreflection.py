"""What the measurements of interreflection rest on: closed meshes, theory, verdicts."""
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from validation import furnace, interreflection


def test_ball_mesh():
    """Closed, of the area and the volume of an inscribed polyhedron, and turned the way it is asked for."""
    for outwards in (1, -1):
        ball = furnace.ball_mesh(12, 1, outwards)
        vertices, faces = (np.array(b).reshape(-1, 3) for b in (ball.vertex_positions_buffer(), ball.faces_buffer()))
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        assert areas.min() > 1e-4 and areas.sum() == pytest.approx(4 * np.pi, rel=0.02)
        assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(outwards * 4 / 3 * np.pi, rel=0.04)
    assert np.array(furnace.ball_mesh(12, 0, 1).vertex_positions_buffer()).reshape(-1, 3)[:, 1].max() == pytest.approx(0, abs=1e-6)


def test_emitting_room(monkeypatch):
    """The theory of the emitting room holds for two bounces, too, and a wrong one is off."""
    monkeypatch.setattr(furnace, "ORDER", 1)
    what, every = furnace.emitting_room(4, 0.5), np.ones((4, 4), bool)
    image = furnace.render(what, 1, (16, 16), transfer="interreflected", bounces=2, max_edge=2.0)
    found = furnace.deviation(image, 1 + 0.5 + 0.25 + 0.125, every)
    assert abs(found["mean"]) < 1e-4 and found["rms"] < 1e-3
    assert abs(furnace.deviation(image, 2, every)["mean"]) > 0.05


def test_verdicts():
    row = {"scene": "x", "rays": 64, "rms": 0.01, "max": 0.1}
    changes = {"mean": 0.001}, {"mean": -0.01}, {"mean": 0.001, "rms": 0.03}, {"mean": 1, "rays": 8}
    lines = furnace.targets([row | change for change in changes], 16)
    assert [line["met"] for line in lines] == [True, True, False, True, True, False]
    report = {"orders": [{"order": 8, "bounces": "all", "mean_relative": 0.01, "bounced": 0.5}],
              "lighting": [{"light": "light at 2", "difference": 0.9}, {"light": "constant", "difference": 1e-6}]}
    assert [line["met"] for line in interreflection.targets(report)] == [True, False, True]


def test_table():
    text = interreflection.table([{"order": 2, "bounced": 0.1234}, {"order": 4, "bias": -0.01}])
    assert text.splitlines()[0] == "| order | bounced | bias |"
    assert "12.34%" in text and "-1.00%" in text
