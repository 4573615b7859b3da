"""The file of a bake, and whether a bake belongs to a scene."""
import json
import os
import pickle
import zipfile

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from mi_shlight import bake_transfer, load_transfer


def parts(build, lift=0.0, order=(0, 1, 2, 3), colour=0.5, side=1.5):
    """Shapes of a small scene, in any order: floor, block, ball and light."""
    shapes = [build.quad(build.level(side, 0), "floor", bsdf={"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}),
              build.box([-0.2, 0.1 + lift, -0.2], [0.2, 0.4 + lift, 0.2], "block", bsdf={"type": "twosided", "bsdf": {"type": "diffuse"}}),
              mi.load_dict({"type": "sphere", "id": "ball", "center": [0.5, 0.3, 0], "radius": 0.1}),
              build.light(build.level(0.5, 1, up=False))]
    return [shapes[i] for i in order]


@pytest.fixture(scope="module")
def scene(build):
    return build.scene(*parts(build))


@pytest.fixture(scope="module")
def transfer(scene):
    return bake_transfer(scene, 2, samples=32, max_edge=0.3, light_margin=0.01)


@pytest.mark.parametrize("name", ["visibility", "variance", "residual", "cones"])
def test_visibility_of_another_shape(file, name):
    rewrite(file, **{name: np.zeros((1, 3), np.float32)})
    assert "shape" in refused(file)


@pytest.fixture
def file(transfer, tmp_path):
    transfer.save(tmp_path / "bake.npz")
    return tmp_path / "bake.npz"


def test_round_trip(transfer, file):
    loaded = load_transfer(file)
    assert np.ptp(transfer.visibility) > 0.5
    for name in ("order", "transfer", "localised", "distant", "samples", "light_margin", "max_edge", "conflict", "occluders", "versions"):
        assert getattr(loaded, name) == getattr(transfer, name), name
    for name in ("coeffs", "visibility", "variance", "residual", "cones", "groups"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(transfer, name))
    assert loaded.coeffs.dtype == np.float32
    np.testing.assert_array_equal(loaded.outlines, transfer.outlines)
    assert len(loaded.meshes) == 2
    for a, b in zip(loaded.meshes, transfer.meshes):
        assert (a.name, a.content, a.two_sided, a.first_row, a.row_count) == (b.name, b.content, b.two_sided, b.first_row, b.row_count)
        for name in ("subdivision", "first", "rows"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_any_name_and_path_type(transfer, tmp_path):
    """The file has the very name that was asked for, whatever its ending, and replaces what was there."""
    target = str(tmp_path / "a bake.transfer")
    (tmp_path / "a bake.transfer").write_text("old")
    transfer.save(target)
    assert os.listdir(tmp_path) == ["a bake.transfer"]
    assert load_transfer(target).order == 2


def test_file_permissions_are_ordinary(transfer, tmp_path):
    transfer.save(tmp_path / "bake.npz")
    (tmp_path / "plain").write_text("")
    assert (tmp_path / "bake.npz").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_missing_folder(transfer, tmp_path):
    with pytest.raises(FileNotFoundError, match="'path' must lie in an existing folder, got .*nowhere.*Create"):
        transfer.save(tmp_path / "nowhere" / "bake.npz")


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()], ids=["full disk", "interrupt"])
def test_interrupted_save_leaves_what_was_there(transfer, tmp_path, monkeypatch, error):
    def fail(file, **arrays):
        file.write(b"half of it")
        raise error

    (tmp_path / "bake.npz").write_text("old")
    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(type(error)):
        transfer.save(tmp_path / "bake.npz")
    assert os.listdir(tmp_path) == ["bake.npz"]
    assert (tmp_path / "bake.npz").read_text() == "old"


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"load_transfer\(\): 'path' must name an existing file, got .*none.npz.*mi-shlight bake"):
        load_transfer(tmp_path / "none.npz")
    with pytest.raises(FileNotFoundError):
        load_transfer(tmp_path)


def refused(path):
    """Text of the error that loading `path` gives, which must name it and say what it should be."""
    with pytest.raises(ValueError) as caught:
        load_transfer(path)
    text = str(caught.value)
    assert text.startswith("load_transfer(): 'path' must name a file written by Transfer.save(), got ")
    assert os.path.basename(path) in text
    return text


@pytest.mark.parametrize("part", [0.0, 0.001, 0.5, 0.99])
def test_truncated(file, part):
    data = file.read_bytes()
    file.write_bytes(data[:int(part * len(data))])
    refused(file)


def test_flipped_bits(transfer, file, tmp_path):
    """Whatever bit is wrong, the file loads with the same content (the bit was in a date or the like) or is refused."""
    data = file.read_bytes()
    rng = np.random.default_rng(0)
    damaged, count = tmp_path / "damaged.npz", 0
    for position in np.concatenate([rng.integers(0, len(data), 150), np.arange(len(data) - 100, len(data))]):
        wrong = bytearray(data)
        wrong[position] ^= 1 << rng.integers(8)
        damaged.write_bytes(wrong)
        try:
            loaded = load_transfer(damaged)
        except ValueError as error:
            assert "damaged.npz" in str(error)
            count += 1
            continue
        np.testing.assert_array_equal(loaded.coeffs, transfer.coeffs)
        assert loaded.meshes[1].content == transfer.meshes[1].content
    assert count > 50


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"PK\x05\x06" + bytes(18), b"<scene/>", bytes(1000)])
def test_foreign_file(tmp_path, content):
    (tmp_path / "other").write_bytes(content)
    refused(tmp_path / "other")


def test_other_numpy_files(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    refused(tmp_path / "other.npz")
    np.save(tmp_path / "other.npy", np.zeros(3))
    refused(tmp_path / "other.npy")


class Bomb:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_nothing_is_unpickled(tmp_path, file):
    trap = tmp_path / "sprung"
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps(Bomb(trap)))
    refused(tmp_path / "pickle.npz")
    arrays = dict(np.load(file))
    arrays["coeffs"] = np.array([Bomb(trap)], dtype=object)
    np.savez(tmp_path / "objects.npz", **arrays)
    refused(tmp_path / "objects.npz")
    assert not trap.exists()


def rewrite(file, entries=None, **replaced):
    """Change entries of a saved file's header, or all of it, or whole arrays (None drops one)."""
    arrays = dict(np.load(file))
    if entries is not None:
        old = json.loads(bytes(arrays["header"]))
        new = {**old, **entries} if isinstance(entries, dict) else entries
        arrays["header"] = np.frombuffer(json.dumps(new).encode(), np.uint8)
    arrays = {k: v for k, v in {**arrays, **replaced}.items() if v is not None}
    with open(file, "wb") as stream:
        np.savez(stream, **arrays)


def test_rewriting_alone_does_no_harm(file):
    rewrite(file, {})
    load_transfer(file)


@pytest.mark.parametrize("header, text", [
    ({"format_version": 1}, "format version 1"), ({"format": "other"}, "header"), ([1, 2], ""), ("text", ""), ({"order": 3}, "shape"),
    ({"meshes": [{"name": "x"}]}, ""), ({"lights": 7}, "outline_"),
    ({"distant": True}, "shape")])
def test_wrong_header(file, header, text):
    rewrite(file, header)
    assert text in refused(file)


@pytest.mark.parametrize("name", ["coeffs", "visibility", "variance", "groups", "header", "outline_0", "rows_1", "first_0",
                                  "subdivision_0"])
def test_missing_array(file, name):
    rewrite(file, **{name: None})
    refused(file)


def test_rows_out_of_range(file):
    """Indices are used on the device without checks: a file whose indices lead astray must not load."""
    rows = np.load(file)["rows_0"].copy()
    rows[3] = 10 ** 6
    rewrite(file, rows_0=rows)
    refused(file)


def test_archive_with_a_bad_member(file, tmp_path):
    with zipfile.ZipFile(tmp_path / "bad.npz", "w") as archive:
        archive.writestr("header.npy", b"not an array")
    refused(tmp_path / "bad.npz")


def test_fits_its_scene(transfer, file, scene, build):
    transfer.check(scene)
    assert transfer.fits(scene)
    again = build.scene(*parts(build))
    assert transfer.fits(again) and load_transfer(file).fits(again), "a scene loaded anew is the same scene"


@pytest.mark.parametrize("change", [{"order": (3, 2, 1, 0)}, {"order": (1, 3, 0, 2)}, {"colour": 0.9}])
def test_what_does_not_matter(transfer, build, change):
    """The order of shapes and the colours of surfaces are no part of a transfer."""
    assert transfer.fits(build.scene(*parts(build, **change)))


@pytest.mark.parametrize("change, named", [({"lift": 0.01}, "block"), ({"side": 1.6}, "floor"), ({"order": (0, 2, 3)}, ""),
                                           ({"order": (0, 1, 3)}, "")], ids=["moved", "resized", "mesh removed", "ball removed"])
def test_what_matters(transfer, build, change, named):
    changed = build.scene(*parts(build, **change))
    assert not transfer.fits(changed)
    with pytest.raises(ValueError, match=rf"Transfer.check\(\): 'scene' must have the geometry it was baked for.*{named}.*Bake again"):
        transfer.check(changed)


def test_another_bsdf_side_matters(transfer, build):
    """A block that scatters on one side only has no back points: its bake is another."""
    shapes = parts(build)
    shapes[1] = build.box([-0.2, 0.1, -0.2], [0.2, 0.4, 0.2], "block")
    assert not transfer.fits(build.scene(*shapes))


def test_added_shape_matters(transfer, build):
    assert not transfer.fits(build.scene(*parts(build), build.box([0.4, 0.7, 0], [0.5, 0.8, 0.1], "new")))


def test_moved_ball_matters(transfer, build):
    shapes = parts(build)
    shapes[2] = mi.load_dict({"type": "sphere", "id": "ball", "center": [0.5, 0.31, 0], "radius": 0.1})
    assert not transfer.fits(build.scene(*shapes))


def test_ids_do_not_matter(transfer, build):
    shapes = parts(build)
    for i, shape in enumerate(shapes):
        shape.set_id(f"renamed_{i}")
    assert transfer.fits(build.scene(*shapes))


def test_moving_the_light_leaves_the_fit(transfer, build):
    """Where lights stand is judged by margin, not by identity."""
    shapes = parts(build)
    shapes[3] = build.light(build.level(0.5, 0.9, up=False))
    assert transfer.fits(build.scene(*shapes))
