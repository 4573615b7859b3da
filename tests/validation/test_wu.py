"""The figures of [W20]: lights that move, errors as the paper measures them, verdicts; and parts of the experiment, tiny."""
import json

import numpy as np
import pytest

pytest.importorskip("mitsuba")

from validation import wu
from validation.experiment import RESULTS
from validation.grid_scenes import W20, table_scene

TINY = wu.Plan(triangles=300, size=16, spp=1, reference_spp=512, rays=8, order=2, gloss=(1, 1), many="Plants")


def sides(lights):
    corners = lights.vertices[lights.faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


def test_lights_that_move():
    lights = table_scene("Buddha", 0.001).lights
    turned, alone = wu.turned_lights(lights), wu.recoloured(lights)
    for other in (turned, alone):
        np.testing.assert_allclose(sides(other), sides(lights), atol=1e-9)
        assert len(other.radiance) == W20["Buddha"].lights and not np.allclose(other.vertices[other.faces], lights.vertices[lights.faces])
    for side in (lights.vertices[:, 0] < 0, lights.vertices[:, 0] > 0):
        np.testing.assert_allclose(turned.vertices[side].mean(axis=0), lights.vertices[side].mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(alone.vertices[alone.faces].mean(axis=1), lights.vertices[lights.faces].mean(axis=1), atol=1e-9)


def test_interpolation_in_pictures(tmp_path):
    rows = {row["picture"]: row for row in wu.measure_interpolation(TINY, tmp_path)["rows"]}
    assert set(rows) == set(wu.INTERPOLATIONS)
    assert all(10 * rows["hermite"][key] < rows[other][key] for key in ("mae", "scan_line") for other in ("trilinear", "taylor"))
    assert 1e-9 < rows["hermite"]["mae"] < 1e-3 and (tmp_path / "wu_interpolation.png").stat().st_size > 1000


def test_states_of_glossy_lights(tmp_path):
    report = wu.measure_many(TINY, tmp_path)
    assert report["light_count"] == 2 and report["change"] > 0.1
    for state in ("as they are", "each turned and coloured"):
        exact, grid, near = (row for row in report["rows"] if row["lights"] == state)
        assert "mae" not in exact and near["mae"] <= grid["mae"] < 0.01 and grid["path"] == pytest.approx(exact["path"], rel=0.05)


def test_verdicts():
    assert all(line["met"] is None for line in wu.targets({}))
    rows = [{"picture": "exact", "path": 0.1}, {"picture": "grid", "path": 0.1, "mae": 2e-4},
            {"picture": "near lights exact", "path": 0.101, "mae": 1e-4}]
    found = [line for line in wu.targets({"path": {"rows": rows}}) if line["met"] is not None]
    assert [line["met"] for line in found] == [False, True, True] and found[2]["measured"] == "1.01"


def test_recorded_run():
    report = json.loads((RESULTS / "wu.json").read_text())
    assert not report["quick"] and set(wu.PARTS) < set(report) and report["many"]["light_count"] == W20["Dragon & Bunny"].lights
    assert report["targets"] == json.loads(json.dumps(wu.targets(report)))
