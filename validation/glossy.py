"""Claim: gloss by spherical harmonics, and down to which roughness which order is enough ([W18] Fig. 10, [W20] section 7.2).

    python -m validation.glossy [--quick] [--out DIR] [--size N] [--orders N ...] [--materials NAME ...] [--reference-spp N]

writes ``glossy.json`` and ``glossy.png``. A floor and the knot of ``scenes/sculpture.xml``, of the same material, under a light that is
red at one end and blue at the other, and a small white one. Each picture of ``shprt`` with ``glossy`` is compared with Mitsuba's ``path``
of the same light transport (``max_depth`` 2): mean absolute difference over mean brightness, of the pixels that show a surface,

- **floor**: alone, ``unshadowed+glossy``: what the order of the BSDF cuts off, and nothing else;
- **sculpture**: both, ``shadowed+glossy``, for each ``bsdf_order``, visibility to order 4;
- **visibility**: the same for other visibility, with one material: its order, fitted to the lights' directions or projected;
- **noise** of the reference: half of the same between two of its halves.

Materials: Phong lobes (a BSDF of this file, of exponents n and 2 / alpha^2 - 2 the counterpart of a roughness alpha), rough conductors
(GGX), rough plastic and Mitsuba's principled BSDF.
"""
from __future__ import annotations

import json
import pathlib

import matplotlib
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

import drjit as dr  # noqa: E402

from mi_shlight.compare import shaded_pixels  # noqa: E402
from mi_shlight.panel import srgb  # noqa: E402
from validation import experiment  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

KNOT = pathlib.Path(__file__).parents[1] / "scenes" / "meshes" / "sculpture_knot.ply"
ORDERS = (4, 8, 14)
ENOUGH = {"conductor 0.5": 8, "conductor 0.3": 8, "plastic 0.3": 8, "principled 0.5": 8, "conductor 0.2": 14, "phong 20": 14}
"""`bsdf_order` that is said to be enough, for an error of a tenth with shadows."""
SHOWN = ("phong 20", "conductor 0.2", "conductor 0.5", "plastic 0.3")


class Phong(mi.BSDF):
    """Modified Phong lobe ``f = (n + 2) / (2 pi) cos(angle to the mirror direction)^n``, `exponent` n."""

    def __init__(self, props):
        super().__init__(props)
        self.exponent = props.get("exponent", 20.0)
        self.m_components = [int(mi.BSDFFlags.GlossyReflection) | int(mi.BSDFFlags.FrontSide)]
        self.m_flags = self.m_components[0]

    def sample(self, ctx, si, sample1, sample2, active=True):
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        bs = mi.BSDFSample3f()
        bs.wo, bs.pdf, bs.eta = wo, mi.warp.square_to_cosine_hemisphere_pdf(wo), mi.Float(1)
        bs.sampled_type, bs.sampled_component = mi.UInt32(self.m_flags), mi.UInt32(0)
        return bs, self.eval(ctx, si, wo, active) / dr.maximum(bs.pdf, 1e-9)

    def eval(self, ctx, si, wo, active=True):
        up = active & (si.wi.z > 0) & (wo.z > 0)
        cosine = dr.maximum(wo.z * si.wi.z - wo.x * si.wi.x - wo.y * si.wi.y, 0)
        return mi.Spectrum((self.exponent + 2) / (2 * dr.pi) * cosine ** self.exponent * wo.z) & up

    def pdf(self, ctx, si, wo, active=True):
        return dr.select(active & (si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def traverse(self, callback):
        pass


mi.register_bsdf("validation_phong", Phong)


def rgb(*value) -> dict:
    return {"type": "rgb", "value": list(value)}


MATERIALS = {
    "phong 20": {"type": "validation_phong", "exponent": 20.0},
    "conductor 0.2": {"type": "roughconductor", "material": "Au", "alpha": 0.2, "distribution": "ggx"},
    "conductor 0.3": {"type": "roughconductor", "material": "Au", "alpha": 0.3, "distribution": "ggx"},
    "conductor 0.5": {"type": "roughconductor", "material": "Au", "alpha": 0.5, "distribution": "ggx"},
    "plastic 0.3": {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": rgb(0.35, 0.3, 0.25)},
    "principled 0.5": {"type": "principled", "roughness": 0.5, "metallic": 0.3, "clearcoat": 0.5, "base_color": rgb(0.5, 0.3, 0.2)},
}


def make_scene(material: dict, size: int, knot: bool) -> mi.Scene:
    look = mi.ScalarTransform4f().look_at
    ramp = np.array([[[24, 3, 1], [17, 4, 4], [10, 5, 10], [4, 4, 17], [1, 3, 24]]], np.float32)
    parts = {"knot": {"type": "ply", "filename": str(KNOT), "bsdf": material, "to_world": mi.ScalarTransform4f().translate([0, -0.6, 0])}}
    return mi.load_dict({
        "type": "scene", **(parts if knot else {}),
        "sensor": {"type": "perspective", "fov": 36, "to_world": look(origin=[0, 2.6, 5.6], target=[0, 0.7, 0], up=[0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}},
        "floor": {"type": "rectangle", "bsdf": material,
                  "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).rotate([1, 0, 0], -90).scale([6, 6, 1])},
        "ramp": {"type": "rectangle", "to_world": look(origin=[0, 2.6, -3.4], target=[0, 0.4, 0], up=[0, 1, 0]).scale([2.2, 0.7, 1]),
                 "emitter": {"type": "shlight", "subdivisions": 32, "radiance": {
                     "type": "bitmap", "bitmap": mi.Bitmap(ramp), "raw": True, "wrap_mode": "clamp"}}},
        "lamp": {"type": "rectangle", "to_world": look(origin=[-2.4, 4.2, 3], target=[0, 0.5, 0], up=[0, 1, 0]).scale(0.5),
                 "emitter": {"type": "shlight", "radiance": rgb(24, 24, 24)}}}, optimize=False)


def reference(scene: mi.Scene, spp: int) -> tuple:
    """(picture, noise, pixels that show surfaces alone): the mean of two renderings, and half of what they differ by."""
    plugin = mi.load_dict({"type": "path", "max_depth": 2})
    halves = [sum(np.array(mi.render(scene, integrator=plugin, spp=256, seed=seed)) for seed in range(first, spp // 256, 2)) / (spp // 512)
              for first in (0, 1)]
    seen = shaded_pixels(scene)
    return (halves[0] + halves[1]) / 2, 0.5 * error(*halves, seen), seen


def error(image: np.ndarray, other: np.ndarray, seen: np.ndarray) -> float:
    """Mean absolute difference over mean brightness, of the pixels `seen`."""
    return float(np.abs(image - other)[seen].mean() / other[seen].mean())


def render(scene: mi.Scene, transfer: str, bsdf_order: int, **settings) -> np.ndarray:
    plugin = mi.load_dict({"type": "shprt", "transfer": transfer, "order": 8, "bsdf_order": bsdf_order, "max_edge": 0.15,
                           "transfer_samples": 256, **settings})
    return np.array(mi.render(scene, integrator=plugin, spp=16, seed=1))


def measure(materials, orders, size: int, spp: int) -> tuple:
    """(record, pictures by material and column)."""
    record, pictures = {"size": size, "reference_spp": spp, "errors": {}}, {}
    for name in materials:
        row = record["errors"][name] = {"floor": {}, "sculpture": {}}
        bare = make_scene(MATERIALS[name], size, False)
        truth, row["floor"]["noise"], seen = reference(bare, spp)
        for order in orders:
            row["floor"][str(order)] = error(render(bare, "unshadowed+glossy", order), truth, seen)
        scene = make_scene(MATERIALS[name], size, True)
        truth, row["sculpture"]["noise"], seen = reference(scene, spp)
        pictures[name] = {"path": truth}
        row["white"] = float(np.percentile(truth[seen], 99.5))
        for order in orders:
            picture = pictures[name][f"order {order}"] = render(scene, "shadowed+glossy", order)
            row["sculpture"][str(order)] = error(picture, truth, seen)
        print(name, json.dumps(row), flush=True)
    name = "conductor 0.3"
    if name in pictures:
        scene, truth = make_scene(MATERIALS[name], size, True), pictures[name]["path"]
        seen = shaded_pixels(scene)
        record["visibility"] = {
            f"{'fitted' if fitted else 'projected'}, order {order}":
                error(render(scene, "shadowed+glossy", 8, localised=fitted, visibility_order=order), truth, seen)
            for fitted in (True, False) for order in (2, 4, 8)}
        print(json.dumps(record["visibility"]), flush=True)
    return record, pictures


def draw(pictures: dict, record: dict, path: pathlib.Path) -> None:
    shown = [name for name in SHOWN if name in pictures] or list(pictures)
    columns = [*(key for key in pictures[shown[0]] if key != "path"), "path"]
    figure, axes = plt.subplots(len(shown), len(columns), figsize=(1.9 * len(columns), 2.05 * len(shown)), squeeze=False)
    for name, row in zip(shown, axes):
        scale = 1 / record["errors"][name]["white"]
        for column, axis in zip(columns, row):
            axis.imshow(srgb(np.minimum(pictures[name][column] * scale, 1)), interpolation="nearest")
            axis.set_xticks([])
            axis.set_yticks([])
            errors = record["errors"][name]["sculpture"]
            text = f"{errors[column.split()[1]]:.1%}" if column != "path" else f"noise {errors['noise']:.1%}"
            axis.set_title(f"{column}: {text}", fontsize=7)
        row[0].set_ylabel(name, fontsize=8)
    figure.tight_layout(pad=0.4)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def targets(record: dict) -> list:
    """Verdicts on the materials whose order was measured."""
    found = {name: record["errors"].get(name, {}).get("sculpture", {}).get(str(order)) for name, order in ENOUGH.items()}
    return [experiment.verdict(f"{name}, with shadows: order {ENOUGH[name]} has an error of at most 10 %", value, 0.1, text="{:.1%}")
            for name, value in found.items()]


def main(arguments=None) -> None:
    options = experiment.options(
        __doc__, arguments, size={"type": int, "default": 64}, orders={"type": int, "nargs": "*", "default": ORDERS},
        materials={"nargs": "*", "choices": MATERIALS, "default": list(MATERIALS)}, reference_spp={"type": int, "default": 4096})
    if options.quick:
        options.size, options.orders, options.materials, options.reference_spp = 16, (4,), ["plastic 0.3"], 512
    record, pictures = measure(options.materials, options.orders, options.size, options.reference_spp)
    record = {"targets": targets(record), **record}
    experiment.print_targets(record["targets"])
    experiment.write(options.out / "glossy.json", record, options.quick)
    draw(pictures, record, options.out / "glossy.png")


if __name__ == "__main__":
    main()
