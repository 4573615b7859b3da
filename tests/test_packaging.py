"""The wheel holds everything, and the set-up script fails in words."""
import os
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import mi_shlight

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
POSIX = pytest.mark.skipif(os.name != "posix", reason="the set-up script is for POSIX systems")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel built from a copy, since setuptools leaves its products in the source tree."""
    source = tmp_path_factory.mktemp("source") / "with space"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("mi_shlight", "plugins"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    target = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index",
                    "-w", target, source], check=True)
    return next(target.glob("*.whl"))


def test_wheel_holds_every_source_file_and_the_data(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    expected = {file.relative_to(ROOT).as_posix() for file in (ROOT / "mi_shlight").rglob("*")
                if file.suffix in (".py", ".npz")}
    expected |= {f"mi_shlight/plugins/{file.name}" for file in (ROOT / "plugins").glob("*.py")}
    assert "mi_shlight/sh/data/lobes.npz" in expected
    assert {name for name in held if ".dist-info/" not in name} == expected
    assert any(name.endswith("licenses/LICENSE") for name in held)


def test_plugins_import_from_an_installed_wheel(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path)
    code = ("import mi_shlight, mi_shlight.plugins, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); "
            "print(mi_shlight.plugins.__file__); print(mi.load_dict({'type': 'shprt'}).parameters()['order'])")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True,
                          env={**os.environ, "PYTHONPATH": str(tmp_path)})
    assert done.stdout.split("\n")[:2] == [str(tmp_path / "mi_shlight/plugins/__init__.py"), "8"]


def test_version_is_the_same_everywhere():
    assert mi_shlight.__version__ == PROJECT["project"]["version"] == version("mi-shlight")
    assert f"\n## {mi_shlight.__version__} " in (ROOT / "CHANGELOG.md").read_text()


def test_runtime_dependencies_are_the_four_agreed_ones():
    names = {entry.split(">")[0].split("<")[0] for entry in PROJECT["project"]["dependencies"]}
    assert names == {"mitsuba", "numpy", "OpenEXR"}  # drjit comes with mitsuba, which pins its version


def script(path, *lines):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(("#!/bin/sh", *lines, "")))
    path.chmod(0o755)


@pytest.fixture
def checkout(tmp_path):
    """A set-up checkout whose python finds LLVM once the file `llvm` exists, and a PATH of bare necessities, without root."""
    checkout, tools = tmp_path / "a checkout", tmp_path / "tools"
    (checkout / ".ci").mkdir(parents=True)
    shutil.copy(ROOT / ".ci/setup", checkout / ".ci")
    shutil.copy(ROOT / "pyproject.toml", checkout)
    script(checkout / ".venv/bin/python", 'case "$*" in *libatomic*) [ -e atomic ]; exit ;; esac',
           "[ -e llvm ] || { echo 'LLVMError: got no library.' >&2; exit 1; }")
    (checkout / "atomic").touch()
    with open(ROOT / "pyproject.toml") as project:
        summed = subprocess.run(["cksum"], stdin=project, capture_output=True, text=True, check=True).stdout
    (checkout / ".venv/set-up").write_text(f"{checkout} {summed}")
    tools.mkdir()
    for tool in ("sh", "cat", "cksum", "dirname", "env", "tail", "touch"):
        (tools / tool).symlink_to(shutil.which(tool))
    (tools / "python3").symlink_to(sys.executable)
    script(tools / "id", "echo 1000")
    script(tools / "uname", "echo Linux")
    return checkout


def set_up(checkout, *arguments, **environment):
    tools = str(checkout.parent / "tools")
    return subprocess.run([f"{tools}/sh", ".ci/setup", *arguments], cwd=checkout, env={"PATH": tools, **environment}, capture_output=True,
                          text=True)


def as_root_with_apt(checkout, offered):
    """Let the user be root and give apt-get one package that brings LLVM; apt-get's calls go to apt.log."""
    tools = checkout.parent / "tools"
    script(tools / "id", "echo 0")
    script(tools / "apt-get", 'echo "$*" >>apt.log',
           f'case "$*" in update*) ;; *" {offered}") touch llvm ;; *" libatomic1") touch atomic ;;',
           '*) echo "E: Unable to locate package" >&2; exit 100 ;; esac')


@POSIX
def test_setup_does_nothing_when_all_is_there(checkout):
    (checkout / "llvm").touch()
    done = set_up(checkout)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@POSIX
def test_setup_without_llvm_and_root_says_what_to_install_in_one_line(checkout):
    script(checkout.parent / "tools/apt-get", "echo called >apt.log")
    done = set_up(checkout)
    assert done.returncode == 1 and done.stdout == "" and not (checkout / "apt.log").exists()
    assert done.stderr.count("\n") == 1 and "apt-get install python3-venv libatomic1 libllvm19" in done.stderr


@POSIX
def test_setup_as_root_installs_libatomic_for_drjit(checkout):
    (checkout / "atomic").unlink()
    (checkout / "llvm").touch()
    assert set_up(checkout).stderr.count("apt-get install python3-venv libatomic1 libllvm19") == 1
    as_root_with_apt(checkout, "libllvm19")
    done = set_up(checkout)
    assert (done.returncode, done.stdout, done.stderr) == (0, "setup: installed libatomic1\n", "")


@POSIX
def test_setup_as_root_takes_the_llvm_that_the_distribution_has(checkout):
    as_root_with_apt(checkout, "libllvm20")
    done = set_up(checkout)
    assert (done.returncode, done.stdout, done.stderr) == (0, "setup: installed libllvm20\n", "")
    calls = (checkout / "apt.log").read_text().splitlines()
    assert [call.split()[-1] for call in calls] == ["-qq", "libllvm19", "libllvm20"]


@POSIX
def test_setup_for_tests_installs_a_browser_where_it_may(checkout):
    (checkout / "llvm").touch()
    missing = set_up(checkout, "browser")
    assert (missing.returncode, missing.stdout, missing.stderr) == (0, "setup: no browser; the test that needs one is skipped\n", "")
    as_root_with_apt(checkout, "chromium")
    assert (set_up(checkout).stdout, set_up(checkout, "browser").stdout) == ("", "setup: installed chromium\n")
    script(checkout.parent / "tools/chromium")
    assert set_up(checkout, "browser").stdout == ""


@POSIX
def test_setup_where_apt_has_no_llvm_says_what_to_do(checkout):
    as_root_with_apt(checkout, "nothing")
    done = set_up(checkout)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "DRJIT_LIBLLVM_PATH" in done.stderr


@POSIX
def test_setup_respects_a_library_chosen_by_the_user(checkout):
    as_root_with_apt(checkout, "libllvm19")
    done = set_up(checkout, DRJIT_LIBLLVM_PATH="/opt/libLLVM-15.so")
    assert (done.returncode, done.stderr) == (1, "setup: LLVMError: got no library.\n")
    assert not (checkout / "apt.log").exists()
