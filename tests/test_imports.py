"""Dependencies between the modules point one way, read from the import statements themselves."""
import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Lowest first. A module may import from its own layer and from lower ones.
LAYERS = (
    {"errors", "arrays", "files", "llvm"},
    {"sh"},
    {"light", "environment"},
    {"grid"},
    {"scene"},
    {"lights", "moving", "scene_grid"},
    {"transfer"},
    {"shading"},
    {"plugins"},
    {"exr", "rendering", "panel", "compare", "motion", "animation"},
    {"planner"},
    {"cli", "__main__"},
)
USES_MITSUBA = {"scene", "lights", "moving", "scene_grid", "transfer", "shading", "plugins", "rendering", "compare", "animation", "planner",
                "cli"}


def modules():
    """Dotted name under mi_shlight -> source file."""
    found = {}
    for folder, prefix in ((ROOT / "mi_shlight", ""), (ROOT / "plugins", "plugins.")):
        for file in sorted(folder.rglob("*.py")):
            name = prefix + ".".join(file.relative_to(folder).with_suffix("").parts)
            if name != "__init__":  # the package itself re-exports from every layer
                found[name] = file
    return found


def imports(name, file):
    """Absolute dotted names that a module imports, inside functions as well."""
    package = ["mi_shlight", *name.split(".")[:-1]]
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[:len(package) - node.level + 1] if node.level else []
            base = ".".join(base + ([node.module] if node.module else []))
            yield from (f"{base}.{alias.name}" for alias in node.names)


def layer(name):
    top = name.split(".")[0]
    ranks = [rank for rank, members in enumerate(LAYERS) if top in members]
    assert ranks, f"mi_shlight.{name} belongs to no layer: add it to LAYERS"
    return ranks[0]


def own_imports(name, file):
    for imported in imports(name, file):
        if imported == "mi_shlight.__version__":
            continue
        if imported == "mi_shlight" or imported.startswith("mi_shlight."):
            yield imported.removeprefix("mi_shlight").removeprefix(".")


@pytest.mark.parametrize("name", sorted(modules()))
def test_imports_point_to_lower_layers(name):
    for imported in own_imports(name, modules()[name]):
        if imported == "":
            assert layer(name) == len(LAYERS) - 1, f"{name} imports the package that imports it"
        else:
            assert layer(imported) <= layer(name), f"{name} imports {imported}, which lies above it"


@pytest.mark.parametrize("name", sorted(modules()))
def test_mathematics_does_not_import_mitsuba(name):
    uses = any(imported.split(".")[0] == "mitsuba" for imported in imports(name, modules()[name]))
    assert not uses or name.split(".")[0] in USES_MITSUBA


def test_cubature_shares_no_code_with_what_it_judges():
    """It is the oracle of the boundary forms: of the package it sees the spherical harmonics and the geometry of polygons."""
    own = set(own_imports("light.quadrature", ROOT / "mi_shlight" / "light" / "quadrature.py"))
    assert own and all(name.startswith(("sh.", "light.polygon.")) for name in own)


def test_the_parser_sees_relative_and_nested_imports(tmp_path):
    source = "from . import a\nfrom ..x.y import b\nimport mitsuba as mi\ndef f():\n    from .z import c\n"
    file = tmp_path / "m.py"
    file.write_text(source)
    assert list(imports("light.m", file)) == ["mi_shlight.light.a", "mi_shlight.x.y.b", "mitsuba", "mi_shlight.light.z.c"]
