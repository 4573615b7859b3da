"""Small scenes for the tests of `shprt`, and ways to render them."""
import pathlib

import mitsuba as mi
import numpy as np

SCENES = pathlib.Path(__file__).parents[2] / "scenes"
SIZE = 16

SQUARE = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
ARROW = [(-1, -1), (0.2, -0.3), (1, -1), (0.4, 1)]
"""Concave: a fan of triangles about its second corner fills it."""
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}


def mesh(vertices, faces, **nested):
    props = mi.Properties()
    for key, plugin in nested.items():
        props[key] = mi.load_dict(plugin)
    shape = mi.Mesh("mesh", len(vertices), len(faces), props=props)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mi.Float([float(v) for v in np.ravel(vertices)])
    parameters["faces"] = mi.UInt32([int(i) for i in np.ravel(faces)])
    parameters.update()
    return shape


def level(outline, y, scale=1.0, up=True, x=0.0, z=0.0):
    """Points of a plane outline, counter-clockwise, laid horizontally; facing up, or down if not `up`."""
    points = np.array([[x + scale * a, y, z - scale * b] for a, b in outline])
    return points if up else points[::-1]


def fan(points, first=0, **nested):
    n = len(points)
    return mesh(points, [[first, (first + i) % n, (first + i + 1) % n] for i in range(1, n - 1)], **nested)


def emitter(plugin="shlight", radiance=(3.0, 2.0, 1.0)):
    value = {"type": "rgb", "value": list(radiance)} if not mi.is_spectral else {"type": "d65", "scale": radiance[0]}
    return {"type": plugin, "radiance": value}


def light(y=1.5, scale=0.4, up=False, outline=SQUARE, first=0, **where):
    plugin, radiance = where.pop("plugin", "shlight"), where.pop("radiance", (3.0, 2.0, 1.0))
    points = level(outline, y, scale, up, **where)
    return fan(points, first if up else len(points) - 1 - first, emitter=emitter(plugin, radiance))


def ring_light(y=1.5):
    """A square light with a square hole."""
    points = np.concatenate([level(SQUARE, y, 0.6), level(SQUARE, y, 0.3)])
    faces = [t for i in range(4) for j in [(i + 1) % 4] for t in ([i, 4 + i, j], [j, 4 + i, 4 + j])]
    return mesh(points, faces, emitter=emitter())


def floor(y=0.0, scale=2.0, bsdf=GREY, up=True, **where):
    return fan(level(SQUARE, y, scale, up, **where), bsdf=bsdf)


def block(low, high, bsdf=GREY):
    (a, b, c), (d, e, f) = low, high
    v = [[a, b, c], [d, b, c], [d, e, c], [a, e, c], [a, b, f], [d, b, f], [d, e, f], [a, e, f]]
    quads = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2]]
    return mesh(v, [t for q in quads for t in ([q[0], q[1], q[2]], [q[0], q[2], q[3]])], bsdf=bsdf)


def camera(origin=(0, 2.4, 3), target=(0, 0, 0.4), fov=24, size=SIZE, pixels="rgb"):
    """By default the floor fills the view, without any edge whose antialiasing would differ between pictures."""
    up = [0, 1, 0] if origin[0] != target[0] or origin[2] != target[2] else [0, 0, -1]
    return {"type": "perspective", "fov": fov, "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), up),
            "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": pixels, "component_format": "float32",
                     "rfilter": {"type": "box"}}}


def scene(sensor=None, **parts):
    if mi.is_monochromatic and sensor is None:
        sensor = camera(pixels="luminance")
    return mi.load_dict({"type": "scene", "sensor": sensor or camera(), **parts}, optimize=False)


def integrator(**parameters):
    return mi.load_dict({"type": "shprt", **parameters})


UNSHADOWED = {"transfer": "unshadowed"}
QUICK = {"order": 3, "max_edge": 1.0, "transfer_samples": 32}


def render(what, spp=4, seed=0, **parameters):
    pixels = np.array(mi.render(what, integrator=integrator(**parameters), spp=spp, seed=seed))
    assert np.isfinite(pixels).all()
    return pixels


def direct(what, spp=1024, samples=4):
    """Converged reference without the light of other surfaces."""
    plugin = mi.load_dict({"type": "direct", "emitter_samples": samples, "bsdf_samples": 0})
    return np.array(mi.render(what, integrator=plugin, spp=spp, seed=1))


def mean_error(image, truth):
    """Mean absolute difference over mean brightness."""
    assert truth.mean() > 1e-3, "an image this dark compares nothing"
    return np.abs(image - truth).mean() / truth.mean()
