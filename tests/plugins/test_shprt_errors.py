"""`errors` of `shprt`: the bound against brute force, where it is exact and where zero, the estimates, the AOVs as layers."""
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

import drjit as dr
from shprt_scenes import GREY, floor, integrator, light, mesh, scene

from mi_shlight import bake_transfer
from mi_shlight.shading.errors import NAMES

HEIGHT, EDGE, SIDE, LAMP = 0.7, 0.1, 0.8, 1.5
RADIANCE = np.array([3.0, 2.0, 1.0])
LUMINANCE = 0.5 * RADIANCE @ [0.212671, 0.715160, 0.072169]
"""Of the lamp, times the floor's reflectance."""
SMALL = {"order": 3, "max_edge": 0.5, "transfer_samples": 256}
KINDS = {"unshadowed": {"transfer": "unshadowed"}, "projected": {"localised": False}, "localised": {}, "exact": {"transfer": "exact"},
         "exact, projected": {"transfer": "exact", "localised": False}, "windowed": {"localised": False, "window": "hann"}}


def half_covered(sensor=None, **more):
    """A floor under a square light that a plate beyond x = EDGE hides."""
    plate = mesh([[EDGE, HEIGHT, 3], [4, HEIGHT, 3], [4, HEIGHT, -3], [EDGE, HEIGHT, -3]], [[0, 1, 2], [0, 2, 3]])
    return scene(sensor, lamp=light(LAMP, SIDE / 2), plate=plate, floor=floor(), **more)


def due(points, shadows=True, n=200):
    """Luminance of the floor at points (P, 3), by midpoints over the lamp and the plate's edge."""
    u = ((np.arange(n) + 0.5) / n - 0.5) * SIDE
    q = np.stack([a.ravel() for a in np.meshgrid(u, [LAMP], u)], axis=1)
    d = q - points[:, None]
    squared = (d ** 2).sum(axis=2)
    seen = points[:, :1] + d[..., 0] * (HEIGHT / LAMP) < EDGE if shadows else True
    return LUMINANCE * (d[..., 1] ** 2 / squared ** 2 * seen).mean(axis=1) * SIDE ** 2 / np.pi


def downwards(points):
    """Rays that meet the floor at points (P, 3)."""
    origin = mi.Point3f(*(mi.Float(c.tolist()) for c in (points + [0, 0.2, 0]).T))
    return mi.RayDifferential3f(mi.Ray3f(origin, mi.Vector3f(0, -1, 0)))


def at(what, rays, **parameters) -> dict:
    """Luminance and errors where the rays hit."""
    plugin, sampler = integrator(errors=True, **parameters), mi.load_dict({"type": "independent"})
    sampler.seed(0, dr.width(rays.o))
    value, _, aovs, _ = plugin.sample(dr.ADMode.Primal, what, sampler, rays)
    values = [mi.luminance(value), *aovs]
    dr.eval(values)
    return {name: np.array(v) + np.zeros(dr.width(rays.o)) for name, v in zip(("value", *NAMES), values)}


POINTS = np.stack([np.linspace(-1.1, 1.1, 23), np.zeros(23), np.full(23, 0.2)], axis=1)


@pytest.mark.parametrize("order, kind", [(2, kind) for kind in KINDS] + [(5, "localised")])
def test_bound_holds(order, kind):
    """At a line of points from full light into the umbra; where it is exact, or zero, it is that."""
    found = at(half_covered(), downwards(POINTS), order=order, transfer_domain="pixel", transfer_samples=1024, **KINDS[kind])
    whole, truth = due(POINTS, shadows=False), due(POINTS, kind != "unshadowed")
    error, bound = abs(found["value"] - truth), found["truncation_bound"]
    assert (error <= bound + 3e-4 * whole).all()
    assert (bound <= whole * 1.05).all()                # what is hidden is no more than all
    if kind in ("unshadowed", "projected"):
        lit = truth >= whole * (1 - 1e-6)
        assert lit.sum() > 3
        np.testing.assert_allclose(bound[lit], error[lit], atol=3e-4 * whole.max())
        assert error[lit].max() > 3e-3 * whole.max()
    elif kind != "windowed":
        agreed = (truth == 0) | (truth >= whole * (1 - 1e-6))
        assert agreed.sum() > 6 and (bound[agreed] < 1e-5 * whole.max()).all()
        part = ~agreed
        assert np.median(bound[part] / error[part]) < 60 and bound[part].min() > 0
    np.testing.assert_array_equal(found["grid_error"], 0)
    np.testing.assert_allclose(sum(found[name] for name in NAMES[:3]), found["total_error"], rtol=1e-6)


def test_deviation_of_few_rays():
    """It is the root mean square of what other places of the rays change, to a factor of two."""
    many = np.repeat(POINTS[9:15], 100, axis=0)
    found = at(half_covered(), downwards(many), order=2, transfer_domain="pixel", transfer_samples=64)
    rows = found["value"].reshape(6, 100)
    seen, told = rows.std(axis=1), found["transfer_error"].reshape(6, 100).mean(axis=1)
    assert seen.max() > 0.01 * due(POINTS).max()
    assert 0.5 < np.sqrt((told ** 2).mean() / (seen ** 2).mean()) < 2


def test_baked_points_and_between():
    """At baked points the bound holds as at any; what lies between them is told by their differences."""
    what = half_covered()
    found = at(what, downwards(POINTS), **SMALL)
    error = abs(found["value"] - due(POINTS))
    covered = error <= found["truncation_bound"] + 3 * found["transfer_error"] + 1e-3 * LUMINANCE
    assert covered.all()
    between = found["transfer_error"] > 5e-3 * LUMINANCE
    assert between.any() and np.corrcoef(found["transfer_error"], error)[0, 1] > 0.3


def test_picture_and_layers(tmp_path):
    """The picture is the same, the AOVs come after the coefficients, and are layers of an EXR file."""
    what, parameters = half_covered(), {**SMALL, "order": 1}
    plain = np.array(mi.render(what, integrator=integrator(**parameters), spp=1))
    plugin = integrator(errors=True, coefficients=True, **parameters)
    assert plugin.aov_names() == ["L.0.0", "L.1.-1", "L.1.0", "L.1.1", *NAMES]
    image = np.array(mi.render(what, integrator=plugin, spp=1))
    np.testing.assert_array_equal(image[..., :3], plain)
    assert np.isfinite(image).all() and (image[..., 7:] >= 0).all() and image[..., 7].max() > 0
    np.testing.assert_allclose(image[..., 7:10].sum(axis=-1), image[..., 10], rtol=1e-5)
    what.sensors()[0].film().bitmap().write(str(tmp_path / "picture.exr"))
    layers = mi.Bitmap(str(tmp_path / "picture.exr"))
    names = [layers.struct_()[i].name for i in range(layers.channel_count())]
    for i, name in enumerate(NAMES):
        np.testing.assert_array_equal(np.array(layers)[..., names.index(name)], image[..., 7 + i])


def test_nothing_hidden():
    what = scene(lamp=light(), floor=floor())
    found = at(what, downwards(POINTS), **SMALL)
    assert found["value"].min() > 0.01
    assert found["truncation_bound"].max() < 1e-6 and found["transfer_error"].max() < 0.01 * found["value"].max()


def test_grid():
    """Its estimate follows the resolution, and is kept to grid_error where lights are near."""
    what = scene(lamp=light(0.8, 0.4), floor=floor())
    estimates = {}
    for resolution, limit in ((4, 0.0), (8, 0.0), (4, 1e-4)):
        found = at(what, downwards(POINTS), order=2, transfer="unshadowed", grid_resolution=resolution, grid_error=limit)
        estimates[resolution, limit] = found["grid_error"]
        exact = at(what, downwards(POINTS), order=2, transfer="unshadowed")
        off = abs(found["value"] - exact["value"])
        if not limit:
            assert 0.1 < np.sqrt((found["grid_error"] ** 2).mean() / (off ** 2).mean()) < 30
    assert estimates[8, 0].mean() < 0.3 * estimates[4, 0].mean()
    assert estimates[4, 1e-4].max() < 2e-4 * LUMINANCE < estimates[4, 0].max()


def test_light_between_surfaces():
    """The bound of what surfaces send on is bounced itself: from the penumbra by way of a wall."""
    what = half_covered(wall=mesh([[-1.3, 0, 2], [-1.3, 0, -2], [-1.3, 1, -2], [-1.3, 1, 2]], [[0, 1, 2], [0, 2, 3]], bsdf=GREY))
    direct = at(what, downwards(POINTS), **SMALL)
    both = at(what, downwards(POINTS), **{**SMALL, "transfer": "interreflected", "bounces": 2, "bounce_samples": 64})
    light, bound = (both[name] - direct[name] for name in ("value", "truncation_bound"))
    assert light.min() > 0 and bound.min() > 0
    assert 1e-6 < bound.max() < light.max()


def test_freeze_and_derivatives():
    """A frozen picture has the same errors; they carry no derivatives."""
    what, plugin = half_covered(), integrator(errors=True, **{**SMALL, "order": 1})
    plugin.prepare_scene(what)
    render = dr.freeze(lambda: mi.render(what, integrator=plugin, spp=1))
    for _ in range(2):
        frozen = np.array(render())
    np.testing.assert_allclose(frozen, np.array(mi.render(what, integrator=plugin, spp=1)), rtol=1e-5, atol=1e-7)
    parameters = mi.traverse(what)
    radiance = next(parameters[name] for name in parameters.keys() if name.endswith("radiance.value"))
    dr.enable_grad(radiance)
    parameters.update()
    image = mi.render(what, parameters, integrator=plugin, spp=1)
    dr.forward(radiance)
    slope = np.array(dr.grad(image))
    assert slope[..., :3].max() > 0
    np.testing.assert_array_equal(slope[..., 3:], 0)


@pytest.mark.parametrize("parameters, named", [
    ({"errors": "yes"}, "'errors' must be true or false"), ({"errors": True, "transfer": "glossy"}, "'errors' must be false with glossy"),
    ({"errors": True, "transfer": "interreflected", "bounce_lighting": "transfer", "localised": False}, "bounce_lighting='transfer'"),
], ids=["type", "glossy", "bounced transfer"])
def test_refused(parameters, named):
    with pytest.raises(RuntimeError, match=named):
        integrator(**parameters)


def test_refused_in_spectral_variants():
    mi.set_variant("llvm_ad_spectral")
    with pytest.raises(RuntimeError, match="'errors' must be false in spectral variants"):
        integrator(errors=True)


def test_refused_bake_of_higher_order(tmp_path):
    bake_transfer(half_covered(), 2, samples=16, max_edge=2.0, localised=False).save(tmp_path / "bake.npz")
    with pytest.raises(RuntimeError, match="'order' must be 2, that of .* with errors, got 1"):
        integrator(errors=True, order=1, transfer_file=str(tmp_path / "bake.npz"), localised=False)
