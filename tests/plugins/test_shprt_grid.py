"""`shprt` with the light grid: pictures against exact evaluation, moving lights, derivatives, dr.freeze, parameters."""
import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from autodiff import derivative
from mi_shlight.scene_grid import SceneGrid
from shprt_scenes import SIZE, block, camera, emitter, fan, floor, integrator, mean_error, render, scene

LIGHTS = 9
QUICK = {"order": 3, "max_edge": 1.0, "transfer_samples": 32}
UNSHADOWED = {"order": 3, "transfer": "unshadowed"}
GRID = {"grid_resolution": 5}


def triangle(k, height=1.1):
    """Light number k: small, above the floor, leaning its own way."""
    random = np.random.default_rng(k)
    middle = np.array([random.uniform(-1, 1), height, random.uniform(-1, 1)])
    corners = middle + 0.3 * np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0]]) * [1, 1, -1] + random.uniform(-0.1, 0.1, (3, 3))
    return fan(corners, emitter=emitter(radiance=random.uniform(0.2, 3, 3)))


def room(count=LIGHTS, **parts):
    return scene(floor=floor(), box=block((-0.4, 0, -0.2), (0, 0.5, 0.2)), **{f"light_{k}": triangle(k) for k in range(count)}, **parts)


@pytest.fixture(scope="module")
def lit_room():
    return room()


@pytest.fixture(scope="module")
def exact(lit_room):
    return render(lit_room, **UNSHADOWED)


@pytest.mark.parametrize("interpolation, error, low, high", [
    ("hermite", 1e-3, 0, 1e-3), ("hermite", 0, 5e-3, 0.05), ("tricubic", 0, 5e-3, 0.05), ("trilinear", 0, 0.05, 0.2),
    ("taylor", 0, 0.05, 0.2), ("inverse_distance", 0, 0.05, 0.3)])
def test_unshadowed(lit_room, exact, interpolation, error, low, high):
    image = render(lit_room, **UNSHADOWED, **GRID, grid_interpolation=interpolation, grid_error=error)
    assert low <= mean_error(image, exact) < high


@pytest.mark.parametrize("count", [2, LIGHTS])
def test_shadowed(count):
    """Two lights have a visibility, and so a grid, each; more share one."""
    what = room(count)
    assert mean_error(render(what, **QUICK, **GRID), render(what, **QUICK)) < 2e-3


def test_shapes_that_are_not_baked():
    what = room(ball={"type": "sphere", "center": [0.6, 0.3, 0], "radius": 0.3, "bsdf": {"type": "diffuse"}})
    assert mean_error(render(what, **QUICK, **GRID), render(what, **QUICK)) < 2e-3


def test_errors_fall_with_the_one_asked_for(lit_room, exact):
    errors = [mean_error(render(lit_room, **UNSHADOWED, **GRID, grid_error=e), exact) for e in (3e-2, 1e-4)]
    assert errors[0] < 3e-2 and errors[1] < 1e-4 and errors[1] < errors[0] / 5


def test_automatic_resolution_with_shapes_without_area():
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.3}}
    ball = {"type": "instance", "ref": {"type": "ref", "id": "group"}, "to_world": mi.ScalarTransform4f().translate([0.6, 0.3, 0])}
    what = scene(floor=floor(), group=group, ball=ball, light=triangle(0))
    assert np.array_equal(render(what, **UNSHADOWED, grid_resolution="auto"), render(what, **UNSHADOWED))


def test_automatic_resolution():
    """Exact where that costs less, for few lights; a grid for many."""
    few, many, plugin = room(1), room(80), integrator(**UNSHADOWED, grid_resolution="auto")
    assert np.array_equal(render(few, **UNSHADOWED, grid_resolution="auto"), render(few, **UNSHADOWED))
    image = np.array(mi.render(many, integrator=plugin, spp=64, seed=0))
    assert plugin._state.grid._cells is not None
    assert mean_error(image, render(many, spp=64, **UNSHADOWED)) < 1e-3


def test_lights_in_the_room_and_on_the_grid():
    """Two-sided, upright amid the floor, along a plane of the grid."""
    corners = np.array([[0, 0, -0.5], [0, 0, 0.5], [0, 0.6, 0.5], [0, 0.6, -0.5]])
    what = scene(floor=floor(), light=fan(corners, emitter={**emitter(), "two_sided": True}))
    exact, blurred, split = (render(what, **UNSHADOWED, **more) for more in ({}, {**GRID, "grid_error": 0}, GRID))
    assert mean_error(blurred, exact) > 0.03 and mean_error(split, exact) < 1e-4


def test_moving_lights_are_followed():
    """Vertices, and radiance: without another bake if the margin permits it."""
    what, plugin = room(), integrator(**QUICK, **GRID, light_margin=0.5)
    mi.render(what, integrator=plugin, spp=1)
    transfer = plugin.prepare_scene(what)
    parameters = mi.traverse(what)
    for k in range(LIGHTS):
        key = f"light_{k}.vertex_positions"
        parameters[key] = dr.ravel(dr.unravel(mi.Point3f, parameters[key]) + mi.Vector3f(0.1, 0.2, -0.1))
    parameters["light_3.emitter.radiance.value"] = mi.Color3f(0, 5, 0)
    parameters.update()
    moved = np.array(mi.render(what, integrator=plugin, spp=4, seed=0))
    assert plugin.prepare_scene(what) is transfer
    exact = integrator(**QUICK, light_margin=0.5)
    exact._transfer = transfer
    assert mean_error(moved, np.array(mi.render(what, integrator=exact, spp=4, seed=0))) < 1e-3


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_rgb_polarized"])
def test_variants(variant):
    if variant not in mi.variants():
        pytest.skip(f"this Mitsuba has no {variant}")
    mi.set_variant(variant)
    what = room(5)
    assert mean_error(render(what, **UNSHADOWED, **GRID), render(what, **UNSHADOWED)) < 1e-3


def test_coefficients(lit_room):
    pictures = [render(lit_room, spp=1, **UNSHADOWED, coefficients=True, **more) for more in ({}, GRID)]
    assert pictures[0].shape[2] == 3 + 16
    assert 1e-6 < np.abs(pictures[1] - pictures[0]).max() < 2e-3 < 1 < np.abs(pictures[0][..., 3:]).max()


@pytest.mark.parametrize("mode", ["forward", "backward"])
@pytest.mark.parametrize("parameters", [UNSHADOWED, QUICK], ids=["unshadowed", "shadowed"])
@pytest.mark.parametrize("keys", [[f"light_{k}.vertex_positions" for k in range(LIGHTS)], ["light_4.emitter.radiance.value"]],
                         ids=["vertices", "radiance"])
def test_derivatives(monkeypatch, keys, parameters, mode):
    """Along a random direction, against differences between pictures with the same near faces: where those change, values jump."""
    first, usual = [], SceneGrid.prepare

    def prepare(grid, *arguments):
        if not first:
            usual(grid, *arguments)
            first.append((grid._cells, grid._near))
            assert grid._near.count > 0
        grid._cells, grid._near = first[0]

    monkeypatch.setattr(SceneGrid, "prepare", prepare)
    what = room(sensor=camera(origin=(0, 0.9, 2.6)))              # with all lights above the view: outlines in it have no derivative
    plugin, random = integrator(**parameters, **GRID, light_margin=0.1), np.random.default_rng(2)
    traversed = mi.traverse(what)
    start = {key: type(traversed[key])(traversed[key]) for key in keys}
    by = {key: type(value)(random.uniform(0, 1, value.shape)) for key, value in start.items()}
    weights = random.uniform(0, 1, (SIZE, SIZE, 3))

    def picture(t):
        for key in keys:
            traversed[key] = start[key] + t * by[key]
        traversed.update()
        return mi.render(what, traversed, integrator=plugin, spp=1, seed=3)

    step = 3e-3 if "vertex" in keys[0] else 0.3
    difference = sum(sign * np.sum(weights * np.array(picture(mi.Float(sign * step)))) for sign in (1, -1)) / (2 * step)
    slope = derivative(lambda t: dr.sum(mi.TensorXf(weights) * picture(t), axis=None).array, mi.Float, mode)
    assert abs(slope - difference) < 1.5e-2 * abs(difference)


@pytest.mark.parametrize("count", [LIGHTS, 0])
def test_derivative_by_a_dark_light(count):
    """The start of an inverse problem: a light of radiance 0 is near to what it would light."""
    what = room(count, dark=fan(np.array([[0.3, 0.3, 0], [0.3, 0.3, 0.3], [0.6, 0.3, 0]]), emitter=emitter(radiance=(0, 0, 0))))
    slopes = []
    for more in ({}, GRID):
        parameters = mi.traverse(what)
        parameters["dark.emitter.radiance.value"] = mi.Color3f(0)
        dr.enable_grad(parameters["dark.emitter.radiance.value"])
        parameters.update()
        dr.backward(dr.sum(mi.render(what, parameters, integrator=integrator(**UNSHADOWED, **more), spp=4, seed=0), axis=None))
        slopes.append(dr.grad(parameters["dark.emitter.radiance.value"])[0][0])
    assert slopes[1] == pytest.approx(slopes[0], rel=2e-3)


def test_frozen_function():
    """The lists of near faces are those of the last picture outside."""
    what, plugin = room(), integrator(**UNSHADOWED, **GRID)
    plain = np.array(mi.render(what, integrator=plugin, spp=1, seed=0))
    frozen = dr.freeze(lambda what, seed: mi.render(what, integrator=plugin, spp=1, seed=seed))
    for seed in (1, 2, 0):
        image = np.array(frozen(what, mi.UInt32(seed)))
    assert mean_error(image, plain) < 1e-5


def test_frozen_function_without_a_picture_before():
    what, plugin = room(3), integrator(**UNSHADOWED, **GRID)
    plugin.prepare_scene(what)
    with pytest.raises(Exception) as caught:
        dr.freeze(lambda what: mi.render(what, integrator=plugin, spp=1))(what)
    error = caught.value
    while error.__cause__ is not None:
        error = error.__cause__
    assert "must be rendered before dr.freeze" in str(error)
    del caught, error
    gc.collect()                                      # Dr.Jit 1.5 aborts if a broken recording is collected during another one


@pytest.mark.parametrize("parameters, text", [
    ({"grid_resolution": 1}, "two or more"), ({"grid_resolution": 257}, "from 0 to 256"), ({"grid_resolution": "many"}, "auto"),
    ({"grid_interpolation": "cubic"}, "hermite"), ({"grid_error": -1.0}, "grid_error"), ({"grid_error": "small"}, "grid_error"),
    ({"grid_resolution": "auto", "grid_error": 0.0}, "above 0")])
def test_bad_parameters(parameters, text):
    with pytest.raises(Exception, match=text):
        integrator(**parameters)


def test_spectral_variants_are_refused():
    mi.set_variant("llvm_ad_spectral")
    integrator(grid_resolution=0)
    with pytest.raises(Exception, match="0 in spectral variants"):
        integrator(**GRID)


def test_from_a_file(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text('<scene version="3.0.0"><integrator type="shprt"><string name="grid_resolution" value="auto"/>'
                    '<string name="grid_interpolation" value="tricubic"/><float name="grid_error" value="0.01"/></integrator></scene>')
    parameters = mi.load_file(str(path)).integrator().parameters()
    assert (parameters["grid_resolution"], parameters["grid_interpolation"], parameters["grid_error"]) == ("auto", "tricubic", 0.01)
    path.write_text(path.read_text().replace('"auto"', '"8"'))
    assert mi.load_file(str(path)).integrator().grid_resolution == 8
