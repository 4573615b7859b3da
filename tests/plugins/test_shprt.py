"""The integrator `shprt`: its pictures against Mitsuba's `direct`, its bakes, outputs, warnings and errors."""
import warnings

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

import reference
from shprt_scenes import (
    ARROW,
    GREY,
    QUICK,
    SCENES,
    SIZE,
    SQUARE,
    UNSHADOWED,
    block,
    camera,
    direct,
    emitter,
    fan,
    floor,
    integrator,
    level,
    light,
    mean_error,
    render,
    ring_light,
    scene,
)

import mi_shlight
from mi_shlight.errors import StaleTransferWarning, UnsupportedSceneWarning
from mi_shlight.shading.settings import parse_transfer

# --- pictures -----------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("parameters", [UNSHADOWED, {"max_edge": 0.5}, {"transfer_domain": "pixel"}], ids=["unshadowed", "vertex", "pixel"])
def test_floor(parameters):
    """Order 8 of an unoccluded floor: mean relative error below 1 % of a converged `direct` picture, whatever the transfer."""
    what = mi.load_file(str(SCENES / "floor.xml"), resx=SIZE, resy=SIZE, optimize=False)
    truth = direct(what, 2048)
    image = render(what, 16, order=8, **parameters)
    assert truth.min() > 0
    assert (np.abs(image - truth) / truth).mean() < 0.01


@pytest.fixture(scope="module")
def room():
    """A room of five walls with a block on the floor, seen from its open side; the light is out of view."""
    mi.set_variant("llvm_ad_rgb")
    walls = {"floor": floor(0, 1), "back": fan([[-1, 0, -1], [1, 0, -1], [1, 2, -1], [-1, 2, -1]], bsdf=GREY),
             "left": fan([[-1, 0, 1], [-1, 0, -1], [-1, 2, -1], [-1, 2, 1]], bsdf=GREY),
             "right": fan([[1, 0, -1], [1, 0, 1], [1, 2, 1], [1, 2, -1]], bsdf=GREY), "ceiling": floor(2, 1, up=False)}
    return scene(camera((0, 1, 4.5), (0, 0.6, 0), 22, 24), **walls, block=block([-0.5, 0, -0.5], [0.2, 0.8, 0.1]), light=light(1.98, 0.3))


@pytest.fixture(scope="module")
def room_truth(room):
    mi.set_variant("llvm_ad_rgb")
    return direct(room, 512)


@pytest.mark.parametrize("parameters, bound", [
    ({"order": 8, "max_edge": 0.15, "transfer_samples": 256}, 0.04),
    ({"order": 8, "transfer_domain": "pixel"}, 0.04)], ids=["vertex", "pixel"])
def test_room(room, room_truth, parameters, bound):
    """Shadows in a closed room: 2.7 % (vertex) and 2.9 % (pixel) measured. What is left is the band limit at the block's
    silhouettes and, per vertex, the blur of a cell."""
    image = render(room, 16, **parameters)
    error = mean_error(image, room_truth)
    assert error < bound
    assert mean_error(render(room, 16, order=8, **UNSHADOWED), room_truth) > 2 * error, "the block's shadow counts"


@pytest.mark.parametrize("make", [lambda: light(outline=ARROW, first=1), ring_light, lambda: light(scale=0.7, x=0.5)],
                         ids=["concave", "ring", "off centre"])
def test_shapes_of_lights(make):
    what = scene(floor=floor(), light=make())
    assert mean_error(render(what, 16, order=8, **UNSHADOWED), direct(what)) < 0.01


def bent_square(y, lift):
    """A square that faces down, with one corner lifted."""
    return [[0, y, 0], [1, y, 0], [1, y + lift, 1], [0, y, 1]]


@pytest.mark.parametrize("lift", [0.2, 0.6])
def test_bent_light(lift):
    """Corners need not lie in one plane: the faces count one by one."""
    what = scene(camera((0.5, 2.4, 3), (0.5, 0, 0.4)), floor=floor(x=0.5), light=fan(bent_square(1.5, lift), first=1, emitter=emitter()))
    for parameters in (UNSHADOWED, {"max_edge": 0.5}):
        with warnings.catch_warnings():
            warnings.simplefilter("error", UnsupportedSceneWarning)
            assert mean_error(render(what, 16, order=8, **parameters), direct(what)) < 0.01


@pytest.mark.parametrize("method", ["auto", "edge", "recurrence"])
def test_unshadowed_is_the_dot_product(method):
    """Order 8: reflectance times the clamped cosine's coefficients times those of the light, which are put out beside the picture."""
    what = scene(camera(size=4), floor=floor(), light=light(outline=ARROW, first=1), second=light(1.0, 0.3, x=1, radiance=(0, 1, 0)))
    plugin = integrator(order=8, coefficients=True, method=method, **UNSHADOWED)
    image = np.array(mi.render(what, integrator=plugin, spp=1, seed=0)).astype(float)
    l = np.arange(9)
    bands = np.repeat([1, 2 / 3, 1 / 4, 0, -1 / 24, 0, 1 / 64, 0, -1 / 128], 2 * l + 1)
    expected = 0.5 * image[..., 3:] @ (bands * reference.sh_basis((0, 1, 0), 8))
    assert expected.min() > 0.01
    np.testing.assert_allclose(image[..., :3] @ [0.212671, 0.715160, 0.072169], expected, rtol=1e-5)


@pytest.mark.parametrize("parameters", [UNSHADOWED, QUICK], ids=["unshadowed", "vertex"])
def test_area_lights_are_lights(parameters):
    """An existing scene needs no change: Mitsuba's own `area` gives the picture of `shlight`."""
    images = [render(scene(floor=floor(), block=block([0, 0, 0], [0.3, 0.5, 0.3]), light=light(plugin=plugin)), **parameters)
              for plugin in ("area", "shlight")]
    assert images[0].mean() > 0.01
    np.testing.assert_allclose(images[0], images[1], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("count", [2, 5])
def test_lights_add(count):
    """Up to four lights have a visibility each, more share one; without occluders both are sums over the lights."""
    lights = {f"light_{i}": light(1 + 0.2 * i, 0.2, x=i - 2, radiance=(1 + i, 2, 3 - 0.5 * i)) for i in range(count)}
    projected = {**QUICK, "localised": False}         # a fit depends on where all lights of a group are
    together = render(scene(floor=floor(), **lights), **projected)
    alone = [render(scene(floor=floor(), light=one), **projected) for one in lights.values()]
    assert min(image.mean() for image in alone) > 1e-3
    np.testing.assert_allclose(together, sum(alone), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("parameters", [UNSHADOWED, QUICK], ids=["unshadowed", "vertex"])
def test_lights_are_one_sided(parameters):
    """A light that faces away gives nothing, and its back is not seen."""
    assert (render(scene(floor=floor(), light=light(up=True, z=-9)), **parameters) == 0).all()
    assert (render(scene(camera((0, 3, 0.1), (0, 1.5, 0), 5), floor=floor(-5), light=light()), **parameters) == 0).all()


def test_light_seen_directly():
    what = scene(camera((0, 0.5, 0.1), (0, 1.5, 0), 5), floor=floor(), light=light(1.5))
    np.testing.assert_allclose(render(what, **UNSHADOWED), np.broadcast_to([3, 2, 1], (SIZE, SIZE, 3)), rtol=1e-6)


def test_reflectance():
    """The picture is proportional to the reflectance, colour by colour, at each point of a texture."""
    def picture(**bsdf):
        return render(scene(camera((0, 4, 0.01)), floor=mi.load_dict({
            "type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90), "bsdf": {"type": "diffuse", **bsdf}}),
            light=light(3, 0.5, x=2)), spp=1, **UNSHADOWED)

    white = picture(reflectance={"type": "rgb", "value": 1.0})
    np.testing.assert_allclose(picture(reflectance={"type": "rgb", "value": [0.2, 0.5, 0.8]}), white * [0.2, 0.5, 0.8], rtol=1e-4)
    board = picture(reflectance={"type": "checkerboard", "color0": {"type": "rgb", "value": 0.1}, "color1": {"type": "rgb", "value": 0.6}})
    ratio = board[white > 0] / white[white > 0]
    assert (white > 0).mean() > 0.1
    assert {round(float(r), 3) for r in np.unique(np.round(ratio, 3))} == {0.1, 0.6}


@pytest.mark.parametrize("parameters", [UNSHADOWED, QUICK, {"transfer_domain": "pixel"}], ids=["unshadowed", "vertex", "pixel"])
def test_two_sided(parameters):
    """A sheet lit from both sides, seen from both: one-sided, its back is black; `twosided`, it shows the light of its own side."""
    lights = {"above": light(1.5, radiance=(4, 0, 0)), "below": light(-1.5, up=True, radiance=(0, 2, 0))}
    for bsdf in (GREY, {"type": "twosided", "bsdf": GREY}):
        for height, channel in ((1.2, 0), (-1.2, 1)):
            what = scene(camera((0.01, height, 0), (0, 0, 0), 40), sheet=floor(0, 1.0, bsdf=bsdf), **lights)
            image = render(what, **parameters)
            if bsdf is GREY and height < 0:
                assert (image == 0).all()
            else:
                assert image[..., channel].min() > 0.01
                # unshadowed, the band-limited cosine is not quite zero below the horizon
                assert image[..., 1 - channel].max() <= (0.01 * image.max() if parameters is UNSHADOWED else 0)
                # the error of order 3, the lowest here
                assert mean_error(image, direct(what, 256)) < 0.06


@pytest.mark.parametrize("with_mesh", [False, True], ids=["alone", "with a mesh"])
def test_shapes_that_are_not_meshes(with_mesh):
    """Per vertex, a sphere has no vertices: rays at its hits take over."""
    parts = {"ball": mi.load_dict({"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5, "bsdf": GREY}), "light": light(2)}
    if with_mesh:
        parts["floor"] = floor()
    what = scene(camera((0, 2.4, 3), (0, 0.6, 0.2), 10), **parts)
    assert mean_error(render(what, 16, order=8, max_edge=1.0), direct(what, 512)) < 0.02


def test_lights_that_reflect():
    """A light's own surface is lit by other lights, per vertex as per pixel."""
    def picture(**parameters):
        bright = fan(level(SQUARE, 0.0, 1.0), bsdf=GREY, emitter=emitter(radiance=(0, 0.1, 0)))
        return render(scene(camera((0, 3, 0.01)), floor=floor(-1, 3), lit=bright, light=light(1, 0.3, x=1.5)), **parameters)

    truth = picture(order=3, **UNSHADOWED)[6:10, 6:10]
    assert truth[..., 0].min() > 0.005 and truth[..., 1].min() > 0.1
    for parameters in (QUICK, {"order": 3, "transfer_domain": "pixel"}):
        np.testing.assert_allclose(picture(localised=False, **parameters)[6:10, 6:10], truth, rtol=1e-3)


def test_pixel_domain_is_close_to_vertex_domain(room):
    vertex = render(room, 8, order=4, max_edge=0.15, transfer_samples=256)
    pixel = render(room, 8, order=4, transfer_domain="pixel", transfer_samples=64)
    assert mean_error(pixel, vertex) < 0.05


# --- baking, keeping, loading ---------------------------------------------------------------------------------------------------

def shadowed_scene(lift=0.0):
    return scene(floor=floor(), block=block([-0.3, 0.3 + lift, -0.3], [0.3, 0.6 + lift, 0.3]), light=light())


def test_transfer_file(tmp_path):
    """A baked file gives the picture of the bake; projected, also at a lower order than it holds; what it is not for is refused."""
    what, file = shadowed_scene(), {"transfer_file": str(tmp_path / "bake.npz")}
    for localised in (True, False):
        mi_shlight.bake_transfer(what, 3, samples=32, max_edge=1.0, localised=localised).save(tmp_path / "bake.npz")
        expected = render(what, localised=localised, **QUICK)
        assert expected.mean() > 0.01
        np.testing.assert_array_equal(render(what, order=3, **file), expected)
        if localised:
            with pytest.raises(Exception, match="'order' must be 3, that of .*bake.npz.*got 2.*own order only"):
                integrator(order=2, **file)
    lower = {**QUICK, "order": 2, "localised": False}
    np.testing.assert_array_equal(render(what, **file, **lower), render(what, **lower))
    with pytest.raises(Exception, match="'order' must be at most 3, that of .*bake.npz.*got 4.*Bake"):
        integrator(order=4, **file)
    with pytest.raises(Exception, match="'transfer' must be shadowed, that of .*bake.npz.*got 'exact'"):
        integrator(order=3, transfer="exact", **file)
    with pytest.raises(ValueError, match=r"Transfer.check\(\): 'scene' must have the geometry"):
        prepared(shadowed_scene(0.1), order=3, **file)


def test_transfer_file_and_what_it_does_not_hold(tmp_path):
    """Light at an infinite distance must have been there; gloss, and surfaces that have nothing else, need nothing of the file."""
    metal = {"type": "roughconductor", "alpha": 0.5}
    parts = {"floor": floor(), "light": light(), "block": block([-0.3, 0.3, -0.3], [0.3, 0.6, 0.3], metal)}
    what, sky = scene(**parts), scene(**parts, sky={"type": "constant", "radiance": 0.2})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnsupportedSceneWarning)
        mi_shlight.bake_transfer(what, 3, samples=32, max_edge=1.0).save(tmp_path / "bake.npz")
    file = {"transfer_file": str(tmp_path / "bake.npz"), "order": 3, "bsdf_order": 3, "visibility_order": 1, "max_edge": 1.0,
            "transfer_samples": 32, "transfer": "shadowed+glossy"}
    np.testing.assert_array_equal(render(what, **file), render(what, **{**file, "transfer_file": ""}))
    with pytest.raises(ValueError, match="'transfer_file' must be the bake of a scene with light at an infinite distance"):
        prepared(sky, **file)


def test_transfer_file_beside_the_scene(tmp_path):
    """Its path is relative to the scene's folder."""
    (tmp_path / "floor.xml").write_text((SCENES / "floor.xml").read_text().replace(
        '<integrator type="shprt">', '<integrator type="shprt"><string name="transfer_file" value="floor.npz"/>'))
    what = mi.load_file(str(SCENES / "floor.xml"), optimize=False)
    mi_shlight.bake_transfer(what, 2, samples=16, max_edge=4.0).save(tmp_path / "floor.npz")
    loaded = mi.load_file(str(tmp_path / "floor.xml"), order=2, resx=8, resy=8, optimize=False)
    assert np.array(mi.render(loaded, spp=1)).mean() > 0.01


@pytest.mark.parametrize("parameters, text", [
    ({"transfer_file": "nowhere.npz"}, "'transfer_file' must name an existing file, got 'nowhere.npz'.*mi-shlight bake"),
    ({"transfer_file": str(SCENES / "floor.xml")}, "written by Transfer.save.*floor.xml"),
    ({"transfer_file": str(SCENES / "floor.xml"), "transfer": "unshadowed"}, "'transfer_file' must go with transfer that is baked"),
    ({"transfer_file": str(SCENES / "floor.xml"), "transfer_domain": "pixel"}, "'transfer_file' must go with"),
])
def test_bad_transfer_file(parameters, text):
    with pytest.raises(Exception, match=text):
        integrator(**parameters)


def prepared(what, **parameters):
    plugin = integrator(**parameters)
    plugin.prepare_scene(what, False)
    return plugin


def test_bake_is_kept_until_geometry_moves():
    what = shadowed_scene()
    plugin = integrator(**QUICK)
    first = plugin.prepare_scene(what, False)
    parameters = mi.traverse(what)
    parameters["floor.bsdf.reflectance.value"] = mi.Color3f(0.9, 0.1, 0.1)
    parameters["light.emitter.radiance.value"] = mi.Color3f(1, 1, 9)
    parameters.update()
    assert plugin.prepare_scene(what, False) is first, "colours are no part of a bake"
    parameters["block.vertex_positions"] = parameters["block.vertex_positions"] + 0.2
    parameters.update()
    second = plugin.prepare_scene(what, False)
    assert second is not first
    assert np.abs(second.visibility - first.visibility).max() > 0.1
    assert plugin.prepare_scene(what, False) is second


def test_bake_is_renewed_when_a_ball_moves():
    ball = mi.load_dict({"type": "sphere", "center": [0, 0.7, 0], "radius": 0.4})
    what = scene(floor=floor(), ball=ball, light=light())
    plugin = integrator(**QUICK)
    first = plugin.prepare_scene(what, False)
    parameters = mi.traverse(what)
    parameters["ball.to_world"] = mi.Transform4f().translate([1.5, 0, 0]) @ parameters["ball.to_world"]
    parameters.update()
    assert plugin.prepare_scene(what, False) is not first
    np.testing.assert_array_equal(np.array(mi.render(what, integrator=plugin, spp=2, seed=0)), render(what, 2, **QUICK))


def test_one_integrator_for_two_scenes():
    plugin, one, two = integrator(**QUICK), shadowed_scene(), shadowed_scene(0.3)
    images = [np.array(mi.render(what, integrator=plugin, spp=2, seed=0)) for what in (one, two, one)]
    assert np.abs(images[0] - images[1]).max() > 0.01
    np.testing.assert_array_equal(images[0], images[2])


def moved_light(strict=False, margin=0.1, by=0.05):
    what = shadowed_scene()
    plugin = prepared(what, light_margin=margin, strict=strict, **QUICK)
    first = plugin.prepare_scene(what, False)
    parameters = mi.traverse(what)
    shift = mi.Float([by, 0, 0] * 4)
    parameters["light.vertex_positions"] = parameters["light.vertex_positions"] + shift
    parameters.update()
    return what, plugin, first


def test_light_within_its_margin():
    what, plugin, first = moved_light()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plugin.prepare_scene(what, False) is first


def test_light_beyond_its_margin():
    what, plugin, first = moved_light(by=0.25)
    with pytest.warns(StaleTransferWarning, match="moved by 0.25 .*light_margin = 0.1.*baking again"):
        second = plugin.prepare_scene(what, False)
    assert second is not first
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plugin.prepare_scene(what, False) is second


def test_light_beyond_its_margin_under_strict():
    what, plugin, _ = moved_light(strict=True, by=0.25)
    with pytest.raises(ValueError, match="moved by 0.25 .*light_margin = 0.1.*'strict'"):
        plugin.prepare_scene(what, False)


# --- what is left out -----------------------------------------------------------------------------------------------------------

LEFT_OUT = {
    "sphere light": ({"odd": {"type": "sphere", "center": [9, 9, 9], "emitter": {"type": "area"}}}, "sphere|Sphere"),
    "sun": ({"odd": {"type": "sunsky", "sun_scale": 1.0}}, "odd.*the disc of its sun"),
    "metal": ({"odd": {"type": "sphere", "center": [9, 9, 9], "bsdf": {"type": "roughconductor"}}}, "black"),
    "plastic": ({"odd": {"type": "sphere", "center": [9, 9, 9], "bsdf": {"type": "plastic"}}}, "only its diffuse reflection"),
    "bump map": ({"odd": {"type": "sphere", "center": [9, 9, 9], "bsdf": {
        "type": "bumpmap", "texture": {"type": "checkerboard"}, "bsdf": {"type": "diffuse"}}}}, "perturbed normals"),
    "mask": ({"odd": {"type": "sphere", "center": [9, 9, 9], "bsdf": {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse"}}}},
             "opacity"),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_left_out_by_name(name):
    parts, text = LEFT_OUT[name]
    what = scene(floor=floor(), light=light(), **parts)
    with pytest.warns(UnsupportedSceneWarning, match=text) as caught:
        plugin = prepared(what, **UNSHADOWED)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plugin.prepare_scene(what)
    with pytest.raises(ValueError, match=f"(?s)({text}).*'strict'"):
        prepared(what, strict=True, **UNSHADOWED)


def test_plain_scene_has_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prepared(scene(floor=floor(), light=light()), strict=True, **QUICK)


def test_what_has_no_diffuse_part_is_black():
    with pytest.warns(UnsupportedSceneWarning, match="black"):
        image = render(scene(floor=floor(bsdf={"type": "roughconductor"}), light=light()), **UNSHADOWED)
    assert (image == 0).all()


def test_plastic_shows_its_diffuse_part():
    plastic = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.5}}
    with pytest.warns(UnsupportedSceneWarning):
        image = render(scene(floor=floor(bsdf=plastic), light=light()), **UNSHADOWED)
    assert image.min() > 0


@pytest.mark.parametrize("parts, text", [
    ({}, "must have a light, got none.*shlight"),
    ({"light": "needle"}, "'light' must be a mesh with finite vertices and an area, got one without"),
], ids=["no light", "no area"])
def test_scenes_that_cannot_be_lit(parts, text):
    if parts.get("light") == "needle":
        parts = {"light": fan([[0, 1, 0], [1, 1, 0], [2, 1, 0]], emitter=emitter())}
    with pytest.raises(Exception, match=text):
        prepared(scene(floor=floor(), **parts), **UNSHADOWED)


def test_no_light_at_render():
    """The reason reaches the user through Mitsuba's layers."""
    with pytest.raises(Exception) as caught:
        mi.render(scene(floor=floor()), integrator=integrator(**UNSHADOWED), spp=1)
    error = caught.value
    while error.__cause__ is not None:
        error = error.__cause__
    assert "must have a light" in str(error)


@pytest.mark.parametrize("parameters, text", [
    ({"ordr": 8}, "'ordr' must be a parameter of 'shprt'.*Did you mean 'order'"),
    ({"quality": 3}, "'quality' must be a parameter.*'order'.*'transfer'"),
    ({"order": -1}, "'order' must be an integer from 0 to 64, got -1"),
    ({"order": 3.5}, "'order' must be an integer from 0 to 64, got 3.5"),
    ({"order": 10_000}, "'order' must be an integer from 0 to 64, got 10000"), ({"order": "8"}, "'order' must be.*got '8'"),
    ({"order": True}, "'order' must be.*got True"), ({"method": "exact"}, "'method' must be one of 'auto', 'recurrence'.*'exact'"),
    ({"method": 1}, "'method' must"), ({"transfer": "shiny"}, "'transfer' must be one of 'unshadowed', 'shadowed'.*'shiny'"),
    ({"transfer": "exact+shadowed"}, "'transfer' must be.*one base"), ({"transfer": "glossy+glossy"}, "'transfer' must be"),
    ({"transfer": "unshadowed+interreflected"}, "'transfer' must not join"), ({"transfer": 3}, "'transfer' must be text"),
    ({"transfer": "interreflected", "transfer_domain": "pixel"}, "'transfer_domain' must be vertex with interreflected"),
    ({"window": "box"}, "'window' must be one of"), ({"bounces": -1}, "'bounces' must"), ({"bounce_samples": 0}, "'bounce_samples' must"),
    ({"bounce_tolerance": 0.0}, "'bounce_tolerance' must"), ({"bounce_lighting": "x"}, "'bounce_lighting' must be one of"),
    ({"visibility_order": -1}, "'visibility_order' must"), ({"bsdf_order": 80}, "'bsdf_order' must"),
    ({"localised": 1}, "'localised' must"),
    ({"transfer": "glossy", "bsdf_order": 62}, "'bsdf_order' must be at most 64 together with visibility_order.*62 and 4"),
    ({"transfer_domain": "texel"}, "'transfer_domain' must be one of 'vertex', 'pixel', got 'texel'"),
    ({"transfer_samples": -5}, "'transfer_samples' must be.*got -5"), ({"transfer_samples": 70_000}, "'transfer_samples' must"),
    ({"transfer_samples": 1.5}, "'transfer_samples' must be an integer.*1.5"), ({"transfer_file": 3}, "'transfer_file' must be the path"),
    ({"max_edge": -1.0}, "'max_edge' must be.*got -1"), ({"max_edge": "1"}, "'max_edge' must"),
    ({"light_margin": -0.1}, "'light_margin' must"),
    ({"strict": 1}, "'strict' must be true or false, got 1"), ({"coefficients": "yes"}, "'coefficients' must be true or false, got 'yes'"),
])
def test_bad_parameters(parameters, text):
    with pytest.raises(Exception, match=text):
        integrator(**parameters)


@pytest.mark.parametrize("text, expected", [
    ("unshadowed", ("unshadowed", False, False)), ("glossy", ("shadowed", False, True)), ("interreflected", ("shadowed", True, False)),
    ("glossy + exact+interreflected", ("exact", True, True)), ("unshadowed+glossy", ("unshadowed", False, True)),
])
def test_transfer_is_a_sum_of_parts(text, expected):
    assert parse_transfer("shprt", text) == expected


def test_parameters_can_be_read_back():
    given = {"order": 3, "transfer_samples": 99, "light_margin": 0.5, "strict": True}
    plugin = integrator(**given)
    assert {name: plugin.parameters()[name] for name in given} == given
    assert integrator(**plugin.parameters()).parameters() == plugin.parameters()
    assert "order = 3" in str(plugin) and "transfer = 'shadowed'" in str(plugin)


# --- radiance, variants, outputs ---------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_spectral_polarized"])
@pytest.mark.parametrize("textured", [False, True], ids=["uniform", "textured"])
def test_variants(variant, textured):
    """The picture of `direct` in every kind of variant, of a light with a texture, too."""
    mi.set_variant(variant)
    board = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.9, 0.5, 0.1]}, "color1": {"type": "rgb", "value": 0.2},
             "to_uv": mi.ScalarTransform4f().scale([4, 4, 1])}
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 2.5, 0]).rotate([1, 0, 0], 90).scale(0.4),
            "emitter": {"type": "shlight", "radiance": board, "subdivisions": 32} if textured else emitter()}
    what = scene(floor=floor(bsdf={"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}}), light=lamp)
    truth = direct(what, 1024)
    image = render(what, 256, order=6, **UNSHADOWED)
    # spectral pictures also carry the noise of the wavelengths
    assert mean_error(image, truth) < (0.03 if mi.is_spectral else 0.012)


def test_scalar_variants_are_refused():
    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError, match="shprt: this integrator needs a JIT variant such as 'llvm_ad_rgb', got 'scalar_rgb'"):
        integrator()


def test_coefficients():
    """The AOVs are the coefficients of the light at the hit, times the luminance of its radiance."""
    what = scene(camera(size=4), floor=floor(), light=light(), second=light(1.0, 0.3, x=1, radiance=(0, 1, 0)))
    plugin = integrator(order=3, coefficients=True, **UNSHADOWED)
    names = [f"L.{l}.{m}" for l in range(4) for m in range(-l, l + 1)]
    assert plugin.aov_names() == names
    image = np.array(mi.render(what, integrator=plugin, spp=1, seed=0))
    np.testing.assert_array_equal(image[..., :3], render(what, 1, order=3, **UNSHADOWED))
    # positions of the same samples, by Mitsuba's own integrator
    positions = np.array(mi.render(what, integrator=mi.load_dict({"type": "aov", "aovs": "p:position"}), spp=1, seed=0))[..., -3:]
    on_floor = np.abs(positions).max(axis=-1) <= 2.0001
    hit = on_floor & (image[..., :3].sum(axis=-1) > 0)
    assert hit.sum() >= 4
    for p, coeffs in zip(positions[hit], image[hit][:, 3:]):
        expected = 0
        for corners, luminance in ((level(SQUARE, 1.5, 0.4), [3, 2, 1]), (level(SQUARE, 1.0, 0.3, x=1), [0, 1, 0])):
            weight = float(mi.luminance(mi.Color3f(luminance))[0])
            expected = expected + weight * np.array(mi_shlight.project_polygon(corners.tolist(), p.tolist(), 3))
        np.testing.assert_allclose(coeffs, expected, rtol=2e-3, atol=2e-5)


def test_nested_in_aov():
    what = scene(floor=floor(), light=light())
    plugin = mi.load_dict({"type": "aov", "aovs": "d:depth", "image": {"type": "shprt", **UNSHADOWED}})
    image = np.array(mi.render(what, integrator=plugin, spp=64, seed=0))
    assert image.shape[-1] == 4 and image[..., 3].min() > 1
    assert mean_error(image[..., :3], render(what, 64, **UNSHADOWED)) < 0.01


def test_same_seed_same_picture(room):
    for parameters in (QUICK, {"order": 2, "transfer_domain": "pixel", "transfer_samples": 16}):
        first, second = (render(room, 2, seed=5, **parameters) for _ in range(2))
        np.testing.assert_allclose(first, second, rtol=1e-5, atol=1e-6)
        assert np.abs(first - render(room, 2, seed=6, **parameters)).max() > 1e-3


def test_crop_window():
    sensor = camera(size=32)
    sensor["film"].update(crop_offset_x=8, crop_offset_y=12, crop_width=16, crop_height=8)
    part = render(scene(sensor, floor=floor(), light=light()), 64, **UNSHADOWED)
    whole = render(scene(camera(size=32), floor=floor(), light=light()), 64, **UNSHADOWED)
    assert part.shape == (8, 16, 3)
    np.testing.assert_allclose(part[1:-1, 1:-1], whole[12:20, 8:24][1:-1, 1:-1], atol=0.02 * whole.max())


def test_alpha():
    """One on surfaces, zero beside them."""
    image = render(scene(camera((0, 3, 0.01), fov=60, pixels="rgba"), floor=floor(scale=0.5), light=light(9)), 4, **UNSHADOWED)
    assert image[SIZE // 2, SIZE // 2, 3] == 1 and image[0, 0, 3] == 0
    assert (image[image[..., 3] == 0][:, :3] == 0).all()


def test_written_and_loaded_scene(tmp_path):
    """The same scene as XML and as a dictionary."""
    loaded = mi.load_file(str(SCENES / "floor.xml"), resx=SIZE, resy=SIZE, spp=2, order=4, optimize=False)
    plugin = loaded.integrator()
    assert plugin.order == 4
    same = mi.load_dict({
        "type": "scene", "sensor": loaded.sensors()[0],
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(4),
                  "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}},
        "light": {"type": "rectangle",
                  "to_world": mi.ScalarTransform4f().translate([0.3, 2.5, -0.2]).rotate([1, 0, 0], 90).scale([0.7, 0.5, 1]),
                  "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.5, 8.0]}}}}, optimize=False)
    np.testing.assert_allclose(render(loaded, 2, order=4, **UNSHADOWED), render(same, 2, order=4, **UNSHADOWED), rtol=1e-4)
