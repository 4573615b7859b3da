"""CIE skies: values on paper, symmetries, and coefficients against a fine quadrature with scipy's harmonics."""
import math

import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight.environment.sky import SKIES, cie_sky, project_sky

SUN = (0.5, 0.7, -0.4)
SUNNY = ("clear", "partly_cloudy")


def sky(direction, kind, sun=SUN, **more):
    return cie_sky(direction, kind, None if kind == "overcast" else sun, **more)


def standard_sky(direction, kind, sun, zenith=(0, 1, 0)):
    """The CIE's formulas once more, in numpy, for unit vectors (N, 3)."""
    zenith, sun = np.array(zenith) / np.linalg.norm(zenith), np.array(sun) / np.linalg.norm(sun)
    c = direction @ zenith
    if kind == "overcast":
        return np.where(c > 0, (1 + 2 * c) / 3, 0)
    gamma, s = np.arccos(np.clip(direction @ sun, -1, 1)), np.arccos(zenith @ sun)
    glow = {"clear": lambda x: 0.91 + 10 * np.exp(-3 * x) + 0.45 * np.cos(x) ** 2, "partly_cloudy": lambda x: 0.526 + 5 * np.exp(-1.5 * x)}
    depth = {"clear": 0.32, "partly_cloudy": 0.8}[kind]
    haze = (1 - np.exp(-depth / np.maximum(c, 1e-9))) / (1 - np.exp(-depth))
    return np.where(c > 0, glow[kind](gamma) / glow[kind](s) * haze, 0)


@pytest.mark.parametrize("kind", SKIES)
def test_zenith_has_the_luminance_of_the_zenith(kind, precision):
    """[G03] prints cos(gamma) for cos(theta) in the partly cloudy sky, which fails this."""
    value = sky(precision.vector((0, 2, 0)), kind, zenith_luminance=3.5)
    assert value[0] == pytest.approx(3.5, rel=10 * precision.eps)


def test_overcast_horizon_is_a_third_of_the_zenith():
    """[G03]'s sine of an angle from the zenith would have it the other way round."""
    assert sky((1, 1e-9, 0), "overcast") == pytest.approx(1 / 3, rel=1e-8)
    assert sky((0.6, 0.8, 0), "overcast") == pytest.approx(2.6 / 3)


@pytest.mark.parametrize("kind", SKIES)
def test_standard_formulas(kind, precision):
    d = np.random.default_rng(0).normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    zenith = (0.1, 0.9, 0.3)
    ours = sky(precision.Array3(d.T), kind, zenith=zenith).numpy()
    np.testing.assert_allclose(ours, standard_sky(d, kind, SUN, zenith), rtol=300 * precision.eps)
    assert (ours[d @ zenith < 0] == 0).all() and (ours[d @ zenith > 0] > 0).all()


@pytest.mark.parametrize("kind", SUNNY)
def test_values_on_paper(kind):
    """Sun 60 degrees from the zenith, seen at the sun itself: f(0) g(60 degrees) / (f(60 degrees) g(0))."""
    s = math.pi / 3
    sun = (math.sin(s), math.cos(s), 0)
    expected = {"clear": 11.36 * (1 - math.exp(-0.64)) / ((0.91 + 10 * math.exp(-math.pi) + 0.1125) * (1 - math.exp(-0.32))),
                "partly_cloudy": 5.526 * (1 - math.exp(-1.6)) / ((0.526 + 5 * math.exp(-math.pi / 2)) * (1 - math.exp(-0.8)))}
    assert cie_sky(sun, kind, sun) == pytest.approx(expected[kind], rel=1e-12)


@pytest.mark.parametrize("kind", SUNNY)
@pytest.mark.parametrize("sun", [SUN, (0, 1, 0), (1, 0.05, 0.2), (1, -0.2, 0.2)], ids=["high", "zenith", "low", "set"])
def test_coefficients_by_quadrature(kind, sun):
    """Against plain midpoints, whose error at the sun's cusp and over the azimuth is below 1e-4 of the largest coefficient."""
    theta, phi = (np.arange(300) + 0.5) * (math.pi / 600), (np.arange(300) + 0.5) * (math.pi / 150)
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    d = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=1)
    values = standard_sky(d, kind, sun) * np.sin(theta) * (math.pi / 600) * (math.pi / 150)
    expected = values @ reference.sh_basis(d, 4)
    np.testing.assert_allclose(project_sky(kind, 4, sun), expected, atol=2e-4 * abs(expected).max())


def test_overcast_coefficients():
    """Exact: ``7 pi / 9`` of irradiance on level ground, by Funk and Hecke's factors of the clamped cosine up to degree 20."""
    coeffs = np.array(project_sky("overcast", 20, zenith=(0, 0, 1)))
    z, weights = np.polynomial.legendre.leggauss(40)
    z, weights = (1 + z) / 2, weights / 2
    d = np.stack([np.sqrt(1 - z * z), 0 * z, z], axis=1)
    degrees = np.arange(21)
    zonal = (2 * math.pi * weights * (1 + 2 * z) / 3) @ reference.sh_basis(d, 20)[:, degrees * (degrees + 1)]
    expected = np.zeros(441)
    expected[degrees * (degrees + 1)] = zonal
    np.testing.assert_allclose(coeffs, expected, atol=1e-14)
    cosine = (2 * math.pi * weights * z) @ reference.sh_basis(d, 20)[:, degrees * (degrees + 1)]
    assert zonal @ cosine == pytest.approx(7 * math.pi / 9, rel=1e-4)


def test_precision_and_many_suns():
    """Loops in the kernel and in Python give the same; one sky per lane."""
    suns = np.array([SUN, (0, 1, 0), (-1, 0.3, 0.1)])
    doubles = [project_sky("clear", 4, sun, (0.1, 1, 0), 2.0) for sun in suns.tolist()]
    scale = np.abs(doubles).max()
    for array, tolerance in ((dr.llvm.ad.Array3f64, 1e-13), (dr.llvm.ad.Array3f, 3e-6)):
        wide = project_sky("clear", 4, array(suns.T), (0.1, 1, 0), 2.0)
        dr.eval(wide)
        np.testing.assert_allclose(np.array([c.numpy() for c in wide]).T, doubles, atol=tolerance * scale)


def test_turning_the_sky_turns_the_light():
    """Zenith and sun turned about x by 90 degrees: degree 1 turns like a vector."""
    before, after = project_sky("clear", 1, (0.5, 0.7, -0.4), (0, 1, 0)), project_sky("clear", 1, (0.5, 0.4, 0.7), (0, 0, 1))
    y, z, x = before[1:]                              # Y_1 = (-y, z, -x)
    assert after == pytest.approx([before[0], z, -y, x], abs=1e-12)


@pytest.mark.parametrize("kind", SUNNY)
def test_derivatives_by_the_sun(kind):
    number, array = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    weights = np.random.default_rng(5).normal(size=16).tolist()
    value = lambda x, zenith: sum(w * c for w, c in zip(weights, project_sky(kind, 3, array(x, number(0.7), number(-0.4)),
                                                                             zenith_luminance=zenith)))
    x, zenith = dr.opaque(number, 0.5), dr.opaque(number, 2)
    dr.enable_grad(x, zenith)
    total = value(x, zenith)
    dr.backward(total)
    moved = lambda step: value(dr.opaque(number, 0.5 + step), number(2))[0]
    assert dr.grad(x)[0] == pytest.approx((moved(1e-4) - moved(-1e-4)) / 2e-4, rel=1e-6)
    assert dr.grad(zenith)[0] == pytest.approx(total[0] / 2, rel=1e-12)


@pytest.mark.parametrize("call,error,text", [
    (lambda: cie_sky((0, 1, 0), "cloudy"), ValueError, "'kind' must be one of 'overcast', 'clear', 'partly_cloudy'"),
    (lambda: cie_sky((0, 1, 0), "clear"), ValueError, "'sun' must be a 3-vector with kind='clear'"),
    (lambda: cie_sky((0, 1, 0), "overcast", SUN), ValueError, "'sun' must be left out with kind='overcast'"),
    (lambda: cie_sky((0, 1, 0), "clear", SUN, zenith_luminance=-1), ValueError, "'zenith_luminance' must be a finite number >= 0"),
    (lambda: project_sky("clear", 3, (0, 0, 0)), ValueError, "'sun' must be a 3-vector of finite length"),
    (lambda: cie_sky((0, 0, 0), "overcast"), ValueError, "'direction' must be a 3-vector of finite length"),
    (lambda: cie_sky((0, 1, 0), "clear", SUN, (0, np.inf, 1)), ValueError, "'zenith' must be a 3-vector of finite length"),
    (lambda: project_sky("clear", 3, SUN, zenith="y"), TypeError, "'zenith' must be a 3-vector"),
    (lambda: project_sky("clear", 99, SUN), ValueError, "'order' must be an integer from 0 to 64"),
])
def test_errors(call, error, text):
    with pytest.raises(error, match=r"\(\): " + text):
        call()
