"""Registration of the plugins: whenever it happens, in every variant, without harm to what is already there."""
import subprocess
import sys

import pytest

mi = pytest.importorskip("mitsuba")


def run(code):
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    return result.stdout.split()


LIGHT = "type(mi.load_dict({'type': 'shlight'})).__name__"


def test_import_before_set_variant_is_enough():
    assert run(f"import mi_shlight, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); print({LIGHT})") == ["SHLight"]


def test_import_after_set_variant_is_enough():
    assert run(f"import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import mi_shlight; print({LIGHT})") == ["SHLight"]


def test_import_alone_leaves_the_variant_unset():
    assert run("import mi_shlight, mitsuba as mi; print(mi.variant())") == ["None"]


def test_variants_switched_back_and_forth_keep_their_classes():
    assert run("""
import mitsuba as mi, mi_shlight
seen = {}
for variant in ('llvm_ad_rgb', 'scalar_rgb', 'llvm_ad_spectral', 'llvm_ad_rgb', 'scalar_spectral', 'scalar_rgb', 'llvm_ad_spectral'):
    mi.set_variant(variant)
    light = mi.load_dict({'type': 'shlight'})
    assert isinstance(light, mi.Emitter)
    assert seen.setdefault(variant, type(light)) is type(light)
    if not variant.startswith('scalar'):
        assert isinstance(mi.load_dict({'type': 'shprt'}), mi.Integrator)
print(len(set(seen.values())))
""") == ["4"]


def test_register_is_idempotent_and_restores_a_cleared_callback():
    assert run(f"""
import mitsuba as mi
from mi_shlight import register
mi.set_variant('llvm_ad_rgb')
register(); first = type(mi.load_dict({{'type': 'shlight'}}))
register(); assert type(mi.load_dict({{'type': 'shlight'}})) is first
mi.detail.clear_variant_callbacks()
register()
mi.set_variant('llvm_ad_mono')
print({LIGHT})
""") == ["SHLight"]


@pytest.mark.parametrize("before", ["mi.set_variant('llvm_ad_rgb')", "mi.set_variant('scalar_rgb'); mi.set_variant('llvm_ad_rgb')"])
def test_two_equal_lights_of_a_dictionary_are_not_merged(before):
    """Mitsuba asks scalar_rgb for the kind of a plugin, and merges equal objects of unknown kind."""
    assert run(f"""
import mitsuba as mi, mi_shlight
{before}
scene = mi.load_dict({{'type': 'scene',
    'a': {{'type': 'rectangle', 'emitter': {{'type': 'shlight', 'radiance': {{'type': 'rgb', 'value': [1, 2, 3]}}}}}},
    'b': {{'type': 'sphere', 'emitter': {{'type': 'shlight', 'radiance': {{'type': 'rgb', 'value': [1, 2, 3]}}}}}}}})
print(len(scene.emitters()))
""") == ["2"]


@pytest.mark.parametrize("variant", ["scalar_rgb", "scalar_spectral"])
def test_integrator_in_a_scalar_variant_names_the_remedy(variant):
    words = " ".join(run(f"""
import mitsuba as mi, mi_shlight
mi.set_variant('{variant}')
try:
    mi.load_dict({{'type': 'shprt'}})
except RuntimeError as error:
    print(str(error).splitlines()[-1])
"""))
    assert f"shprt: this integrator needs a JIT variant such as 'llvm_ad_rgb', got '{variant}'" in words


def test_kind_placeholder_of_an_inactive_variant_says_so():
    words = " ".join(run("""
import mitsuba as mi, mi_shlight
mi.set_variant('llvm_ad_rgb')
config = mi.parser.ParserConfig('scalar_rgb')
scene = mi.parser.parse_string(config, '<scene version="3.0.0"><shape type="sphere"><emitter type="shlight"/></shape></scene>')
try:
    mi.parser.instantiate(config, scene)
except RuntimeError as error:
    print(str(error).splitlines()[-1])
"""))
    assert "shlight: the variant 'scalar_rgb' is not active. Call mitsuba.set_variant('scalar_rgb') first." in words


def test_mathematics_is_imported_without_mitsuba_and_register_refuses():
    assert run("""
import sys
sys.modules['mitsuba'] = None
from mi_shlight import register
import mi_shlight.sh.basis, mi_shlight.light.project
try:
    register()
except ImportError:
    print('ImportError')
""") == ["ImportError"]
