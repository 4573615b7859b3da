"""Recover an area light from one picture of its soft shadows: ``python scenes/inverse_rendering.py [rectangle | pentagon]``.

The target is path traced. `shprt` renders the same room under a guess of the light, without noise from the light and with shadows that
are differentiable, so that Adam can follow the gradient from the guess to the light that made the target.

    rectangle   position, orientation, edge lengths and radiance: 11 numbers, through ``light.to_world``
    pentagon    five vertices: 15 numbers, through ``light.vertex_positions``

To use it for a scene of your own: give :py:func:`optimise` the scene, its light as a :py:class:`Rectangle` or :py:class:`Polygon`, and the
picture. The light should stay out of view: the derivative of its own outline as the camera sees it is left out.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

if mi.variant() is None:
    mi.set_variant("llvm_ad_rgb")
import mi_shlight  # noqa: F401  registers the plugins

ROOM = Path(__file__).resolve().parent / "inverse_room.xml"
AIM = np.array([0.0, 0.3, 0.0])
"""Middle of the blockers; the light's distance is measured from here."""

PENTAGON = np.array([(-0.65, -0.45), (0.35, -0.55), (0.80, 0.05), (0.15, 0.60), (-0.60, 0.35)])
"""Outline of the pentagon that is looked for, in its own plane."""

PENTAGON_RADIANCE = (12.0, 10.0, 7.0)
CLEARANCE = 1.0
"""Starts have all their corners above this height: over the blockers."""

BULGE = 0.02
"""Least height of a polygon's corner over the line between its neighbours, in parts of their distance."""

RESIDUAL = 0.1
"""Differences beyond this part of the picture's mean count linearly instead of squared, so that no pixel rules the first steps."""

HELD = {"log_half_edges": 0.3}
"""Parameters that wait for this part of the steps. A light's size shows in the penumbras only, and from a wrong place it would be fitted to
the wrong ones."""


# ------------------------------------------------------------------------------------------------ lights with free parameters
class Rectangle:
    """A rectangle light as numbers that Adam may change freely, none of which can run into a limit.

    The orientation is a turn (axis times angle, radians) away from the one it starts with; edge lengths are logarithms, and so is the
    radiance, by way of the irradiance of the room's middle: radiance times area over squared distance. The picture tells that far
    better than radiance, area or distance, and Adam, which scales every number by itself, finds the others only if it need not keep
    them in step.
    """

    def __init__(self, centre, frame, half_edges, radiance):
        """`frame`: (3, 3) rotation whose columns are the directions of the two edges and the lit side."""
        self.frame = mi.Matrix4f(np.block([[frame, np.zeros((3, 1))], [np.zeros((1, 3)), 1]]).tolist())
        self.start = {"centre": mi.Point3f(*floats(centre)), "turn": mi.Vector3f(0, 0, 0),
                      "log_half_edges": mi.Vector2f(*floats(np.log(half_edges)))}
        self.start["log_irradiance"] = mi.Color3f(*floats(np.log(radiance))) - dr.log(self._distance_squared_over_area(self.start))

    @classmethod
    def of_scene(cls, parameters):
        """The scene's own ``light``."""
        matrix = np.array(parameters["light.to_world"].matrix, dtype=float).reshape(4, 4)
        length = np.linalg.norm(matrix[:3, :3], axis=0)
        return cls(matrix[:3, 3], matrix[:3, :3] / length, length[:2], np.ravel(parameters["light.emitter.radiance.value"]))

    def to_world(self, values):
        angle = dr.sqrt(dr.squared_norm(values["turn"]) + 1e-12)     # differentiable at 0, too
        turn = mi.Transform4f().rotate(values["turn"] / angle, angle * (180 / dr.pi))
        half = dr.exp(values["log_half_edges"])
        return mi.Transform4f().translate(values["centre"]) @ turn @ mi.Transform4f(self.frame) @ mi.Transform4f().scale(
            mi.Vector3f(half.x, half.y, 1))

    def radiance(self, values):
        return dr.exp(values["log_irradiance"]) * self._distance_squared_over_area(values)

    def _distance_squared_over_area(self, values):
        half = dr.exp(values["log_half_edges"])
        return dr.squared_norm(values["centre"] - mi.Point3f(*floats(AIM))) / (4 * half.x * half.y)

    def apply(self, values, parameters) -> None:
        """Set the light of a scene; derivatives go through to `values`."""
        parameters["light.to_world"] = self.to_world(values)
        parameters["light.emitter.radiance.value"] = self.radiance(values)
        parameters.update()

    def brighten(self, values, factor) -> None:
        """Multiply the radiance by a `factor` per channel."""
        values["log_irradiance"] = dr.detach(values["log_irradiance"]) + mi.Color3f(*floats(np.log(factor)))

    def constrain(self, values) -> None:
        """Nothing to do: every value is a rectangle."""

    def outline(self, values) -> tuple:
        """Corners (4, 3), counter-clockwise seen from the lit side, and radiance (3,)."""
        matrix = np.array(dr.detach(self.to_world(values)).matrix, dtype=float).reshape(4, 4)
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        return corners @ matrix[:3, :2].T + matrix[:3, 3], np.ravel(dr.detach(self.radiance(values))).astype(float)


class Polygon:
    """A planar polygon light whose vertices are free; its radiance is known."""

    def __init__(self, corners, radiance):
        """`corners`: (n, 3), counter-clockwise seen from the lit side, convex."""
        self.radiance = np.array(radiance, dtype=float)
        self.count = len(corners)
        self.start = {"vertices": mi.Float(floats(corners))}

    def shape(self):
        """The light as a mesh to put into a scene."""
        props = mi.Properties()
        props["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": floats(self.radiance)}})
        mesh = mi.Mesh("light", self.count, self.count - 2, props=props)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = self.start["vertices"]
        parameters["faces"] = mi.UInt32([i for k in range(1, self.count - 1) for i in (0, k, k + 1)])
        parameters.update()
        return mesh

    def apply(self, values, parameters) -> None:
        """Set the light of a scene; derivatives go through to `values`."""
        parameters["light.vertex_positions"] = values["vertices"]
        parameters.update()

    def brighten(self, values, factor) -> None:
        """Nothing to do: the radiance is known."""

    def constrain(self, values) -> None:
        """Move the vertices to the plane that fits them best, and corners that became dents out again, so that no face turns over."""
        corners, _ = self.outline(values)
        centre = corners.mean(axis=0)
        normal = np.linalg.svd(corners - centre)[2][2]
        corners -= np.outer((corners - centre) @ normal, normal)
        if centroid(corners)[1] @ normal < 0:
            normal = -normal
        for k in list(range(self.count)) * self.count:               # a corner that moves out may leave its neighbour in a dent
            before, after = corners[k - 1], corners[(k + 1) % self.count]
            out = np.cross(after - before, normal)
            height = (corners[k] - before) @ out / (out @ out)
            corners[k] += max(BULGE - height, 0) * out
        values["vertices"] = mi.Float(floats(corners))

    def outline(self, values) -> tuple:
        """Corners (n, 3), counter-clockwise seen from the lit side, and radiance (3,)."""
        return np.array(dr.detach(values["vertices"]), dtype=float).reshape(-1, 3), self.radiance


def floats(values) -> list:
    return [float(v) for v in np.ravel(values)]


# ------------------------------------------------------------------------------------------------ the optimisation
def picture_loss(scene, parameters, integrator, target, spp, seed):
    """Loss of a render against the target; the gradient of what `parameters` hold is added to where they came from."""
    image, unit = mi.render(scene, parameters, integrator=integrator, spp=spp, seed=seed), dr.mean(target, axis=None)
    loss = dr.mean(dr.sqrt(dr.square((image - target) / unit) + RESIDUAL**2) - RESIDUAL, axis=None)
    dr.backward(loss)
    return dr.detach(loss)


def optimise(scene, light, target, integrator=None, *, iterations=240, rate=0.1, spp=4, seed=0, resample=False, freeze=True):
    """Fit the parameters of a light to a picture by Adam.

    Parameters
    ----------
    scene : mi.Scene
        Its shape ``light`` is changed; everything else stays.
    light : Rectangle or Polygon
        Where to start.
    target : mi.TensorXf, shape (H, W, 3)
        The picture to match, of the size of the scene's film.
    integrator : mi.Integrator, optional
        Default: the scene's own.
    iterations : int
        Number of steps. The step length falls from `rate` to 0 along a quarter of a cosine.
    rate : float
        First step length: scene units, radians and logarithms.
    spp : int
        Samples per pixel of each step.
    seed : int
        Seed of the samples.
    resample : bool
        Draw new samples in every step. Better for an integrator that samples the light, whose noise averages out over the steps.
    freeze : bool
        Record render and derivative once and replay them: the same results without 0.1 s of Python in every step. Mitsuba's projective
        integrators do not support it.

    Yields
    ------
    (loss, corners, radiance): of the light that each step rendered, before it moved on: the loss, corners (n, 3), and radiance (3,).

    Notes
    -----
    The brightness is matched to the target's mean before the first step: as long as it is wrong, all else would move to make up for
    it. Unless `resample` is set the samples stay the same, so that the gradient has no noise that would drown the little the picture
    tells about the size of a light; `mi.render` takes image and derivative with different samples, so they do not bias it either. That
    needs many rays per pixel, since with few the noise of the shadows depends on the light's size. The room's file has 32 for each of the
4 samples: as many rays, and about as much time, as one sample of 128, which also leaves the noise of edges and twice the error of the area.
    """
    parameters, integrator = mi.traverse(scene), integrator or scene.integrator()
    descend = dr.freeze(picture_loss) if freeze else picture_loss
    prepare = getattr(integrator, "prepare_scene", lambda scene: None)     # what shprt cannot do inside of a frozen function
    adam = mi.ad.Adam(lr=rate, beta_2=0.95, params=light.start)      # forgets the large gradients of the first steps
    light.apply(light.start, parameters)
    first = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    light.brighten(adam, np.array(target).mean(axis=(0, 1)) / np.array(first).mean(axis=(0, 1)))
    for i in range(iterations):
        fall = np.cos(0.5 * np.pi * i / iterations)
        adam.set_learning_rate({name: rate * fall * (i >= HELD.get(name, 0) * iterations) for name in light.start})
        light.apply(adam, parameters)
        prepare(scene)
        loss = descend(scene, parameters, integrator, target, spp, dr.opaque(mi.UInt32, seed + i * resample))
        found = light.outline(adam)
        adam.step()
        light.constrain(adam)
        yield loss.array[0], *found
    light.apply({name: dr.detach(adam[name]) for name in light.start}, parameters)


def light_errors(found, truth) -> dict:
    """Differences between two lights, each as `outline` gives it.

    Returns
    -------
    dict
        ``centre``: distance of the centroids over the true light's distance from the scene; ``angle``: between the normals,
        degrees; ``area``: ratio minus 1; ``corners``: root mean square distance of corresponding corners, over the same
        distance (the smallest for any choice of the first corner); ``radiance``: largest relative difference of a channel;
        ``power``: ratio of area times mean radiance, minus 1.
    """
    (corners, radiance), (true_corners, true_radiance) = found, truth
    (centre, area), (true_centre, true_area) = centroid(corners), centroid(true_corners)
    distance = np.linalg.norm(true_centre - AIM)
    size, true_size = np.linalg.norm(area), np.linalg.norm(true_area)
    apart = [np.sqrt(((np.roll(corners, k, axis=0) - true_corners) ** 2).sum(axis=1).mean()) for k in range(len(corners))]
    return {"centre": float(np.linalg.norm(centre - true_centre) / distance),
            "angle": float(np.degrees(np.arccos(np.clip(area @ true_area / (size * true_size), -1, 1)))),
            "area": float(size / true_size - 1), "corners": float(min(apart) / distance),
            "radiance": float(np.abs(radiance / true_radiance - 1).max()),
            "power": float(size * radiance.mean() / (true_size * true_radiance.mean()) - 1)}


def centroid(corners) -> tuple:
    """Centre of area, and the area as a vector along the normal, of a planar polygon."""
    fan = corners - corners[0]
    areas = np.cross(fan[1:-1], fan[2:]) / 2
    total = areas.sum(axis=0)
    parts = areas @ total / (total @ total)
    return corners[0] + parts @ (fan[1:-1] + fan[2:]) / 3, total


# ------------------------------------------------------------------------------------------------ the two problems
def load_room(resolution: int, order: int = 8, light=None):
    """The example scene; `light`: a shape that takes the place of its rectangle."""
    room = mi.load_file(str(ROOM), optimize=False, resx=resolution, resy=resolution, order=order)
    if light is None:
        return room
    kept = {shape.id(): shape for shape in room.shapes() if shape.id() != "light"}
    return mi.load_dict({"type": "scene", "integrator": room.integrator(), "sensor": room.sensors()[0], **kept, "light": light},
                        optimize=False)


def true_light(problem: str):
    """The light to recover: ``rectangle`` is the one in the scene's file, ``pentagon`` stands at the same place."""
    rectangle = Rectangle.of_scene(mi.traverse(load_room(16)))
    if problem == "rectangle":
        return rectangle
    matrix = np.array(rectangle.to_world(rectangle.start).matrix, dtype=float).reshape(4, 4)
    edges = matrix[:3, :2] / np.linalg.norm(matrix[:3, :2], axis=0)
    return Polygon(PENTAGON @ edges.T + matrix[:3, 3], PENTAGON_RADIANCE)


def random_start(truth, scene, rng):
    """A light somewhere else: what the optimisation starts from.

    The centre is anywhere in the ball of half the light's distance, the orientation is turned about a random axis by up to 30
    degrees, and edges are 0.5 to 2 times as long. A rectangle has a random colour, each channel 0.5 to 2 times its true mean; a
    pentagon starts regular. Starts that the camera could see, or that hang among the blockers, are drawn again.
    """
    corners, radiance = truth.outline(truth.start)
    true_centre, area = centroid(corners)
    distance = np.linalg.norm(true_centre - AIM)
    along = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    normal = area / np.linalg.norm(area)
    frame = np.stack([along, np.cross(normal, along), normal], axis=1)
    factor = lambda count: 2 ** rng.uniform(-1, 1, count)
    while True:
        offset = rng.normal(size=3)
        offset *= rng.uniform() ** (1 / 3) / np.linalg.norm(offset)
        axis = rng.normal(size=3)
        turn = mi.ScalarTransform4f().rotate(floats(axis), float(rng.uniform(-30, 30)))
        centre, turned = true_centre + distance / 2 * offset, np.array(turn.matrix)[:3, :3] @ frame
        if isinstance(truth, Rectangle):
            half_edges = np.linalg.norm(np.diff(corners[:3], axis=0), axis=1) / 2
            light = Rectangle(centre, turned, half_edges * factor(2), radiance.mean() * factor(3))
        else:
            angles = 2 * np.pi * np.arange(len(corners)) / len(corners)
            radius = np.sqrt(np.linalg.norm(area) / np.pi) * factor(1)
            light = Polygon(centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) @ turned[:, :2].T, radiance)
        outline = light.outline(light.start)[0]
        if outline[:, 1].min() > CLEARANCE and not in_view(scene, outline):
            return light


def in_view(scene, corners) -> bool:
    """Whether the camera sees a point of a polygon's outline, occluders aside."""
    steps = np.linspace(0, 1, 9)[:, None, None]
    points = (corners * (1 - steps) + np.roll(corners, -1, axis=0) * steps).reshape(-1, 3)
    it = dr.zeros(mi.Interaction3f, len(points))
    it.p = mi.Point3f(*(mi.Float(floats(column)) for column in points.T))
    _, weight = scene.sensors()[0].sample_direction(it, mi.Point2f(0.5))
    return bool(dr.any(weight != 0, axis=None))


def set_up(problem: str, resolution: int, order: int = 8, target_spp: int = 1024):
    """(scene, true light, path-traced target picture) of ``rectangle`` or ``pentagon``."""
    truth = true_light(problem)
    scene = load_room(resolution, order, truth.shape() if problem == "pentagon" else None)
    path = mi.load_dict({"type": "path", "max_depth": 2})
    return scene, truth, mi.render(scene, integrator=path, spp=target_spp)


def draw(path, pictures: dict) -> None:
    """Write pictures (H, W, 3) side by side with their names above, all at the exposure of the last."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from mi_shlight.panel import srgb

    exposure = 0.9 / np.percentile(list(pictures.values())[-1], 99)
    figure = Figure(figsize=(3 * len(pictures), 3.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, picture) in zip(np.ravel(figure.subplots(1, len(pictures))), pictures.items()):
        axes.set_title(name)
        axes.imshow(srgb(np.array(picture) * exposure))
        axes.set_axis_off()
    figure.savefig(path)


# ------------------------------------------------------------------------------------------------ command line
def main(arguments=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("problem", nargs="?", choices=("rectangle", "pentagon"), default="rectangle")
    parser.add_argument("--seed", type=whole(0, 2**31), default=0, help="of the random start")
    parser.add_argument("--iterations", type=whole(1, 100000), default=240)
    parser.add_argument("--resolution", type=whole(8, 1024), default=64, help="pixels each way")
    parser.add_argument("--order", type=whole(0, 64), default=8, help="highest degree of the spherical harmonics")
    parser.add_argument("-o", "--output", type=Path, help="PNG file for the pictures before, after and target")
    options = parser.parse_args(arguments)
    if options.output is not None and not options.output.resolve().parent.is_dir():
        parser.error(f"argument -o/--output: folder '{options.output.parent}' must exist. Create it first.")

    scene, truth, target = set_up(options.problem, options.resolution, options.order)
    light = random_start(truth, scene, np.random.default_rng(options.seed))
    light.apply(light.start, mi.traverse(scene))
    before = mi.render(scene, spp=64)
    for i, (loss, *found) in enumerate(optimise(scene, light, target, iterations=options.iterations)):
        if i % 10 == 0 or i == options.iterations - 1:
            errors = light_errors(found, truth.outline(truth.start))
            print(f"step {i:4d}  loss {loss:.4f}  centre off by {errors['centre']:6.1%} of its distance, normal by {errors['angle']:4.1f} "
                  f"degrees, area {errors['area']:+6.1%}, power {errors['power']:+6.1%}", flush=True)
    if options.output is not None:
        draw(options.output, {"before": before, "after": mi.render(scene, spp=64), "target, path traced": target})


def whole(low: int, high: int):
    """Type of a command-line argument: a whole number from `low` to `high`."""
    def convert(text: str) -> int:
        if not text.isdigit() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"must be a whole number from {low} to {high}, got '{text}'.")
        return int(text)
    return convert


if __name__ == "__main__":
    sys.exit(main())
