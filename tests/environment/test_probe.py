"""Angle maps and maps of functions, against functions that are known and [G03]'s own look-up."""
import math

import numpy as np
import pytest

import reference
from mi_shlight.environment.probe import angle_map_to_latlong, latlong, project_angle_map

FRAMES = [((0, 0, -1), (0, 1, 0)), ((0, 0, 1), (0, -1, 0)), ((0.6, 0, 0.8), (0, 1, 0))]


def smooth(d):
    """Of degree 2: known coefficients from any quadrature."""
    return 1 + d @ [0.3, -0.5, 0.7] + (d @ [0.1, 0.9, 0.2]) ** 2


def smooth_coefficients(order):
    z, weights = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * math.pi / 8
    d = np.stack(np.broadcast_arrays(np.sqrt(1 - z * z)[:, None] * np.cos(phi), np.sqrt(1 - z * z)[:, None] * np.sin(phi), z[:, None]), -1)
    return ((weights[:, None] * math.pi / 8 * smooth(d))[..., None] * reference.sh_basis(d, order)).sum(axis=(0, 1))


def green_lookup(image, d):
    """[G03] "hdr_lightsource", which skips the poles, for unit vectors (N, 3)."""
    size = len(image)
    r = np.arccos(d[:, 2]) / math.pi / np.hypot(d[:, 0], d[:, 1])
    x, y = (((d[:, k] * r * size + size).astype(int)) >> 1 for k in (0, 1))
    return image[y, x]


def angle_map(function, size, forward, up):
    v, u = np.meshgrid((np.arange(size) + 0.5) * 2 / size - 1, (np.arange(size) + 0.5) * 2 / size - 1, indexing="ij")
    r = np.hypot(u, v)
    spread = np.sinc(r) * math.pi
    d = (u * spread)[..., None] * np.cross(forward, up) - (v * spread)[..., None] * np.array(up) + np.cos(math.pi * r)[..., None] * forward
    return np.where(r < 1.02, function(d), -7.0)      # what no pixel at the rim holds must not matter


def test_constant_probe():
    coeffs = project_angle_map(np.full((100, 100, 2), [1.0, 3.0]), 3)
    expected = np.zeros((2, 16))
    expected[:, 0] = np.sqrt(4 * math.pi) * np.array([1, 3])
    np.testing.assert_allclose(coeffs, expected, atol=2e-5)


def test_only_the_inscribed_circle_counts():
    """Of 12 x 12 pixels three in each corner lie outside."""
    inside = np.random.default_rng(1).random((12, 12))
    image = inside.copy()
    for i, j in ((0, 0), (0, 1), (1, 0)):
        image[[i, i, -1 - i, -1 - i], [j, -1 - j, j, -1 - j]] = np.inf, -np.inf, np.nan, 1e300
    np.testing.assert_array_equal(project_angle_map(image, 3), project_angle_map(inside, 3))
    np.testing.assert_array_equal(angle_map_to_latlong(image, 20), angle_map_to_latlong(inside, 20))
    image[1, 1] = np.inf
    with pytest.raises(ValueError, match="'image' must be"):
        project_angle_map(image, 3)


@pytest.mark.parametrize("forward,up", FRAMES)
def test_smooth_probe(forward, up):
    coeffs = project_angle_map(angle_map(smooth, 256, forward, up), 4, forward, up)
    np.testing.assert_allclose(coeffs, smooth_coefficients(4), atol=1e-4)


def test_green_lookup_sees_the_same_light():
    """Coefficients of noise, integrated over directions as [G03] does."""
    image = np.random.default_rng(0).random((9, 9))
    z = (np.arange(200) + 0.5) / 100 - 1
    phi = (np.arange(400) + 0.5) * math.pi / 200
    d = np.stack(np.broadcast_arrays(np.sqrt(1 - z * z)[:, None] * np.cos(phi), np.sqrt(1 - z * z)[:, None] * np.sin(phi), z[:, None]), -1)
    d = d.reshape(-1, 3)
    expected = green_lookup(image, d) @ reference.sh_basis(d, 3) * (4 * math.pi / len(d))
    np.testing.assert_allclose(project_angle_map(image, 3, (0, 0, 1), (0, -1, 0)), expected, atol=4e-3)


@pytest.mark.parametrize("forward,up", FRAMES)
def test_probe_as_a_map(forward, up):
    """Pixels of the map at the directions that Mitsuba's ``envmap`` gives them."""
    image = angle_map(smooth, 200, forward, up)
    pixels = angle_map_to_latlong(image, 33, forward, up)
    assert pixels.shape == (33, 66) and pixels.dtype == np.float32
    np.testing.assert_allclose(pixels[1:-1], latlong(smooth, 33)[1:-1], atol=0.02)
    colours = angle_map_to_latlong(np.stack([image, 2 * image], axis=-1), 33, forward, up)
    np.testing.assert_allclose(colours, np.stack([pixels, 2 * pixels], axis=-1), rtol=1e-6)


def test_map_of_a_function():
    mi = pytest.importorskip("mitsuba")
    pixels = latlong(lambda d: d, 5)
    assert pixels.shape == (5, 10, 3)
    np.testing.assert_allclose(pixels[0], [[0, 1, 0]] * 10, atol=1e-7)
    phi = 2 * math.pi * 2.5 / 10
    np.testing.assert_allclose(pixels[2, 2], [math.sin(phi), 0, -math.cos(phi)], atol=1e-7)
    np.testing.assert_allclose(latlong(lambda d: d * 2, 5, mi.Vector3f), 2 * pixels, rtol=1e-6)
    np.testing.assert_allclose(latlong(lambda d: d.y, 5, mi.Vector3f), pixels[..., 1], atol=1e-7)
    assert (latlong(lambda d: mi.Float(2), 5, mi.Vector3f) == 2).all()


@pytest.mark.parametrize("call,error,text", [
    (lambda: project_angle_map(np.zeros((4, 5)), 3), ValueError, r"'image' must be a square array .* got 'an array \(4, 5\)'"),
    (lambda: project_angle_map(np.full((4, 4), np.nan), 3), ValueError, "'image' must be .* got 'one with inf or nan'"),
    (lambda: project_angle_map("probe.hdr", 3), TypeError, "'image' must be a square array"),
    (lambda: project_angle_map(np.zeros((4, 4), complex), 3), TypeError, "'image' must be a square array .* got 'an array of complex128'"),
    (lambda: project_angle_map(np.zeros((4, 4)), 3, forward="ahead"), TypeError, "'forward' must be a 3-vector of floating point numbers"),
    (lambda: project_angle_map(np.zeros((4, 4)), 3, up=(0, 0, 1)), ValueError, "'up' must stand at right angles to 'forward'"),
    (lambda: project_angle_map(np.zeros((4, 4)), 3, forward=(0, 0, 0)), ValueError, "'forward' must be a 3-vector of finite length"),
    (lambda: angle_map_to_latlong(np.zeros((4, 4)), 2), ValueError, "'height' must be an integer from 3 to 16384"),
    (lambda: angle_map_to_latlong(np.zeros((4, 4)), 3, up=(0, np.inf, 0)), ValueError, "'up' must be a 3-vector of finite length"),
    (lambda: latlong(3, 3), TypeError, "'function' must be a function of unit vectors, got 3"),
    (lambda: latlong(lambda d: d[:5], 8), ValueError, "'function' must return one number, or K numbers, for each of 128 directions"),
    (lambda: latlong(lambda d: d * 1j, 3), TypeError, "'function' must return .* got 'an array of complex128'"),
])
def test_errors(call, error, text):
    with pytest.raises(error, match=r"\(\): " + text):
        call()
