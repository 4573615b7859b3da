"""`shprt` under skies and lights without an extent: pictures against Mitsuba's `path`, windows, derivatives by pixels of a sky."""
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

import drjit as dr
from autodiff import derivative
from shprt_scenes import SIZE, block, floor, integrator, light, mean_error, render, scene

from mi_shlight.sh.windows import KINDS

COARSE = {"order": 4, "max_edge": 0.25, "transfer_samples": 256}
SUN = {"type": "directional", "direction": [0.3, -1, -0.4], "irradiance": {"type": "rgb", "value": [1.2, 1.0, 0.7]}}


def sky():
    """Smooth, brighter on one side and above."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 17), np.arange(32) * np.pi / 16, indexing="ij")
    pixels = np.stack([1 + np.cos(theta), 1 + 0.5 * np.sin(theta) * np.cos(phi), 1 - 0.5 * np.sin(theta) * np.sin(phi)], axis=-1)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(0.3 * pixels, dtype=np.float32))}


LIGHTS = {
    "constant": lambda: {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.2, 0.1]}}},
    "envmap": lambda: {"sky": sky()},
    "sun": lambda: {"sun": SUN},
    "all": lambda: {"sky": sky(), "sun": SUN, "lamp": light(),
                    "bulb": {"type": "point", "position": [1, 1.5, 1], "intensity": {"type": "rgb", "value": 1.0}}},
}


def on_floor(**lights):
    return scene(floor=floor(), block=block([-0.3, 0.2, -0.3], [0.3, 0.5, 0.3]), **lights)


@pytest.fixture(scope="module")
def truth():
    """Path-traced pictures, by light and bounces."""
    known = {}

    def of(name, bounces):
        if (name, bounces) not in known:
            path = mi.load_dict({"type": "path", "max_depth": 2 + bounces})
            known[name, bounces] = np.array(mi.render(on_floor(**LIGHTS[name]()), integrator=path, spp=2048, seed=1))
        return known[name, bounces]

    return of


@pytest.mark.parametrize("name, parameters", [
    ("constant", {}), ("envmap", {}), ("envmap", {"transfer_domain": "pixel", "transfer_samples": 64}), ("sun", {}),
    ("all", {}), ("all", {"transfer": "exact"}), ("all", {"transfer": "exact+interreflected", "bounces": 1}),
    ("envmap", {"transfer": "interreflected", "bounces": 1, "bounce_lighting": "transfer", "localised": False}),
    ("all", {"transfer": "shadowed+glossy", "bsdf_order": 2, "visibility_order": 2}),
], ids=lambda value: value if isinstance(value, str) else "-".join(map(str, value.values())))
def test_pictures(truth, name, parameters):
    """Shadows of the sun have sharp edges, on which pixels of both pictures differ by chance."""
    image = render(on_floor(**LIGHTS[name]()), 64, **{**COARSE, **parameters})
    expected = truth(name, 1 if "interreflected" in parameters.get("transfer", "") else 0)
    assert mean_error(image, expected) < 0.02
    assert abs(image.mean() / expected.mean() - 1) < 0.01


def test_a_sky_alone_is_lit_without_shadows():
    """Over an open floor ``unshadowed`` and ``shadowed`` are the same."""
    what = scene(floor=floor(), **LIGHTS["envmap"]())
    plain, baked = (render(what, **{**COARSE, "transfer": transfer}) for transfer in ("unshadowed", "shadowed"))
    np.testing.assert_allclose(plain, baked, rtol=2e-3)


def test_windows():
    """They change the picture of a sky, and of a lamp only if its transfer is projected."""
    sky, lamp = on_floor(**LIGHTS["envmap"]()), on_floor(lamp=light())
    pictures = {kind: render(sky, window=kind, **COARSE) for kind in KINDS}
    for kind in KINDS[1:]:
        assert 1e-3 < mean_error(pictures[kind], pictures["none"]) < 0.2
    np.testing.assert_array_equal(render(lamp, window="hann", **COARSE), render(lamp, **COARSE))
    assert mean_error(*(render(lamp, window=kind, localised=False, **COARSE) for kind in ("hann", "none"))) > 1e-2


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_derivative_by_pixels_of_the_sky(mode):
    what, plugin = on_floor(**LIGHTS["envmap"]()), integrator(**COARSE)
    parameters, weights = mi.traverse(what), dr.linspace(mi.Float, 1, -0.5, SIZE * SIZE * 3)
    start = mi.TensorXf(parameters["sky.data"])
    change = mi.TensorXf(np.random.default_rng(0).random(start.shape).astype(np.float32))

    def value(t, seed):
        parameters["sky.data"] = start + change * t
        parameters.update()
        return dr.sum(mi.render(what, parameters, integrator=plugin, spp=2, seed=seed).array * weights)

    step, seed = 0.1, mi.sample_tea_32(7, 1)[0]
    above, below = (value(mi.Float(t), seed)[0] for t in (step, -step))
    assert abs(above - below) > 0.1
    assert derivative(lambda t: value(t, 7), mi.Float, mode) == pytest.approx((above - below) / (2 * step), rel=1e-3)
