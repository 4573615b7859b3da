"""`shprt` with interreflection: pictures against Mitsuba's `path`, derivatives against differences, both kinds of lighting, warnings."""
import gc
import warnings

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from autodiff import derivative
from shprt_scenes import GREY, SIZE, block, camera, fan, floor, integrator, light, mean_error, render, scene

from mi_shlight.errors import UnsupportedSceneWarning

COARSE = {"order": 3, "max_edge": 0.5, "transfer_samples": 64, "bounce_samples": 64, "transfer": "interreflected", "localised": False}
BY_TRANSFER = {**COARSE, "bounce_lighting": "transfer"}


def paint(*value):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(value)}}


def corner(height=1.9, sensor=None, **parts):
    """Two walls, one red, a floor and a light that shines down."""
    walls = {"floor": floor(0, 1), "back": fan([[-1, 0, -1], [1, 0, -1], [1, 2, -1], [-1, 2, -1]], bsdf=GREY),
             "left": fan([[-1, 0, 1], [-1, 0, -1], [-1, 2, -1], [-1, 2, 1]], bsdf=paint(0.8, 0.1, 0.1))}
    return scene(sensor or camera((0, 1, 4.5), (0, 0.6, 0), 22), light=light(height, 0.3), **walls, **parts)


def ball():
    return mi.load_dict({"type": "sphere", "center": [0.3, 0.5, 0.5], "radius": 0.4, "bsdf": GREY})


def path(what, depth, spp=512):
    """Converged reference of light after at most `depth` segments; -1: all."""
    return np.array(mi.render(what, integrator=mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100}), spp=spp, seed=1))


def bounced(what, spp=16, **parameters):
    """What interreflection adds to the picture."""
    return render(what, spp, **parameters) - render(what, spp, **{**parameters, "transfer": "shadowed"})


@pytest.mark.parametrize("bounces, depth", [(1, 3), (0, -1)])
def test_bounces(bounces, depth):
    """One bounce, and all (0), against as many of `path`. Compared is the light between surfaces alone."""
    what = corner()
    image, truth = bounced(what, bounces=bounces, **COARSE), path(what, depth) - path(what, 2)
    assert mean_error(image, truth) < 0.07, "4.7 % measured: order 3, 64 rays and the noise of `path`"
    beside_the_red_wall = image[SIZE // 2:, :4].mean(axis=(0, 1))
    assert beside_the_red_wall[0] > 2 * beside_the_red_wall[1] > 0


def test_spectral():
    mi.set_variant("llvm_ad_spectral")
    what = corner(sensor=camera((0, 1, 4.5), (0, 0.6, 0), 22, 8))
    image, truth = bounced(what, 256, **COARSE), path(what, -1, 4096) - path(what, 2, 4096)
    assert mean_error(image, truth) < 0.1


def test_shapes_without_vertices():
    """They get light from other surfaces by rays of their own, of as many bounces; that they send none is said."""
    what = corner(sensor=camera((1.2, 3, 2), (0.3, 0.8, 0.5), 5), ball=ball())
    with pytest.warns(UnsupportedSceneWarning, match="1 shape.s. without vertices, such as 'ball': .* reflect none"):
        image = bounced(what, bounces=1, **COARSE)
    truth = path(what, 3, 2048) - path(what, 2, 2048)
    assert mean_error(10 * image, 10 * truth) < 0.1, "5.8 % measured with a reference of less noise"
    assert image.mean() == pytest.approx(truth.mean(), rel=0.05), "a second bounce would add 17 %"
    with pytest.raises(ValueError, match="without vertices.*'strict'"):
        integrator(strict=True, **COARSE).prepare_scene(what, False)


@pytest.mark.filterwarnings("ignore:.*without vertices")
def test_nothing_baked():
    """A scene without meshes has nothing between which light could bounce."""
    what = scene(camera((0.3, 0.5, 4), (0.3, 0.5, 0.5), 8), ball=ball(), light=light(1.9, 0.3))
    for parameters in (COARSE, BY_TRANSFER):
        assert (bounced(what, 1, **parameters) == 0).all()


def test_transfer_vectors():
    """They agree with gathering where a light is far and looks the same from everywhere, and are off where it is near."""
    errors = []
    for height in (1.9, 40.0):
        what = corner(height)
        gathered, by_vectors = (bounced(what, 4, bounces=2, **parameters) for parameters in (COARSE, BY_TRANSFER))
        errors.append(mean_error(by_vectors * (height / 1.9) ** 2, gathered * (height / 1.9) ** 2))
    assert errors[1] < 0.04
    assert errors[0] > 0.2


def test_transfer_vectors_follow_the_reflectance():
    what, plugin = corner(), integrator(bounces=1, **BY_TRANSFER)
    parameters = mi.traverse(what)
    images = []
    for red in (0.8, 0.0):
        parameters["left.bsdf.reflectance.value"] = mi.Color3f(red, 0.1, 0.1)
        parameters.update()
        images.append(np.array(mi.render(what, integrator=plugin, spp=1, seed=0)))
        np.testing.assert_array_equal(images[-1], render(what, 1, bounces=1, **BY_TRANSFER))
    assert images[1].mean() < 0.99 * images[0].mean()


# --- derivatives ----------------------------------------------------------------------------------------------------------------

MOVES = {
    "light": ("light.vertex_positions", lambda: mi.Float([1, 0.3, 0.5] * 4), 1e-2, False),
    "radiance": ("light.emitter.radiance.value", lambda: mi.Color3f(0.3, -0.5, 1.0), 0.5, False),
    "wall": ("left.bsdf.reflectance.value", lambda: mi.Color3f(0.3, -0.5, 1.0), 2e-2, True),
}
"""Key, direction, step of the differences, and whether a ball is in view. (The visibility of a light that moves is traced at its hits.)"""

SEED = mi.sample_tea_32(7, 1)[0]
"""mi.render takes the derivative with this seed when it renders with 7."""


@pytest.mark.parametrize("name", MOVES)
def test_derivatives(name):
    """Of a weighted sum of direct and bounced light, in forward and reverse mode, against differences over the same samples."""
    key, tangent, step, with_ball = MOVES[name]
    what = corner(**{"ball": ball()} if with_ball else {})
    plugin = integrator(bounces=2, light_margin=0.5, **COARSE)
    parameters, weights = mi.traverse(what), dr.linspace(mi.Float, 1, -0.5, SIZE * SIZE * 3)
    original = type(parameters[key])(parameters[key])

    def value(t, seed):
        parameters[key] = original + tangent() * t
        parameters.update()
        return dr.sum(mi.render(what, parameters, integrator=plugin, spp=2, seed=seed).array * weights)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnsupportedSceneWarning)
        above, below = (value(mi.Float(t), SEED)[0] for t in (step, -step))
        difference = (above - below) / (2 * step)
        assert abs(difference) > 0.1
        for mode in ("forward", "backward"):
            assert derivative(lambda t: value(t, 7), mi.Float, mode) == pytest.approx(difference, rel=1e-3)


def test_open_scenes_are_not_given_up_early():
    """Most light leaves the scene at once, but what a block and a floor send each other goes on: all bounces are as many as 16."""
    what = scene(camera((0, 1.5, 2)), floor=floor(bsdf=GREY), block=block([-0.5, 0, -0.5], [0.5, 1, 0.5], GREY),
                 sky={"type": "constant", "radiance": 0.3})
    some = [render(what, bounces=n, **{**COARSE, "transfer": "interreflected"}) for n in (1, 16, 0)]
    assert mean_error(some[2], some[1]) < 1e-3 < 1e-2 < mean_error(some[0], some[1])


@pytest.mark.parametrize("parameters", [COARSE, BY_TRANSFER], ids=["gather", "transfer"])
def test_frozen_function(parameters):
    """`dr.freeze` gives what the plain function gives while a light and a colour change."""
    gc.collect()                                      # Dr.Jit 1.5 aborts if a broken recording is collected during another one
    what, plugin = corner(), integrator(light_margin=0.5, bounces=2, **parameters)
    numbers = mi.traverse(what)
    start = mi.Float(numbers["light.vertex_positions"])
    picture = lambda scene: mi.render(scene, integrator=plugin, spp=1, seed=0)
    frozen = dr.freeze(picture)
    images = []
    for i in range(3):
        numbers["light.vertex_positions"] = start + 0.1 * i * mi.Float([1, 0, 0] * 4)
        numbers["left.bsdf.reflectance.value"] = mi.Color3f(0.8 - 0.2 * i, 0.1, 0.1)
        numbers.update()
        plugin.prepare_scene(what, False)
        images.append(np.array(frozen(what)))
        np.testing.assert_array_equal(images[-1], np.array(picture(what)))
    assert np.abs(images[2] - images[0]).max() > 0.01


# --- what is said ---------------------------------------------------------------------------------------------------------------

def test_white_room():
    """A closed white room never loses light."""
    white = paint(1, 1, 1)
    walls = block([1, 2, 1], [-1, 0, -1], bsdf=white)                  # the corners swapped: it faces inwards
    what = scene(camera((0, 1, 0.9), (0, 1, 0), 40), walls=walls, light=light(1.9, 0.05))
    with pytest.warns(UnsupportedSceneWarning, match="not died down after 256 bounces.*lower the reflectance"):
        image = bounced(what, 1, **{**COARSE, "max_edge": 2.0})
    assert image.min() > 0.02
