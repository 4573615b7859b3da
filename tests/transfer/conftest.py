"""Small scenes for the tests of the bake."""
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")


def mesh(vertices, faces, normals=None, name="mesh", **nested):
    """A Mitsuba mesh from arrays, with a nested `bsdf` or `emitter`."""
    props = mi.Properties()
    for key, plugin in nested.items():
        props[key] = mi.load_dict(plugin)
    shape = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=normals is not None, props=props)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mi.Float([float(v) for v in np.ravel(vertices)])
    parameters["faces"] = mi.UInt32([int(i) for i in np.ravel(faces)])
    if normals is not None:
        parameters["vertex_normals"] = mi.Float([float(v) for v in np.ravel(normals)])
    parameters.update()
    shape.set_id(name)
    return shape


def quad(corners, name="quad", **nested):
    """Two triangles with one normal, counter-clockwise seen from the side they face."""
    return mesh(corners, [[0, 1, 2], [0, 2, 3]], name=name, **nested)


def level(side, y, up=True, x=0.0, z=0.0):
    """Corners of a horizontal square about (x, y, z) that faces up or down."""
    h = side / 2
    corners = np.array([[-h, 0, h], [h, 0, h], [h, 0, -h], [-h, 0, -h]]) + [x, y, z]
    return corners if up else corners[::-1]


def light(corners, name="light", radiance=1.0):
    return quad(corners, name, emitter={"type": "area", "radiance": {"type": "rgb", "value": radiance}})


def box(low, high, name="box", inside=False, **nested):
    """An axis-aligned box of flat faces whose normals point outwards, or into a room."""
    (a, b, c), (d, e, f) = low, high
    v = np.array([[a, b, c], [d, b, c], [d, e, c], [a, e, c], [a, b, f], [d, b, f], [d, e, f], [a, e, f]], float)
    quads = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2]]
    faces = [t for q in quads for t in ([q[0], q[1], q[2]], [q[0], q[2], q[3]])]
    if inside:
        faces = [t[::-1] for t in faces]
    return mesh(v, faces, name=name, **nested)


def scene(*shapes):
    return mi.load_dict({"type": "scene", **{s.id(): s for s in shapes}}, optimize=False)


class Build:
    """The functions of this file, for tests: a conftest cannot be imported by name."""

    mesh, quad, level, light, box, scene = (staticmethod(f) for f in (mesh, quad, level, light, box, scene))


@pytest.fixture(scope="session")
def build():
    """Functions that build meshes, lights and scenes."""
    return Build
