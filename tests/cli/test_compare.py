"""The comparison: its figures recomputed from the files it writes, its mask, its noise estimate, its picture."""
import json
import sys

import mitsuba as mi
import numpy as np
import pytest

from mi_shlight.cli import main
from mi_shlight.compare import colours, compare, image_errors, shaded_pixels
from mi_shlight.exr import read_exr
from mi_shlight.panel import draw_panel, srgb

SHPRT = '<integrator type="shprt"><integer name="order" value="3"/><integer name="transfer_samples" value="64"/></integrator>'
FACING_LIGHT = """<shape type="rectangle">
        <transform name="to_world"><scale value="0.3"/><rotate x="1" angle="-45"/><translate x="0.9" y="0.6"/></transform>
        <emitter type="area"><rgb name="radiance" value="3"/></emitter>
    </shape>"""


@pytest.fixture(scope="module")
def rgb():
    mi.set_variant("llvm_ad_rgb")


def rgb_image(path):
    return np.stack([read_exr(path)[0][name] for name in "RGB"], axis=-1).astype(np.float64)


def test_compare_writes_images_panel_and_report_that_agree(capsys, scene_file, tmp_path):
    folder = tmp_path / "result"
    code = main(["compare", str(scene_file(SHPRT)), "-o", str(folder), "--spp", "8", "--reference-spp", "64"])
    out, err = capsys.readouterr()
    assert (code, err) == (0, "")
    assert {file.name for file in folder.iterdir()} == {"sh.exr", "reference.exr", "panel.png", "report.json"}
    report = json.loads((folder / "report.json").read_text())
    sh, reference = rgb_image(folder / "sh.exr"), rgb_image(folder / "reference.exr")
    mask = shaded_pixels(mi.load_file(str(tmp_path / "scene.xml"), optimize=False))
    assert mask.sum() == report["shaded_pixels"] > 100
    error = np.abs(sh - reference)[mask]
    assert report["errors"]["mean_relative"] == pytest.approx(error.sum() / reference[mask].sum(), rel=1e-4)
    assert report["errors"]["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4)
    # Order 3 blurs shadows, but it must be the same scene: wrong light or reflectance would exceed these by far.
    assert report["noise"]["mean_relative"] < report["errors"]["mean_relative"] < 0.25
    assert abs(report["errors"]["bias"]) < 0.1
    assert report["settings"]["order"] == 3 and report["reference_spp"] == 64 and report["size"] == [24, 24]
    times = report["times"]
    assert times["sh_over_direct"] == pytest.approx(times["sh"] / times["direct"])
    assert all(times[name] > 0 for name in ("first_render", "bake", "sh", "direct"))
    assert f"{report['errors']['mean_relative']:.2%}" in out and "Mitsuba's direct" in out
    assert read_exr(folder / "sh.exr")[1]["scene"] == "scene.xml"
    picture = np.array(mi.Bitmap(str(folder / "panel.png")))
    assert picture.shape[1] > 1000 and picture[..., :3].std() > 20


def test_reference_is_direct_light_only(rgb, scene_file, tmp_path):
    scene = mi.load_file(str(scene_file(SHPRT)), optimize=False)
    compare(scene, tmp_path, spp=1, reference_spp=256)
    direct = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=256, seed=7))
    mask = shaded_pixels(scene)
    assert rgb_image(tmp_path / "reference.exr")[mask].mean() == pytest.approx(direct[mask].mean(), rel=0.01)


def test_mask_leaves_out_emitters_and_background(rgb, scene_file):
    scene = mi.load_file(str(scene_file("", FACING_LIGHT)), optimize=False, res="64")
    mask = shaded_pixels(scene)
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 1}), spp=16))
    emission = image.max(axis=-1) > 0
    assert 50 < emission.sum() < 2000 and not (mask & emission).any()
    assert mask.sum() > 1000
    bare = mi.load_dict({"type": "scene", "sensor": scene.sensors()[0], "one": {"type": "sphere", "radius": 0.5}})
    depth = shaded_pixels(bare)
    assert depth[32, 32] and not depth[0, 0]  # a sphere in the middle of nothing


def test_noise_is_the_error_of_the_mean_of_both_halves(rgb, scene_file, tmp_path):
    """Four times the samples halve the noise, and the noise predicts the distance to a converged image."""
    scene = mi.load_file(str(scene_file(SHPRT)), optimize=False)
    path = mi.load_dict({"type": "path", "max_depth": 2})
    truth = np.mean([np.array(mi.render(scene, integrator=path, spp=2048, seed=seed)) for seed in (91, 92)], axis=0)
    mask = shaded_pixels(scene)
    noise = {}
    for spp in (32, 128):
        noise[spp] = compare(scene, tmp_path, spp=1, reference_spp=spp)["noise"]["mean_relative"]
        actual = image_errors(rgb_image(tmp_path / "reference.exr"), truth, mask)["mean_relative"]
        assert noise[spp] == pytest.approx(actual, rel=0.2)
    assert noise[32] / noise[128] == pytest.approx(2, rel=0.2)


def test_image_errors_on_numbers_worked_by_hand():
    reference = np.array([[[1.0, 1.0], [3.0, 3.0]], [[2.0, 2.0], [50.0, 50.0]]])
    image = np.array([[[1.5, 1.5], [2.0, 2.0]], [[2.0, 2.0], [0.0, 0.0]]])
    errors = image_errors(image, reference, [[True, True], [True, False]])
    assert errors["mean_relative"] == pytest.approx(1.5 / 6)
    assert errors["bias"] == pytest.approx(-0.5 / 6)
    assert errors["rmse"] == pytest.approx(np.sqrt((0.25 + 1) / 3))
    assert errors["max"] == pytest.approx(0.5)
    assert errors["p95"] == pytest.approx(np.percentile([0.25, 0.5, 0], 95))


def test_black_reference_is_refused():
    with pytest.raises(ValueError, match="must have light on the pixels of the mask, got none"):
        image_errors(np.ones((2, 2, 3)), np.zeros((2, 2, 3)), np.ones((2, 2), bool))


def test_colours_picks_by_name_and_repeats_luminance():
    image = np.arange(8.0).reshape(1, 2, 4)
    np.testing.assert_array_equal(colours(image, ["A", "R", "G", "B"])[0, 0], [1, 2, 3])
    np.testing.assert_array_equal(colours(image, ["Y", "L.0.0", "x", "z"])[0, 1], [4, 4, 4])


def test_srgb_is_the_standard_curve():
    np.testing.assert_allclose(srgb(np.array([-1, 0, 0.002, 0.0031308, 0.18, 1, 7])),
                               [0, 0, 0.02584, 0.04045, 0.46135, 1, 1], atol=1e-4)


def test_panel_shows_the_sign_of_the_difference(tmp_path):
    """A left half that is too bright is red, a right half that is too dark is blue, what is not compared is grey."""
    reference = np.full((20, 20, 3), 0.5)
    image = reference.copy()
    image[:, :10] += 0.1
    image[:, 10:] -= 0.1
    mask = np.ones((20, 20), bool)
    mask[:4] = False
    figures = dict(mean_relative=0.2, p99=0.2, bias=0.0)
    draw_panel(tmp_path / "panel.png", image, reference, mask, {
        "scene": "s", "spp": 1, "reference_spp": 2, "size": [20, 20], "errors": figures, "noise": figures,
        "settings": dict(order=1, transfer="unshadowed", transfer_domain="vertex"),
        "times": dict(first_render=1.0, bake=1.0, sh=1.0, direct=1.0, sh_over_direct=1.0)})
    from matplotlib.image import imread
    picture = imread(tmp_path / "panel.png")[..., :3]
    height, width, _ = picture.shape
    red, green, blue = np.moveaxis(picture[:, int(width * 0.6):int(width * 0.9)], -1, 0)
    columns = np.arange(red.shape[1])
    reds, blues = red - blue > 0.2, blue - red > 0.2
    assert reds.mean() > 0.1 and blues.mean() > 0.1
    assert (reds * columns).sum() / reds.sum() < (blues * columns).sum() / blues.sum()
    assert (np.abs(red - 0.6) + np.abs(green - 0.6) + np.abs(blue - 0.6) < 0.02).mean() > 0.03


def test_missing_matplotlib_names_the_extra_and_writes_nothing(capsys, scene_file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["compare", str(scene_file(SHPRT)), "-o", str(tmp_path / "result")]) == 2
    err = capsys.readouterr().err
    assert err.startswith("mi-shlight: error: ") and "mi-shlight[plot]" in err and err.count("\n") == 1
    assert not (tmp_path / "result").exists()


@pytest.mark.parametrize("options, text", [
    (dict(folder="none"), "'folder' must be an existing folder"),
    (dict(spp=0), "'spp' must be an integer from 1"),
    (dict(reference_spp=1), "'reference_spp' must be an integer from 2"),
    (dict(seed=-1), "'seed' must"),
])
def test_compare_checks_its_input(rgb, scene_file, tmp_path, options, text):
    scene = mi.load_file(str(scene_file(SHPRT)), optimize=False)
    with pytest.raises((ValueError, OSError), match=text):
        compare(scene, tmp_path / options.pop("folder", ""), **options)
