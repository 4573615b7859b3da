"""The measurement of soft shadows: its exact radiance, its error measures, and that the claim holds in small."""
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
pytest.importorskip("matplotlib")

from mi_shlight import polygon_irradiance
from validation import bake_speed, soft_shadows
from validation.soft_shadows import BALL_AT, BALL_RADIUS, LIGHT_AT, LIGHT_SIDE, Floor, Plan


def test_exact_radiance():
    """Far from the shadow Lambert's formula; below the ball, where it covers the light, nothing; in between, counting rays."""
    h = LIGHT_SIDE / 2
    light = np.array([[-h, 0, h], [h, 0, h], [h, 0, -h], [-h, 0, -h]]) + LIGHT_AT
    points = np.array([[1.4, 0, 1.4], [-0.15, 0, -0.1], [-0.15, 0, 0.3]])
    radiance, visible = soft_shadows.exact_radiance(points)
    lambert = [polygon_irradiance([list(v) for v in light], list(p), [0.0, 1.0, 0.0]) / np.pi for p in points]
    assert visible[0] == 1 and radiance[0] == pytest.approx(lambert[0], rel=1e-4)
    assert visible[1] == 0 and radiance[1] == 0
    assert 0.05 < visible[2] < 0.95
    rng = np.random.default_rng(0)
    d = LIGHT_AT + (rng.random((100_000, 3)) - 0.5) * [LIGHT_SIDE, 0, LIGHT_SIDE] - points[2]
    length = np.linalg.norm(d, axis=1)
    closest = np.linalg.norm(np.cross(BALL_AT - points[2], d / length[:, None]), axis=1)
    mean = ((d[:, 1] / length ** 2) ** 2 * (closest > BALL_RADIUS)).mean() * LIGHT_SIDE ** 2 / np.pi
    assert radiance[2] == pytest.approx(mean, rel=0.02)


def test_errors():
    """Half the shadow's brightness missing in one block of four; the lamp's block does not count."""
    truth = np.ones((16, 16, 3))
    image, shadow, lamp = truth.copy(), np.zeros((16, 16), bool), np.zeros((16, 16), bool)
    image[:8, :8], shadow[:8, :8] = 0.5, True
    image[8:, 8:], lamp[9, 9] = 7, True
    found = soft_shadows.errors(image, truth, shadow, lamp)
    assert found["blocks"] == pytest.approx(0.5 / 3)
    assert found["blocks in shadow"] == found["pixels in shadow"] == pytest.approx(0.5)
    assert found["pixels"] == pytest.approx((0.5 * 64 + 6 * 63) / 255)


def test_claim_in_small():
    """Localised order 4 is better than projected order 8, by a factor."""
    floor = Floor(Plan(side=16))
    assert floor.shadow.sum() > 20
    projected, localised = (floor.error(floor.shaded(order, 256, localised=fitted)) for order, fitted in ((8, False), (4, True)))
    assert localised < 0.02 and projected > 4 * localised


def test_terrain():
    """Its normals stand on it."""
    positions, normals, _ = bake_speed.terrain(400)
    for axis, column in ((1, 0), (0, 2)):
        slope = np.gradient(positions[:, 1].reshape(400, 400), 4 / 399, axis=axis, edge_order=2).ravel()
        np.testing.assert_allclose(-normals[:, column] / normals[:, 1], slope, atol=0.01)


def test_rays_of_the_bake():
    """What the recorder writes down are the rays of the bake: tested by Mitsuba they give the visibility that the bake finds."""
    scene = bake_speed.build(24)
    lights = bake_speed.polygon_lights(scene)
    positions, normals, _ = bake_speed.terrain(24)
    p, n = mi.Point3f(*positions[:128].T.copy()), mi.Normal3f(*normals[:128].T.copy())
    bake_lights, group = bake_speed.BakeLights(lights, 0.0), (mi.UInt32(0), mi.UInt32(1))
    recorder = bake_speed.Recorder(scene, lights, 128)
    visible = []
    for occluders in (recorder, bake_speed.Occluders(scene, lights)):
        sight = bake_speed.LightSight(occluders, bake_lights, group)
        found = bake_speed.sample_transfer(sight, p, n, 1, bake_speed.RAYS, mi.Float(0.5), fit=bake_speed.cone_fit(1, bake_speed.RAYS))
        visible.append(np.array(found.visibility))
    ray, there = recorder.rays()
    hit = np.array(scene.ray_test(ray, active=there)).reshape(bake_speed.RAYS, 128)
    there = np.array(there).reshape(bake_speed.RAYS, 128)
    assert there.any(axis=0).all() and 0 < hit[there].mean() < 1
    np.testing.assert_array_equal(visible[0], 1)
    counted = 1 - hit.sum(axis=0) / there.sum(axis=0)           # without the weight of the cosine
    np.testing.assert_allclose(counted, visible[1], atol=0.15)
    assert abs(counted - visible[1]).mean() < 0.03
    np.testing.assert_array_equal(counted == 1, visible[1] == 1)
