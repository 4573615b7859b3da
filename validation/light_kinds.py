"""Claim: lights of all kinds light a scene together, each as the path tracer has it; skies and proxy shadows look as they should.

A torus over a floor under a polygon, a sky of the CIE with a round cloud of light (a cap) in it, a constant light and a directional one,
one by one and together (as [W18] figure 9), against ``path`` at ``max_depth`` 2.

    python -m validation.light_kinds [--quick] [--out DIR] [--reference-spp N]

writes ``light_kinds.json``, ``light_kinds.png``, ``light_kinds_skies.png`` and ``light_kinds_proxy.png``.
"""
from __future__ import annotations

import mitsuba as mi
import numpy as np

from validation import experiment

SIZE, SPP, ORDER = 96, 64, 8
BLOCK = 3
"""Pixels across over which the pictures of differences are averaged."""
SUN = (0.55, 0.6, 0.35)
SKIES = {"overcast": None, "clear": SUN, "partly_cloudy": SUN}
CAP, CAP_ANGLE, CAP_COLOUR = (-0.8, 0.5, 0.3), 0.35, np.array([6.0, 3.0, 1.0])


def scene(size: int = SIZE, **lights):
    """A torus that leans over a floor, in a square picture of `size` pixels."""
    return mi.load_dict({
        "type": "scene", **lights, "torus": torus(),
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(4), "bsdf": matt(0.6, 0.6, 0.6)},
        "sensor": {"type": "perspective", "fov": 34, "to_world": mi.ScalarTransform4f().look_at([0.6, 2.6, 4.6], [0, 0.6, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "component_format": "float32"}},
    }, optimize=False)


def matt(*colour):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}


def torus(around: int = 72, across: int = 28, radius: float = 0.75, tube: float = 0.27):
    """A closed mesh with smooth normals."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(across) * 2 * np.pi / across,
                                                 indexing="ij"))
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    points = np.stack([np.cos(u), np.sin(u), 0 * u], axis=1) * radius + tube * normals
    lean = np.array(mi.ScalarTransform4f().rotate([0, 1, 0], 35).rotate([1, 0, 0], -35).matrix, dtype=np.float64)[:3, :3]
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    at = lambda a, b: (i + a) % around * across + (j + b) % across
    faces = np.concatenate([np.stack([at(0, 0), at(1, 0), at(1, 1)], 1), np.stack([at(0, 0), at(1, 1), at(0, 1)], 1)])
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(matt(0.75, 0.5, 0.35))
    mesh = mi.Mesh("torus", len(points), len(faces), has_vertex_normals=True, props=props)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float((points @ lean.T + [0, 0.95, 0]).ravel().tolist())
    parameters["vertex_normals"] = mi.Float((normals @ lean.T).ravel().tolist())
    parameters["faces"] = mi.UInt32(faces.ravel().tolist())
    parameters.update()
    return mesh


def sky_map(kind: str, sun, cap: bool, height: int = 129):
    """Pixels of the sky, bluish away from a cap of light in it; its rim is averaged over the pixels."""
    from mi_shlight.environment.probe import latlong
    from mi_shlight.environment.sky import cie_sky

    pixels = 0.25 * latlong(lambda d: cie_sky(d, kind, sun), height, mi.Vector3f)[..., None] * np.array([0.75, 0.9, 1.2])
    if cap:
        axis = np.array(CAP) / np.linalg.norm(CAP)
        rim = lambda d: np.clip(0.5 + (CAP_ANGLE - np.arccos(np.clip(d @ axis, -1, 1))) / (np.pi / (height - 1)), 0, 1)
        pixels = pixels + latlong(rim, height)[..., None] * CAP_COLOUR
    return np.ascontiguousarray(pixels, dtype=np.float32)


def envmap(pixels) -> dict:
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels)}


def light_kinds() -> dict:
    """One set of emitters for each kind, and all of them."""
    corners = [[-1.5, 2.2, -0.6], [-0.4, 2.8, 0.2], [-0.9, 1.8, 1.2]]
    props = mi.Properties()
    props["emitter"] = mi.load_dict({"type": "shlight", "radiance": {"type": "rgb", "value": [9.0, 7.0, 5.0]}})
    polygon = mi.Mesh("polygon", 3, 1, props=props)
    parameters = mi.traverse(polygon)
    parameters["vertex_positions"], parameters["faces"] = mi.Float(np.ravel(corners).tolist()), mi.UInt32([0, 1, 2])
    parameters.update()
    sun = {"type": "directional", "direction": [-c for c in SUN], "irradiance": {"type": "rgb", "value": [1.2, 1.0, 0.8]}}
    spot = {"type": "spot", "cutoff_angle": 25, "intensity": {"type": "rgb", "value": [2, 3, 8]},
            "to_world": mi.ScalarTransform4f().look_at([2.2, 2.4, 1.0], [0.9, 0, 0.4], [0, 1, 0])}
    return {"polygon": {"polygon": polygon}, "sky and cap": {"sky": envmap(sky_map("clear", SUN, True))},
            "constant": {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.4, 0.5, 0.6]}}},
            "directional and spot": {"sun": sun, "spot": spot},
            "all together": {"polygon": polygon, "sky": envmap(sky_map("clear", SUN, True)), "sun": sun, "spot": spot}}


def compare(what, reference_spp: int, transfer: str = "shadowed", **parameters) -> dict:
    """SH picture, path traced one, and their difference over the reference's mean with the noise of the reference."""
    shprt = mi.load_dict({"type": "shprt", "order": ORDER, "transfer": transfer, "max_edge": 0.06, **parameters})
    image = np.array(mi.render(what, integrator=shprt, spp=SPP, seed=5))
    path = mi.load_dict({"type": "path", "max_depth": 2})
    halves = [np.array(mi.render(what, integrator=path, spp=reference_spp // 2, seed=seed)) for seed in (1, 2)]
    reference = (halves[0] + halves[1]) / 2
    mean = reference.mean()
    error = abs(image - reference)
    return {"image": image, "reference": reference, "mean_relative": float(error.mean() / mean),
            "p99": float(np.percentile(error, 99) / mean), "bias": float((image - reference).mean() / mean),
            "noise_of_reference": float(abs(halves[0] - halves[1]).mean() / 2 / mean)}


def proxy_shadow_on_floor(resolution: int = 64, orders=(4, 8, 14)) -> dict:
    """Irradiance over pi of a floor under a ball and a clear sky: with the ball as a cap that is taken out of the sky's coefficients at
    each point, and by quadrature over what the ball leaves of the sky. Errors relative to the light that the ball takes away.
    """
    from mi_shlight.environment.cap import proxy_shadow
    from mi_shlight.environment.sky import cie_sky, project_sky
    from mi_shlight.sh.functions import sphere_quadrature
    from mi_shlight.transfer.cosine import cosine_transfer

    height, radius, kind = 0.7, 0.45, "clear"
    x, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-2, 2, resolution), np.linspace(-2, 2, resolution)))
    to = np.stack([-x, np.full_like(x, height), -z])
    distance = np.linalg.norm(to, axis=0)
    directions, weights = sphere_quadrature(128)
    upper = directions[:, 1] > 0
    directions, weights = directions[upper], weights[upper]
    sky = np.array(cie_sky(mi.Vector3f(directions.T.astype(np.float32)), kind, SUN), dtype=np.float64) * weights * directions[:, 1] / np.pi
    rim = np.sqrt(1 - (radius / distance) ** 2)
    truth = np.array([sky[directions @ v < c].sum() for v, c in zip((to / distance).T, rim)])
    pictures, errors = {"truth": truth.reshape(resolution, resolution)}, {}
    for order in orders:
        light = [mi.Float(c) for c in project_sky(kind, order, SUN)]
        shadowed = proxy_shadow(light, mi.Vector3f(to.astype(np.float32)), mi.Float(np.arcsin(radius / distance).astype(np.float32)))
        transfer = cosine_transfer(mi.Normal3f(0, 1, 0), order)
        image = np.array(sum(t * s for t, s in zip(transfer, shadowed)), dtype=np.float64)
        pictures[f"order {order}"] = image.reshape(resolution, resolution)
        taken = sky.sum() - truth
        errors[f"order {order}"] = {"mean_of_shadow": float(abs(image - truth).mean() / taken.mean()),
                                    "largest_of_shadow": float(abs(image - truth).max() / taken.max())}
    return {"pictures": pictures, "errors": errors}


def draw_proxy(result: dict, path) -> None:
    """The floor from above: truth, then each order."""
    figure, axes = _figure(1, len(result["pictures"]), 3.2)
    for axis, (name, picture) in zip(axes.ravel(), result["pictures"].items()):
        shown = axis.imshow(picture, vmin=0, vmax=result["pictures"]["truth"].max(), cmap="gray", interpolation="nearest")
        error = result["errors"].get(name)
        title = f"{name}: error {error['mean_of_shadow']:.1%}" if error else "ball under a clear sky"
        axis.set_title(title, fontsize="medium")
    figure.colorbar(shown, ax=axes.ravel().tolist(), label="irradiance / pi")
    figure.savefig(path, pil_kwargs={"optimize": True})


def _figure(rows: int, columns: int, height: float) -> tuple:
    from mi_shlight.panel import require_matplotlib

    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.5 * columns + 1, height), dpi=76, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    return figure, axes


def draw_kinds(results: dict, path) -> None:
    """A column for each kind: SH, path tracing, difference."""
    from matplotlib.ticker import PercentFormatter

    from mi_shlight.panel import srgb

    figure, axes = _figure(3, len(results), 7.6)
    for column, (name, r) in zip(axes.T, results.items()):
        exposure = 0.9 / np.percentile(r["reference"], 99)
        side = len(r["image"]) // BLOCK
        blocks = (r["image"] - r["reference"]).reshape(side, BLOCK, side, BLOCK, 3)
        difference = blocks.mean(axis=(1, 3, 4)) / r["reference"].mean()
        for axis, picture in zip(column, (r["image"], r["reference"])):
            axis.imshow(srgb(picture * exposure))
        shown = column[2].imshow(difference, cmap="RdBu_r", vmin=-0.05, vmax=0.05)
        column[0].set_title(name)
        column[2].set_title(f"mean {r['mean_relative']:.2%} (noise {r['noise_of_reference']:.2%})", fontsize="small")
    for axis, label in zip(axes[:, 0], (f"SH, order {ORDER}", "path traced", f"difference, {BLOCK} x {BLOCK} pixels")):
        axis.set_ylabel(label)
    figure.colorbar(shown, ax=axes[2].tolist(), format=PercentFormatter(xmax=1), label="of the reference's mean")
    figure.savefig(path, pil_kwargs={"optimize": True})


def targets(report: dict) -> list:
    """Verdicts on bias, which noise does not hide, and on proxy shadows."""
    return [*(experiment.verdict(f"{name}: bias against path tracing at most 0.5 %", abs(row["bias"]), 0.005, text="{:.2%}")
              for table in ("kinds", "skies") for name, row in report[table].items()),
            experiment.verdict("proxy shadow, order 14: error of the shadow at most 1 %",
                               report["proxy_shadow"]["order 14"]["mean_of_shadow"], 0.01, text="{:.2%}")]


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments, reference_spp={"type": int, "default": 4096})
    size, resolution, skies = SIZE, 64, SKIES
    mi.set_variant("llvm_ad_rgb")
    import mi_shlight  # noqa: F401  registers shprt and shlight

    kinds = light_kinds()
    if options.quick:
        options.reference_spp, size, resolution = 64, 8 * BLOCK, 8
        kinds, skies = {name: kinds[name] for name in list(kinds)[-1:]}, {}
    numbers = lambda results: {name: {k: v for k, v in r.items() if not isinstance(v, np.ndarray)} for name, r in results.items()}
    kinds = {name: compare(scene(size, **lights), options.reference_spp) for name, lights in kinds.items()}
    draw_kinds(kinds, options.out / "light_kinds.png")
    skies = {kind: compare(scene(size, sky=envmap(sky_map(kind, sun, False))), options.reference_spp) for kind, sun in skies.items()}
    if skies:
        draw_kinds(skies, options.out / "light_kinds_skies.png")
    proxy = proxy_shadow_on_floor(resolution)
    draw_proxy(proxy, options.out / "light_kinds_proxy.png")
    report = {"kinds": numbers(kinds), "skies": numbers(skies), "proxy_shadow": proxy["errors"],
              "settings": {"order": ORDER, "spp": SPP, "reference_spp": options.reference_spp, "size": size}}
    report = {"targets": targets(report), **report}
    for table in ("kinds", "skies", "proxy_shadow"):
        for name, row in report[table].items():
            print(f"{name:22s} " + ", ".join(f"{key.replace('_', ' ')} {value:.2%}" for key, value in row.items()))
    experiment.print_targets(report["targets"])
    experiment.write(options.out / "light_kinds.json", report, options.quick)


if __name__ == "__main__":
    main()
