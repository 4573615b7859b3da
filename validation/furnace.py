"""Claim: where theory knows the light of all bounces, interreflection gives it: white furnaces, emitting rooms, integrating spheres.

    python -m validation.furnace [--quick] [--out DIR]

prints a table and writes ``furnace.json`` and ``furnace.png``.

**white furnaces**: open scenes of reflectance 1 under an environment of radiance 1, in which every surface has radiance 1, whatever its
shape: what a point does not see of the sky it gets from other surfaces. Deviations come from two sources: the noise of the visibility and
the gather rays, which the rows of ``samples`` show, and light that is lost or gained at contacts. ``direct`` is the mean deviation without
interreflection.

**emitting rooms**: a closed room of reflectance rho whose walls all have the emission 1: radiance ``1 / (1 - rho)``, and ``sum_b rho^b``
after some bounces.

**integrating spheres**: a closed sphere of reflectance rho around a small black square that emits to both sides. With the areas A of the
sphere and a of the square, both sides, a share a/A of what the wall sends ends on the square, and the rest makes a uniform irradiance:
``E/pi = L (a/A) q / (1 - q)``, ``q = rho (1 - a/A)``.

Deviation: over pixels that see a surface and no emitter, of the radiance relative to theory: mean, root mean square, and maximum.
"""
from __future__ import annotations

import math
import pathlib
import sys
import warnings

import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

import mi_shlight.plugins  # noqa: F401
from mi_shlight.compare import shaded_pixels
from mi_shlight.errors import UnsupportedSceneWarning
from validation import experiment

ORDER = 6
SAMPLES = ((64, 256), (256, 1024), (1024, 2048))
"""Rays per point: (`bounce_samples`, `transfer_samples`)."""
REFLECTANCES = (0.2, 0.5, 0.8)
TARGET_MEAN, TARGET_RMS = 0.005, 0.02


def grey(value: float, two_sided: bool = False) -> dict:
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}
    return {"type": "twosided", "bsdf": diffuse} if two_sided else diffuse


def rectangle(to_world, **nested) -> dict:
    return {"type": "rectangle", "to_world": to_world, **nested}


def sensor(size: int, origin, target, fov: float) -> dict:
    return {"type": "perspective", "fov": fov, "near_clip": 1e-3, "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}}


def ball_mesh(stacks: int, top: float, outwards: float, **nested):
    """Part of a sphere of radius 1 from the south pole up to the height `top`, as a mesh; normals point in if `outwards` is -1."""
    theta = np.linspace(math.pi, math.acos(top), stacks + 1)
    phi = 2 * np.pi * np.arange(2 * stacks) / (2 * stacks)
    t, p = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    vertices = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], axis=1)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(stacks), np.arange(2 * stacks), indexing="ij"))
    a, b = i * 2 * stacks + j, i * 2 * stacks + (j + 1) % (2 * stacks)
    faces = np.concatenate([np.stack([a, b, b + 2 * stacks], axis=1), np.stack([a, b + 2 * stacks, a + 2 * stacks], axis=1)])
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces = faces[areas > 1e-6 * areas.max()]         # at the poles every second one is a line
    props = mi.Properties()
    for key, plugin in nested.items():
        props[key] = mi.load_dict(plugin)
    shape = mi.Mesh("ball", len(vertices), len(faces), props=props)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = mi.Float(vertices.ravel().tolist())
    parameters["faces"] = mi.UInt32((faces if outwards > 0 else faces[:, ::-1]).ravel().tolist())
    parameters.update()
    return shape


def walls(bsdf: dict, faces, **nested) -> dict:
    """Walls of a room of side 2 about the origin, facing inwards."""
    turns = {"floor": ([1, 0, 0], -90), "ceiling": ([1, 0, 0], 90), "left": ([0, 1, 0], 90), "right": ([0, 1, 0], -90),
             "back": ([0, 1, 0], 0), "front": ([0, 1, 0], 180)}
    return {name: rectangle(mi.ScalarTransform4f().rotate(*turns[name]).translate([0, 0, -1]), bsdf=bsdf, **nested) for name in faces}


def scene(size: int, parts: dict, origin, target, fov: float):
    return mi.load_dict({"type": "scene", "sensor": sensor(size, origin, target, fov), **parts}, optimize=False)


def white_furnaces(size: int) -> dict:
    """Name -> scene in which everything has the radiance 1."""
    sky = {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}}
    stand = mi.ScalarTransform4f().translate([0, 0.6, 0]).rotate([0, 1, 0], 30).scale([0.4, 0.6, 0.4])
    block = {"type": "cube", "to_world": stand, "bsdf": grey(1)}
    floor = rectangle(mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(3), bsdf=grey(1))
    open_box = walls(grey(1, two_sided=True), ("floor", "ceiling", "left", "right", "back"))
    return {"block on a floor": scene(size, {**sky, "floor": floor, "block": block}, [2, 2.5, 3], [0, 0.4, 0], 35),
            "bowl": scene(size, {**sky, "bowl": ball_mesh(24, 0, -1, bsdf=grey(1, two_sided=True))}, [0, 2.2, 2], [0, -0.4, 0], 32),
            "open box": scene(size, {**sky, **open_box}, [0, 0, 4.5], [0, 0, 0], 30)}


def emitting_room(size: int, rho: float):
    emitter = {"type": "shlight", "radiance": {"type": "rgb", "value": 1.0}}
    parts = walls(grey(rho), ("floor", "ceiling", "left", "right", "back", "front"), emitter=emitter)
    return scene(size, parts, [0.3, 0.2, 0.8], [-0.4, -0.3, -1], 70)


LAMP = 0.2
"""Side of the square in the integrating sphere."""


def integrating_sphere(size: int, rho: float):
    emitter = {"type": "shlight", "radiance": {"type": "rgb", "value": 1.0}, "two_sided": True}
    lamp = rectangle(mi.ScalarTransform4f().rotate([1, 0, 0], 90).scale(LAMP / 2), emitter=emitter)
    return scene(size, {"lamp": lamp, "sphere": ball_mesh(24, 1, -1, bsdf=grey(rho))}, [0, 0.3, 0.7], [0, 0.05, -1], 60)


def render(what, spp: int, rays, **parameters) -> np.ndarray:
    plugin = mi.load_dict({"type": "shprt", "order": ORDER, "bounce_samples": rays[0], "transfer_samples": rays[1],
                           "bounce_tolerance": 1e-4, **parameters})
    return np.array(mi.render(what, integrator=plugin, spp=spp, seed=0))


def deviation(image, theory: float, mask) -> dict:
    relative = image[mask] / theory - 1
    return {"mean": float(relative.mean()), "rms": float(np.sqrt((relative ** 2).mean())), "max": float(abs(relative).max())}


def measure(size: int, spp: int, samples, reflectances, **settings) -> tuple:
    """Rows, and pictures with their theory; `settings` of ``shprt``."""
    rows, pictures = [], {}
    for name, what in white_furnaces(size).items():
        mask = shaded_pixels(what)
        direct = render(what, spp, samples[-1], transfer="shadowed", **settings)
        for rays in samples:
            for kind in ("gather", "transfer") if rays == samples[0] else ("gather",):
                image = render(what, spp, rays, transfer="interreflected", bounce_lighting=kind, localised=False, **settings)
                rows.append({"scene": name, "lighting": kind, "rays": rays[0], **deviation(image, 1, mask),
                             "direct": deviation(direct, 1, mask)["mean"]})
                print(rows[-1], file=sys.stderr, flush=True)
        pictures[name] = direct, image, mask
    for rho in reflectances:
        what, rays = emitting_room(size, rho), samples[len(samples) // 2]
        every = np.ones((size, size), bool)
        for bounces, theory in ((1, 1 + rho + rho ** 2), (0, 1 / (1 - rho))):
            image = render(what, spp, rays, transfer="interreflected", bounces=bounces, **settings)
            rows.append({"scene": f"emitting room, rho {rho}, bounces {bounces or 'all'}", "lighting": "gather", "rays": rays[0],
                         **deviation(image, theory, every)})
            print(rows[-1], file=sys.stderr, flush=True)
    for rho in reflectances:
        what = integrating_sphere(size, rho)
        mask = shaded_pixels(what)
        every, direct = (render(what, spp, rays, transfer=kind, **settings) for kind in ("interreflected", "shadowed"))
        area = next(float(shape.surface_area()[0]) for shape in what.shapes() if not shape.is_emitter())
        share = 2 * LAMP ** 2 / area
        theory = rho * share * rho * (1 - share) / (1 - rho * (1 - share))
        rows.append({"scene": f"integrating sphere, rho {rho}", "lighting": "gather", "rays": rays[0],
                     **deviation(every - direct, theory, mask)})
        print(rows[-1], file=sys.stderr, flush=True)
    return rows, pictures


def targets(rows: list, rays: int) -> list:
    """Verdicts on mean and root mean square of each scene with `rays`, or more."""
    lines = []
    for row in rows:
        if row["rays"] >= rays:
            what = f"{row['scene']}, {row['rays']} rays"
            lines += [experiment.verdict(f"{what}: mean deviation at most {TARGET_MEAN:.1%}", abs(row["mean"]), TARGET_MEAN, text="{:.2%}"),
                      experiment.verdict(f"{what}: root mean square at most {TARGET_RMS:.0%}", row["rms"], TARGET_RMS, text="{:.2%}")]
    return lines


def draw(pictures: dict, path: pathlib.Path) -> None:
    figure, axes = plt.subplots(2, len(pictures), figsize=(3.6 * len(pictures) + 1, 6.6), layout="constrained")
    for k, (name, (direct, image, mask)) in enumerate(pictures.items()):
        axes[0, k].imshow(np.where(mask, direct.mean(axis=-1), 1), cmap="gray", vmin=0, vmax=1)
        axes[0, k].set_title(f"{name}: direct light")
        drawn = axes[1, k].imshow(np.where(mask, image.mean(axis=-1) - 1, np.nan), cmap="RdBu_r", vmin=-0.05, vmax=0.05)
        axes[1, k].set_title("all bounces, minus 1")
    for axis in axes.ravel():
        axis.set(xticks=[], yticks=[])
    figure.colorbar(drawn, ax=axes[1], extend="both")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments)
    mi.set_variant("llvm_ad_rgb")
    warnings.simplefilter("ignore", UnsupportedSceneWarning)
    if options.quick:
        samples, (rows, pictures) = SAMPLES[:1], measure(12, 4, SAMPLES[:1], REFLECTANCES[:1], order=2, max_edge=0.5)
    else:
        samples, (rows, pictures) = SAMPLES, measure(64, 16, SAMPLES, REFLECTANCES)
    lines = targets(rows, samples[len(samples) // 2][0])
    print("| scene | lighting | rays | mean | rms | max | direct alone |\n|---|---|---|---|---|---|---|")
    for row in rows:
        print(f"| {row['scene']} | {row['lighting']} | {row['rays']} | {row['mean']:+.2%} | {row['rms']:.2%} | {row['max']:.2%} | "
              + (f"{row['direct']:+.2%} |" if "direct" in row else "|"))
    experiment.print_targets(lines)
    experiment.write(options.out / "furnace.json", {"targets": lines, "rows": rows}, options.quick)
    draw(pictures, options.out / "furnace.png")


if __name__ == "__main__":
    main()
