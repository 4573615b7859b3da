"""The LLVM check: file names, the choice between libraries, and the error before anything runs."""
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mi_shlight import llvm

DEBIAN = Path("/usr/lib/x86_64-linux-gnu")


@pytest.mark.parametrize("name, major", [
    ("libLLVM-14.so.1", 14),
    ("libLLVM-14.0.6.so.1", 14),
    ("libLLVM-15.so", 15),
    ("libLLVM.so.19.1", 19),
    ("/usr/lib/llvm-20/lib/libLLVM.so.20.1", 20),
    ("libLLVM.so", None),
    ("libLLVM-C.so.19", None),
    ("libLLVMX86Info.a", None),
    ("libLLVM.so.19.1-rust-1.83.0-stable", None),
    ("notlibLLVM-19.so", None),
])
def test_version_in_a_file_name(name, major):
    assert llvm.llvm_major(name) == major


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder in place of the system's; no user's choice, Dr.Jit not imported."""
    monkeypatch.setattr(llvm, "_LIBRARY_FOLDERS", (str(tmp_path),))
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)
    # Set first, so that whatever select_llvm() puts there is taken back at the end.
    monkeypatch.setenv(llvm.PATH_VARIABLE, "")
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    return tmp_path


def put(folder, *names):
    for name in names:
        (folder / name).write_bytes(b"")


linux_only = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="libraries are searched on Linux only")


@linux_only
def test_libraries_are_sorted_by_version_and_links_followed(folder):
    put(folder, "libLLVM-9.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-C.so.19")
    (folder / "libLLVM.so").symlink_to("libLLVM-15.so.1")
    (folder / "libLLVM-21.so.1").symlink_to("removed.so")
    assert llvm.installed_llvm() == [
        (9, str(folder / "libLLVM-9.so.1")), (15, str(folder / "libLLVM-15.so.1")), (19, str(folder / "libLLVM.so.19.1"))]


@linux_only
def test_libraries_of_the_users_linker_path_are_seen(folder, monkeypatch):
    own = folder / "own"
    own.mkdir()
    put(own, "libLLVM-15.so.1")
    monkeypatch.setenv("LD_LIBRARY_PATH", f":{own}:/nowhere")
    assert llvm.installed_llvm() == [(15, str(own / "libLLVM-15.so.1"))]


@linux_only
def test_newest_library_is_chosen_when_an_old_one_is_beside_it(folder):
    put(folder, "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM.so.20.1")
    assert llvm.select_llvm() == str(folder / "libLLVM.so.20.1")
    assert os.environ[llvm.PATH_VARIABLE] == str(folder / "libLLVM.so.20.1")


@linux_only
@pytest.mark.parametrize("names", [(), ("libLLVM-15.so.1",), ("libLLVM.so.19.1", "libLLVM.so.20.1")])
def test_choice_is_left_to_drjit_when_there_is_nothing_to_gain(folder, names):
    put(folder, *names)
    assert llvm.select_llvm() is None
    assert os.environ[llvm.PATH_VARIABLE] == ""


@linux_only
def test_users_choice_and_a_loaded_drjit_are_respected(folder, monkeypatch):
    put(folder, "libLLVM-15.so.1", "libLLVM.so.19.1")
    monkeypatch.setitem(sys.modules, "drjit", object())
    assert llvm.select_llvm() is None
    monkeypatch.delitem(sys.modules, "drjit")
    monkeypatch.setenv(llvm.PATH_VARIABLE, "/mine.so")
    assert llvm.select_llvm() is None
    assert os.environ[llvm.PATH_VARIABLE] == "/mine.so"


OLD = (15, "/usr/lib/libLLVM-15.so.1")
NEW = (19, "/usr/lib/libLLVM.so.19.1")


@pytest.mark.parametrize("found, parts", [
    (((15, 0, 6), OLD[1], None, [OLD]), ["19 or newer", "version 15.0.6 (/usr/lib/libLLVM-15.so.1)", "apt-get install libllvm19"]),
    (((18, 1, 8), None, None, [OLD, NEW]), ["version 18.1.8.", f"set DRJIT_LIBLLVM_PATH={NEW[1]} before Python starts"]),
    (((15, 0, 6), OLD[1], OLD[1], [OLD, NEW]), ["DRJIT_LIBLLVM_PATH points", NEW[1], "or unset DRJIT_LIBLLVM_PATH"]),
    ((None, None, None, []), ["got no library.", "apt-get install libllvm19"]),
    ((None, None, "/nowhere/x.so", []), ["nothing that can be loaded (/nowhere/x.so)", "DRJIT_LIBLLVM_PATH points"]),
])
def test_explanation_names_value_rule_and_remedy(found, parts):
    text = llvm.explain(*found)
    assert "\n" not in text
    for part in parts:
        assert part in text


def run(code, library=None):
    environment = {key: value for key, value in os.environ.items() if key != llvm.PATH_VARIABLE}
    if library is not None:
        environment[llvm.PATH_VARIABLE] = str(library)
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)


REQUIRE = """
from mi_shlight import llvm
try:
    llvm.require_llvm()
except llvm.LLVMError as error:
    print(error)
"""

SET_VARIANT = """
import mitsuba as mi
from mi_shlight import register
register()
try:
    mi.set_variant('llvm_ad_rgb')
except ImportError as error:
    print(error)
"""


@pytest.mark.parametrize("code", [REQUIRE, SET_VARIANT], ids=["require_llvm", "set_variant"])
def test_llvm_15_is_refused_before_anything_runs(code):
    library = DEBIAN / "libLLVM-15.so.1"
    if not library.exists():
        pytest.skip("LLVM 15 is not installed")
    result = run(code, library)
    assert result.returncode == 0, result.stderr
    assert "19 or newer" in result.stdout and f"version 15.0.6 ({library})" in result.stdout
    assert len(result.stdout.strip().splitlines()) == 1


@pytest.mark.parametrize("library, found", [
    (DEBIAN / "libLLVM-14.so.1", "got version 14"),
    (Path("/nowhere/libLLVM.so"), "got nothing that can be loaded (/nowhere/libLLVM.so)"),
])
def test_library_that_drjit_refuses(library, found):
    if library.parent == DEBIAN and not library.exists():
        pytest.skip("LLVM 14 is not installed")
    result = run(REQUIRE, library)
    assert result.returncode == 0, result.stderr
    assert found in result.stdout and "19 or newer" in result.stdout


def test_import_of_the_package_chooses_before_drjit_loads_a_library():
    majors = [major for major, _ in llvm.installed_llvm()]
    if not majors or not majors[0] < llvm.MINIMUM_LLVM <= majors[-1]:
        pytest.skip("this machine has no old LLVM beside a new one")
    result = run("import mi_shlight, os; from mi_shlight import llvm; print(os.environ[llvm.PATH_VARIABLE], llvm.llvm_info()['path'])")
    assert result.stdout.split() == [llvm.installed_llvm()[-1][1]] * 2, result.stderr


def test_llvm_in_use_here_is_accepted_and_described():
    result = run("from mi_shlight import llvm; llvm.require_llvm(); print(llvm.llvm_info())")
    assert result.returncode == 0, result.stderr
    info = eval(result.stdout)
    assert info["supported"] and info["version"][0] >= llvm.MINIMUM_LLVM
    if sys.platform.startswith("linux"):
        assert llvm.llvm_major(os.path.realpath(info["path"])) == info["version"][0]
