"""Gloss in pictures: visibility times light against the matrix route, pictures against path tracing, derivatives against differences."""
import pathlib
import sys

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

import drjit as dr  # noqa: E402

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "plugins"))
from shprt_scenes import block, camera, floor, integrator, light, mean_error, render, scene  # noqa: E402

from mi_shlight.sh import product_matrix  # noqa: E402
from mi_shlight.shading.glossy import arriving  # noqa: E402

ROUGH = {"type": "roughconductor", "material": "Au", "alpha": 0.5}
PLASTIC = {"type": "roughplastic", "alpha": 0.4, "diffuse_reflectance": {"type": "rgb", "value": [0.5, 0.2, 0.1]}}


def numbers(rng, *shape):
    return [mi.Float(row.tolist()) for row in rng.normal(size=shape)]


@pytest.mark.parametrize("orders", [(2, 3, 2), (2, 1, 3)], ids=["light finer", "light coarser"])
def test_product_with_visibility_equals_the_transfer_matrix(orders):
    """[G03] eq. 8: the matrix that multiplies by what is blocked, applied to the light, is the other way to the same coefficients."""
    (blocked_order, light_order, order), lanes, rng = orders, 5, np.random.default_rng(1)
    blocked = numbers(rng, (blocked_order + 1) ** 2, lanes)
    channels = [numbers(rng, (light_order + 1) ** 2, lanes) for _ in range(3)]
    found = np.array([[np.array(c) for c in part] for part in arriving(blocked, channels, order)])
    matrix = product_matrix(np.array(blocked).T.astype(np.float64), light_order, order)
    size = (order + 1) ** 2, (light_order + 1) ** 2
    truth = [np.einsum("nij,jn->in", np.eye(*size) - matrix, np.array(part)) for part in channels]
    assert np.abs(found - truth).max() < 2e-6 * np.abs(truth).max()


@pytest.mark.parametrize("part", [0.0, 1.0, 0.25])
def test_constant_visibility_scales_the_light_and_cuts_nothing_off(part):
    blocked = [mi.Float(part * np.sqrt(4 * np.pi))] + [mi.Float(0)] * 8
    lit = [[mi.Float(float(i)) for i in range(9)]]
    found = [c[0] for c in arriving(blocked, lit, 3)[0]]
    assert np.allclose(found, [(1 - part) * i for i in range(9)] + [0] * 7, atol=1e-6)


FLAT = {"transfer": "unshadowed+glossy", "order": 2, "bsdf_order": 6}
VIEW = camera((0, 1.6, 2.2), (0, 0, -0.2), 34)
GREY_EMITTER = {"type": "constant", "radiance": {"type": "rgb", "value": 0.7}}


def lamp(**where):
    """Out of view, behind what is seen."""
    return light(y=1.3, scale=0.4, z=-1.1, **where)


def path(what, spp=1024, seed=1):
    return np.array(mi.render(what, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=spp, seed=seed))


@pytest.mark.parametrize("bsdf", [ROUGH, PLASTIC], ids=lambda bsdf: bsdf["type"])
def test_picture_is_that_of_the_path_tracer(bsdf):
    what = scene(VIEW, floor=floor(bsdf=bsdf), lamp=lamp())
    assert mean_error(render(what, **FLAT), path(what)) < 0.04


def test_shadow_of_a_ball_on_a_glossy_floor():
    """Light to the sum of both orders: a fit of visibility means nothing band by band."""
    ball = {"type": "sphere", "center": [0, 0.45, -0.35], "radius": 0.25, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    what = scene(VIEW, floor=floor(bsdf=ROUGH), lamp=lamp(), ball=ball)
    truth = path(what)
    settings = dict(FLAT, transfer_domain="pixel", transfer_samples=64, bsdf_order=4, visibility_order=1)
    assert mean_error(render(what, **settings), truth) > 0.25
    assert mean_error(render(what, **dict(settings, transfer="shadowed+glossy")), truth) < 0.1


def test_constant_light_from_all_around_is_scaled_by_the_albedo():
    what = scene(floor=floor(bsdf=PLASTIC), sky=GREY_EMITTER)
    assert np.allclose(render(what, **FLAT).mean(axis=(0, 1)), path(what).mean(axis=(0, 1)), rtol=2e-3)


def test_lights_without_an_extent_are_met_by_the_bsdf_itself():
    sun = {"type": "directional", "direction": [0.1, -1, 0.8], "irradiance": {"type": "rgb", "value": 2.0}}
    what = scene(VIEW, floor=floor(bsdf=dict(ROUGH, alpha=0.1)), sun=sun)
    assert mean_error(render(what, **FLAT), path(what, 4, 0)) < 1e-5


def test_back_of_a_two_sided_surface_shines():
    below = camera((0, -1.6, 2.2), (0, 0, -0.2), 34)
    up = light(y=-1.3, scale=0.4, z=-1.1, up=True)
    what = scene(below, floor=floor(bsdf={"type": "twosided", "nested": ROUGH}), lamp=up)
    assert mean_error(render(what, **dict(FLAT, bsdf_order=4)), path(what)) < 0.08


def test_grid_of_lights_gives_the_same_picture():
    what = scene(VIEW, floor=floor(bsdf=ROUGH), lamp=lamp())
    settings = dict(FLAT, bsdf_order=3)
    with_grid = render(what, grid_resolution=8, **settings)
    assert 0 < mean_error(with_grid, render(what, **settings)) < 3e-3


def test_picture_follows_the_material():
    what = scene(VIEW, floor=floor(bsdf=dict(ROUGH, alpha=0.3)), lamp=lamp())
    settings = dict(FLAT, bsdf_order=3)
    plugin, parameters = integrator(**settings), mi.traverse(what)
    before = np.array(mi.render(what, integrator=plugin, spp=4))
    parameters["floor.bsdf.alpha.value"] = 0.5
    parameters.update()
    after = np.array(mi.render(what, integrator=plugin, spp=4))
    assert mean_error(before, after) > 0.05
    assert mean_error(after, render(scene(VIEW, floor=floor(bsdf=ROUGH), lamp=lamp()), **settings)) < 1e-6


@pytest.mark.filterwarnings("ignore:shprt. BSDF")
def test_gloss_that_appears_later_has_its_shadows():
    """An anisotropic surface, whose gloss is left out, becomes an isotropic one."""
    def stage(alpha):
        bsdf = {"type": "roughconductor", "alpha_u": alpha, "alpha_v": 0.5}
        return scene(VIEW, floor=floor(bsdf=bsdf), block=block([-0.3, 0.3, -0.3], [0.3, 0.5, 0.3]), lamp=lamp())

    settings = {"transfer": "glossy", "order": 2, "bsdf_order": 2, "visibility_order": 1, "max_edge": 1.0, "transfer_samples": 32}
    what, plugin = stage(0.1), integrator(**settings)
    parameters = mi.traverse(what)
    before = np.array(mi.render(what, integrator=plugin, spp=4))
    parameters["floor.bsdf.alpha_u.value"] = 0.5
    parameters.update()
    after = np.array(mi.render(what, integrator=plugin, spp=4))
    assert mean_error(before, after) > 0.5
    np.testing.assert_allclose(after, render(stage(0.5), **settings), rtol=1e-5)


@pytest.mark.parametrize("bsdf, words", [
    ({"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4}, "anisotropic"),
    ({"type": "conductor"}, "mirror"),
    ({"type": "plastic"}, "mirror reflection is left out"),
    ({"type": "roughdielectric", "alpha": 0.3}, "transmits"),
    ({"type": "principled", "roughness": 0.4, "base_color": {"type": "checkerboard"}, "metallic": 1.0}, "mean of its textures"),
], ids=lambda value: value["type"] if isinstance(value, dict) else "")
def test_what_is_left_out_is_named(bsdf, words):
    with pytest.warns(UserWarning, match=words):
        integrator(**FLAT).prepare_scene(scene(floor=floor(bsdf=bsdf), lamp=lamp()))


def test_gloss_that_is_left_out_is_black():
    """Mitsuba makes up a diffuse reflectance for BSDFs that have none."""
    what = scene(VIEW, floor=floor(bsdf={"type": "roughconductor", "alpha_u": 0.2, "alpha_v": 0.4}), lamp=lamp())
    with pytest.warns(UserWarning, match="anisotropic"):
        assert render(what, **dict(FLAT, bsdf_order=2)).max() == 0


def derivative_pair(what, key, settings, forward, change, step):
    """(by autodiff, by differences) of a weighted mean of the picture, along `change` of a parameter."""
    plugin, parameters = integrator(**settings), mi.traverse(what)
    kind = type(parameters[key])
    start = kind(dr.detach(parameters[key]))
    weights = mi.TensorXf(np.random.default_rng(3).random((16, 16, 3)).astype(np.float32))
    seed = mi.sample_tea_32(mi.UInt32(5), mi.UInt32(1))[0]

    def value(t, seed):
        parameters[key] = kind(start + t * change)
        parameters.update()
        return dr.mean(mi.render(what, parameters, integrator=plugin, spp=4, seed=seed) * weights, axis=None).array

    t = dr.opaque(mi.Float, 0)
    dr.enable_grad(t)
    result = value(t, 5)
    if forward:
        dr.forward(t)
    else:
        dr.backward(result)
    slope = dr.grad(result if forward else t)[0]
    difference = (value(mi.Float(step), seed) - value(mi.Float(-step), seed))[0] / (2 * step)
    return slope, difference


ALONG_X = np.tile([1.0, 0.0, 0.0], 4)


@pytest.mark.parametrize("key, change, step, forward", [
    ("lamp.vertex_positions", ALONG_X, 2e-3, False),
    ("lamp.vertex_positions", ALONG_X, 2e-3, True),
    ("floor.bsdf.alpha.value", [1.0], 5e-3, False),
    ("floor.vertex_positions", np.roll(ALONG_X, 1), 5e-4, False),
], ids=["light moves", "light moves, forward", "roughness", "floor rises"])
def test_derivatives(key, change, step, forward):
    what = scene(VIEW, floor=floor(bsdf=ROUGH), lamp=lamp())
    slope, difference = derivative_pair(what, key, dict(FLAT, bsdf_order=2), forward, mi.Float(np.asarray(change).tolist()), step)
    assert abs(difference) > 1e-5 and abs(slope - difference) < 2e-3 * abs(difference)


def test_derivative_by_a_light_with_shadows():
    """All of the picture is lit, and visibility a constant of each pixel, so differences of pictures see no more than the derivative."""
    ball = {"type": "sphere", "center": [0, 0.45, -0.35], "radius": 0.25, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    what = scene(VIEW, floor=floor(bsdf=ROUGH), lamp=lamp(), ball=ball)
    settings = dict(FLAT, transfer="glossy", bsdf_order=2, visibility_order=1, transfer_domain="pixel", transfer_samples=16)
    slope, difference = derivative_pair(what, "lamp.emitter.radiance.value", settings, False, mi.Color3f(1, -0.5, 0.2), 2e-2)
    assert abs(slope - difference) < 1e-3 * abs(difference)
