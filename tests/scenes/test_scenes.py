"""The example scenes: reproducible, small, and what their descriptions promise."""
import functools
import importlib
import re
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

SCENES = Path(__file__).resolve().parents[2] / "scenes"
NAMES = ("cornell_box", "floor", "plant", "sculpture", "textured_room", "many_lights", "double_sided")
LIGHTS = {"cornell_box": {"light": 4}, "floor": {"light": 4}, "plant": {"light-triangle": 3, "light-rectangle": 4},
          "sculpture": {"light-rectangle": 4, "light-triangle": 3, "light-arrow": 7},
          "textured_room": {"light-blue": 4, "light-pink": 4}, "many_lights": {f"light_{k:03d}": 3 for k in range(723)},
          "double_sided": {"light": 4}}
FACETS = {"textured_room": 344, "many_lights": 723, "double_sided": 2}          # 344 and 723 as in Wu et al. 2020; both sides count
MAX_FILE_BYTES, MAX_FOLDER_BYTES = 500_000, 1_300_000


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture(scope="module")
def generator():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCENES)
        yield importlib.import_module("generate")


def text_of(name: str) -> str:
    return (SCENES / f"{name}.xml").read_text(encoding="utf-8")


@functools.cache
def stock_scene(name: str, **parameters):
    """The scene with Mitsuba's own plugins only: `area`, one-sided, for shlight and `direct`, on lights only, for shprt."""
    text = re.sub(r'<(integer|boolean) name="(subdivisions|two_sided)" value="\w+"/>', "", text_of(name))
    text = text.replace('type="shlight"', 'type="area"').replace('filename" value="', f'filename" value="{SCENES}/')
    text = text.replace('<default name="order" value="8"/>', "")
    direct = ('<integrator type="direct"><integer name="emitter_samples" value="1"/>'
              '<integer name="bsdf_samples" value="0"/></integrator>')
    text, count = re.subn(r'<integrator type="shprt">.*?</integrator>', direct, text, flags=re.DOTALL)
    assert count == 1
    return mi.load_string(text, optimize=False, **parameters)


def mesh_arrays(mesh) -> tuple[np.ndarray, np.ndarray]:
    return (np.array(mesh.vertex_positions_buffer(), dtype=float).reshape(-1, 3),
            np.array(mesh.faces_buffer()).reshape(-1, 3))


def visible_points(scene) -> tuple[np.ndarray, np.ndarray]:
    """(points, normals) under the centres of the pixels, normals turned to the camera, without lights."""
    width, height = scene.sensors()[0].film().size()
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    position = mi.Point2f(mi.Float(x.ravel().tolist()), mi.Float(y.ravel().tolist()))
    ray, _ = scene.sensors()[0].sample_ray(0, 0, position, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    normal = np.array(mi.Normal3f(si.n)).T
    normal *= np.where(np.sum(normal * np.array(ray.d).T, axis=1) > 0, -1, 1)[:, None]
    keep = np.array(si.is_valid()) & ~np.array(si.shape.is_emitter())
    return np.array(si.p).T[keep], normal[keep]


def light_samples(mesh) -> tuple[np.ndarray, np.ndarray]:
    """Centroids of the 16 sub-triangles of every triangle of a light, and the light's normal."""
    vertices, faces = mesh_arrays(mesh)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    up = [((i + 1 / 3) / 4, (j + 1 / 3) / 4) for i in range(4) for j in range(4 - i)]
    down = [((i + 2 / 3) / 4, (j + 2 / 3) / 4) for i in range(3) for j in range(3 - i)]
    points = np.concatenate([a + u * (b - a) + v * (c - a) for u, v in up + down])
    normal = np.cross(b[0] - a[0], c[0] - a[0])
    return points, normal / np.linalg.norm(normal)


def blocked(scene, origin: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Whether the open segment from `origin` to `target` (both (N, 3)) meets a surface of the scene."""
    way = target - origin
    o, d = (mi.Vector3f(*(mi.Float(column.tolist()) for column in array.T)) for array in (origin, way))
    return np.array(scene.ray_test(mi.Ray3f(mi.Point3f(o), d, 1 - 1e-3, 0.0, mi.Color0f())))


def test_regenerating_gives_the_committed_bytes(generator, tmp_path):
    written = {p.relative_to(tmp_path): p.read_bytes() for p in generator.generate(tmp_path)}
    committed = {p.relative_to(SCENES): p.read_bytes() for p in [*SCENES.glob("*.xml"), *SCENES.glob("meshes/*")]}
    assert sorted(written) == sorted(committed)
    assert [str(p) for p in written if written[p] != committed[p]] == []


def test_files_are_small():
    sizes = {p.name: p.stat().st_size for p in SCENES.rglob("*") if p.is_file() and "__pycache__" not in p.parts}
    assert {name: size for name, size in sizes.items() if size >= MAX_FILE_BYTES} == {}
    assert sum(sizes.values()) < MAX_FOLDER_BYTES


@pytest.mark.parametrize("name", NAMES)
def test_loads_with_own_plugins(name):
    import mi_shlight

    mi_shlight.register()
    scene = mi.load_file(str(SCENES / f"{name}.xml"), optimize=False, order=4, spp=3, resx=12, resy=10)
    assert type(scene.integrator()).__name__ == "SHPRT"
    assert {s.id(): len(mesh_arrays(s)[0]) for s in scene.shapes() if s.is_emitter()} == LIGHTS[name]
    assert {type(e).__name__ for e in scene.emitters()} == {"SHLight"}
    if name in FACETS:
        from mi_shlight.lights import LightTable
        from mi_shlight.scene import polygon_lights

        assert LightTable(polygon_lights(scene)).count == FACETS[name]
    sensor = scene.sensors()[0]
    assert tuple(sensor.film().size()) == (12, 10) and sensor.sampler().sample_count() == 3


@pytest.mark.parametrize("name", NAMES)
def test_every_shape_has_an_id_and_every_reflectance_is_below_0_9(name):
    scene = stock_scene(name)
    ids = [s.id() for s in scene.shapes()]
    assert len(set(ids)) == len(ids) and not any(i.startswith("__") or i == "" for i in ids)
    assert all(s.is_mesh() for s in scene.shapes())
    colours = {key: np.array(value).max() for key, value in mi.traverse(scene).items()
               if re.search(r"(reflectance|color[01])\.value$", key)}
    assert {key: value for key, value in colours.items() if value >= 0.9} == {}
    assert len(colours) >= 1


@pytest.mark.parametrize("name", NAMES)
def test_contains_diffuse_materials_and_shlights_only(name):
    text = text_of(name)
    assert set(re.findall(r'<bsdf type="(\w+)"', text)) <= {"diffuse", "twosided"}
    assert re.findall(r'<emitter type="(\w+)"', text) == ["shlight"] * len(LIGHTS[name])
    assert len(stock_scene(name).emitters()) == len(LIGHTS[name])


@pytest.mark.parametrize("name", NAMES)
def test_lights_are_planar_and_consistently_wound(name):
    lights = [s for s in stock_scene(name).shapes() if s.is_emitter()]
    assert {s.id(): s.vertex_count() for s in lights} == LIGHTS[name]
    for light in lights:
        vertices, faces = mesh_arrays(light)
        _, normal = light_samples(light)
        assert np.ptp(vertices @ normal) < 2e-5          # coordinates are stored in steps of 1e-5
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        assert np.all(np.cross(b - a, c - a) @ normal > 0)


def test_textures_of_lights_span_dark_to_bright():
    for name in re.findall(r'value="(meshes/\w+\.png)"', text_of("textured_room")):
        texture = np.array(mi.Bitmap(str(SCENES / name)))
        assert texture.dtype == np.uint8 and 250 < texture.max() and texture.std(axis=(0, 1)).max() > 20


def test_many_lights_stand_apart_in_three_panels_of_gradually_changing_colour():
    lights = [s for s in stock_scene("many_lights").shapes() if s.is_emitter()]
    corners = np.array([mesh_arrays(light)[0] for light in lights])
    centres, reach = corners.mean(axis=1), np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2)
    parameters = mi.traverse(stock_scene("many_lights"))
    colours = np.array([np.ravel(np.array(parameters[f"{light.id()}.emitter.radiance.value"])) for light in lights])
    for panel in np.split(np.arange(723), 3):
        plane = np.linalg.svd(corners[panel].reshape(-1, 3) - corners[panel].mean(axis=(0, 1)))
        assert plane[1][2] < 0.02 and plane[1][1] > 10               # coordinates are stored in steps of 1e-3
        distance = np.linalg.norm(centres[panel, None] - centres[panel], axis=2) + 10 * np.eye(241)
        inner = reach[panel].max() / 2.2                              # of the inscribed circle
        assert distance.min() > 2 * 0.6 * inner
        nearest = distance.argmin(axis=1)
        step = np.abs(colours[panel][nearest] - colours[panel]).max()
        assert 0 < step < 0.6 and np.ptp(colours[panel], axis=0).max() > 3


def test_double_sided_light_stands_inside_what_it_lights():
    scene = stock_scene("double_sided")
    light, = (mesh_arrays(s)[0] for s in scene.shapes() if s.is_emitter())
    lit = np.concatenate([mesh_arrays(s)[0] for s in scene.shapes() if not s.is_emitter()])
    assert np.all(light > lit.min(axis=0)) and np.all(light < lit.max(axis=0))
    assert '<boolean name="two_sided" value="true"/>' in text_of("double_sided")


def test_arrow_light_is_concave_and_covered_once():
    light = next(s for s in stock_scene("sculpture").shapes() if s.id() == "light-arrow")
    vertices, faces = mesh_arrays(light)                 # the file keeps the order of the outline
    _, normal = light_samples(light)
    following = np.roll(vertices, -1, axis=0)
    turns = np.cross(following - vertices, np.roll(following, -1, axis=0) - following) @ normal
    assert np.sum(turns < 0) == 2 and np.sum(turns > 0) == 5
    outline_area = np.cross(vertices, following).sum(axis=0) @ normal / 2
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(outline_area, rel=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_every_light_lights_and_shadows_what_the_camera_sees(name):
    """Of the visible points turned towards a light most are lit by it, and some lie in its shadow (none on `floor`)."""
    scene = stock_scene(name, resx=48, resy=48)
    points, normals = visible_points(scene)
    points = points + 1e-4 * normals
    lights = [s for s in scene.shapes() if s.is_emitter()]
    for light in lights[::60] if name == "many_lights" else lights:
        samples, light_normal = light_samples(light)
        facing, shadowed = 0, 0
        for sample in samples:
            way = sample - points
            turned = (np.sum(way * normals, axis=1) > 0) & (way @ light_normal < 0)
            facing += turned.sum()
            shadowed += (turned & blocked(scene, points, np.broadcast_to(sample, points.shape))).sum()
        assert facing > 0.25 * len(points) * len(samples), light.id()
        if name == "floor":
            assert shadowed == 0
        else:
            assert 0.05 * facing < shadowed < 0.6 * facing, light.id()


@pytest.mark.parametrize("name", ("plant", "sculpture"))
def test_no_light_shadows_another_where_the_camera_sees(name):
    scene = stock_scene(name, resx=64, resy=64)
    points, _ = visible_points(scene)
    lights = [s for s in scene.shapes() if s.is_emitter()]
    only_lights = mi.load_dict({"type": "scene", **{s.id(): s for s in lights}}, optimize=False)
    for light in lights:
        for sample in light_samples(light)[0]:
            assert not blocked(only_lights, points, np.broadcast_to(sample, points.shape)).any(), light.id()


@pytest.mark.parametrize("name", NAMES)
def test_picture_is_well_exposed(name):
    image = np.array(mi.render(stock_scene(name, resx=48, resy=48), spp=32, seed=1))
    assert np.all(np.isfinite(image))
    assert 0.08 < image.mean() < 0.6
    light_in_view, black = {"double_sided": (0.04, 0.55),          # with one side dark
                            "textured_room": (0, 0.06),            # above its walls
                            "cornell_box": (0, 1)}.get(name, (0, 0))         # its ceiling and side faces
    assert np.mean(image.max(axis=2) > 1) < light_in_view + 0.03        # clipped in 8 bits
    assert np.mean(image.max(axis=2) < 0.01) < black + 0.03


@pytest.mark.parametrize("name", ("plant", "sculpture"))
def test_meshes_are_not_folded(name):
    """No triangle without area, none against its smooth normals: both would bake black spots."""
    for mesh in stock_scene(name).shapes():
        vertices, faces = mesh_arrays(mesh)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        areas = np.linalg.norm(normals, axis=1) / 2
        assert areas.min() > 1e-6, mesh.id()
        if mesh.has_vertex_normals():
            smooth = np.array(mesh.vertex_normals_buffer()).reshape(-1, 3)[faces]
            cosines = np.einsum("fkc,fc->fk", smooth, normals) / (2 * areas[:, None])
            assert cosines.min() > 0.3, mesh.id()


def test_sculpture_is_closed_and_faces_outwards():
    knot = next(s for s in stock_scene("sculpture").shapes() if s.id() == "knot")
    vertices, faces = mesh_arrays(knot)
    edges = {tuple(edge) for k in range(3) for edge in faces[:, [k, (k + 1) % 3]].tolist()}
    assert len(edges) == faces.size                      # no directed edge twice
    assert all((b, a) in edges for a, b in edges)        # each has its opposite: watertight
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.sum(a * np.cross(b, c)) > 0                # positive volume: faces wound outwards


def test_cornell_box_is_mitsubas_own():
    description = mi.cornell_box()
    description["integrator"] = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
    own, theirs = stock_scene("cornell_box"), mi.load_dict(description, optimize=False)
    assert [s.id() for s in own.shapes()] == [s.id() for s in theirs.shapes()]
    for a, b in zip(own.shapes(), theirs.shapes()):
        np.testing.assert_array_equal(mesh_arrays(a)[1], mesh_arrays(b)[1])
        np.testing.assert_allclose(mesh_arrays(a)[0], mesh_arrays(b)[0], rtol=0, atol=1.2e-7)
    image, expected = (np.array(mi.render(s, spp=16, seed=5)) for s in (own, theirs))
    # The parser composes transforms in double precision, the dictionary's are single: positions differ by one rounding
    assert np.linalg.norm(image - expected) < 1e-4 * np.linalg.norm(expected)


def test_ply_writer_refuses_more_vertices_than_16_bit_indices_reach(generator, tmp_path):
    surface = sys.modules["generate_meshes"].Surface(np.zeros((65537, 3)), np.zeros((1, 3), dtype=int))
    with pytest.raises(ValueError, match="at most 65536 vertices, got 65537"):
        generator.write_ply(tmp_path / "large.ply", surface)
