"""Claim: what [W18] shows in pictures comes out here: exact coefficients, shadows by order, lights that move, skies, patterned lights.

    python -m validation.wang [--quick] [--out DIR] [--only PART ...]

writes ``wang.json`` and a picture for each part. ``--only`` measures some parts anew and keeps the others of an existing ``wang.json``.
Procedural surfaces stand in for the paper's models: leaves in three pots (Plant), a fluted column on a block (Buddha), a knot with scales
(Dragon), a lumpy ball with ears (Face). As in the paper all vertices have transfer of order 8 that is projected over the sphere, unless
said otherwise; references are Mitsuba's ``path`` at ``max_depth`` 2. Errors are sums of absolute differences over that of the reference,
of all pixels that show a surface (glossy.py), and of their means over 8 x 8.

**integration** (Fig. 4): the Face, lit at the points under the pixels' centres, by coefficients from the recurrence of the paper and from
145,800 stratified samples of the light at every point, as many as the paper has, with the same transfer; difference in grey levels
of 256. The same by ``shprt`` with ``recurrence`` and with cubature.

**orders** (Fig. 5): the Plant at orders 2, 4, 6 and 8. *sharpness* is the part of the reference's contrast that a picture has,
``<grad a, grad b> / <grad b, grad b>`` over its shadows; between halves of the reference, for b, so that its noise does not count.

**edits** (Fig. 8): the Face under a light that is moved, turned in its plane and out of it, and of which a corner is pulled, by one
bake; and by transfer localised to the light, baked for each.

**environment** (Fig. 9): the Dragon under a light and a sky, either of them turned. The sky is turned by the ``envmap``'s ``to_world``; its
coefficients are compared with those turned by ``sh.rotate``.

**patterned** (Fig. 10): a light of 24 polygons, red to blue from end to end and green in the middle, above a glossy Buddha and floor
(Mitsuba's principled BSDF, half diffuse, half rough metal; Phong in the paper), transfer localised. *red* is red over red and blue of the
floor, in strips from left to right.

**frames** (Table 2): scenes with the paper's numbers of triangles and lights; milliseconds of CPU on one thread, median. *frame*: lights
moved through `mi.traverse`, and 512 x 512 pixels by ``shprt``, one sample each. *vertices*: coefficients of all lights at all vertices, in
the paper what takes the time, by time per point times the number of both; *monomial*: as the paper's comparison (validation.baselines).
"""
from __future__ import annotations

import json
import sys
import time
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from validation.paper_scenes import GLOSSY, NO_REFINEMENT, SQUARE, Display, View, assemble, draw_sheet, facing, placed_again, polygon

from mi_shlight import cie_sky, latlong, project_polygon
from mi_shlight.scene import aligned, polygon_lights
from mi_shlight.sh import rotate
from mi_shlight.shading.distant import DistantLights
from mi_shlight.transfer.localised import sample_transfer
from mi_shlight.transfer.visibility import BakeLights, LightSight, Occluders
from validation import grid_scenes
from validation.baselines import project_monte_carlo
from validation.engine import ellipse, evaluation, points_around, take_turns
from validation.engine_report import MONOMIAL, QUAD, Record
from validation.engine_report import QUICK as FEW_ROUNDS
from validation.experiment import options, print_targets, significant, verdict, versions, write
from validation.glossy import error, reference
from validation.soft_shadows import block_means, grey, render

FACTOR = 10
"""Of the differences that Fig. 4 shows."""
METHODS = ("recurrence", MONOMIAL, "edge")


class Published(NamedTuple):
    """A row of [W18] Table 2, frames per second on their GPU, and what stands for its model here."""

    figure: int
    triangles: int
    lights: int
    fps: float
    monomial_fps: float
    build: object
    view: View


def dragon(triangles: float) -> tuple:
    return grid_scenes.shares(triangles, (grid_scenes.floor(2.6), 0.12, grid_scenes.GREY),
                              (grid_scenes.knot((0, 0.85, 0), 1.15, (3, 5), 0.2), 0.88, (0.5, 0.68, 0.55))), None


W18 = {"Plant": Published(5, 163_000, 1, 350.0, 91.0, grid_scenes.plants, View((0.2, 2.6, 5.2), (0, 0.65, 0), 38)),
       "Buddha": Published(1, 388_000, 3, 28.4, 8.2, grid_scenes.buddha, View((0, 2.0, 5.4), (0, 0.95, 0), 34)),
       "Dragon": Published(9, 1_000_000, 1, 38.5, 15.3, dragon, View((0, 3.0, 5.6), (0, 0.65, 0), 36)),
       "Face": Published(8, 98_000, 1, 384.6, 150.0, grid_scenes.monkey, View((0.2, 2.0, 4.6), (0, 0.75, 0), 36))}

ARROW = np.array([[0, -0.2], [0.7, -0.6], [0, 0.8], [-0.7, -0.6]])
"""Concave; fans about its first corner."""
LIGHTS = {"Plant": {"light": (0.5 * SQUARE, (-1.5, 2.6, 1.6), (14.0, 13.0, 12.0))},
          "Buddha": {"triangle": (0.9 * SQUARE[:3], (-2.2, 2.2, 1.8), (9.0, 3.0, 2.0)),
                     "pentagon": (0.7 * ellipse(5)[:, :2] / 0.4, (2.2, 2.4, 1.4), (2.0, 4.0, 9.0)),
                     "arrow": (ARROW, (0.3, 3.4, 0.8), (5.0, 6.0, 3.0))},
          "Dragon": {"light": (0.5 * SQUARE, (1.2, 2.6, 1.6), (12.0, 10.0, 7.0))},
          "Face": {"light": (0.6 * SQUARE, (-1.5, 2.5, 1.7), (9.0, 9.0, 8.5))}}
TARGET = (0, 0.6, 0)
PATTERNED_AT, PATTERNED_VIEW = (0, 3.3, 1.2), View((0, 2.8, 5.2), (0, 0.85, 0), 37)


class Plan(NamedTuple):
    """Sizes to measure."""

    triangles: float = 30_000
    """Of the scenes but those that are timed."""
    size: int = 128
    spp: int = 64
    reference_spp: int = 2048
    rays: int = 512
    """Of projected transfer, per vertex."""
    integrated_size: int = 96
    side: int = 270
    """Samples along either direction of a triangle of the light: two make the paper's 146k."""
    frame_scale: float = 1.0
    """Of the timed scenes' triangles."""
    frame_size: int = 512
    frame_rays: int = 1 << 24
    """Of all vertices together; their number does not change the time of a frame."""
    frames: int = 7
    timed: tuple = tuple(W18)
    order: int = 8
    orders: tuple = (2, 4, 6, 8)
    """Of Fig. 5."""
    bsdf_orders: tuple = (8, 14)

    def projected(self, **settings) -> dict:
        """``shprt`` with transfer that is baked once, projected over the sphere, and kept wherever the light moves."""
        return {"type": "shprt", "order": self.order, "transfer_samples": self.rays, "max_edge": NO_REFINEMENT, "localised": False,
                "light_margin": 1e3, **settings}

    def localised(self, **settings) -> dict:
        """``shprt`` with transfer fitted to the light where it is."""
        return self.projected(localised=True, light_margin=0.0, **settings)


QUICK = Plan(triangles=2000, size=32, spp=4, reference_spp=512, rays=32, integrated_size=16, side=32, frame_scale=0.01, frame_size=64,
             frame_rays=1 << 14, frames=3, timed=("Buddha",), order=4, orders=(2, 4), bsdf_orders=(3,))


def corners_of(name: str) -> dict:
    return {light: facing(outline, position, TARGET) for light, (outline, position, _) in LIGHTS[name].items()}


def make_scene(name: str, triangles: float, size: int, **more) -> mi.Scene:
    lights = {light: polygon(light, corners, LIGHTS[name][light][2]) for light, corners in corners_of(name).items()}
    return assemble(W18[name].build(triangles)[0], {**lights, **more}, W18[name].view, size)


def errors(image: np.ndarray, truth: np.ndarray, seen: np.ndarray) -> dict:
    """Of pixels, and of means over 8 x 8 of which all pixels are `seen`."""
    whole = block_means(seen.astype(float)) == 1
    return {"pixels": significant(error(image, truth, seen)),
            "blocks": significant(error(block_means(grey(image)), block_means(grey(truth)), whole))}


def signed(image: np.ndarray, truth: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Means of the difference over 4 x 4 pixels, over the mean of the reference, for a sheet."""
    difference = np.where(seen, grey(image) - grey(truth), 0) / grey(truth)[seen].mean()
    side = len(difference) // 4
    return difference.reshape(side, 4, side, 4).mean(axis=(1, 3))


# Fig. 4: integration.

def pixel_points(scene: mi.Scene, size: int) -> tuple:
    """(points, normals, colours) under the centres of the pixels that see a surface, and the mask of these."""
    k = dr.arange(mi.UInt32, size * size)
    ray, _ = scene.sensors()[0].sample_ray(0, 0, (mi.Point2f(k % size, k // size) + 0.5) / size, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    seen = np.array(si.is_valid())
    colour = np.array(si.bsdf().eval_diffuse_reflectance(si, si.is_valid())).T[seen]
    normal = dr.mulsign(si.sh_frame.n, dr.dot(si.sh_frame.n, -ray.d))
    rows = lambda v: [aligned(mi.Float, c) for c in np.array(v)[:, seen]]
    return mi.Point3f(*rows(si.p)), mi.Normal3f(*rows(normal)), colour, seen.reshape(size, size)


def projected_transfer(scene: mi.Scene, p, n, order: int, rays: int) -> list:
    """Shadowed transfer at points, as ``shprt`` has it."""
    lights = polygon_lights(scene)
    group = mi.UInt32(0), mi.UInt32(1)
    dr.make_opaque(group)
    sight = LightSight(Occluders(scene, lights), BakeLights(lights, 0.0), group)
    coeffs = sample_transfer(sight, p, n, order, rays, dr.opaque(mi.Float, 0.5, dr.width(p))).coeffs
    dr.eval(coeffs)
    return coeffs


def measure_integration(plan: Plan, out) -> dict:
    size, name = plan.integrated_size, "Face"
    scene = make_scene(name, plan.triangles, size)
    p, n, colour, seen = pixel_points(scene, size)
    transfer = projected_transfer(scene, p, n, plan.order, plan.rays)
    vertices = [mi.Point3f(*map(float, corner)) for corner in corners_of(name)["light"][::-1]]
    dr.make_opaque(vertices)

    def picture(coeffs) -> np.ndarray:
        shade = sum(t * c for t, c in zip(transfer, coeffs))
        image = np.zeros((size, size, 3))
        image[seen] = np.array(shade)[:, None] * colour * LIGHTS[name]["light"][2]
        return image

    analytic = picture(project_polygon(vertices, p, plan.order, "recurrence"))
    sampled = picture(project_monte_carlo(vertices, p, plan.order, plan.side))
    by_method = {method: render(scene, plan.projected(method=method), plan.spp) for method in ("recurrence", "quadrature")}
    display = Display(analytic, seen)
    rows = []
    for what, a, b in (("Monte Carlo at the pixels' centres", sampled, analytic),
                       ("shprt by cubature", by_method["quadrature"], by_method["recurrence"])):
        apart = abs(display.levels(a) - display.levels(b))[seen]
        rows.append({"numerical": what, "samples": (QUAD - 2) * plan.side ** 2 if a is sampled else None, "grey_levels": int(apart.max()),
                     "pixels_that_differ": significant((apart.max(axis=1) > 0).mean()),
                     "largest_difference": significant((abs(a - b)[seen]).max() / b[seen].mean()),
                     "scan_line": significant(abs(a - b)[size // 2].max() / b[size // 2].max())})
    difference = abs(display.levels(sampled) - display.levels(analytic)) / 255
    draw_integration(out / "wang_integration.png", display, analytic, sampled, difference)
    return {"rows": rows, "points": int(seen.sum())}


def draw_integration(path, display: Display, analytic: np.ndarray, sampled: np.ndarray, difference: np.ndarray) -> None:
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 4, figsize=(13, 3.3), layout="constrained", width_ratios=(1, 1, 1, 1.3))
    for axis, picture, title in zip(axes, (display(analytic), display(sampled), np.clip(FACTOR * difference, 0, 1)),
                                    ("analytic", "numerical integration", f"difference of grey levels x {FACTOR}")):
        axis.imshow(picture, interpolation="nearest")
        axis.set_title(title)
        axis.set(xticks=[], yticks=[])
    row = len(analytic) // 2
    axes[0].axhline(row, color="red", linewidth=0.6)
    axes[3].plot(grey(display(sampled))[row], color="C3", linewidth=2.5, label="numerical")
    axes[3].plot(grey(display(analytic))[row], "k:", linewidth=1.2, label="analytic")
    axes[3].set(title="central scan line", xlabel="pixel", ylabel="display value")
    axes[3].legend()
    figure.savefig(path, dpi=80)
    pyplot.close(figure)


# Fig. 5: orders.

def gradients(image: np.ndarray, part: np.ndarray) -> np.ndarray:
    return np.concatenate([g[part] for g in np.gradient(grey(image))])


def measure_orders(plan: Plan, out) -> dict:
    scene = make_scene("Plant", plan.triangles, plan.size)
    truth, noise, seen = reference(scene, plan.reference_spp)
    open_light = render(scene, plan.projected(transfer="unshadowed"), plan.spp)
    shadow = seen & (grey(truth) < 0.97 * grey(open_light)) & (grey(truth) > 0)
    halves = [gradients(render(scene, {"type": "path", "max_depth": 2}, plan.reference_spp // 4, seed), shadow) for seed in (90, 91)]
    contrast = halves[0] @ halves[1]
    rows, sheet, display = [], [], Display(truth, seen)
    for transfer, settings in (("projected", plan.projected), ("localised", plan.localised)):
        line = []
        for order in plan.orders:
            image = render(scene, settings(order=order), plan.spp)
            dim = error(image, truth, shadow)
            sharpness = gradients(image, shadow) @ (halves[0] + halves[1]) / 2 / contrast
            rows.append({"transfer": transfer, "order": order, **errors(image, truth, seen), "in_shadow": significant(dim),
                         "sharpness": significant(sharpness)})
            line.append((f"order {order}: error {dim:.1%}", display(image)))
        line.append((f"path, noise {noise:.1%}", display(truth)))
        sheet.append((f"{transfer}; error in shadow", line))
    draw_sheet(out / "wang_orders.png", sheet)
    return {"rows": rows, "noise": significant(noise)}


# Fig. 8: edits.

def edited_lights() -> dict:
    """Corners of the Face's light, as it is and changed in the four ways of the figure."""
    outline, position, _ = LIGHTS["Face"]["light"]
    start = facing(outline, position, TARGET)
    centre = start.mean(axis=0)
    normal = np.cross(start[1] - start[0], start[2] - start[0])
    turned = lambda axis, degrees: centre + (start - centre) @ rotation(axis, degrees).T
    pulled = start.copy()
    pulled[2] += 1.2 * (start[2] - centre)
    return {"as it was": start, "moved": start + [1.6, 0.5, 0.3], "turned in its plane": turned(normal, 45),
            "turned out of it": turned((0.3, 1, 0), 65), "a corner pulled": pulled}


def rotation(axis, degrees: float) -> np.ndarray:
    return Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis, float) / np.linalg.norm(axis)).as_matrix()


def measure_edits(plan: Plan, out) -> dict:
    scene = make_scene("Face", plan.triangles, plan.size)
    kept = mi.load_dict(plan.projected())
    baked, rows, sheet, display = None, [], [[], [], []], None
    for name, corners in edited_lights().items():
        placed_again(scene, {"light": corners})
        transfer = kept.prepare_scene(scene, progress=False)
        baked = baked or transfer
        truth, noise, seen = reference(scene, plan.reference_spp)
        image = np.array(mi.render(scene, integrator=kept, spp=plan.spp, seed=1))
        near = render(scene, plan.localised(), plan.spp)
        display = display or Display(truth, seen)
        rows += [{"light": name, "transfer": "projected", "baked_once": transfer is baked, **errors(image, truth, seen),
                  "noise": significant(noise)},
                 {"light": name, "transfer": "localised", "baked_once": False, **errors(near, truth, seen), "noise": significant(noise)}]
        sheet[0].append((name, display(image)))
        sheet[1].append(("", display(truth)))
        sheet[2].append((f"mean {rows[-2]['pixels']:.1%}, noise {noise:.1%}", signed(image, truth, seen)))
    draw_sheet(out / "wang_edits.png", list(zip((f"SH, order {plan.order}, one bake", "path", "difference / mean, to ±10 %"), sheet)),
               outlines=list(edited_lights().values()))
    return {"rows": rows}


# Fig. 9: environment.

def sky(height: int = 65) -> np.ndarray:
    """A clear sky with the sun's glow, warm, over a dim ground, brighter than Mitsuba's maps are by default."""
    glow = latlong(lambda d: cie_sky(d, "clear", (0.5, 0.4, 0.75)), height, mi.Vector3f)[..., None]
    warm = np.array([1.2, 0.9, 0.6]) * np.clip(glow - 2, 0, None) + np.array([0.2, 0.3, 0.45]) * np.clip(glow, 0, 2)
    return (0.35 * warm + 0.02).astype(np.float32)


def sky_coefficients(scene: mi.Scene, order: int) -> np.ndarray:
    """(3, C) as ``shprt`` projects the scene's map."""
    found = DistantLights(scene, order).attached().coefficients(mi.Color0f(), dr.zeros(mi.Point3f))
    dr.eval(found)
    return np.array([np.ravel(np.array(c)) for c in found], dtype=np.float64).T


def measure_environment(plan: Plan, out) -> dict:
    angle = 120
    upright = make_scene("Dragon", plan.triangles, plan.size, sky={"type": "envmap", "bitmap": mi.Bitmap(sky())})
    start = corners_of("Dragon")["light"]
    about = rotation((0, 1, 0), angle)
    kept = mi.load_dict(plan.projected())
    coeffs, rows, sheet, display = sky_coefficients(upright, plan.order), [], [[], [], []], None
    parameters = mi.traverse(upright)
    for name, light, map_turn in (("light and sky", False, 0), ("light turned", True, 0), ("sky turned", False, angle),
                                  ("both turned", True, angle)):
        placed_again(upright, {"light": start @ about.T if light else start})
        parameters["sky.to_world"] = mi.Transform4f().rotate([0, 1, 0], map_turn)
        parameters.update()
        truth, noise, seen = reference(upright, plan.reference_spp)
        image = np.array(mi.render(upright, integrator=kept, spp=plan.spp, seed=1))
        display = display or Display(truth, seen)
        expected = np.array([rotate(c, rotation((0, 1, 0), map_turn)) for c in coeffs])
        rows.append({"picture": name, **errors(image, truth, seen), "noise": significant(noise),
                     "rotated_coefficients": significant(abs(sky_coefficients(upright, plan.order) - expected).max()
                                                          / abs(coeffs).max())})
        sheet[0].append((name, display(image)))
        sheet[1].append(("", display(truth)))
        sheet[2].append((f"mean {rows[-1]['pixels']:.1%}, noise {noise:.1%}", signed(image, truth, seen)))
    draw_sheet(out / "wang_environment.png", list(zip((f"SH, order {plan.order}", "path", "difference / mean, to ±10 %"), sheet)))
    return {"rows": rows, "degrees": angle}


# Fig. 10: patterned lights, gloss.

def patterned_light(rows: int = 3, columns: int = 8) -> dict:
    """Lights by name: a quilt of quadrilaterals with gaps, red to blue, green in the middle."""
    lights = {}
    for j in range(rows):
        for i in range(columns):
            t = 1 - i / (columns - 1)                    # right of the light is left of what it faces
            colour = 14 * np.array([(1 - t) ** 2, 1.2 * t * (1 - t) * (j != 1), t ** 2]) * (0.4 + 0.6 * ((i + j) % 2)) + 0.1
            outline = [2.0, 0.75] * ((SQUARE * 0.88 + 1 + 2 * np.array([i, j])) / [columns, rows] - 1)
            lights[f"patch_{j}{i}"] = polygon(f"patch_{j}{i}", facing(outline, PATTERNED_AT, (0, 0.4, 0.2)), colour)
    return lights


def share_of_red(image: np.ndarray, strips: int = 8) -> np.ndarray:
    """Red over red and blue, of the lowest eighth of a picture, where only the floor is seen, in strips from left to right."""
    rows = image[-len(image) // 8:]
    red, _, blue = np.moveaxis(rows.reshape(len(rows), strips, -1, 3).mean(axis=(0, 2)), -1, 0)
    return red / (red + blue)


def measure_patterned(plan: Plan, out) -> dict:
    scene = assemble(W18["Buddha"].build(plan.triangles)[0], patterned_light(), PATTERNED_VIEW, plan.size, GLOSSY)
    truth, noise, seen = reference(scene, plan.reference_spp)
    display, rows, pictures = Display(truth, seen), [], []
    for bsdf_order in plan.bsdf_orders:
        image = render(scene, plan.localised(transfer="shadowed+glossy", bsdf_order=bsdf_order,
                                             visibility_order=min(4, bsdf_order)), plan.spp)
        red = share_of_red(image)
        rows.append({"bsdf_order": bsdf_order, **errors(image, truth, seen), "noise": significant(noise), "red": np.round(red, 3),
                     "red_apart": significant(abs(red - share_of_red(truth)).max())})
        pictures.append((f"SH, BSDF to order {bsdf_order}: {rows[-1]['pixels']:.1%}", display(image)))
    draw_sheet(out / "wang_patterned.png", [("", [*pictures, (f"path, noise {noise:.1%}", display(truth))])], width=3)
    return {"rows": rows, "path_red": np.round(share_of_red(truth), 3), "polygons": len(patterned_light())}


# Table 2: frames.

def vertex_nanoseconds(order: int) -> dict:
    """Time of all coefficients of one quadrilateral at one vertex, by method; without overhead."""
    corners = ellipse(QUAD)
    evaluations = {method: evaluation("projection", method, order) for method in METHODS}
    threads = dr.thread_count()
    dr.set_thread_count(1)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        times = take_turns(Record(), "vertices", evaluations, corners, points_around(corners, 2.0), FEW_ROUNDS)
    dr.set_thread_count(threads)
    return {method: float(np.median(times[method])) for method in METHODS}


def frame_milliseconds(name: str, scene: mi.Scene, plan: Plan) -> tuple:
    """({part: milliseconds of CPU}, last picture) on one thread; the first two frames compile."""
    vertices = sum(shape.vertex_count() for shape in scene.shapes())
    integrator = mi.load_dict(plan.projected() | {"transfer_samples": max(plan.frame_rays // vertices, 16)})
    start, threads = time.process_time(), dr.thread_count()
    integrator.prepare_scene(scene, progress=False)
    bake, spent = time.process_time() - start, {"move": [], "render": []}
    dr.set_thread_count(1)
    for k in range(plan.frames):
        start = time.process_time()
        placed_again(scene, {light: corners + [0.05 * k, 0, 0] for light, corners in corners_of(name).items()})
        middle = time.process_time()
        image = mi.render(scene, integrator=integrator, spp=1)
        dr.eval(image)
        dr.sync_thread()
        spent["move"].append(middle - start)
        spent["render"].append(time.process_time() - middle)
    dr.set_thread_count(threads)
    print(f"frames: {name}, bake {bake:.1f} s", file=sys.stderr, flush=True)
    medians = {f"{part}_ms": significant(1e3 * np.median(seconds[2:])) for part, seconds in spent.items()}
    return {"bake_s": significant(bake), **medians}, np.array(image)


def measure_frames(plan: Plan, out) -> dict:
    rows, pictures, per_vertex = [], [], vertex_nanoseconds(plan.order)
    for name in plan.timed:
        published = W18[name]
        more = {"sky": {"type": "envmap", "bitmap": mi.Bitmap(sky())}} if name == "Dragon" else {}
        scene = make_scene(name, plan.frame_scale * published.triangles, plan.frame_size, **more)
        spent, image = frame_milliseconds(name, scene, plan)
        model = next(shape for shape in scene.shapes() if not shape.is_emitter())
        frame, evaluations = spent["move_ms"] + spent["render_ms"], model.vertex_count() * published.lights
        rows.append({"scene": name, "triangles": model.face_count(), "vertices": model.vertex_count(), "lights": published.lights,
                     **spent, "frame_ms": significant(frame), "fps": significant(1e3 / frame),
                     **{f"vertices_{method}_ms": significant(1e-6 * evaluations * ns) for method, ns in per_vertex.items()},
                     "monomial_over_recurrence": significant(per_vertex[MONOMIAL] / per_vertex["recurrence"]),
                     "published_fps": published.fps, "published_monomial_fps": published.monomial_fps,
                     "published_ratio": significant(published.fps / published.monomial_fps)})
        shown = Display(image, image.max(axis=2) > 0)(image)[::2, ::2]
        pictures.append((f"{name}: {frame / 1e3:.2g} s of one core a frame", shown))
    draw_sheet(out / "wang_frames.png", [("", pictures)], width=3)
    return {"rows": rows, "pixels": plan.frame_size ** 2}


PARTS = {"integration": measure_integration, "orders": measure_orders, "edits": measure_edits, "environment": measure_environment,
         "patterned": measure_patterned, "frames": measure_frames}


def targets(report: dict) -> list:
    """Verdicts on what the captions say, of the parts that `report` has."""
    out = []
    check = lambda *arguments, **keywords: out.append(verdict(*arguments, **keywords))
    rows = lambda part: report.get(part, {}).get("rows", [])
    for row in rows("integration"):
        check(f"Fig. 4, {row['numerical']}: differs from the analytic picture by at most one grey level", row["grey_levels"], 1)
        check(f"Fig. 4, {row['numerical']}: scan line the same to 0.5 % of its maximum", row["scan_line"], 5e-3)
    found = [row for row in rows("orders") if row["transfer"] == "projected"]
    steps = list(zip(found, found[1:]))
    check("Fig. 5: every higher order has a smaller error in shadow (largest ratio of two)",
          max((b["in_shadow"] / a["in_shadow"] for a, b in steps), default=None), 1)
    check("Fig. 5: shadows sharpen with every order (smallest gain)",
          min((b["sharpness"] - a["sharpness"] for a, b in steps), default=None), 0, at_most=False)
    lowest = [row["in_shadow"] for row in rows("orders") if row["transfer"] == "localised"]
    check("Fig. 5: error in shadow of localised transfer of the lowest order over that of projected transfer of the highest",
          lowest[0] / found[-1]["in_shadow"] if lowest else None, 1)
    for row in rows("edits"):
        if row["transfer"] == "projected":
            check(f"Fig. 8, light {row['light']}: mean error at most 5 %", row["pixels"], 0.05, text="{:.2%}")
    kept = [row["baked_once"] for row in rows("edits") if row["transfer"] == "projected"]
    check("Fig. 8: bakes for all pictures", 1 + kept.count(False) if kept else None, 1)
    for row in rows("environment"):
        check(f"Fig. 9, {row['picture']}: mean error at most 5 %", row["pixels"], 0.05, text="{:.2%}")
    check("Fig. 9: the turned map's coefficients are the turned coefficients, largest difference",
          max((row["rotated_coefficients"] for row in rows("environment")), default=None), 1e-5)
    for row in rows("patterned"):
        check(f"Fig. 10, BSDF to order {row['bsdf_order']}: mean error at most 10 %", row["pixels"], 0.1, text="{:.2%}")
        check(f"Fig. 10, BSDF to order {row['bsdf_order']}: share of red along the floor within 0.05 of path's", row["red_apart"], 0.05)
    frames = rows("frames")
    check("Table 2: coefficients by the zonal recurrence at least 2 times faster than by monomials",
          frames[0]["monomial_over_recurrence"] if frames else None, 2, at_most=False)
    check("Table 2: whole frames per second on one core, slowest scene: at least 1", min((row["fps"] for row in frames), default=None), 1,
          at_most=False)
    return out


def print_rows(name: str, rows: list) -> None:
    print(f"\n{name}")
    print(*(json.dumps({key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in row.items()})
            for row in rows), sep="\n")


def main(arguments=None) -> None:
    parsed = options(__doc__, arguments, only={"nargs": "+", "choices": list(PARTS), "metavar": "PART",
                                               "help": "parts to measure: " + ", ".join(PARTS)})
    plan, path = QUICK if parsed.quick else Plan(), parsed.out / "wang.json"
    report = json.loads(path.read_text()) if parsed.only and path.exists() else {}
    for part in parsed.only or PARTS:
        start = time.process_time()
        report[part] = {**PARTS[part](plan, parsed.out), "run": versions()}
        print_rows(f"{part} ({time.process_time() - start:.0f} s of CPU)", report[part]["rows"])
    lines = targets(report)
    print_targets(lines)
    write(path, {"targets": lines, **{part: report[part] for part in PARTS if part in report}}, parsed.quick)


if __name__ == "__main__":
    main()
