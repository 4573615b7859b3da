"""Gradients of pictures by `shprt`: forward and backward mode against finite differences over the same samples."""
import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from shprt_scenes import QUICK, SIZE, SQUARE, UNSHADOWED, block, emitter, floor, integrator, light, scene

GRADIENT_SEED = mi.sample_tea_32(7, 1)[0]
"""mi.render takes the derivative with this seed when it renders with 7."""


def picture_weights():
    return mi.TensorXf(np.random.default_rng(2).uniform(0, 1, SIZE * SIZE * 3).tolist(), shape=(SIZE, SIZE, 3))


def derivatives(what, plugin, key, value, tangent, step):
    """<w, d image / d key . tangent> by forward mode, backward mode and central differences with the same samples."""
    parameters = mi.traverse(what)
    weights = picture_weights()
    original = type(parameters[key])(dr.detach(parameters[key]))

    def attach(t):
        parameters[key] = value(original, tangent, t)
        parameters.update()

    results = []
    for forward in (True, False):
        t = mi.Float(0)
        dr.enable_grad(t)
        attach(t)
        image = mi.render(what, parameters, integrator=plugin, spp=4, seed=7)
        if forward:
            dr.forward(t)
            results.append(dr.sum(dr.grad(image) * weights, axis=None).array[0])
        else:
            dr.backward(dr.sum(image * weights, axis=None))
            results.append(dr.grad(t)[0])
    ends = []
    for sign in (1, -1):
        attach(mi.Float(sign * step))
        ends.append(dr.sum(mi.render(what, integrator=plugin, spp=4, seed=GRADIENT_SEED) * weights, axis=None).array[0])
    attach(mi.Float(0))
    return *results, (ends[0] - ends[1]) / (2 * step)


def shifted(original, tangent, t):
    return original + tangent * t


def along(count, seed):
    """A fixed direction in the space of `count` numbers."""
    return mi.Float(np.random.default_rng(seed).normal(size=count).tolist())


GRADIENTS = [
    ("light.emitter.radiance.value", lambda: mi.Color3f(0.3, -0.5, 1.0), 0.5),
    ("floor.bsdf.reflectance.value", lambda: mi.Color3f(0.3, -0.5, 1.0), 0.1),
]


@pytest.mark.parametrize("parameters", [{"order": 3, **UNSHADOWED}, QUICK], ids=["unshadowed", "vertex"])
@pytest.mark.parametrize("key, tangent, step", GRADIENTS, ids=["radiance", "reflectance"])
def test_gradients(parameters, key, tangent, step):
    """The picture is linear in radiance and reflectance, so that differences over a large step are exact but for rounding."""
    what = scene(floor=floor(), block=block([-0.3, 0.3, -0.3], [0.3, 0.6, 0.3]), light=light())
    forward, backward, difference = derivatives(what, integrator(**parameters), key, shifted, tangent(), step)
    assert abs(difference) > 1
    assert forward == pytest.approx(difference, rel=1e-3)
    assert backward == pytest.approx(difference, rel=1e-3)


@pytest.mark.parametrize("seed", [0, 1])
def test_gradients_of_light_vertices(seed):
    """Motion of all corners in all directions, without shadows; a step that balances rounding and curvature. A triangle, as a light
    must stay planar."""
    tangent = along(9, seed)
    what = scene(floor=floor(), light=light(outline=SQUARE[:3]), second=light(1.2, 0.2, x=0.8))
    forward, backward, difference = derivatives(what, integrator(order=3, **UNSHADOWED), "light.vertex_positions", shifted, tangent, 3e-3)
    assert abs(difference) > 0.3
    assert forward == pytest.approx(difference, rel=5e-3)
    assert backward == pytest.approx(difference, rel=5e-3)


def test_gradients_of_a_rectangle():
    lamp = {"type": "rectangle", "emitter": emitter(),
            "to_world": mi.ScalarTransform4f().translate([0.2, 1.5, 0]).rotate([1, 0, 0], 90).scale(0.4)}
    what = scene(floor=floor(), light=lamp)
    turn = lambda original, axis, t: mi.Transform4f().translate([1.0 * t, 0.5 * t, 0]) @ original @ mi.Transform4f().rotate(axis, 40 * t)
    axis = mi.Vector3f(0, 1, 0.3)
    forward, backward, difference = derivatives(what, integrator(order=3, **UNSHADOWED), "light.to_world", turn, axis, 3e-3)
    assert abs(difference) > 0.3
    assert forward == pytest.approx(difference, rel=5e-3)
    assert backward == pytest.approx(difference, rel=5e-3)
