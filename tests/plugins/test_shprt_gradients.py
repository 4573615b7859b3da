"""Gradients of pictures by `shprt`: forward and backward mode against finite differences over the same samples."""
import warnings
from dataclasses import dataclass

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from shprt_scenes import GREY, QUICK, SIZE, SQUARE, UNSHADOWED, block, camera, emitter, fan, floor, integrator, level, light, scene

from mi_shlight.errors import StaleTransferWarning, UnsupportedSceneWarning
from mi_shlight.plugins import shprt

GRADIENT_SEED = mi.sample_tea_32(7, 1)[0]
"""mi.render takes the derivative with this seed when it renders with 7."""

PENTAGON = [(np.cos(a), np.sin(a)) for a in 2 * np.pi * np.arange(5) / 5]
OPEN, OCCLUDED = {}, {"block": lambda: block([-0.3, 0.3, -0.3], [0.3, 0.6, 0.3])}
MESHES = {"box": lambda: box(), "panel": lambda: panel()}
VERTEX = {"transfer": "shadowed", **QUICK, "order": 2, "light_margin": 0.5}
"""The margin keeps one bake for all steps of the differences: transfer is held fixed."""
PIXEL = {"order": 2, "transfer_domain": "pixel", "transfer_samples": 16, "method": "edge"}


def along(count, seed):
    """A fixed direction in the space of `count` numbers."""
    return mi.Float(np.random.default_rng(seed).normal(size=count).tolist())


def shift(tangent):
    return lambda original, t: original + tangent() * t


def turn(shift, axis, angle):
    """Motion of what has a `to_world`: a shift, and a turn about its own centre in degrees, per unit of t."""
    return lambda original, t: (mi.Transform4f().translate(mi.Vector3f(shift) * t) @ original
                                @ mi.Transform4f().rotate(mi.Vector3f(axis), angle * t))


@dataclass
class Move:
    """A parameter of the scene as a function of one number t."""

    key: str
    at: object
    """Function (original value, t) -> value."""
    step: float
    """For the finite differences; the parameters that the picture is linear in take a large one."""


MOVES = {
    "corners": Move("light.vertex_positions", shift(lambda: along(15, 1)), 1e-2),
    "other corners": Move("light.vertex_positions", shift(lambda: along(15, 2)), 1e-2),
    "lamp": Move("lamp.to_world", turn((1, 0.5, 0), (0, 1, 0.3), 40), 2e-2),
    "radiance": Move("light.emitter.radiance.value", shift(lambda: mi.Color3f(0.3, -0.5, 1.0)), 0.5),
    "radiance of the lamp": Move("lamp.emitter.radiance.value", shift(lambda: mi.Color3f(0.3, -0.5, 1.0)), 0.5),
    "spectrum": Move("light.emitter.radiance.values", shift(lambda: along(95, 4)), 0.1),
    "reflectance": Move("floor.bsdf.reflectance.value", shift(lambda: mi.Color3f(0.3, -0.5, 1.0)), 0.1),
    "floor lifted": Move("floor.vertex_positions", shift(lambda: mi.Float([0.2, 1, -0.1] * 4)), 2e-2),
    "floor tilted": Move("floor.vertex_positions", shift(lambda: mi.Float([0, 1, 0, 0, 1, 0] + 6 * [0])), 2e-2),
    "normals": Move("floor.vertex_normals", shift(lambda: along(12, 3)), 1e-2),
    "camera": Move("sensor.to_world", turn((0.2, 0.5, 1), (0, 1, 0), 2), 1e-2),
    "box": Move("box.vertex_positions", shift(lambda: mi.Float([1, 0.5, -0.3] * 24)), 1e-2),
    "panel": Move("panel.vertex_positions", shift(lambda: along(12, 7) + 1), 1e-2),
    "radiance of the box": Move("box.emitter.radiance.value", shift(lambda: mi.Color3f(0.3, -0.5, 1.0)), 0.5),
    "texture": Move("panel.emitter.radiance.data", lambda original, t: original + mi.TensorXf(along(48, 6), shape=(4, 4, 3)) * t, 0.1),
    "floor turned": Move("floor.to_world", turn((0.3, 0, 1), (1, 0.5, 0), 20), 2e-2),
}
PLASTIC = {"type": "roughplastic", "alpha": 0.4}
LIGHTS = ["corners", "other corners", "lamp", "radiance", "radiance of the lamp", "reflectance"]


def lamp():
    """A rectangle beside the pentagon, at its height: neither stands before the other."""
    to_world = mi.ScalarTransform4f().translate([0.9, 1.5, 0]).rotate([1, 0, 0], 90).scale(0.2)
    return {"type": "rectangle", "to_world": to_world, "emitter": emitter(radiance=(1, 2, 3))}


def box():
    """A closed light of twelve faces, where the same three sides are turned to all points that are seen."""
    to_world = mi.ScalarTransform4f().translate([-2.2, 1.5, -2.2]).scale(0.4)
    return {"type": "cube", "to_world": to_world, "emitter": emitter(radiance=(2, 1, 3))}


def texture(seed):
    values = np.random.default_rng(seed).uniform(0.4, 0.8, 48).astype(np.float32)
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(values.tolist(), shape=(4, 4, 3))}


def panel():
    """A textured light."""
    outline = level([(-0.3, -0.2), (0.3, -0.3), (0.4, 0.3), (-0.3, 0.3)], 1.5, up=False, z=1)
    return fan(outline, emitter={"type": "shlight", "radiance": texture(2), "subdivisions": 8})


def rounded_floor():
    """A floor with vertex normals."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(GREY)
    shape = mi.Mesh("floor", 4, 2, has_vertex_normals=True, props=props)
    numbers = mi.traverse(shape)
    numbers["vertex_positions"] = mi.Float(np.ravel(level(SQUARE, 0.0, 2.0)).tolist())
    numbers["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    numbers["vertex_normals"] = mi.Float([0.0, 1.0, 0.0] * 4)
    numbers.update()
    return shape


def rectangle_floor():
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2), "bsdf": GREY}


CONFIGURATIONS = {
    "unshadowed": ({**UNSHADOWED, "order": 3}, OPEN, [*LIGHTS, "floor lifted", "floor tilted", "camera"]),
    "unshadowed, edge": ({**UNSHADOWED, "order": 2, "method": "edge"}, {"floor": rectangle_floor}, ["corners", "lamp", "floor turned"]),
    "unshadowed, recurrence": ({**UNSHADOWED, "order": 3, "method": "recurrence"}, OPEN, ["corners", "floor tilted"]),
    "normals": ({**UNSHADOWED, "order": 3, "method": "edge"}, {"floor": rounded_floor}, ["corners", "normals"]),
    "coefficients": ({**UNSHADOWED, "order": 2, "method": "edge", "coefficients": True}, OPEN, ["corners", "radiance", "floor lifted"]),
    "vertex": (VERTEX, OCCLUDED, LIGHTS),
    "vertex, receiver": ({**VERTEX, "method": "edge"}, OPEN, ["corners", "floor lifted"]),
    "exact": ({**VERTEX, "transfer": "exact"}, OCCLUDED, LIGHTS),
    "exact, receiver": ({**PIXEL, "transfer": "exact"}, OPEN, ["corners", "floor lifted", "camera"]),
    "pixel": (PIXEL, OPEN, ["corners", "lamp", "radiance", "floor lifted"]),
    "meshes": ({**UNSHADOWED, "order": 2, "method": "edge"}, {**MESHES, "lamp": None},
               ["corners", "box", "panel", "radiance of the box", "texture", "floor tilted"]),
    "meshes alone": ({**VERTEX, "order": 2, "method": "edge"}, {**MESHES, "light": None, "lamp": None}, ["box", "panel", "texture"]),
}
VARIANTS = {
    "llvm_ad_spectral": [("unshadowed", ["corners", "lamp", "spectrum", "floor tilted"]), ("vertex", ["corners", "lamp", "spectrum"])],
    "llvm_ad_mono": [("unshadowed, edge", ["corners", "lamp"])],
    "llvm_ad_spectral_polarized": [("unshadowed, edge", ["corners", "lamp"])],
}
TOLERANCE = 3e-5
"""Relative to the differences; rounding of float32 pictures leaves about 5e-6."""

BENT = pytest.mark.filterwarnings("ignore:shprt. light 'light'. its faces hide:mi_shlight.errors.UnsupportedSceneWarning")
"""Lights whose corners move on their own do not stay planar."""


class Differentiator:
    """A weighted sum over the picture as a function of several moves."""

    def __init__(self, what, plugin, moves):
        self.what, self.plugin, self.moves = what, plugin, moves
        self.parameters = mi.traverse(what)
        self.originals = {}
        for m in moves:
            value = self.parameters[m.key]
            self.originals[m.key] = type(value)(dr.detach(value))

    def render(self, amounts, seed):
        """The picture with the moves carried out by `amounts`; moves of one parameter add up."""
        values = dict(self.originals)
        for m, t in zip(self.moves, amounts):
            values[m.key] = m.at(values[m.key], t)
        for key, value in values.items():
            self.parameters[key] = value
        self.parameters.update()
        return mi.render(self.what, self.parameters, integrator=self.plugin, spp=4, seed=seed)

    def weights(self, shape):
        return np.random.default_rng(2).uniform(0, 1, shape).astype(np.float32)

    def backward(self):
        """Derivative by each move, from one picture."""
        amounts = [mi.Float(0) for _ in self.moves]
        dr.enable_grad(amounts)
        image = self.render(amounts, 7)
        dr.backward(dr.sum(image * mi.TensorXf(self.weights(image.shape)), axis=None))
        slopes = dr.grad(amounts)
        dr.eval(slopes)                               # all at once: read one by one each would compile the derivative anew
        return np.array([slope[0] for slope in slopes])

    def forward(self, rates):
        """Derivative along all moves at once, each at its rate."""
        t = mi.Float(0)
        dr.enable_grad(t)
        image = self.render([t * rate for rate in rates], 7)
        dr.forward(t)
        return np.sum(np.array(dr.grad(image), dtype=np.float64) * self.weights(image.shape))

    def difference(self, k):
        """Fourth-order central difference by move k."""
        def value(steps):
            amounts = [mi.Float(steps * m.step if i == k else 0) for i, m in enumerate(self.moves)]
            dr.make_opaque(amounts)
            image = self.render(amounts, GRADIENT_SEED)
            return np.sum(np.array(image, dtype=np.float64) * self.weights(image.shape))

        return (8 * (value(1) - value(-1)) - (value(2) - value(-2))) / (12 * self.moves[k].step)


def differentiator(parameters, parts, names):
    everything = {"floor": floor, "light": lambda: light(outline=PENTAGON), "lamp": lamp, **parts}
    what = scene(**{name: make() for name, make in everything.items() if make})
    return Differentiator(what, integrator(**parameters), [MOVES[name] for name in names])


def check(parameters, parts, names):
    subject = differentiator(parameters, parts, names)
    differences = np.array([subject.difference(k) for k in range(len(names))])
    assert np.abs(differences).min() > 0.3
    backward, rates = subject.backward(), np.sign(differences)        # no two moves cancel
    np.testing.assert_allclose(backward, differences, rtol=TOLERANCE)
    assert subject.forward(rates) == pytest.approx(rates @ differences, rel=TOLERANCE)


@BENT
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_gradients(name):
    check(*CONFIGURATIONS[name])


@BENT
@pytest.mark.parametrize("variant, name, names", [(v, name, names) for v, rows in VARIANTS.items() for name, names in rows])
def test_variants(variant, name, names):
    mi.set_variant(variant)
    parameters, parts, _ = CONFIGURATIONS[name]
    check({**parameters, "method": "edge"}, parts, names)


def test_many_lights():
    """Twenty lights share one visibility and one loop; the last one moves."""
    lights = {f"light{i}": light(1.5, 0.1, x=0.1 * i - 1, outline=PENTAGON) for i in range(19)}
    what = scene(floor=floor(), **lights, light=light(1.5, 0.1, x=0.9, outline=PENTAGON))
    subject = Differentiator(what, integrator(**VERTEX, method="edge"), [Move("light.vertex_positions", shift(lambda: along(15, 1)), 1e-2)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnsupportedSceneWarning)
        assert abs(subject.difference(0)) > 0.1
        np.testing.assert_allclose(subject.backward(), [subject.difference(0)], rtol=2e-4)


@pytest.mark.parametrize("key, step", [("light.emitter.radiance.data", 0.1), ("floor.bsdf.reflectance.data", 0.1)])
def test_textures(key, step):
    """Through the mean over each triangle for a light."""
    what = scene(floor={**rectangle_floor(), "bsdf": {"type": "diffuse", "reflectance": texture(1)}},
                 light={**lamp(), "emitter": {"type": "shlight", "radiance": texture(2), "subdivisions": 8}})
    tangent = mi.TensorXf(along(48, 6), shape=(4, 4, 3))
    plugin = integrator(**UNSHADOWED, order=3, method="edge")
    subject = Differentiator(what, plugin, [Move(key, lambda original, t: original + tangent * t, step)])
    difference = subject.difference(0)
    assert abs(difference) > 0.02
    np.testing.assert_allclose(subject.backward(), [difference], rtol=TOLERANCE)
    assert subject.forward([1.0]) == pytest.approx(difference, rel=TOLERANCE)


# --- what derivatives leave out: the list in the plugin's documentation ----------------------------------------------------------

@pytest.mark.parametrize("parameters, key", [
    (VERTEX, "block.vertex_positions"), (PIXEL, "block.vertex_positions"),
    (VERTEX, "floor.vertex_positions"), (PIXEL, "floor.vertex_positions"),
], ids=["vertex, occluder", "pixel, occluder", "vertex, receiver", "pixel, receiver"])
def test_transfer_is_held_fixed(parameters, key):
    """An occluder has no derivative; a floor that slides along itself leaves each pixel its transfer, which is right for its picture."""
    what = scene(floor=floor(), block=OCCLUDED["block"](), light=light())
    subject = Differentiator(what, integrator(**parameters), [
        Move(key, lambda original, t: original + mi.Float([1, 0, 0] * (len(original) // 3)) * t, 0),
        Move("light.vertex_positions", lambda original, t: original + mi.Float([1, 0, 0] * 4) * t, 0)])
    fixed, moving = subject.backward()
    assert abs(moving) > 0.05 and abs(fixed) < 1e-5 * abs(moving)


@pytest.mark.parametrize("parameters", [UNSHADOWED, VERTEX], ids=["unshadowed", "vertex"])
def test_outlines_in_the_picture_are_left_out(parameters):
    """The edge of a light that the camera sees."""
    what = scene({**camera((0, 0.5, 0.1), (0, 1.5, 0), 60)}, floor=floor(), light=light())
    subject = Differentiator(what, integrator(**{**parameters, "order": 3, "method": "edge"}), [
        Move("light.vertex_positions", lambda original, t: original + mi.Float([1, 0, 0] * 4) * t, 0.05)])
    assert abs(subject.difference(0)) > 1 and subject.backward()[0] == 0


# --- bakes, bent lights, frozen functions -----------------------------------------------------------------------------------------

def test_a_new_bake_belongs_to_the_picture(monkeypatch):
    """A light that leaves its margin is baked anew when the picture is rendered, not in its derivative, which then is that of a new
    integrator."""
    bakes = []
    trace = shprt.trace_transfer
    monkeypatch.setattr(shprt, "trace_transfer", lambda *arguments: bakes.append(1) or trace(*arguments))
    what = scene(floor=floor(), block=OCCLUDED["block"](), light=light())
    parameters, plugin = mi.traverse(what), integrator(**QUICK)
    start = mi.Float(dr.detach(parameters["light.vertex_positions"]))
    for i in range(3):
        gradients = []
        for used in (plugin, integrator(**QUICK)):
            x = mi.Float(0.1 * i)
            dr.enable_grad(x)
            parameters["light.vertex_positions"] = start + mi.Float([1, 0, 0] * 4) * x
            parameters.update()
            bakes.clear()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", StaleTransferWarning)
                image = mi.render(what, parameters, integrator=used, spp=4, seed=7)
            assert len(bakes) == 1
            dr.backward(dr.sum(image, axis=None))
            assert len(bakes) == 1
            gradients.append(dr.grad(x)[0])
        assert abs(gradients[1]) > 0.01
        assert gradients[0] == pytest.approx(gradients[1], rel=1e-5)


@pytest.mark.parametrize("parameters, parts", [
    ({**UNSHADOWED, "order": 3, "method": "edge"}, OCCLUDED), (VERTEX, OCCLUDED), (PIXEL, OCCLUDED),
    ({**UNSHADOWED, "order": 1, "method": "edge"}, MESHES),
    ({**VERTEX, "transfer": "exact+glossy", "bsdf_order": 2, "visibility_order": 1}, {"floor": lambda: floor(bsdf=PLASTIC)}),
], ids=["unshadowed", "vertex", "pixel", "meshes", "glossy"])
def test_frozen_function(parameters, parts):
    """`dr.freeze` around render and backward gives what the plain function gives while a light moves. Only a bake must be asked for."""
    own = {name: make() for name, make in parts.items()}
    what = scene(**{"floor": floor(), "light": light(outline=PENTAGON), "lamp": lamp(), **own})
    numbers, plugin = mi.traverse(what), integrator(**{**parameters, "light_margin": 0.15})
    start, tangent = mi.Float(dr.detach(numbers["light.vertex_positions"])), mi.Float([1, 0.5, 0] * 5)
    weights = dr.linspace(mi.Float, 0.5, 1, SIZE * SIZE * 3)

    def step(scene, parameters):
        image = mi.render(scene, parameters, integrator=plugin, spp=4, seed=7)
        loss = dr.sum(image.array * weights)
        dr.backward(loss)
        return loss

    def run(function):
        results = []
        plugin.prepare_scene(what, progress=False)
        for i in range(5):
            t = mi.Float(0.05 * i)
            dr.enable_grad(t)
            numbers["light.vertex_positions"] = start + tangent * t
            numbers.update()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", StaleTransferWarning)
                if plugin.transfer != "unshadowed" and plugin.transfer_domain == "vertex":
                    plugin.prepare_scene(what, progress=False)
                loss = function(what, numbers)
            results.append((loss[0], dr.grad(t)[0]))
        return np.array(results)

    frozen = dr.freeze(step)
    plain, replayed = run(step), run(frozen)
    assert frozen.n_recordings < 4, "some of the frozen calls must be replays"
    assert np.abs(np.diff(plain, axis=0)).min() > 1e-3
    np.testing.assert_allclose(replayed, plain, rtol=1e-5)


def test_frozen_function_of_an_unprepared_scene():
    what, plugin = scene(floor=floor(), light=light()), integrator(**UNSHADOWED, order=2, method="edge")
    frozen = dr.freeze(lambda scene: mi.render(scene, integrator=plugin, spp=1))
    with pytest.raises(Exception) as caught:
        frozen(what)
    error = caught.value
    while error.__cause__ is not None:
        error = error.__cause__
    assert "Call integrator.prepare_scene(scene) first" in str(error)
    plugin.prepare_scene(what)
    np.testing.assert_array_equal(np.array(frozen(what)), np.array(mi.render(what, integrator=plugin, spp=1)))
