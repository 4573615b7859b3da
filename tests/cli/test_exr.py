"""EXR files: what is written is read back, by us and by Mitsuba, and a failure leaves nothing behind."""
import numpy as np
import pytest

from mi_shlight.exr import read_exr, write_exr
from mi_shlight.files import check_output, replacing

RNG = np.random.default_rng(1)
NAMES = ("R", "G", "B", "L.0.0", "L.1.-1", "L.1.0", "L.1.1")


@pytest.fixture
def planes():
    return {name: RNG.normal(size=(5, 7)).astype(np.float32) for name in NAMES}


def test_channels_and_metadata_survive_exactly(tmp_path, planes):
    metadata = {"order": 8, "method": "auto", "light_margin": 0.25, "strict": True, "mitsuba": "3.9.1", "transfer_file": ""}
    write_exr(tmp_path / "image.exr", planes, metadata)
    channels, read = read_exr(tmp_path / "image.exr")
    assert set(channels) == set(NAMES)
    for name in NAMES:
        np.testing.assert_array_equal(channels[name], planes[name])
        assert channels[name].dtype == np.float32
    assert read == {**metadata, "strict": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["image.exr"]


def test_mitsuba_reads_the_layers(tmp_path, planes):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    write_exr(tmp_path / "image.exr", planes)
    bitmap = mi.Bitmap(str(tmp_path / "image.exr"))
    names = [field.name for field in bitmap.struct_()]
    for name in NAMES:
        np.testing.assert_array_equal(np.array(bitmap)[..., names.index(name)], planes[name])


def test_non_contiguous_and_double_input_is_converted(tmp_path):
    image = RNG.normal(size=(4, 6, 3))
    write_exr(tmp_path / "image.exr", dict(zip("RGB", np.moveaxis(image, -1, 0))))
    np.testing.assert_array_equal(read_exr(tmp_path / "image.exr")[0]["G"], image[..., 1].astype(np.float32))


@pytest.mark.parametrize("channels, metadata, kind, text", [
    ({}, None, ValueError, "'channels' must name at least one channel"),
    ({"R": np.zeros((2, 2)), "G": np.zeros((2, 3))}, None, ValueError, r"channels\['G'\].*got \(2, 3\)"),
    ({"R": np.zeros((2, 2, 3))}, None, ValueError, r"got \(2, 2, 3\)"),
    ({"R": np.zeros((0, 2))}, None, ValueError, r"got \(0, 2\)"),
    ({"R": np.zeros((2, 2))}, {"type": "x"}, ValueError, "name of the file format, got 'type'"),
    ({"R": np.zeros((2, 2))}, {"order": [1]}, TypeError, r"metadata\['order'\].*got \[1\]"),
])
def test_bad_content_is_refused_and_writes_nothing(tmp_path, channels, metadata, kind, text):
    with pytest.raises(kind, match=text):
        write_exr(tmp_path / "image.exr", channels, metadata)
    assert not list(tmp_path.iterdir())


def test_reading_what_is_not_an_exr_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="must name an existing file"):
        read_exr(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("no image")
    with pytest.raises(OSError, match="must be an OpenEXR file"):
        read_exr(tmp_path / "text.exr")


def test_replacing_keeps_the_old_file_when_interrupted(tmp_path):
    target = tmp_path / "file.npz"
    target.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        with replacing(target) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt
    assert [file.name for file in tmp_path.iterdir()] == ["file.npz"] and target.read_text() == "old"
    with replacing(target) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".npz"
        temporary.write_text("new")
    assert [file.name for file in tmp_path.iterdir()] == ["file.npz"] and target.read_text() == "new"


def test_check_output_names_rule_and_remedy(tmp_path):
    assert check_output("render", "-o", tmp_path / "a.EXR", ".exr") == tmp_path / "a.EXR"
    with pytest.raises(ValueError, match=r"render\(\): '-o' must end in '.exr', got .*a.png'. Write '.*a.exr'"):
        check_output("render", "-o", tmp_path / "a.png", ".exr")
    with pytest.raises(FileNotFoundError, match="must lie in an existing folder"):
        check_output("render", "-o", tmp_path / "none" / "a.exr", ".exr")
    with pytest.raises(IsADirectoryError, match="is a folder"):
        check_output("bake", "-o", tmp_path)


def test_check_output_refuses_a_read_only_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("mi_shlight.files.os.access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(PermissionError, match="folder you may write to"):
        check_output("render", "-o", tmp_path / "a.exr")
