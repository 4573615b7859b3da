"""Lights that move are followed: the same as a fresh look at the scene, or a refusal where that would find something else."""
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from mi_shlight.moving import MovingLights
from mi_shlight.scene import polygon_lights

SQUARE = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], float)
TENT = SQUARE + np.array([[0, 0, 0], [0, 0.5, 0], [0, 0, 0], [0, 0.5, 0]])
AREA = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}


def ramp():
    texels = np.linspace(0, 1, 4, dtype=np.float32)[None, :, None].repeat(3, axis=2)
    return {"type": "shlight", "radiance": {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}, "subdivisions": 32}




def mesh(vertices, faces, name, emitter):
    props = mi.Properties()
    props["emitter"] = mi.load_dict(emitter)
    shape = mi.Mesh(name, len(vertices), len(faces), props=props)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mi.Float(np.ravel(vertices).tolist())
    parameters["faces"] = mi.UInt32(np.ravel(faces).tolist())
    parameters.update()
    shape.set_id(name)
    return shape


class Scene:
    """A planar quadrangle, one whose faces have vertices of their own, a bent one, a rectangle and a textured rectangle."""

    def __init__(self):
        apart = SQUARE[[0, 1, 2, 0, 2, 3]] + [0, 1, 0]
        shapes = [mesh(SQUARE, [[0, 1, 2], [0, 2, 3]], "planar", AREA), mesh(apart, [[0, 1, 2], [3, 4, 5]], "apart", AREA),
                  mesh(TENT, [[0, 1, 2], [0, 2, 3]], "bent", AREA)]
        self.scene = mi.load_dict({"type": "scene", **{s.id(): s for s in shapes}, "plain": {"type": "rectangle", "light": AREA},
                                   "textured": {"type": "rectangle", "light": ramp()}}, optimize=False)
        self.parameters = mi.traverse(self.scene)
        self.lights = self.look()
        self.moving = MovingLights(self.lights)

    def look(self):
        return polygon_lights(self.scene, lambda text: None)

    def light(self, name):
        return next(light for light in self.lights if light.name == name)

    def move(self, name, change):
        """`change`: from vertices (V, 3) to others, or a transform of a rectangle."""
        if callable(change):
            key = f"{name}.vertex_positions"
            self.parameters[key] = mi.Float(change(np.array(self.parameters[key]).reshape(-1, 3)).ravel().tolist())
        else:
            self.parameters[f"{name}.to_world"] = change
        self.parameters.update()


def rigid(vertices):
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    return 1.5 * vertices @ turn + [0.3, 2, -1]


def test_what_is_followed():
    """Vertices, normals and all that is made of them equal those of a fresh look at the scene; the objects stay."""
    case = Scene()
    for name in ("planar", "apart", "bent"):
        case.move(name, rigid)
    turned = mi.ScalarTransform4f().translate([1, 2, 3]).rotate([0, 1, 0], 130).scale(2)
    for name in ("plain", "textured"):
        case.move(name, turned)
    before = list(case.lights)
    assert case.moving.follow()
    for light, old, fresh in zip(case.lights, before, case.look()):
        assert light is old
        np.testing.assert_array_equal(light.vertices, fresh.vertices)
        np.testing.assert_array_equal(light.faces, fresh.faces)
        np.testing.assert_array_equal(light.outline, fresh.outline)
        assert (light.normal is None) == (fresh.normal is None)
        if fresh.normal is not None:
            np.testing.assert_allclose(light.normal, fresh.normal, atol=1e-6)
            np.testing.assert_array_equal(light.start, fresh.start)
    assert case.moving.follow(), "nothing has moved since"


def lift(corner, by):
    def change(vertices):
        vertices[corner, 1] += by
        return vertices
    return change


@pytest.mark.parametrize("name, change", [
    ("planar", lift(1, 0.3)), ("bent", lambda v: v * [1, 0, 1]), ("apart", lift(0, 1e-4)), ("planar", lambda v: v * [0, 1, 0]),
    ("bent", lambda v: v * np.nan), ("plain", mi.ScalarTransform4f().scale([-1, 1, 1])),
    ("textured", mi.ScalarTransform4f().scale([4, 1, 1])), ("bent", lambda v: v * [1, -1, 1])],
    ids=["bent", "flattened", "torn", "without area", "not finite", "mirrored", "texture cut otherwise", "hollow where it was convex"])
def test_what_is_not(name, change):
    """The lights are then left as they were."""
    case = Scene()
    before = [light.vertices.copy() for light in case.lights]
    case.move(name, change)
    assert not case.moving.follow()
    for light, vertices in zip(case.lights, before):
        np.testing.assert_array_equal(light.vertices, vertices)


def test_small_bends_do_not_matter():
    """Within the tolerance a planar light stays planar."""
    case = Scene()
    case.move("planar", lift(1, 1e-4))
    assert case.moving.follow()
    assert case.light("planar").normal is not None
