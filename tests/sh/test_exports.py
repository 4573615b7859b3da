"""What `mi_shlight.sh` offers by name."""
import importlib
import pkgutil

import pytest

from mi_shlight import sh


def test_every_name_is_there_and_stays():
    """A function named as a module of the package would give way to it once that is imported."""
    modules = {module.name for module in pkgutil.iter_modules(sh.__path__)}
    for name in modules:
        importlib.import_module(f"mi_shlight.sh.{name}")
    assert modules.isdisjoint(sh.__all__)
    for name in sh.__all__:
        found = getattr(sh, name)
        assert callable(found) and found.__doc__ or name == "CONVENTIONS"
    assert dir(sh) == sorted(sh.__all__)


def test_unknown_name():
    with pytest.raises(AttributeError, match="'mi_shlight.sh' has no attribute 'rotat'"):
        sh.rotat
