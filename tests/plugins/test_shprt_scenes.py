"""`shprt` on the scenes people really have: turned normals, black shapes, instances, light on lights, edits between renders."""
import warnings

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from shprt_scenes import (  # noqa: E402
    GREY, QUICK, SQUARE, block, camera, direct, emitter, floor, integrator, level, light, mean_error, render, scene)

from mi_shlight import bake_transfer  # noqa: E402
from mi_shlight.errors import StaleTransferWarning, UnsupportedSceneWarning  # noqa: E402

DOWN = mi.ScalarTransform4f().translate([0, 1.5, 0]).rotate([1, 0, 0], 90).scale(0.5)


def rectangle(to_world, **nested):
    return {"type": "rectangle", "to_world": to_world, **nested}


@pytest.mark.parametrize("light_shape", [
    rectangle(DOWN, emitter=emitter()),
    rectangle(mi.ScalarTransform4f().translate([0, 1.5, 0]).rotate([1, 0, 0], -90).scale(0.5), flip_normals=True, emitter=emitter()),
    rectangle(DOWN @ mi.ScalarTransform4f().scale([-1, 1, 1]), emitter=emitter()),
    rectangle(DOWN @ mi.ScalarTransform4f().scale([1, 1, -1]), emitter=emitter()),
], ids=["plain", "flip_normals", "mirrored in x", "mirrored in z"])
def test_emitting_side_is_mitsubas(light_shape):
    what = scene(floor=floor(), light=light_shape)
    truth, image = direct(what, spp=256), render(what, order=4, transfer="unshadowed")
    if truth.max() == 0:
        assert image.max() == 0
    else:
        assert mean_error(image, truth) < 0.02


def test_some_of_these_lights_are_lit_and_some_dark():
    """The comparison above means something only if Mitsuba itself shows both."""
    lit = direct(scene(floor=floor(), light=rectangle(DOWN, emitter=emitter())), spp=16)
    dark = direct(scene(floor=floor(), light=rectangle(DOWN, flip_normals=True, emitter=emitter())), spp=16)
    assert lit.mean() > 0.01 and dark.max() == 0


@pytest.mark.parametrize("face_normals", [False, True])
def test_receiver_turned_inside_out(face_normals):
    """A floor with its winding downwards and flip_normals is lit from above, in the vertex domain too."""
    turned = rectangle(mi.ScalarTransform4f().rotate([1, 0, 0], 90).scale(2), flip_normals=True, face_normals=face_normals, bsdf=GREY)
    what = scene(floor=turned, light=light())
    truth = direct(what, spp=256)
    assert mean_error(render(what, order=4, max_edge=0.5, transfer_samples=64), truth) < 0.03


def test_black_shape_does_not_spoil_a_bake(tmp_path):
    away = mi.ScalarTransform4f().translate([1.4, 0.2, -1]).scale(0.2)
    what = scene(floor=floor(), light=light(), mirror={"type": "cube", "to_world": away, "bsdf": {"type": "conductor"}})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnsupportedSceneWarning)
        baked = bake_transfer(what, 3, samples=32, max_edge=1.0)
        assert baked.fits(what)
        baked.save(tmp_path / "bake.npz")
        own = render(what, **QUICK)
        np.testing.assert_array_equal(render(what, order=3, transfer_file=str(tmp_path / "bake.npz")), own)


def test_light_that_reflects_another_light():
    """The white back of a panel under a second light is lit like any surface, by rays or by bake."""
    panel = rectangle(mi.ScalarTransform4f().translate([0, 0.5, 0]).rotate([1, 0, 0], 90).scale(0.6), emitter=emitter(),
                      bsdf={"type": "twosided", "bsdf": GREY})
    what = scene(sensor=camera(origin=(0, 3, 2), target=(0, 0.5, 0), fov=12), panel=panel, floor=floor(), lamp=light(y=2.5))
    truth = direct(what, spp=256)
    for domain in ("vertex", "pixel"):
        assert mean_error(render(what, order=4, max_edge=0.5, transfer_samples=128, transfer_domain=domain), truth) < 0.03


def test_light_in_the_shadow_of_another():
    """The floor below a panel is lit by the panel alone; the lamp behind it is hidden."""
    what = scene(floor=floor(), panel=light(y=0.8, scale=0.9, radiance=(0.3, 0.3, 0.3)), lamp=light(y=1.8, scale=0.2))
    assert mean_error(render(what, spp=16, order=4, max_edge=0.1, transfer_samples=128), direct(what, spp=256)) < 0.06


def test_instances():
    """A shape group is not baked: its hits are shaded by rays, and it casts shadows."""
    group = {"type": "shapegroup", "box": {"type": "cube", "bsdf": GREY}}
    there = mi.ScalarTransform4f().translate([0, 0.2, 0.3]).scale(0.2)
    copy = {"type": "instance", "group": {"type": "ref", "id": "boxes"}, "to_world": there}
    what = scene(floor=floor(), light=light(), boxes=group, copy=copy)
    names = [s.id() for s in what.shapes()]
    image = render(what, spp=16, order=4, max_edge=0.1, transfer_samples=256)
    assert [s.id() for s in what.shapes()] == names
    assert mean_error(image, direct(what, spp=512)) < 0.06


@pytest.mark.parametrize("bsdf, text", [
    ({"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "roughconductor"}}, "blend.*black"),
    ({"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse"}}, "opacity is not modelled.*black"),
    ({"type": "principled", "metallic": 1.0}, "base colour, too bright for metals"),
])
def test_reflectance_that_mitsuba_cannot_tell(bsdf, text):
    what = scene(floor=floor(bsdf=bsdf), light=light())
    with pytest.warns(UnsupportedSceneWarning, match=text):
        image = render(what, spp=1, transfer="unshadowed", order=2)
    assert image.max() < 3


def test_blend_of_diffuse_bsdfs_is_diffuse():
    shades = ({"type": "diffuse", "reflectance": value} for value in (0.8, 0.4))
    blend = {"type": "blendbsdf", "weight": 0.25, **dict(zip("ab", shades))}
    what = scene(floor=floor(bsdf=blend), light=light())
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedSceneWarning)
        assert mean_error(render(what, order=4, transfer="unshadowed"), direct(what, spp=256)) < 0.02


def test_radiance_as_mesh_attribute_is_left_out_by_name():
    lamp = light(radiance=(1, 1, 1))
    coloured = mi.load_dict({"type": "rectangle", "to_world": DOWN, "emitter": {
        "type": "area", "radiance": {"type": "mesh_attribute", "name": "face_color"}}})
    coloured.add_attribute("face_color", 3, [1.0] * 6)
    with pytest.warns(UnsupportedSceneWarning, match="mesh attribute"):
        render(scene(floor=floor(), lamp=lamp, coloured=coloured), spp=1, transfer="unshadowed", order=2)


def test_directional_area_is_left_out_by_name():
    beam = rectangle(DOWN, emitter={"type": "directionalarea"})
    with pytest.warns(UnsupportedSceneWarning, match="DirectionalArea.*only 'shlight' and 'area'"):
        render(scene(floor=floor(), lamp=light(), beam=beam), spp=1, transfer="unshadowed", order=2)


def test_parameters_are_read_only():
    """The bake depends on them: a changed order would read it with the wrong stride."""
    with pytest.raises(AttributeError):
        integrator(order=2).order = 8


def _with_bsdf(bsdf):
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    return props


def test_changed_normals_are_noticed():
    smooth = mi.Mesh("floor", 4, 2, has_vertex_normals=True, props=_with_bsdf(GREY))
    numbers = mi.traverse(smooth)
    numbers["vertex_positions"] = mi.Float(np.ravel(level(SQUARE, 0.0, 2.0)).tolist())
    numbers["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    numbers["vertex_normals"] = mi.Float([0.0, 1.0, 0.0] * 4)
    numbers.update()
    what = scene(floor=smooth, light=light())
    plugin = integrator(**QUICK)
    before = np.array(mi.render(what, integrator=plugin, spp=4))
    parameters = mi.traverse(what)
    tilted = dr.normalize(mi.Normal3f(0.6, 0.8, 0))
    parameters["floor.vertex_normals"] = dr.tile(dr.ravel(tilted), 4)
    parameters.update()
    after = np.array(mi.render(what, integrator=plugin, spp=4))
    assert np.abs(after - before).max() > 0.02


def test_lights_in_another_order_are_not_called_moved(tmp_path):
    lights = {"a": light(x=-0.8), "b": light(x=0.8, scale=0.2)}
    bake_transfer(scene(floor=floor(), **lights), 2, samples=16, max_edge=1.0).save(tmp_path / "bake.npz")
    fewer = scene(floor=floor(), a=lights["a"])
    with pytest.warns(StaleTransferWarning, match="lights, or their order, are not those"):
        render(fewer, spp=1, order=2, transfer_file=str(tmp_path / "bake.npz"))


def test_shapes_smaller_than_a_cell_are_named():
    what = scene(floor=floor(scale=100.0), box=block((-0.1, 0, -0.1), (0.1, 0.2, 0.1)), light=light())
    with pytest.warns(UnsupportedSceneWarning, match=r"1 shape\(s\) are smaller than a baked cell"):
        bake_transfer(what, 0, samples=1)


def test_an_edge_limit_that_cannot_be_reached_is_named():
    with pytest.warns(UnsupportedSceneWarning, match="an edge is cut into at most 256 parts"):
        bake_transfer(scene(floor=floor(), light=light()), 0, samples=1, max_edge=4 / 300)


def test_only_lights():
    lamp = scene(sensor=camera(origin=(0, 0, 0), target=(0, 1.5, 0), fov=10), lamp=light(radiance=(3, 2, 1)))
    np.testing.assert_allclose(render(lamp, **QUICK), np.broadcast_to([3.0, 2.0, 1.0], (16, 16, 3)), rtol=1e-6)


def test_a_wrong_file_is_refused_each_time(tmp_path):
    """A render after a refused one must not take the file for checked."""
    bake_transfer(scene(floor=floor(), light=light()), 2, samples=16, max_edge=1.0).save(tmp_path / "bake.npz")
    other, plugin = scene(floor=floor(y=-0.5), light=light()), integrator(order=2, transfer_file=str(tmp_path / "bake.npz"))
    for _ in range(2):
        with pytest.raises(ValueError, match="must have the geometry it was baked for"):
            plugin.prepare_scene(other)


def test_a_bake_that_broke_off_is_not_replaced_by_an_old_one():
    what, plugin = scene(floor=floor(), light=light()), integrator(**QUICK)
    first = plugin.prepare_scene(what, progress=False)
    parameters = mi.traverse(what)
    parameters["floor.vertex_positions"] = parameters["floor.vertex_positions"] * 0.9
    parameters.update()

    def break_off(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        plugin.prepare_scene(what, progress=break_off)
    second = plugin.prepare_scene(what, progress=False)
    assert second is not first and second.fits(what)
