"""A turned object re-uses its bake: measured on few rays here, and as recorded."""
import json
import pathlib

import numpy as np
import pytest

from mi_shlight.environment.sky import project_sky
from mi_shlight.sh import rotate
from validation import turned_object

RECORDED = json.loads((pathlib.Path(turned_object.__file__).parent / "results" / "turned_object.json").read_text())


def test_one_bake_for_all_turns():
    upright, turned = np.eye(3), turned_object.rotation(200, 35)
    sky = np.array(project_sky("clear", turned_object.ORDER, turned_object.SUN), dtype=np.float64)
    kept, new = turned_object.bake(upright, 64), turned_object.bake(turned, 64) @ sky
    assert turned_object.difference(kept @ rotate(sky, turned.T), new) < 0.09        # noise of 64 rays
    for wrong in (upright, turned):
        assert turned_object.difference(kept @ rotate(sky, wrong), new) > 0.25


def test_recorded_run():
    assert RECORDED["order"] == 8 and len(RECORDED["turns"]) == 4
    for row in RECORDED["turns"]:
        assert row["against_rebake"] < 5e-3 and row["against_path"] < 0.035
        assert row["against_path"] == pytest.approx(row["rebake_against_path"], rel=0.01)
    noise = list(RECORDED["against_rebake_by_samples"].values())
    assert noise[0] > 2 * noise[1] > 4 * noise[2]
