"""A rotated bake is the bake of the rotated scene."""
import pathlib

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from mi_shlight.sh.rotation import rotate
from mi_shlight.transfer.bake import bake_transfer
from mi_shlight.transfer.rotated import rigid_motion, rotate_transfer

ORDER, SAMPLES, EDGE = 4, 1024, 1.0
AXIS, ANGLE, SHIFT = np.array([0.48, 0.6, 0.64]), 130.0, (3.0, -1.0, 0.5)
SKY = {"type": "envmap", "bitmap": mi.Bitmap(np.random.default_rng(0).random((6, 8, 3)).astype(np.float32) ** 4)}


def motion():
    """Turned about an axis and moved."""
    return mi.ScalarTransform4f().translate(list(SHIFT)).rotate(AXIS.tolist(), ANGLE)


def turned(points, transform):
    matrix = np.array(transform.matrix)
    return np.asarray(points) @ matrix[:3, :3].T + matrix[:3, 3]


def object_scene(build, transform=None, sky=SKY, **changes):
    """A box on a plate beside a ball, under the sky."""
    transform, scale = transform or mi.ScalarTransform4f(), changes.get("scale", 1)
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    box, plate = build.box((-0.5, 0, -0.5), (0.5, 1, 0.5), bsdf=grey), build.quad(build.level(3, 0), "plate", bsdf=grey)
    for shape in (box, plate):
        parameters = mi.traverse(shape)
        points = np.array(parameters["vertex_positions"]).reshape(-1, 3) * (scale * changes.get(shape.id(), 1))
        parameters["vertex_positions"] = mi.Float(turned(points, transform).ravel().tolist())
        parameters.update()
    centre, radius = turned(np.array([1.0, 0.4, 1.0]) * scale, transform), changes.get("ball", 0.3) * scale
    ball = {"type": "sphere", "center": centre.tolist(), "radius": radius}
    size, eye = 12, mi.ScalarTransform4f().look_at([0, 4, 5], [0, 0.3, 0], [0, 1, 0])
    camera = {"type": "perspective", "fov": 40, "to_world": transform @ eye,
              "film": {"type": "hdrfilm", "width": size, "height": size, "component_format": "float32", "rfilter": {"type": "box"}}}
    return mi.load_dict({"type": "scene", "box": box, "plate": plate, "ball": ball, "sky": sky, "camera": camera}, optimize=False)


@pytest.fixture(scope="module")
def baked(build):
    before, after = object_scene(build), object_scene(build, motion())
    bake = lambda scene: bake_transfer(scene, ORDER, samples=SAMPLES, max_edge=EDGE)
    return before, after, bake(before), bake(after)


def test_rotated_bake_equals_a_new_one(baked):
    """To the noise of either: the same directions, in another place of the hemisphere."""
    before, after, transfer, fresh = baked
    moved = rotate_transfer(transfer, before, after)
    moved.check(after)
    with pytest.raises(ValueError, match="must have the geometry it was baked for"):
        moved.check(before)
    at_corners = lambda t: np.concatenate([t.coeffs[0, block.first_row + block.rows] for block in t.meshes])     # rows are sorted by place
    distance = lambda t: np.linalg.norm(at_corners(t) - at_corners(fresh)) / np.linalg.norm(at_corners(fresh))
    assert distance(moved) < 0.01 and distance(transfer) > 0.5
    rotation = np.array(motion().matrix)[:3, :3]
    np.testing.assert_allclose(moved.cones[..., :3], transfer.cones[..., :3] @ rotation.T, atol=1e-6)
    np.testing.assert_array_equal(moved.cones[..., 3], transfer.cones[..., 3])


def test_rotating_the_light_instead(baked):
    """``T' . L = T . D(R)^-1 L`` at every point."""
    before, after, transfer, _ = baked
    light, rotation = np.random.default_rng(1).normal(size=(ORDER + 1) ** 2), np.array(motion().matrix)[:3, :3]
    moved = rotate_transfer(transfer, before, after)
    np.testing.assert_allclose(moved.coeffs @ light, transfer.coeffs @ rotate(light, rotation.T), atol=1e-5)


def test_picture_of_the_rotated_object(baked, build, tmp_path):
    """The camera turns along and the sky stays: as the picture of a new bake; also as the object at rest under a sky turned back."""
    before, after, transfer, fresh = baked

    def picture(scene, bake):
        path = pathlib.Path(tmp_path) / "bake.npz"
        bake.save(path)
        shprt = mi.load_dict({"type": "shprt", "order": ORDER, "transfer_file": str(path)})
        return np.array(mi.render(scene, integrator=shprt, spp=4, seed=1))

    reused, anew = picture(after, rotate_transfer(transfer, before, after)), picture(after, fresh)
    back = mi.ScalarTransform4f().rotate(AXIS.tolist(), -ANGLE)
    at_rest = picture(object_scene(build, sky={**SKY, "to_world": back}), transfer)
    assert anew.mean() > 0.01
    assert abs(reused - anew).mean() < 0.005 * anew.mean()
    assert abs(reused - at_rest).mean() < 0.001 * anew.mean()


def test_motion_from_points():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(7, 3)) * [1, 1, 0]      # flat: a mirror image fits as well
    matrix = np.array(motion().matrix, dtype=np.float64)
    rotation, translation = rigid_motion(points, points @ matrix[:3, :3].T + matrix[:3, 3])
    np.testing.assert_allclose(rotation, matrix[:3, :3], atol=1e-6)
    np.testing.assert_allclose(translation, SHIFT, atol=1e-6)


@pytest.mark.parametrize("change", [{"box": 1.1}, {"plate": 0.9}, {"ball": 0.4}, {"box": -1}])
def test_another_object(baked, build, change):
    before, _, transfer, _ = baked
    with pytest.raises(ValueError, match="'moved' must"):
        rotate_transfer(transfer, before, object_scene(build, motion(), **change))


def test_sizes_are_relative_to_the_scene(build):
    """In one of 3 mm a ball 0.04 mm larger is another one; what rounding does to it is not."""
    turn = mi.ScalarTransform4f().rotate(AXIS.tolist(), ANGLE)
    before, *after = (object_scene(build, way, scale=1e-3, ball=radius) for way, radius in ((None, 0.3), (turn, 0.30001), (turn, 0.34)))
    transfer = bake_transfer(before, 1, samples=4)
    rotate_transfer(transfer, before, after[0]).check(after[0])
    with pytest.raises(ValueError, match="'moved' must be 'scene' after a rotation"):
        rotate_transfer(transfer, before, after[1])


def test_errors(baked, build):
    before, after, transfer, _ = baked
    with pytest.raises(ValueError, match="must have the geometry it was baked for"):
        rotate_transfer(transfer, after, before)
    with pytest.raises(TypeError, match="'moved' must be a mitsuba.Scene"):
        rotate_transfer(transfer, before, "scene.xml")
    with pytest.raises(TypeError, match="'transfer' must be a Transfer"):
        rotate_transfer(None, before, after)
    with pytest.raises(ValueError, match="'scene' must consist of meshes"):
        disk = mi.load_dict({"type": "scene", "disk": {"type": "disk"}, "sky": SKY}, optimize=False)
        rotate_transfer(bake_transfer(disk, 1, samples=1), disk, disk)
