"""The figures of [W18]: their scenes, what is done to the lights, verdicts; and parts of the experiment, tiny."""
import json

import numpy as np
import pytest

pytest.importorskip("mitsuba")

from validation import paper_scenes, wang
from validation.experiment import RESULTS

TINY = wang.Plan(triangles=300, size=16, spp=2, reference_spp=512, rays=16, integrated_size=12, side=8, frame_scale=2e-3, frame_size=16,
                 frame_rays=1 << 10, frames=3, timed=("Buddha",), order=2, orders=(1, 2), bsdf_orders=(1,))


def area_and_normal(corners):
    twice = sum(np.cross(a - corners[0], b - corners[0]) for a, b in zip(corners[1:], corners[2:]))
    return np.linalg.norm(twice) / 2, twice / np.linalg.norm(twice)


def test_lights_face_what_they_light():
    for name, lights in wang.LIGHTS.items():
        for light, (_, position, _) in lights.items():
            normal = area_and_normal(wang.corners_of(name)[light])[1]
            assert normal @ np.subtract(wang.TARGET, position) / np.linalg.norm(np.subtract(wang.TARGET, position)) == pytest.approx(1)
    triangles = wang.grid_scenes.table_scene("Monkey", 0.01).lights
    mesh = paper_scenes.light_triangles(triangles)["light_000"]
    corners = np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)
    assert area_and_normal(corners)[1] @ (np.array([0, 0.7, 0]) - corners[0]) > 1


def test_edited_lights():
    lights = wang.edited_lights()
    start, normal = area_and_normal(lights["as it was"])
    for name, corners in lights.items():
        area, other = area_and_normal(corners)
        same_plane = np.ptp(np.concatenate([corners, lights["as it was"]]) @ normal) < 1e-9
        expected = {"as it was": (True, True, True), "moved": (True, True, False), "turned in its plane": (True, True, True),
                    "turned out of it": (True, False, False), "a corner pulled": (False, True, True)}[name]
        assert (abs(area / start - 1) < 1e-9, abs(other @ normal - 1) < 1e-9, same_plane) == expected, name


def test_share_of_red():
    image = np.zeros((16, 16, 3))
    image[-2:, :8], image[-2:, 8:] = (3, 9, 1), (1, 0, 4)
    np.testing.assert_allclose(wang.share_of_red(image), [0.75] * 4 + [0.2] * 4)


def test_analytic_and_numerical_pictures(tmp_path):
    report = wang.measure_integration(TINY, tmp_path)
    sampled, cubature = report["rows"]
    assert 40 < report["points"] <= 144 and sampled["samples"] == 128 and cubature["samples"] is None
    assert 1e-6 < sampled["largest_difference"] < 0.05 and cubature["largest_difference"] < 1e-4 and cubature["grey_levels"] <= 1
    coarse = wang.measure_integration(TINY._replace(side=1), tmp_path)["rows"][0]
    assert coarse["largest_difference"] > 5 * sampled["largest_difference"] and coarse["grey_levels"] > 1
    assert (tmp_path / "wang_integration.png").stat().st_size > 1000


def test_one_bake_follows_the_light(tmp_path):
    rows = wang.measure_edits(TINY, tmp_path)["rows"]
    kept = [row for row in rows if row["transfer"] == "projected"]
    assert len(rows) == 10 and all(row["baked_once"] for row in kept) and all(0 < row["pixels"] < 0.6 for row in kept)


def test_map_turned_by_its_transform():
    light = {"sky": {"type": "envmap", "bitmap": wang.mi.Bitmap(wang.sky(17))}}
    scene = wang.make_scene("Dragon", 100, 8, **light)
    start = wang.sky_coefficients(scene, 3)
    parameters = wang.mi.traverse(scene)
    parameters["sky.to_world"] = wang.mi.Transform4f().rotate([0, 1, 0], 70)
    parameters.update()
    turned = wang.sky_coefficients(scene, 3)
    assert abs(turned - start).max() > 0.05 * abs(start).max()
    expected = [wang.rotate(c, wang.rotation((0, 1, 0), 70)) for c in start]
    np.testing.assert_allclose(turned, expected, atol=1e-6 * abs(start).max())


def test_verdicts():
    assert all(line["met"] is None for line in wang.targets({}))
    rows = [{"transfer": kind, "order": n, "in_shadow": error, "sharpness": sharpness}
            for kind, n, error, sharpness in (("projected", 2, 0.4, 0.5), ("projected", 4, 0.2, 0.8), ("localised", 2, 0.1, 0.9))]
    found = [line for line in wang.targets({"orders": {"rows": rows}}) if line["met"] is not None]
    assert [line["met"] for line in found] == [True] * 3 and [float(line["measured"]) for line in found] == pytest.approx([0.5, 0.3, 0.5])
    rows[1].update(in_shadow=0.5, sharpness=0.4)
    assert [line["met"] for line in wang.targets({"orders": {"rows": rows}}) if line["met"] is not None] == [False, False, True]


def test_recorded_run():
    report = json.loads((RESULTS / "wang.json").read_text())
    assert not report["quick"] and set(wang.PARTS) < set(report)
    for row in report["frames"]["rows"]:
        published = wang.W18[row["scene"]]
        assert row["lights"] == published.lights and row["triangles"] == pytest.approx(published.triangles, rel=0.05)
    assert len(report["frames"]["rows"]) == len(wang.W18)
    assert all(row["grey_levels"] <= 1 for row in report["integration"]["rows"])
    assert report["targets"] == json.loads(json.dumps(wang.targets(report)))
