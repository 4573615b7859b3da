"""Projection of functions and images, and reconstruction: exact where they say so, else against closed forms, envmap and brute force."""
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import reference
from mi_shlight.sh import functions, project_function, project_function_stratified, project_image, reconstruct, sphere_quadrature

RNG = np.random.default_rng(2)
MAP = RNG.random((6, 8, 3)).astype(np.float32)

# int max(z, 0) Y_l0 dw
COSINE = {0: np.sqrt(np.pi) / 2, 2: np.sqrt(np.pi / 3), 6: np.sqrt(5 * np.pi) / 8, 20: -np.sqrt(np.pi) / 16}
GRID = 96
BRUTE = 5e-4
"""Its error for a map with kinks between 6 x 8 pixels."""


def brute(f, order):
    """Coefficients by the midpoint rule with scipy's harmonics."""
    theta, phi = np.meshgrid((np.arange(GRID) + 0.5) * np.pi / GRID, (np.arange(2 * GRID) + 0.5) * np.pi / GRID, indexing="ij")
    d = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)], axis=-1).reshape(-1, 3)
    return (f(d).T * (np.sin(theta.ravel()) * (np.pi / GRID) ** 2)) @ reference.sh_basis(d, order)


def environment(image, **parameters):
    """Radiance of Mitsuba's envmap by direction, (N, 3) -> (N, 3)."""
    emitter = mi.load_dict({"type": "scene", "map": {"type": "envmap", "bitmap": mi.Bitmap(image), **parameters},
                            "shape": {"type": "sphere"}}).environment()

    def radiance(d):
        si = dr.zeros(mi.SurfaceInteraction3f, len(d))
        si.wi = -mi.Vector3f(*(mi.Float(c.astype(np.float32)) for c in d.T))
        return np.array(emitter.eval(si), dtype=np.float64).T

    return radiance


@pytest.mark.parametrize("latitudes", [1, 2, 7])
def test_quadrature_is_exact_to_its_degree(latitudes):
    directions, weights = sphere_quadrature(latitudes)
    moments = weights @ reference.sh_basis(directions, 2 * latitudes - 1)
    np.testing.assert_allclose(moments, [np.sqrt(4 * np.pi)] + [0] * (len(moments) - 1), atol=1e-13)
    assert directions.shape == (2 * latitudes ** 2, 3)


def test_round_trip():
    coeffs = RNG.normal(size=(2, 49))
    f = lambda d: reconstruct(coeffs, d)
    np.testing.assert_allclose(project_function(f, 6, latitudes=7), coeffs, atol=1e-13)
    assert np.abs(project_function(f, 6, latitudes=6) - coeffs).max() > 1e-3          # one less does not do
    np.testing.assert_allclose(project_function(lambda d: f(d)[:, 1], 4), coeffs[1, :25], atol=1e-13)


def test_cosine_lobe():
    coeffs = project_function(lambda d: np.maximum(d[:, 2], 0), 4, latitudes=200)
    np.testing.assert_allclose(coeffs, [COSINE.get(i, 0) for i in range(25)], atol=3e-5)


def test_in_parts_as_at_once(monkeypatch):
    f = lambda d: np.exp(d)
    whole = project_function(f, 3), project_function_stratified(f, 3, 400)
    monkeypatch.setattr(functions, "MAX_FLOATS", 1000)
    np.testing.assert_allclose(project_function(f, 3), whole[0], atol=1e-13)
    coeffs, error = project_function_stratified(f, 3, 400)
    assert (abs(coeffs - whole[1][0]) < 8 * error).all()                               # other random numbers
    np.testing.assert_allclose(error, whole[1][1], rtol=0.5)


def test_traced_function():
    """By Dr.Jit types, scalar and colour, with a derivative."""
    number, vector = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    sharpness = number(2)
    dr.enable_grad(sharpness)
    gray = lambda d: dr.exp(sharpness * (d.x * 0.6 + d.z * 0.8))
    coeffs = project_function(gray, 2, vector=vector)
    expected = project_function(lambda d: np.exp(2 * (d[:, 0] * 0.6 + d[:, 2] * 0.8)), 2)
    np.testing.assert_allclose([c[0] for c in coeffs], expected, atol=1e-13)
    dr.forward(sharpness)
    # int exp(k t) dw = 4 pi sinh(k) / k
    slope = 4 * np.pi * (np.cosh(2) / 2 - np.sinh(2) / 4) / np.sqrt(4 * np.pi)
    assert dr.grad(coeffs[0])[0] == pytest.approx(slope, rel=1e-12)
    colours = project_function(lambda d: mi.Color3f(d.x, 1, 0), 1, vector=mi.Vector3f)
    expected = [[0, np.sqrt(4 * np.pi), 0], [0] * 3, [0] * 3, [-np.sqrt(4 * np.pi / 3), 0, 0]]
    np.testing.assert_allclose(np.array(colours)[..., 0], expected, atol=2e-5)


def test_stratified():
    f = lambda d: np.stack([np.maximum(d[:, 2], 0), np.exp(d[:, 0])], axis=1)
    exact = project_function(f, 4, latitudes=200)
    coeffs, error = project_function_stratified(f, 4, 2500, seed=3)
    assert coeffs.shape == error.shape == (2, 25)
    assert (abs(coeffs - exact) < 4.5 * error + 3e-5).all()
    assert np.array_equal(project_function_stratified(f, 4, 2500, seed=3)[0], coeffs)
    assert not np.array_equal(project_function_stratified(f, 4, 2500, seed=4)[0], coeffs)
    deviations = [project_function_stratified(f, 4, 2500, seed)[0] - exact for seed in range(40)]
    ratio = np.sqrt(np.mean(np.square(deviations), axis=0)) / error
    assert 0.5 < ratio.min() and ratio.max() < 1.5                                     # of 40 runs: their deviation is known to 11 %
    directions, weights = sphere_quadrature(40)
    squares = np.square(f(directions)).T * weights @ np.square(reference.sh_basis(directions, 4))
    assert np.mean(error / np.sqrt((4 * np.pi * squares - exact ** 2) / 2500)) < 0.25  # of as many samples without strata


def test_image_is_what_envmap_evaluates():
    expected = brute(environment(MAP), 8)
    np.testing.assert_allclose(project_image(MAP, 8), expected, atol=BRUTE)
    np.testing.assert_allclose(project_image(MAP, 2), project_image(MAP, 8)[:, :9], atol=1e-13)
    assert np.abs(project_image(MAP, 8, interpolation="box") - expected).max() > 100 * BRUTE


def test_image_in_a_turned_world():
    transform = mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 70)
    expected = brute(environment(MAP, to_world=transform), 4)
    np.testing.assert_allclose(project_image(MAP, 4, to_world=transform), expected, atol=BRUTE)


def test_image_of_boxes():
    def f(d):
        u, v = np.arctan2(d[:, 0], -d[:, 2]) / (2 * np.pi) % 1, np.arccos(d[:, 1]) / np.pi
        return MAP[(v * 6).astype(int), (u * 8).astype(int)]

    np.testing.assert_allclose(project_image(MAP, 5, interpolation="box"), brute(f, 5), atol=BRUTE)
    gray = project_image(MAP[..., 1], 5, interpolation="box")
    np.testing.assert_allclose(gray, project_image(MAP, 5, interpolation="box")[1], atol=1e-14)


@pytest.mark.parametrize("interpolation", ["bilinear", "box"])
@pytest.mark.parametrize("shape", [(2, 1), (3, 700), (600, 5)])
def test_constant_image(interpolation, shape):
    """Whatever its size, at orders beyond what its pixels can tell apart."""
    coeffs = project_image(np.full(shape, 2.0), 20, interpolation=interpolation)
    np.testing.assert_allclose(coeffs, [2 * np.sqrt(4 * np.pi)] + [0] * 440, atol=1e-12)


def test_a_single_pixel_counts_its_solid_angle():
    image = np.zeros((180, 360))
    image[40, 100] = 1.0
    exact = (np.cos(40 * np.pi / 180) - np.cos(41 * np.pi / 180)) * np.pi / 180
    assert project_image(image, 2, interpolation="box")[0] * np.sqrt(4 * np.pi) == pytest.approx(exact, rel=1e-13)


def test_reconstruct(precision):
    coeffs = RNG.normal(size=25)
    d = np.array([[0.0, 0, 1], [0.6, 0, -0.8], [-0.48, 0.6, 0.64]])
    expected = reference.sh_basis(d, 4) @ coeffs
    values = reconstruct([precision.Float(c) for c in coeffs.tolist()], precision.Array3(*(precision.Float(c.copy()) for c in d.T)))
    np.testing.assert_allclose(np.array(values), expected, atol=60 * precision.eps)
    np.testing.assert_allclose(reconstruct(coeffs, d), expected, atol=1e-14)
    np.testing.assert_allclose(reconstruct(coeffs * 1j, d), expected * 1j, atol=1e-14)
    assert reconstruct(coeffs, d[1]) == pytest.approx(expected[1])
    assert reconstruct(coeffs.tolist(), d[2].tolist()) == pytest.approx(expected[2])
    np.testing.assert_allclose(reconstruct(coeffs.tolist(), d), expected, atol=1e-14)


@pytest.mark.parametrize("call, error, text", [
    (lambda: project_function(lambda d: d, -1), ValueError, "'order'"),
    (lambda: project_function(lambda d: d[0], 2), ValueError, "'f' must return"),
    (lambda: project_function(lambda d: d[:, 0], 2, latitudes=0), ValueError, "'latitudes'"),
    (lambda: sphere_quadrature(0.5), ValueError, "'latitudes'"),
    (lambda: project_function_stratified(lambda d: d[:, 0], 2, samples=1), ValueError, "'samples'"),
    (lambda: project_function_stratified(lambda d: d[:, 0], 2, seed=-1), ValueError, "'seed'"),
    (lambda: project_image(np.ones(4), 2), ValueError, "'image'"),
    (lambda: project_image(np.ones((1, 4)), 2), ValueError, "'image'"),
    (lambda: project_image(np.full((2, 4), np.nan), 2), ValueError, "with inf or nan"),
    (lambda: project_image("sky.exr", 2), TypeError, "'image'"),
    (lambda: project_image(np.ones((4, 4), complex), 2), TypeError, "'image' must .*complex128"),
    (lambda: project_function(None, 1), TypeError, "'f' must be a function of unit vectors, got None"),
    (lambda: project_function(lambda d: "white", 1), TypeError, "'f' must return"),
    (lambda: project_function(lambda d: d * 1j, 1), TypeError, "'f' must return .*complex128"),
    (lambda: project_function_stratified(3, 1), TypeError, "'f' must be a function"),
    (lambda: project_function(lambda d: d, 1, vector=float), TypeError, "'vector' must be the type of a Dr.Jit"),
    (lambda: project_function(lambda d: 1.0, 1, vector=dr.llvm.Array3f), TypeError, "'f' must return a float or 3-vector"),
    (lambda: project_function(lambda d: dr.llvm.Float(1, 2), 1, vector=dr.llvm.Array3f), ValueError, "'f' must return .*got '2 values'"),
    (lambda: project_image(MAP, 2, to_world=2 * np.eye(3)), ValueError, "'to_world' must be a rotation"),
    (lambda: project_image(MAP, 2, interpolation="cubic"), ValueError, "'interpolation'"),
    (lambda: reconstruct([1.0] * 3, [0.0, 0, 1]), ValueError, "'coeffs'"),
    (lambda: reconstruct(np.ones(4), np.ones((2, 2))), ValueError, "'directions'"),
    (lambda: reconstruct(np.ones((2, 3, 4)), [0, 0, 1]), ValueError, "'coeffs' must be an array"),
    (lambda: reconstruct(["a"], [0.0, 0, 1]), TypeError, "'coeffs' must hold"),
    (lambda: reconstruct([dr.llvm.Float(1)], np.ones((5, 3))), TypeError, "'coeffs' must hold Python floats beside a numpy array"),
    (lambda: reconstruct([1.0], "up"), TypeError, "'directions' must be a 3-vector"),
    (lambda: reconstruct(np.ones(4), "up"), TypeError, "'directions' must be unit vectors"),
    (lambda: reconstruct(np.ones(4), dr.llvm.Array3f(0, 0, 1)), ValueError, "'directions' must be unit vectors")])
def test_bad_arguments(call, error, text):
    with pytest.raises(error, match=r"\(\): .*" + text):
        call()
