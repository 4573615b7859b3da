"""The README's examples run as written, at a lower resolution where a command allows it."""
import contextlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from mi_shlight.cli import main

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PYTHON = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
COMMANDS = re.findall(r"^\$ (.*)$", "".join(re.findall(r"```console\n(.*?)```", README, re.DOTALL)), re.MULTILINE)


@pytest.fixture
def beside_scenes(tmp_path, monkeypatch):
    """An empty working folder in which `scenes/` is the repository's."""
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_readme_has_examples():
    assert len(PYTHON) >= 2 and {command.split()[1] for command in COMMANDS} == {"render", "plan", "bake", "compare", "animate", "info"}


@pytest.mark.parametrize("block", range(len(PYTHON)))
def test_python_examples_run(beside_scenes, block):
    subprocess.run([sys.executable, "-c", PYTHON[block]], check=True)
    for file in re.findall(r"write_bitmap\(\"([^\"]+)\"", PYTHON[block]):
        assert (beside_scenes / file).stat().st_size > 1000


def test_commands_run(beside_scenes, capsys):
    """One after the other, since a later one reads what an earlier one wrote."""
    for command in COMMANDS:
        program, verb, *arguments = shlex.split(command)
        assert program == "mi-shlight"
        if verb != "info":
            arguments += ["-D", "resx=24", "-D", "resy=24"]
        if verb in ("render", "animate", "compare"):
            arguments += ["--transfer-samples", "16"]
        arguments += {"compare": ["--reference-spp", "16"], "animate": ["--frames", "2"]}.get(verb, [])
        assert main([verb, *arguments]) == 0, f"{command}: {capsys.readouterr().err}"
        with contextlib.suppress(ValueError):
            assert (beside_scenes / arguments[arguments.index("-o") + 1]).exists()


def test_xml_examples_load(beside_scenes):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    scenes = [mi.load_string(f'<scene version="3.0.0">{xml}</scene>', optimize=False)
              for xml in re.findall(r"```xml\n(.*?)```", README, re.DOTALL)]
    assert [scene.integrator().grid_resolution for scene in scenes] == [0, 0, "auto"] and len(scenes[0].emitters()) == 1


def test_make_targets_and_links_exist():
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"make (\w+)", "".join(re.findall(r"```sh\n(.*?)```", README, re.DOTALL))):
        assert f"\n{target}:" in makefile
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        if not link.startswith("https://"):
            assert (ROOT / link).exists(), f"README links to {link}, which does not exist"
