"""The emitter `shlight` against Mitsuba's `area`: images, gradients, parameters, and the errors for bad input.

Images are compared bit for bit. That takes one thread: with several, Mitsuba's film adds the samples of a pixel in an
order that changes from run to run, with `area` too. (One thread while rendering only: Mitsuba waits forever when it
loads a bitmap with one.)
"""
from contextlib import contextmanager

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from mi_shlight import register  # noqa: E402
from mi_shlight.plugins import shlight  # noqa: E402

SIZE = 12

RADIANCE = {
    "default": '',
    "rgb": '<rgb name="radiance" value="3, 2, 1"/>',
    "number": '<float name="radiance" value="2"/>',
    "uniform": '<spectrum name="radiance" value="1.5"/>',
    "samples": '<spectrum name="radiance" value="400:1, 500:2, 700:1.5"/>',
    "d65": '<spectrum name="radiance" type="d65"><float name="scale" value="2"/></spectrum>',
    "checkerboard": '<texture name="radiance" type="checkerboard"><transform name="to_uv"><scale value="4"/></transform></texture>',
    "bitmap": '<texture name="radiance" type="bitmap"><string name="filename" value="{folder}/light.exr"/></texture>',
}

SHAPES = {
    "rectangle": '<shape type="rectangle" id="light"><transform name="to_world"><scale value="0.5"/><rotate x="1" angle="60"/>'
                 '<translate y="1.2" z="-0.3"/></transform>{emitter}</shape>',
    "triangle": '<shape type="obj" id="light"><string name="filename" value="{folder}/triangle.obj"/>{emitter}</shape>',
    "cube": '<shape type="cube" id="light"><transform name="to_world"><scale value="0.2"/><rotate y="1" angle="30"/>'
            '<translate y="0.9"/></transform>{emitter}</shape>',
    "sphere": '<shape type="sphere" id="light"><float name="radius" value="0.3"/>'
              '<point name="center" x="0" y="1" z="0"/>{emitter}</shape>',
}

SCENE = """
<scene version="3.0.0">
    <integrator type="{integrator}"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 1.2, 3" target="0, 0.5, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="{size}"/><integer name="height" value="{size}"/>
            <string name="pixel_format" value="{pixels}"/>
        </film>
    </sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/></transform></shape>
    <shape type="sphere"><float name="radius" value="0.3"/><point name="center" x="0.5" y="0.3" z="0.2"/></shape>
    {lights}
</scene>
"""

# All kinds of radiance and of shapes in one variant; in the others, what depends on the type of spectra.
ALL = [("rectangle", radiance) for radiance in RADIANCE] + [
    ("triangle", "rgb"), ("triangle", "bitmap"), ("cube", "rgb"), ("sphere", "d65"), ("sphere", "checkerboard")]
SOME = [("rectangle", "d65"), ("rectangle", "bitmap"), ("triangle", "rgb"), ("cube", "number"), ("sphere", "default")]
CASES = [("llvm_ad_rgb", *case) for case in ALL] + [
    (variant, *case)
    for variant in ("llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_spectral_polarized", "cuda_ad_rgb", "cuda_ad_spectral")
    for case in SOME]
INTEGRATORS = ("path", "direct", "volpath", "prb", "ptracer")
# Every radiance with one integrator, every integrator with some; two ways to sample in other variants. The particle tracer samples
# wavelengths, which Mitsuba's textures cannot do: its area light fails there too.
IMAGES = [(*case, integrator) for case in CASES for integrator in INTEGRATORS
          if (integrator == "path" or case[1:] in SOME) and (case[0] == "llvm_ad_rgb" or integrator in ("path", "ptracer"))
          and not (integrator == "ptracer" and case[2] in ("checkerboard", "bitmap"))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files that the scenes refer to."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "triangle.obj").write_text(
        "v -0.5 0.8 0\nv 0.6 0.9 0.1\nv 0.1 1.5 -0.3\nvt 0.1 0.1\nvt 0.9 0.2\nvt 0.4 0.9\nf 1/1 2/2 3/3\n")
    set_variant("scalar_rgb")
    pixels = np.random.default_rng(1).uniform(0.1, 2, (4, 5, 3)).astype(np.float32)
    mi.Bitmap(pixels).write(str(folder / "light.exr"))
    return folder


@contextmanager
def one_thread():
    count = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(count)


def set_variant(variant):
    backend = {"cuda": dr.JitBackend.CUDA, "llvm": dr.JitBackend.LLVM}.get(variant.split("_")[0])
    if backend is not None and not dr.has_backend(backend):
        pytest.skip(f"{variant} does not run on this machine")
    register()
    mi.set_variant(variant)


def load(folder, integrator, lights, size=SIZE):
    pixels = "luminance" if mi.is_monochromatic else "rgb"
    return mi.load_string(SCENE.format(integrator=integrator, size=size, pixels=pixels, lights=lights), optimize=False)


def light(folder, plugin, shape, radiance, more=""):
    emitter = f'<emitter type="{plugin}">{RADIANCE[radiance]}{more}</emitter>'
    return SHAPES[shape].replace("{emitter}", emitter).replace("{folder}", str(folder))


def image(scene, spp=4):
    with one_thread():
        pixels = np.array(mi.render(scene, spp=spp, seed=3))
    assert np.isfinite(pixels).all()
    assert pixels.mean() > 0.01, "an image this dark compares nothing"
    return pixels


@pytest.mark.parametrize("variant, shape, radiance, integrator", IMAGES)
def test_same_image_as_area(folder, variant, shape, radiance, integrator):
    set_variant(variant)
    expected = image(load(folder, integrator, light(folder, "area", shape, radiance)))
    found = image(load(folder, integrator, light(folder, "shlight", shape, radiance)))
    if variant.startswith("cuda"):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * expected.max())
    else:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("shape, radiance", [("rectangle", "number"), ("triangle", "bitmap")])
def test_same_image_as_area_in_a_scalar_variant(folder, shape, radiance):
    set_variant("scalar_rgb")
    expected, found = (image(load(folder, "direct", light(folder, plugin, shape, radiance), size=6), spp=1)
                       for plugin in ("area", "shlight"))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * expected.max())


def test_light_seen_from_its_front_shows_its_radiance_and_its_back_is_dark(folder):
    set_variant("llvm_ad_rgb")
    scene = load(folder, "path", light(folder, "shlight", "rectangle", "rgb"))
    emitter = scene.emitters()[0]
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.wi = mi.Vector3f([0.6, 0], [0, 0.6], [0.8, -0.8])
    np.testing.assert_array_equal(np.array(emitter.eval(si)), [[3, 0], [2, 0], [1, 0]])


SCREEN = ('<shape type="rectangle"><transform name="to_world"><scale x="0.5" y="0.5" z="{z}"/><rotate y="1" angle="90"/>'
          '<translate y="0.6"/></transform>{emitter}</shape>')


def screen(radiance, z=1, more=""):
    """A light that stands upright on the floor and shines to its right, to its left if `z` is -1."""
    return SCREEN.format(z=z, emitter=f'<emitter type="shlight">{RADIANCE[radiance]}{more}</emitter>')


@pytest.mark.parametrize("integrator", ["path", "direct", "prb", "ptracer"])
@pytest.mark.parametrize("radiance", ["rgb", "checkerboard"])
def test_two_sided_light_is_two_lights_back_to_back(folder, integrator, radiance):
    """The sum of the pictures of its two sides."""
    if integrator == "ptracer" and radiance == "checkerboard":
        pytest.skip("the particle tracer samples no wavelengths of textures")
    set_variant("llvm_ad_rgb")
    lights = [screen(radiance, more='<boolean name="two_sided" value="true"/>'), screen(radiance), screen(radiance, -1)]
    found, right, left = (np.array(mi.render(load(folder, integrator, text), spp=512, seed=3)) for text in lights)
    assert right.mean() > 1e-3 and left.mean() > 1e-3
    assert np.abs(right - left).mean() > 0.5 * right.mean()
    assert np.abs(found - right - left).mean() < 0.05 * found.mean()
    assert found.mean() == pytest.approx(right.mean() + left.mean(), rel=0.01)


@pytest.mark.parametrize("radiance", ["rgb", "checkerboard"])
def test_methods_of_a_two_sided_light(folder, radiance):
    """Radiance on both sides; a sampled point belongs to either, with half the density."""
    set_variant("llvm_ad_rgb")
    more = '<boolean name="two_sided" value="true"/>'
    scenes = [load(folder, "path", screen(radiance, more=text)) for text in (more, "")]
    ours, plain = (scene.emitters()[0] for scene in scenes)
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.wi, si.uv = mi.Vector3f([0.6, 0, 1], [0, 0.6, 0], [0.8, -0.8, 0]), mi.Point2f(0.1, 0.1)
    seen = np.array(ours.eval(si))
    np.testing.assert_array_equal(seen[:, 0], seen[:, 1])
    assert seen[:, 0].min() > 0 and not seen[:, 2].any()
    rng = mi.PCG32(256)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ps, weight = ours.sample_position(0, sample)
    facing = np.array(dr.dot(ps.n, plain.sample_position(0, sample)[0].n))
    assert 0.4 < (facing > 0.99).mean() < 0.6 and (np.abs(facing) > 0.99).all()
    np.testing.assert_allclose(np.array(weight * ours.pdf_position(ps)), 1, rtol=1e-5)
    np.testing.assert_allclose(np.array(ours.pdf_position(ps)), 0.5 * np.array(plain.pdf_position(ps)), rtol=1e-6)
    it = dr.zeros(mi.Interaction3f, 256)
    for side in (1, -1):
        it.p = mi.Point3f(side, 0.5, 0.2)
        ds, spectrum = ours.sample_direction(it, sample)
        assert dr.all(ds.pdf > 0)
        np.testing.assert_allclose(np.array(ours.pdf_direction(it, ds)), np.array(ds.pdf), rtol=1e-5)
        np.testing.assert_allclose(np.array(spectrum * ds.pdf), np.array(ours.eval_direction(it, ds)), rtol=1e-5)


def test_sampling_weight_steers_samples_as_with_area(folder):
    set_variant("llvm_ad_rgb")

    def lights(plugin, weight):
        heavy = light(folder, plugin, "rectangle", "rgb", f'<float name="sampling_weight" value="{weight}"/>')
        return heavy + light(folder, plugin, "sphere", "number").replace('id="light"', 'id="other"')

    found = image(load(folder, "direct", lights("shlight", 5)))
    np.testing.assert_array_equal(found, image(load(folder, "direct", lights("area", 5))))
    assert not np.array_equal(found, image(load(folder, "direct", lights("shlight", 1))))


@pytest.mark.parametrize("radiance", ["rgb", "bitmap"])
def test_methods_agree_with_area_call_by_call(folder, radiance):
    set_variant("llvm_ad_rgb")
    # The scenes must outlive the emitters: those do not keep their shapes alive.
    scenes = [load(folder, "path", light(folder, plugin, "triangle", radiance)) for plugin in ("shlight", "area")]
    ours, theirs = (scene.emitters()[0] for scene in scenes)
    rng = mi.PCG32(64)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    ps, weight = ours.sample_position(0.5, sample)
    expected_ps, expected_weight = theirs.sample_position(0.5, sample)
    np.testing.assert_array_equal(np.array(weight), np.array(expected_weight))
    # A sample of the texture beside the triangle is no point of the light: its weight is 0, the rest undefined.
    found = np.broadcast_to(np.array(weight) > 0, 64)
    assert found.sum() > 15
    np.testing.assert_array_equal(np.array(ps.p)[:, found], np.array(expected_ps.p)[:, found])
    # Mitsuba's area light cannot tell this density; the one it sampled with is the reference.
    densities = [np.broadcast_to(np.array(pdf), 64)[found] for pdf in (ours.pdf_position(ps), expected_ps.pdf)]
    np.testing.assert_allclose(*densities, rtol=1e-5)

    it = dr.zeros(mi.Interaction3f, 64)
    it.p = mi.Point3f(0.2, 0.1, 2)
    ds, spectrum = ours.sample_direction(it, sample)
    assert dr.count(ds.pdf > 0)[0] > 20
    np.testing.assert_array_equal(np.array(ours.pdf_direction(it, ds)), np.array(theirs.pdf_direction(it, ds)))
    np.testing.assert_array_equal(np.array(ours.eval_direction(it, ds)), np.array(theirs.eval_direction(it, ds)))
    np.testing.assert_allclose(np.array(spectrum * ds.pdf), np.array(ours.eval_direction(it, ds)), rtol=1e-5, atol=1e-6)
    assert str(ours.bbox()) == str(theirs.get_shape().bbox())


def gradient(scene, key, weights, **options):
    parameters = mi.traverse(scene)
    value = type(parameters[key])(parameters[key])
    dr.enable_grad(value)
    parameters[key] = value
    parameters.update()
    with one_thread():
        dr.backward(dr.mean(mi.render(scene, parameters, spp=8, seed=5, **options) * weights, axis=None))
        return np.array(dr.grad(value)).ravel()


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
@pytest.mark.parametrize("radiance, key", [("rgb", "value"), ("bitmap", "data")])
def test_gradient_of_the_radiance_equals_that_of_area(folder, variant, radiance, key):
    set_variant(variant)
    weights = mi.TensorXf(np.random.default_rng(2).uniform(0.5, 1.5, (SIZE, SIZE, 3)).astype(np.float32))
    key = f"light.emitter.radiance.{key}"
    expected, found = (gradient(load(folder, "prb", light(folder, plugin, "rectangle", radiance)), key, weights)
                       for plugin in ("area", "shlight"))
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_gradient_of_the_radiance_is_the_image_of_unit_radiance(folder):
    """An image is linear in the radiance: the derivative needs no second renderer to check."""
    set_variant("llvm_ad_rgb")
    weights = np.random.default_rng(2).uniform(0.5, 1.5, (SIZE, SIZE, 3)).astype(np.float32)
    scene = load(folder, "prb", light(folder, "shlight", "rectangle", "rgb"))
    found = gradient(scene, "light.emitter.radiance.value", mi.TensorXf(weights), seed_grad=77)
    unit = np.array(mi.render(scene, spp=8, seed=77)) / [3, 2, 1]
    np.testing.assert_allclose(found, (unit * weights).sum(axis=(0, 1)) / weights.size, rtol=1e-4)


def test_changed_radiance_is_used_at_the_next_render(folder):
    set_variant("llvm_ad_rgb")
    scene = load(folder, "path", light(folder, "shlight", "cube", "rgb"))
    image(scene)
    parameters = mi.traverse(scene)
    parameters["light.emitter.radiance.value"] = mi.Color3f(2, 2, 2)
    parameters.update()
    np.testing.assert_array_equal(image(scene), image(load(folder, "path", light(folder, "shlight", "cube", "number"))))


def test_parameters_and_flags_are_those_of_area(folder):
    set_variant("llvm_ad_rgb")
    for radiance in ("rgb", "bitmap"):
        scenes = [load(folder, "path", light(folder, plugin, "rectangle", radiance)) for plugin in ("shlight", "area")]
        ours, theirs = ([key for key in mi.traverse(scene).keys() if key.startswith("light.")] for scene in scenes)
        assert ours == theirs
        assert f"light.emitter.radiance.{'value' if radiance == 'rgb' else 'data'}" in ours
        assert scenes[0].emitters()[0].flags() == scenes[1].emitters()[0].flags()
        image(scenes[0])
        assert scenes[0].emitters_dr().flags() == scenes[1].emitters_dr().flags()


def test_medium_inside_the_light_is_accepted(folder):
    set_variant("llvm_ad_rgb")
    scene = load(folder, "volpath", light(folder, "shlight", "rectangle", "rgb", '<medium type="homogeneous"/>'))
    assert scene.emitters()[0].get_medium() is not None
    assert "medium = Homogeneous" in str(scene.emitters()[0])


def test_description(folder):
    set_variant("llvm_ad_rgb")
    scene = load(folder, "path", light(folder, "shlight", "rectangle", "rgb"))
    text = str(scene.emitters()[0])
    assert text.startswith("SHLight[") and "Rectangle 'light'" in text and "surface_area = 1" in text
    assert "[3, 2, 1]" in text and "two_sided = false" in text and "subdivisions" not in text
    textured = load(folder, "path", light(folder, "shlight", "rectangle", "checkerboard", '<integer name="subdivisions" value="32"/>'))
    assert "subdivisions = 32" in str(textured.emitters()[0])
    assert "it must be inside a shape" in str(mi.load_dict({"type": "shlight"}))


BAD = [
    ('<transform name="to_world"><translate x="1"/></transform>', ["'to_world' must not be given", "move 'to_world' to the shape"]),
    ('<string name="radiance" value="bright"/>', ["'radiance' must be a spectrum, a texture or a number", "got 'bright'"]),
    ('<bsdf name="radiance" type="diffuse"/>', ["'radiance' must be a spectrum, a texture or a number"]),
    ('<boolean name="radiance" value="true"/>', ["'radiance' must be", "got True"]),
    ('<vector name="radiance" value="1, 2, 3"/>', ["'radiance' must be", '<rgb name="radiance"']),
    ('<rgb name="radiace" value="1, 2, 3"/>', ["'radiace'", "Did you mean 'radiance'?"]),
    ('<string name="two_sided" value="yes"/>', ["'two_sided' must be true or false", "got 'yes'"]),
    ('<integer name="subdivisions" value="0"/>', ["'subdivisions' must be an integer from 1 to 65536", "got 0"]),
    ('<float name="subdivisions" value="2.5"/>', ["'subdivisions' must be an integer", "got 2.5"]),
    ('<integer name="order" value="8"/>', ["'order'", "got '8'", "Its parameters are 'radiance'"]),
]


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
@pytest.mark.parametrize("bad, parts", BAD)
def test_bad_input_is_explained_at_loading(folder, variant, bad, parts):
    set_variant(variant)
    with pytest.raises(RuntimeError) as caught:
        load(folder, "path", f'<shape type="rectangle"><emitter type="shlight">{bad}</emitter></shape>')
    paragraph = str(caught.value).strip().splitlines()[-1]
    for part in ["shlight(): ", *parts]:
        assert part in paragraph


def causes(error):
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


@pytest.mark.parametrize("variant, integrator", [
    ("scalar_rgb", "path"), ("llvm_ad_rgb", "path"), ("llvm_ad_rgb", "prb"), ("llvm_ad_rgb", "ptracer"), ("llvm_ad_spectral", "direct")])
@pytest.mark.parametrize("other", [False, True])
def test_light_outside_a_shape_stops_the_render(folder, variant, integrator, other):
    set_variant(variant)
    lights = '<emitter type="shlight" id="lamp"/>' + (light(folder, "area", "cube", "rgb") if other else "")
    scene = load(folder, integrator, lights)
    with pytest.raises(RuntimeError) as caught:
        mi.render(scene, spp=1)
    detached = [error for error in causes(caught.value) if isinstance(error, shlight.DetachedLightError)]
    assert detached and "must be inside a shape" in str(detached[0]) and "'lamp'" in str(detached[0])
    with pytest.raises(shlight.DetachedLightError, match="Move the <emitter> into a <shape>"):
        shlight.check_attached(scene)


def test_attached_lights_pass_the_check(folder):
    set_variant("llvm_ad_rgb")
    shlight.check_attached(load(folder, "path", light(folder, "shlight", "cube", "rgb") + '<emitter type="constant"/>'))
