"""Light at an infinite distance against quadrature of what the emitter evaluates, light without an extent against its formulas."""
import math

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

import drjit as dr

import reference
from mi_shlight.sh.functions import project_image
from mi_shlight.shading.distant import DistantLights

PIXELS = np.random.default_rng(0).random((7, 10, 3)).astype(np.float32)
PLACE = mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 50)
MIRRORED = PLACE @ mi.ScalarTransform4f().scale([-1, 1, 1])
FLOOR = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90)}      # y = 0, faces up, 2 x 2
ORDER = 5


def scene(**parts):
    return mi.load_dict({"type": "scene", "floor": FLOOR, **parts}, optimize=False)


def envmap(pixels=PIXELS, **more):
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32)), **more}


def coefficients(lights, wavelengths=None):
    """(order + 1)^2 rows of one column for each channel."""
    found = lights.attached().coefficients(mi.Color0f() if wavelengths is None else wavelengths, mi.Point3f(0))
    dr.eval(found)
    return np.array([np.ravel(c) for c in found])


def by_quadrature(emitter, rows, columns, transform, wavelengths=None, nodes=8):
    """Gauss-Legendre's rule in each cell between the pixels' places, by the emitter's own evaluation."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    share, weight = (1 + x) / 2, weight / 2
    theta, phi = (np.ravel(np.arange(n)[:, None] + o + share) * step for n, o, step in
                  ((rows - 1, 0, math.pi / (rows - 1)), (columns, 0.5, 2 * math.pi / columns)))
    area = np.outer(np.tile(weight, rows - 1) * np.sin(theta) * math.pi / (rows - 1), np.tile(weight, columns) * 2 * math.pi / columns)
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    local = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)])
    d = np.array(transform.matrix)[:3, :3] @ local
    si = dr.zeros(mi.SurfaceInteraction3f, len(theta))
    si.wi = -mi.Vector3f(d)
    if wavelengths is not None:
        si.wavelengths = wavelengths
    values = np.array(mi.unpolarized_spectrum(emitter.eval(si)), dtype=np.float64).reshape(-1, len(theta))
    return reference.sh_basis(d.T, ORDER).T @ (values * area.ravel()).T


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_mono_polarized"])
@pytest.mark.parametrize("transform", [PLACE, MIRRORED], ids=["turned", "mirrored"])
def test_envmap_is_what_mitsuba_evaluates(variant, transform):
    """A map of noise: cells of 30 by 36 degrees, poles included; float32 angles next to the poles cost the last digits."""
    mi.set_variant(variant)
    what = scene(sky=envmap(scale=2.0, to_world=mi.ScalarTransform4f(transform.matrix)))
    ours, expected = coefficients(DistantLights(what, ORDER)), by_quadrature(what.environment(), 7, 10, transform)
    np.testing.assert_allclose(ours, expected, atol=1e-5 * abs(expected).max())


@pytest.mark.parametrize("smooth", [True, False])
def test_remainder(smooth):
    """The norm of what a map's coefficients leave: not less, and nearly that if the map is smooth; nothing of a constant sky."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 33), (np.arange(64) + 0.5) * np.pi / 32, indexing="ij")
    bright = np.exp(3 * np.sin(theta) * np.cos(phi))[..., None] * [1.0, 0.5, 0.2]
    pixels = bright if smooth else np.random.default_rng(1).random((33, 64, 3))
    found = np.ravel(DistantLights(scene(sky=envmap(pixels, to_world=PLACE)), 2).attached().remainder())
    pixels = pixels.astype(np.float32).astype(np.float64)
    fine = np.linspace(0, 32, 32 * 8 + 1)             # the bilinear map on a grid eight times as fine
    rows = np.stack([np.stack([np.interp(fine, np.arange(33), pixels[:, j, c]) for j in range(64)], 1) for c in range(3)], -1)
    at = np.arange(512) / 8
    values = np.stack([[np.interp(at, np.arange(65), np.append(row[:, c], row[0, c])) for row in rows] for c in range(3)], -1)
    area = np.sin(fine * np.pi / 32)[:, None, None] * (np.pi / 256) * (np.pi / 256)
    expected = np.sqrt((values ** 2 * area).sum(axis=(0, 1)) - (project_image(pixels, 2) ** 2).sum(axis=-1))
    assert (found > 0.995 * expected).all()
    assert (found < (1.06 if smooth else 1.6) * expected).all()
    constant = scene(sky={"type": "constant", "radiance": {"type": "rgb", "value": 0.5}})
    np.testing.assert_array_equal(np.ravel(DistantLights(constant, 2).attached().remainder()), 0)


def test_envmap_agrees_with_the_projection_of_its_image():
    """The package's other way from a map to coefficients, in numpy and float64."""
    ours = coefficients(DistantLights(scene(sky=envmap(to_world=PLACE)), ORDER))
    np.testing.assert_allclose(ours.T, project_image(PIXELS, ORDER, PLACE), atol=3e-5)


def test_single_bright_pixel_of_a_large_map():
    """Nothing is sampled, so nothing is missed."""
    pixels = np.zeros((256, 512, 3))
    pixels[40, 77] = [1e4, 2e4, 0]
    ours = coefficients(DistantLights(scene(sky=envmap(pixels)), 8))
    expected = project_image(pixels, 8).T
    assert abs(expected).max() > 0.5
    np.testing.assert_allclose(ours, expected, atol=1e-4 * abs(expected).max())


def test_pixels_of_another_number():
    """A map that is replaced by one of another size, between two pictures."""
    what = scene(sky=envmap())
    lights, parameters = DistantLights(what, ORDER), mi.traverse(what)
    before = coefficients(lights)
    new = np.random.default_rng(3).random((300, 21, 3)).astype(np.float32)
    parameters["sky.data"] = mi.TensorXf(np.concatenate([new[:, -1:], new, new[:, :1]], axis=1))
    parameters.update()
    after = coefficients(lights)
    assert abs(after - before).max() > 0.1
    np.testing.assert_allclose(after.T, project_image(new, ORDER), atol=3e-5)


def test_constant():
    what = scene(sky={"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}})
    expected = np.zeros((36, 3))
    expected[0] = np.sqrt(4 * math.pi) * np.array([1, 2, 3])
    np.testing.assert_allclose(coefficients(DistantLights(what, ORDER)), expected, rtol=1e-6)


def test_spectra():
    """Between the wavelengths that are held: of a smooth map, whose hue and scale Mitsuba interpolates apart, and of a constant."""
    mi.set_variant("llvm_ad_spectral")
    wavelengths = mi.Spectrum([451.0, 523.5, 605.0, 703.0])
    theta, phi = np.meshgrid(np.linspace(0, math.pi, 33), (np.arange(64) + 0.5) * math.pi / 32, indexing="ij")
    smooth = np.stack([1 + 0.5 * np.cos(theta), 1 + 0.4 * np.sin(theta) * np.sin(phi), 0.8 + 0.6 * np.sin(theta) * np.cos(phi)], axis=-1)
    what = scene(sky=envmap(smooth, to_world=mi.ScalarTransform4f(PLACE.matrix)))
    expected = by_quadrature(what.environment(), 33, 64, PLACE, wavelengths, nodes=3)
    np.testing.assert_allclose(coefficients(DistantLights(what, ORDER), wavelengths), expected, atol=1e-3 * abs(expected).max())

    what = scene(sky={"type": "constant", "radiance": {"type": "d65"}})
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = wavelengths
    radiance = np.ravel(what.environment().eval(si))
    np.testing.assert_allclose(coefficients(DistantLights(what, 1), wavelengths)[0], np.sqrt(4 * math.pi) * radiance, rtol=1e-6)


def test_sky_without_pixels():
    """Mitsuba's own sky is evaluated between directions 1 degree apart."""
    what = scene(sky={"type": "sunsky", "sun_scale": 0.0, "sun_direction": [0.4, 0.3, 0.6]})
    ours, expected = coefficients(DistantLights(what, ORDER)), by_quadrature(what.environment(), 91, 120, mi.ScalarTransform4f(), nodes=2)
    np.testing.assert_allclose(ours, expected, atol=0.005 * abs(expected).max())


def test_derivatives_by_pixels_scale_and_radiance():
    """Coefficients are linear in them: forward mode gives the coefficients of the change, reverse mode the transposed."""
    rng = np.random.default_rng(1)
    for plugin, key, change in ((envmap(to_world=PLACE), "sky.data", rng.normal(size=(7, 12, 3))),
                                (envmap(to_world=PLACE), "sky.scale", rng.normal(size=1)),
                                ({"type": "constant"}, "sky.radiance.value", rng.normal(size=1))):
        what = scene(sky=plugin)
        if key == "sky.data":                         # the outer columns are copies
            change[:, 0], change[:, -1] = change[:, -2], change[:, 1]
        parameters, weights = mi.traverse(what), rng.normal(size=(36, 3)).astype(np.float32)
        start = np.array(parameters[key]).copy()
        kind = {"sky.data": mi.TensorXf, "sky.scale": mi.Float}.get(key, mi.Color3f if dr.depth_v(parameters[key]) == 2 else mi.Float)

        def put(t):
            moved = mi.Float(start.ravel().tolist()) + t * mi.Float(change.ravel().tolist())
            parameters[key] = mi.TensorXf(moved, start.shape) if kind is mi.TensorXf else kind(moved)
            parameters.update()
            found = DistantLights(what, ORDER).attached().coefficients(mi.Color0f(), mi.Point3f(0))
            return sum(dr.dot(mi.Color3f(*row), mi.Color3f(c)) for row, c in zip(weights.tolist(), found))

        expected = float(put(mi.Float(1.0))[0]) - float(put(mi.Float(0.0))[0])
        for mode in ("forward", "backward"):
            t = dr.opaque(mi.Float, 0.0)
            dr.enable_grad(t)
            total = put(t)
            (dr.backward if mode == "backward" else lambda _: dr.forward(t))(total)
            assert dr.grad(t if mode == "backward" else total)[0] == pytest.approx(expected, rel=1e-4), (key, mode)


def test_background_is_seen():
    """Where the camera looks past all shapes."""
    what = mi.load_dict({"type": "scene", "sky": envmap(to_world=PLACE), "ball": {"type": "sphere", "radius": 0.1}, "camera": {
        "type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])}}, optimize=False)
    ours = np.array(mi.render(what, integrator=mi.load_dict({"type": "shprt", "transfer": "unshadowed", "order": 2}), spp=256))
    expected = np.array(mi.render(what, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=256))
    corner = (slice(0, 2), slice(0, 2))
    assert expected[corner].mean() > 0.1
    np.testing.assert_allclose(ours[corner], expected[corner], rtol=0.01)


# --- without an extent ----------------------------------------------------------------------------------------------------------

POINTS = [(-0.5, 0, -0.5), (0.5, 0, 0.3), (0.9, 0, -0.9)]
DELTA = {
    "directional": {"type": "directional", "direction": [0.3, -1.0, 0.2], "irradiance": {"type": "rgb", "value": [1, 2, 3]}},
    "point": {"type": "point", "position": [0.2, 1.5, -0.1], "intensity": {"type": "rgb", "value": [1, 2, 3]}},
    "spot": {"type": "spot", "to_world": mi.ScalarTransform4f().look_at([-0.5, 2, -0.5], [-0.5, 0, -0.5], [1, 0, 0]), "cutoff_angle": 20.0,
             "beam_width": 15.0, "intensity": {"type": "rgb", "value": [1, 2, 3]}},
}


def expected_white(kind, p):
    """Irradiance over pi on ground that faces up."""
    if kind == "directional":
        d, strength = -np.array([0.3, -1.0, 0.2]) / math.sqrt(1.13), 1.0
    else:
        to = np.array([0.2, 1.5, -0.1] if kind == "point" else [-0.5, 2, -0.5]) - p
        d, strength = to / np.linalg.norm(to), 1 / (to @ to)
        if kind == "spot" and d[1] < math.cos(math.radians(20)):
            strength = 0.0
    return strength * d[1] / math.pi * np.array([1, 2, 3])


def white(lights, points=POINTS, **more):
    p = mi.Point3f(np.array(points).T.tolist())
    found = lights.delta_irradiance(p, mi.Normal3f(0, 1, 0), mi.Color0f(), mi.Bool(True), **more)
    return np.array(found).T


@pytest.mark.parametrize("kind", DELTA)
def test_lights_without_an_extent(kind):
    lights = DistantLights(scene(light=DELTA[kind]), ORDER)
    assert not lights.projected and lights.delta_count == 1
    np.testing.assert_allclose(white(lights), [expected_white(kind, np.array(p)) for p in POINTS], rtol=1e-5)


def test_several_of_them_and_their_shadows():
    """A wall shades the second point from the point light, and nothing from below."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0.35, 0.5, 0.1]).rotate([0, 1, 0], 60).scale(0.3)}
    lights = DistantLights(scene(wall=wall, **{kind: DELTA[kind] for kind in ("point", "spot")}), ORDER)
    free = np.array([expected_white("point", np.array(p)) + expected_white("spot", np.array(p)) for p in POINTS])
    np.testing.assert_allclose(white(lights, shadows=False), free, rtol=1e-5)
    free[1] = 0
    np.testing.assert_allclose(white(lights), free, rtol=1e-5)
    below = lights.delta_irradiance(mi.Point3f(0, 0, 0), mi.Normal3f(0, -1, 0), mi.Color0f(), mi.Bool(True))
    assert np.array(below).max() == 0


def test_any_bsdf_reflects_them():
    """A rough conductor: its BSDF, cosine included, times what arrives."""
    metal = {"type": "roughconductor", "alpha": 0.3}
    what = scene(metal={**FLOOR, "bsdf": metal, "to_world": mi.ScalarTransform4f().translate([0, 0.1, 0]).rotate([1, 0, 0], -90)},
                 directional=DELTA["directional"])
    si = what.ray_intersect(mi.Ray3f(mi.Point3f([0, 0.1], 1, [1, 0.9]), dr.normalize(mi.Vector3f(0.05, -1, -1))))
    bsdf, d = si.bsdf(), mi.Vector3f(*(-np.array([0.3, -1.0, 0.2]) / math.sqrt(1.13)).tolist())
    ours = np.array(DistantLights(what, ORDER).delta_reflected(si, bsdf, si.is_valid()))
    expected = np.array(bsdf.eval(mi.BSDFContext(), si, si.to_local(d)) * mi.Color3f(1, 2, 3))
    assert expected.min() > 0.01
    np.testing.assert_allclose(ours, expected, rtol=1e-5)


def test_derivatives_of_a_point_light():
    """By its place and by the point that it lights, in both modes, against the inverse square's own."""
    what = scene(light=DELTA["point"])
    parameters = mi.traverse(what)
    start, lights = mi.Point3f(parameters["light.position"]), DistantLights(what, ORDER)

    def value(t):
        parameters["light.position"] = start + mi.Vector3f(1, 0.5, -1) * t
        parameters.update()
        return lights.delta_irradiance(mi.Point3f(0.5 + 2 * t, 0, 0.3), mi.Normal3f(0, 1, 0), mi.Color0f(), mi.Bool(True))[0]

    def formula(t):
        to = np.array([0.2 + t, 1.5 + 0.5 * t, -0.1 - t]) - [0.5 + 2 * t, 0, 0.3]
        return to[1] / np.linalg.norm(to) ** 3 / math.pi

    slope = (formula(1e-4) - formula(-1e-4)) / 2e-4
    for mode in ("forward", "backward"):
        t = dr.opaque(mi.Float, 0.0)
        dr.enable_grad(t)
        result = value(t)
        (dr.backward if mode == "backward" else lambda _: dr.forward(t))(result)
        assert dr.grad(t if mode == "backward" else result)[0] == pytest.approx(slope, rel=1e-4)


def test_complaints():
    told = []
    lights = DistantLights(scene(sky={"type": "sunsky", "sun_direction": [0.4, 0.3, 0.6]}), ORDER, told.append)
    assert not lights.projected and len(told) == 1
    assert "'sky' (SunskyEmitter)" in told[0] and "set its sun_scale to 0 and add a 'directional' light" in told[0]
    quiet = []
    area = {"type": "rectangle", "emitter": {"type": "area"}}
    lights = DistantLights(scene(area=area, **DELTA), ORDER, quiet.append)
    assert not quiet and lights.delta_count == 3 and not lights.projected
    assert white(DistantLights(scene(area=area), ORDER)).max() == 0
