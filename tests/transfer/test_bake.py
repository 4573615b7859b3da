"""Baking: arguments, progress, determinism, and scenes at the edge of what can be baked."""
import warnings

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from mi_shlight import bake_transfer
from mi_shlight.errors import UnsupportedSceneWarning


@pytest.fixture(scope="module")
def table(build):
    """A floor, a plate above it and a light above both."""
    return build.scene(build.quad(build.level(2, 0), "floor"), build.box([-0.3, 0.4, -0.3], [0.3, 0.5, 0.3], "plate"),
                       build.light(build.level(0.8, 1, up=False)))


@pytest.mark.parametrize("arguments, error, parts", [
    ({"order": -1}, ValueError, ["'order'", "-1", "0"]),
    ({"order": 10_000}, ValueError, ["'order'", "10000", "64"]),
    ({"order": 3.5}, (TypeError, ValueError), ["'order'", "3.5", "integer"]),
    ({"order": "8"}, TypeError, ["'order'", "'8'"]),
    ({"transfer": "glossy"}, ValueError, ["'transfer'", "'glossy'", "'shadowed'"]),
    ({"transfer": "unshadowed"}, ValueError, ["'transfer'", "'unshadowed'", "analytic"]),
    ({"transfer": 3}, TypeError, ["'transfer'", "3"]),
    ({"samples": 0}, ValueError, ["'samples'", "got 0", "from 1 to 65536"]),
    ({"samples": 100.5}, ValueError, ["'samples'", "100.5"]),
    ({"samples": True}, TypeError, ["'samples'", "True"]),
    ({"max_edge": -0.1}, ValueError, ["'max_edge'", "-0.1"]),
    ({"max_edge": float("nan")}, ValueError, ["'max_edge'", "nan"]),
    ({"max_edge": None}, TypeError, ["'max_edge'", "None"]),
    ({"light_margin": float("inf")}, ValueError, ["'light_margin'", "inf"]),
    ({"light_margin": "1"}, TypeError, ["'light_margin'", "'1'"]),
    ({"localised": 1}, TypeError, ["'localised'", "True or False"]),
])
def test_argument_errors(table, arguments, error, parts):
    with pytest.raises(error) as caught:
        bake_transfer(table, **{"order": 1, "samples": 16, **arguments})
    text = str(caught.value)
    assert text.startswith("bake_transfer(): ")
    for part in parts:
        assert part in text


@pytest.mark.parametrize("scene", [None, "scene.xml", 3])
def test_scene_argument(scene):
    with pytest.raises(TypeError, match=r"bake_transfer\(\): 'scene' must be a mitsuba.Scene .*load_file"):
        bake_transfer(scene)


def test_scene_of_another_variant(table):
    mi.set_variant("llvm_ad_mono")
    with pytest.raises(TypeError, match="llvm_ad_mono"):
        bake_transfer(table, 1)


def test_no_light(build):
    with pytest.raises(ValueError, match="polygonal or distant light"):
        bake_transfer(build.scene(build.quad(build.level(2, 0), "floor")), 1)


def test_too_many_points(build):
    """A fine bake of a large scene is refused before any memory is taken, with the mesh's name and the remedy."""
    floors = [build.quad(build.level(2, -y), f"floor_{y}") for y in range(250)]
    with pytest.raises(ValueError, match=r"'max_edge' must leave at most 16000000 points.*1e-05.*floor_\d+.*longer edge"):
        bake_transfer(build.scene(build.light(build.level(1, 1, up=False)), *floors), 0, samples=16, max_edge=1e-5)


def test_what_a_bake_records(table):
    transfer = bake_transfer(table, 2, samples=32, max_edge=0.5, light_margin=0.125)
    recorded = transfer.order, transfer.transfer, transfer.localised, transfer.distant, transfer.samples
    assert recorded == (2, "shadowed", True, False, 32)
    assert (transfer.max_edge, transfer.light_margin) == (0.5, 0.125)
    assert [block.name for block in transfer.meshes] == ["floor", "plate"]
    rows = sum(block.row_count for block in transfer.meshes)
    assert transfer.coeffs.shape == (1, rows, 9) and transfer.coeffs.dtype == np.float32
    assert transfer.visibility.shape == transfer.variance.shape == (1, rows)
    assert (transfer.visibility >= 0).all() and (transfer.visibility <= 1).all()
    assert transfer.groups.tolist() == [0, 1]
    np.testing.assert_allclose(np.unique(transfer.outlines[0].reshape(-1, 3), axis=0),
                               [[-0.4, 1, -0.4], [-0.4, 1, 0.4], [0.4, 1, -0.4], [0.4, 1, 0.4]], atol=1e-6)
    assert transfer.versions["mitsuba"] == mi.__version__
    assert transfer.conflict == 0


def test_automatic_edge(table):
    """1/64 of the diagonal of the receivers' bounding box: the floor's 2 x 2, and the plate up to 0.5."""
    transfer = bake_transfer(table, 0, samples=16)
    assert transfer.max_edge == pytest.approx(np.sqrt(4 + 4 + 0.25) / 64, rel=1e-5)


def test_deterministic(table):
    first, second = (bake_transfer(table, 2, samples=64, max_edge=0.3, light_margin=0.05) for _ in range(2))
    assert (first.visibility > 0).any() and (first.visibility < 1).any()
    np.testing.assert_array_equal(first.coeffs, second.coeffs)
    np.testing.assert_array_equal(first.visibility, second.visibility)
    np.testing.assert_array_equal(first.variance, second.variance)


def test_progress(build, monkeypatch):
    """Reports grow, agree on the total and end with it, over several launches and light groups."""
    monkeypatch.setattr("mi_shlight.transfer.bake.ROWS_PER_LAUNCH", 50)
    scene = build.scene(build.quad(build.level(2, 0), "floor"), build.light(build.level(0.5, 1, up=False)),
                        build.light(build.level(0.5, 2, up=False), "second"))
    reports = []
    transfer = bake_transfer(scene, 0, samples=16, max_edge=0.4, progress=lambda done, total: reports.append((done, total)))
    done = [d for d, _ in reports]
    assert len(reports) >= 4
    assert done == sorted(set(done)) and done[0] > 0
    assert {total for _, total in reports} == {done[-1]} == {transfer.visibility.size}


def test_many_launches_give_what_one_gives(table, monkeypatch):
    """Up to sampling noise: the directions of a point may depend on the launch it falls into."""
    whole = bake_transfer(table, 1, samples=1024, localised=False, max_edge=0.3)
    monkeypatch.setattr("mi_shlight.transfer.bake.ROWS_PER_LAUNCH", 37)
    parts = bake_transfer(table, 1, samples=1024, localised=False, max_edge=0.3)
    assert np.ptp(whole.visibility) == 1
    np.testing.assert_allclose(parts.visibility, whole.visibility, atol=0.01)
    np.testing.assert_allclose(parts.coeffs, whole.coeffs, atol=0.005)


def test_launches_share_their_kernels(table, monkeypatch):
    """More launches compile no more kernels: nothing of a launch, such as its first row, may be a constant of them."""
    def kernels(rows):
        monkeypatch.setattr("mi_shlight.transfer.bake.ROWS_PER_LAUNCH", rows)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            bake_transfer(table, 0, samples=16, max_edge=0.5)
            # Small ones copy numpy's memory, and there is one for each alignment that it happens to have.
            return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT]) if entry["operation_count"] > 100}

    assert kernels(19) <= kernels(50) != set()


def test_progress_on_a_terminal_only(table, capsys):
    bake_transfer(table, 0, samples=16, max_edge=1.0, progress=True)
    captured = capsys.readouterr()
    assert captured.out == captured.err == "", "what is not a terminal gets no carriage returns"


def test_only_lights(build):
    transfer = bake_transfer(build.scene(build.light(build.level(1, 1, up=False))), 2, samples=16)
    assert transfer.coeffs.shape == (1, 0, 9) and transfer.meshes == []


def test_only_shapes_that_are_not_meshes(build):
    ball = mi.load_dict({"type": "sphere", "id": "ball"})
    transfer = bake_transfer(build.scene(build.light(build.level(1, 2, up=False)), ball), 2, samples=16)
    assert transfer.coeffs.shape == (1, 0, 9)


def test_black_surfaces_are_not_baked(build):
    mirror = build.quad(build.level(2, 0), "mirror", bsdf={"type": "conductor"})
    floor = build.quad(build.level(2, -1), "floor")
    with pytest.warns(UnsupportedSceneWarning, match="mirror.*black"):
        transfer = bake_transfer(build.scene(build.light(build.level(1, 2, up=False)), mirror, floor), 1, samples=16, max_edge=1.0)
    assert [block.name for block in transfer.meshes] == ["floor"]
    assert (transfer.visibility == 0).any(), "but they block light"


def test_warnings_name_what_is_left_out(build):
    bulb = mi.load_dict({"type": "sphere", "id": "bulb", "center": [5, 5, 5], "emitter": {"type": "area"}})
    with pytest.warns(UnsupportedSceneWarning, match="bulb"):
        bake_transfer(build.scene(build.light(build.level(1, 2, up=False)), build.quad(build.level(2, 0), "floor"), bulb), 0,
                      samples=16, max_edge=2.0, progress=lambda done, total: None)


def test_no_warning_for_a_plain_scene(table):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bake_transfer(table, 0, samples=16, max_edge=1.0)
