"""Lights of several facets under `shprt`, textured, meshes and two-sided ones: against sums over their facets and Mitsuba's `path`."""
import warnings

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from shprt_scenes import (  # noqa: E402
    GREY, QUICK, SQUARE, UNSHADOWED, camera, direct, emitter, fan, floor, integrator, level, light, mean_error, render, scene)

from mi_shlight import project_polygon  # noqa: E402
from mi_shlight.errors import UnsupportedSceneWarning  # noqa: E402
from mi_shlight.light.cut import cut, is_convex, lattice  # noqa: E402
from mi_shlight.lights import LightTable  # noqa: E402
from mi_shlight.scene import polygon_lights  # noqa: E402

DOWN = mi.ScalarTransform4f().translate([0, 1.2, 0]).rotate([1, 0, 0], 90)
BOX = mi.ScalarTransform4f().translate([0.1, 1.3, 0]).rotate([1, 1, 0.3], 35).scale(0.2)


def bitmap(seed=1, size=4):
    """A texture with one bright corner."""
    values = np.random.default_rng(seed).uniform(0.2, 0.8, (size, size, 3)).astype(np.float32)
    values[:size // 2, :size // 2] *= 10
    return {"type": "bitmap", "raw": True, "filter_type": "nearest", "data": mi.TensorXf(values.ravel().tolist(), shape=values.shape)}


def textured(subdivisions, radiance=None, to_world=None, **more):
    return {"type": "rectangle", "to_world": to_world or DOWN @ mi.ScalarTransform4f().scale([0.8, 0.4, 1]),
            "emitter": {"type": "shlight", "radiance": radiance or bitmap(), "subdivisions": subdivisions, **more}}


def cube(to_world=BOX, **more):
    return {"type": "cube", "to_world": to_world, "emitter": {**emitter(), **more}}


def textured_mesh(subdivisions=8, **more):
    """A planar quadrangle, no parallelogram, with a texture."""
    points = level([(-0.3, -0.2), (0.3, -0.3), (0.4, 0.3), (-0.3, 0.3)], 1.4, up=False, x=0.8)
    return fan(points, emitter={"type": "shlight", "radiance": bitmap(2), "subdivisions": subdivisions, **more})


# --- cutting ----------------------------------------------------------------------------------------------------------------------

def quad(width, height, skew=0.0):
    positions = np.array([[0, 0, 0], [width, 0, 0], [width + skew, height, 0], [0, height, 0.0]])
    faces, uv = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    return faces, positions, uv[faces]


@pytest.mark.parametrize("width, height, skew, count, expected, vertices", [
    (1, 1, 0, 2, 2, 4), (1, 1, 0, 128, 128, 81), (4, 1, 0, 32, 32, 27), (1, 4, 0, 128, 128, 85), (1, 1, 0.5, 18, 18, 16),
    (1, 1, 0.5, 1, 2, 4), (100, 1, 0, 8, 8, 10)])
def test_cut(width, height, skew, count, expected, vertices):
    """The parts fill the light, share their corners, and have the texture coordinates of the place they lie in."""
    faces, positions, uv = quad(width, height, skew)
    pieces = cut(faces, positions, uv, count)
    assert len(pieces.triangles) == expected and len(pieces.index) == vertices == len(np.unique(pieces.triangles))
    np.testing.assert_allclose(pieces.weight.sum(axis=1), 1)
    points = np.einsum("ck,ckx->cx", pieces.weight, positions[pieces.index])
    assert len(np.unique(points.round(9), axis=0)) == vertices
    corners = points[pieces.triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert areas.min() > 0 and areas.sum() == pytest.approx((width + skew / 2) * height)
    for place, texture in zip(corners.mean(axis=1), pieces.uv.mean(axis=1)):
        found = []
        for face, face_uv in zip(positions[faces], uv):
            b = np.linalg.solve(np.vstack([face[:, :2].T, np.ones(3)]), [*place[:2], 1])
            if b.min() > -1e-9:
                found.append(b @ face_uv)
        assert any(np.allclose(texture, f) for f in found)


def test_cells_are_nearly_square():
    faces, positions, uv = quad(4, 1)
    pieces = cut(faces, positions, uv, 128)
    corners = np.einsum("ck,ckx->cx", pieces.weight, positions[pieces.index])[pieces.triangles]
    np.testing.assert_allclose(np.ptp(corners, axis=1)[:, :2], 0.25, atol=1e-12)


def test_lattice():
    for s in (1, 2, 5):
        corners = lattice(s)
        assert corners.shape == (s * s, 3, 3) and (corners.sum(axis=-1) == s).all() and corners.min() == 0
        a, b = ((corners[:, k] - corners[:, 0])[:, 1:] for k in (1, 2))
        assert (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] == 1).all()


def test_is_convex():
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    outward = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    assert is_convex(outward, corner, 1e-3) and not is_convex(outward[:, ::-1], corner, 1e-3)
    assert is_convex(outward[:2], corner, 1e-3)
    dented = np.vstack([corner, [[0.2, 0.2, 0.2]]])
    assert not is_convex(np.vstack([outward[:3], [[1, 2, 4], [2, 3, 4], [3, 1, 4]]]), dented, 1e-3)


# --- facets -----------------------------------------------------------------------------------------------------------------------

PARTS = {
    "textured rectangle": (lambda: textured(16), 16),
    "textured, two-sided": (lambda: textured(8, two_sided=True), 16),
    "textured quadrangle": (textured_mesh, 8),
    "mean of a texture": (lambda: textured(1), 1),
    "cube": (cube, 12),
    "textured cube": (lambda: cube(radiance=bitmap(), subdivisions=48), 48),
    "two-sided polygon": (lambda: fan(level(SQUARE, 1.2, 0.4), emitter={**emitter(), "two_sided": True}), 2),
}


def facets(table):
    """Corners, emitted radiance of all facets of a table as numpy arrays: edges (start, end) and channels."""
    first, start, end = (np.array(getattr(table.facets, name)) for name in ("first_edge", "start", "end"))
    positions = np.array(table.facets.positions).reshape(-1, 3).astype(float)
    emitted = np.array(table.facets.emitted).reshape(-1, 3).astype(float)
    return [(positions[start[a:b]], positions[end[a:b]]) for a, b in zip(first, first[1:])], emitted


@pytest.mark.parametrize("name", PARTS)
def test_coefficients_are_the_sum_over_the_facets(name):
    """Each facet alone, in double precision, where it turns its front to the point: shared edges lose nothing."""
    make, count = PARTS[name]
    wall = fan([[-3, -3, -0.5], [3, -3, -0.5], [3, 4, -0.5], [-3, 4, -0.5]], bsdf=GREY)
    what = scene(camera((0.3, 1.2, 6), (0.3, 1.2, -0.5), 30, 3), wall=wall, light=make())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnsupportedSceneWarning)
        table = LightTable(polygon_lights(what)).attached()
        image = np.array(mi.render(what, integrator=integrator(order=3, coefficients=True, **UNSHADOWED), spp=1, seed=0))
    positions = mi.render(what, integrator=mi.load_dict({"type": "aov", "aovs": "p:position"}), spp=1, seed=0)
    points = np.array(positions)[..., -3:].reshape(-1, 3)
    edges, emitted = facets(table)
    assert table.count == count == len(edges)
    luminance = emitted @ [0.212671, 0.715160, 0.072169]
    compared = 0
    for point, found in zip(points, image[..., 3:].reshape(-1, 16)):
        if abs(point[2] + 0.5) < 1e-4:
            parts = [np.array(project_polygon(chain(*ends), tuple(point), 3, "edge")) for ends in edges]
            expected = sum(weight * part * (part[0] > 0) for part, weight in zip(parts, luminance))
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=3e-6)
            compared += expected[0] > 0
    assert compared >= 3


def chain(start, end):
    """Corners of one loop of edges in order."""
    loop, k = [], 0
    for _ in start:
        loop.append(tuple(start[k]))
        k = int(np.argmin(np.abs(start - end[k]).sum(axis=1)))
    return loop


def test_radiance_of_the_facets():
    """Means over the texels: a grid that falls on them, and each half of a texel the same."""
    values = np.random.default_rng(4).uniform(0, 1, (2, 4, 3)).astype(np.float32)
    picture = {"type": "bitmap", "raw": True, "filter_type": "nearest", "data": mi.TensorXf(values.ravel().tolist(), shape=(2, 4, 3))}
    what = scene(floor=floor(), light=textured(16, picture))
    table = LightTable(polygon_lights(what)).attached()
    _, emitted = facets(table)
    found = emitted[np.lexsort(emitted.T)]
    expected = np.repeat(values.reshape(-1, 3), 2, axis=0)
    np.testing.assert_allclose(found, expected[np.lexsort(expected.T)], rtol=1e-5)
    one = LightTable(polygon_lights(scene(floor=floor(), light=textured(1, bitmap())))).attached()
    many = LightTable(polygon_lights(scene(floor=floor(), light=textured(32, bitmap())))).attached()
    np.testing.assert_allclose(facets(one)[1][0], facets(many)[1].mean(axis=0), rtol=1e-4)


def test_polygons_of_a_light():
    """What visibility looks at: one outline of a planar light, whatever its texture and sides; otherwise the faces, facing out."""
    two_sided = fan(level(SQUARE, 1.2, 0.4), emitter={**emitter(), "two_sided": True})
    what = scene(floor=floor(), a=textured(32), b=cube(), c=two_sided, d=light())
    lights = {found.name: found for found in polygon_lights(what)}
    assert [len(lights[name].polygons) for name in "abcd"] == [1, 12, 1, 1]
    assert [len(outline) for outline, _ in lights["b"].polygons] == [3] * 12
    centre = lights["b"].vertices.mean(axis=0)
    for outline, normal in lights["b"].polygons:
        assert np.dot(outline[0, 0] - centre, normal) > 0 and np.linalg.norm(normal) == pytest.approx(1)
    table = LightTable(list(lights.values())).attached()
    edges, normals = (np.array(values) for values in table.outlines())
    polygons = [polygon for found in lights.values() for polygon in found.polygons]
    np.testing.assert_allclose(edges, np.concatenate([outline.ravel() for outline, _ in polygons]), atol=1e-6)
    np.testing.assert_allclose(normals.reshape(-1, 3), [normal for _, normal in polygons], atol=1e-6)


# --- pictures ---------------------------------------------------------------------------------------------------------------------

def test_refinement_converges_to_the_texture():
    """`path` shows the texture itself. 2, 32 and 128 triangles: 8 %, 1.4 % and 1.3 % measured, of which the noise of `path` and the band
    limit are 1.2 %."""
    what = scene(floor=floor(), light=textured(1))
    truth = np.array(mi.render(what, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=2048, seed=1))
    errors = []
    for count in (2, 32, 128):
        image = render(scene(floor=floor(), light=textured(count)), 16, order=8, **UNSHADOWED)
        errors.append(mean_error(image, truth))
    assert errors[0] > 3 * errors[1] > 3 * errors[2] and errors[2] < 0.015


@pytest.fixture(scope="module")
def under_a_cube():
    mi.set_variant("llvm_ad_rgb")
    what = scene(floor=floor(), light=cube(mi.ScalarTransform4f().translate([0.1, 1.6, 0]).scale(0.2)))
    return what, direct(what, 4096, 16)


@pytest.mark.parametrize("parameters", [UNSHADOWED, {"max_edge": 0.5}, {"transfer_domain": "pixel"}], ids=["unshadowed", "vertex", "pixel"])
def test_cube_light(under_a_cube, parameters):
    what, truth = under_a_cube
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedSceneWarning)
        image = render(what, 16, order=8, **parameters)
    assert mean_error(image, truth) < 0.01


def test_uniform_texture_changes_nothing():
    """A light cut into triangles of equal radiance is the light in one piece."""
    white = lambda: {"type": "bitmap", "raw": True, "data": mi.TensorXf([2.0] * 48, shape=(4, 4, 3))}
    whole = {"type": "rectangle", "to_world": DOWN @ mi.ScalarTransform4f().scale([0.8, 0.4, 1]),
             "emitter": {"type": "shlight", "radiance": {"type": "rgb", "value": 2.0}}}
    for parameters in ({**UNSHADOWED, "order": 3}, QUICK):
        images = [render(scene(floor=floor(), light=lamp), **parameters) for lamp in (textured(16, white()), whole)]
        assert images[1].mean() > 0.01
        np.testing.assert_allclose(*images, rtol=2e-4, atol=1e-5)


def test_two_sided_light():
    """The sum of the pictures of its two sides, on a floor and on what hangs above."""
    def picture(**lights):
        above = fan(level(SQUARE, 2.4, 2.0, up=False), bsdf=GREY)
        return render(scene(camera((0, 1.2, 5), (0, 1.2, 0), 40), floor=floor(), above=above, **lights), 4, order=4, **UNSHADOWED)

    def sheet(up=False, **more):
        return fan(level(SQUARE, 1.2, 0.4, up), emitter={**emitter(), **more})

    both, down, up = picture(light=sheet(two_sided=True)), picture(light=sheet()), picture(light=sheet(True))
    assert down.mean() > 0.005 and up.mean() > 0.005
    seen = np.maximum(down, up) == 3                  # the sheet itself, on one of its sides
    np.testing.assert_allclose(np.where(seen, 0, both), np.where(seen, 0, down + up), rtol=1e-4, atol=1e-5)


def test_kernels_do_not_grow_with_the_lights():
    """Two textured lights and four run the same kernels, and so compile once. (One alone is no call of many for Mitsuba.)"""
    counts = []
    for number in (2, 4):
        lights = {f"light{k}": textured(2 * (k + 1), to_world=DOWN @ mi.ScalarTransform4f().translate([0.4 * k, 0, 0]).scale(0.1))
                  for k in range(number)}
        what = scene(camera(size=4), floor=floor(), **lights)
        plugin = integrator(order=2, **UNSHADOWED)
        mi.render(what, integrator=plugin, spp=1)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(mi.render(what, integrator=plugin, spp=1))
            counts.append(max(k["operation_count"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT))
    assert counts[0] == pytest.approx(counts[1], rel=0.02)


# --- warnings, moves --------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("make, warns", [
    (cube, False), (lambda: textured(8, two_sided=True), False), (lambda: cube(two_sided=True), True),
    (lambda: {**cube(), "flip_normals": True}, True)], ids=["cube", "two-sided rectangle", "two-sided cube", "inside of a cube"])
def test_faces_that_hide_one_another_are_named(make, warns):
    what = scene(floor=floor(), lamp=make())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        polygon_lights(what)
    assert len(caught) == warns
    assert not warns or "light 'lamp': its faces hide one another" in str(caught[0].message)


@pytest.mark.parametrize("make", [cube, textured_mesh], ids=["cube", "textured"])
def test_moves_are_noticed(make):
    """Beyond its margin a light has its visibility baked anew, within it only the light changes."""
    what = scene(floor=floor(), light=make())
    plugin, parameters = integrator(**QUICK, light_margin=0.1), mi.traverse(what)
    first = plugin.prepare_scene(what, False)
    before = np.array(mi.render(what, integrator=plugin, spp=4, seed=0))
    start = mi.Float(parameters["light.vertex_positions"])
    for shift, same in ((0.05, True), (0.3, False)):
        parameters["light.vertex_positions"] = start + mi.Float([shift, 0, 0] * (len(start) // 3))
        parameters.update()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert (plugin.prepare_scene(what, False) is first) == same
        assert np.abs(np.array(mi.render(what, integrator=plugin, spp=4, seed=0)) - before).max() > 1e-3
