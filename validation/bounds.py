"""Claim: the truncation bound of `shprt` holds at every point looked at, and is 1 to 10 times the error; total_error covers a picture.

    python -m validation.bounds [--quick] [--out DIR]

writes ``bounds.json``, ``bounds.png`` (curves) and ``bounds_maps.png`` (pictures), and prints tables.

*Bound*: at the middles of the pixels, transfer by rays of each hit's own (``transfer_domain`` pixel), so that nothing is interpolated; and
at baked points. What is due there comes without any spherical harmonics: the mean of visibility times both cosines over the squared
distance, over thousands of stratified points of the lights, or directions of the sky, by shadow rays of this module's own. It is known to
three standard errors, from repetitions, and what a light may hide between its points. A violation is an error above the bound by more than
that; the ratio is that of bound to error, where the error is three times that or more.

A bound knows of an occluder what the rays of its transfer vector have met; a shadow that they have missed is a matter of
``transfer_error``. So violations are counted of the bound alone, of the bound and three of these, and of the bound alone once more with
32 times the rays at the points where it was violated.

*Sum*: pictures as they come by default, transfer baked at vertices, against the same truth: how often ``total_error`` covers the error,
and how the two go together.
"""
from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np

from mi_shlight.scene import Fingerprint, aligned, keep_quiet, mesh_arrays, receivers
from mi_shlight.shading import near
from mi_shlight.shading.errors import PointErrors
from mi_shlight.shading.hits import HitTransfer
from mi_shlight.shading.lighting import Lighting
from mi_shlight.shading.settings import Settings
from mi_shlight.shading.state import SceneState
from mi_shlight.transfer.visibility import inside_a_body

from .experiment import options, print_targets, verdict, write
from .light_kinds import SUN, envmap, sky_map
from .light_kinds import scene as torus_scene
from .soft_shadows import ball_scene, from_file

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.colors import LogNorm  # noqa: E402

KINDS = {"unshadowed": {"transfer": "unshadowed"}, "projected": {"localised": False}, "localised": {}, "exact": {"transfer": "exact"}}
ROUNDING = 2e-5
"""Of float32, as a part of what a surface that faces the lights has."""
TOLD = 3
"""An error that is so many times what the truth may be off by can be told from it."""


class Plan(NamedTuple):
    """Sizes to measure."""

    size: int = 32
    """Pixels along a side."""
    strata: int = 24
    """Points of a triangle of a light along one side, in each repetition."""
    repeats: int = 8
    orders: tuple = (2, 4, 6, 8, 11, 14)
    rays: int = 1024
    points: int = 600
    """Baked points to look at."""
    scenes: tuple = ("cornell_box", "ball", "floor", "plant", "sculpture", "sky", "many_lights")
    few: tuple = (2, 8)
    """Orders where all of them would take too long."""
    pictures: tuple = ("cornell_box", "ball", "plant", "sculpture")
    """Scenes with transfer at vertices, too."""


QUICK = Plan(size=10, strata=4, repeats=4, orders=(2,), rays=64, points=40, scenes=("ball", "sky"), few=(2,), pictures=("ball",))

SCENES = {"ball": ball_scene, "sky": lambda size: torus_scene(sky=envmap(sky_map("clear", SUN, True))),
          **{name: from_file(name) for name in ("cornell_box", "plant", "sculpture", "floor", "many_lights")}}


class Points(NamedTuple):
    """Places to look at."""

    rays: object
    """That meet them."""
    p: object
    n: object
    """Unit normals on the side that is seen."""
    reflectance: object
    """Diffuse, 0 where nothing is lit."""
    lit: np.ndarray


class Truth(NamedTuple):
    """Luminance that is due at points, (P,) each."""

    value: np.ndarray
    error: np.ndarray
    """What `value` may be off by."""
    facing: np.ndarray
    """Luminance if the surface faced all the lights and saw them."""


# What is due.

def pixels(scene, size: int) -> Points:
    """The middles of the pixels."""
    place = (np.arange(size) + 0.5) / size
    x, y = (aligned(mi.Float, a.ravel()) for a in np.meshgrid(place, place))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5, 0.5))
    return seen_by(scene, mi.Ray3f(ray.o, ray.d))


def seen_by(scene, rays) -> Points:
    si = scene.ray_intersect(rays)
    bsdf, front = si.bsdf(), mi.Frame3f.cos_theta(si.wi) > 0
    lit = si.is_valid() & ~si.shape.is_emitter() & (front | mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide))
    reflectance = dr.select(lit, bsdf.eval_diffuse_reflectance(si, lit), 0)
    n = dr.select(front, si.sh_frame.n, -si.sh_frame.n)
    dr.eval(rays, si.p, n, reflectance, lit)
    return Points(rays, si.p, n, reflectance, np.array(lit))


def truth_of(scene, points: Points, plan: Plan) -> tuple:
    """(truth, the same if nothing cast shadows) by shadow rays to stratified points of the lights or, under a sky, along stratified
    directions.
    """
    random = np.random.default_rng(1)
    sky = scene.environment()
    lamps = [shape for shape in scene.shapes() if shape.is_emitter()]
    strata = plan.strata if len(lamps) < 5 else 2
    found = []
    for _ in range(plan.repeats):
        if sky is None:
            table, count = light_points(lamps, strata, random), strata * strata
        else:
            count = 4 * plan.strata ** 2
            table = stratified(2 * plan.strata, random)
        columns = [aligned(mi.Float, column) for column in table.T]
        found.append(received(scene, points, columns, sky, len(lamps) > 4))
    shadowed, unshadowed, facing = (np.array(values) for values in zip(*found))
    facing, hidden = facing.mean(axis=0), unshadowed.mean(axis=0) / (count * plan.repeats)
    error = lambda values: 3 * values.std(axis=0, ddof=1) / math.sqrt(plan.repeats) + ROUNDING * facing
    return (Truth(shadowed.mean(axis=0), error(shadowed) + hidden, facing), Truth(unshadowed.mean(axis=0), error(unshadowed), facing))


def stratified(strata: int, random) -> np.ndarray:
    """(strata^2, 2) points of the unit square, one in each of its parts."""
    corner = np.stack(np.meshgrid(*[np.arange(strata)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    return (corner + random.random(corner.shape)) / strata


def light_points(lamps: list, strata: int, random) -> np.ndarray:
    """Rows of position, normal times area share, radiance, and number of the light, for points on the faces of all lights."""
    rows = []
    for number, shape in enumerate(lamps):
        faces, vertices, _, side = mesh_arrays(shape)
        radiance = np.ravel(mi.traverse(shape.emitter())["radiance.value"])
        two_sided = getattr(shape.emitter(), "two_sided", False)
        for a, b, c in vertices.astype(float)[faces]:
            u, v = stratified(strata, random).T
            q = (1 - np.sqrt(u))[:, None] * a + (np.sqrt(u) * (1 - v))[:, None] * b + (np.sqrt(u) * v)[:, None] * c
            area = side * np.cross(b - a, c - a) / 2 / len(q)
            rows.append(np.hstack([q, np.tile([*area, *(radiance * np.ones(3)), number, two_sided], (len(q), 1))]))
    return np.concatenate(rows)


def received(scene, points: Points, columns: list, sky, crowded: bool) -> tuple:
    """Luminance reflected with the points of one repetition, the same if nothing cast shadows, and if all lights were faced, too."""
    start = points.p + points.n * ((1 + dr.max(abs(points.p))) * mi.math.RayEpsilon)
    count = dr.opaque(mi.UInt32, dr.width(columns[0]))
    read = lambda k: [dr.gather(mi.Float, column, k) for column in columns]

    def lamp(k):
        x, y, z, a, b, c, red, green, blue, number, two_sided = read(k)
        d = mi.Vector3f(x, y, z) - points.p
        squared = dr.squared_norm(d)
        emitted = -dr.dot(mi.Vector3f(a, b, c), d)
        emitted = dr.select(two_sided > 0, abs(emitted), dr.maximum(emitted, 0))
        whole = mi.Color3f(red, green, blue) * (emitted / dr.power(squared, 1.5) * dr.inv_pi)
        return whole, dr.maximum(dr.dot(points.n, d), 0) * dr.rsqrt(squared), lamp_seen(d, number)

    def lamp_seen(d, number):
        """Lights let light through: their own, or, where many share one visibility, that of all."""
        def body(going, seen, o, left):
            ray = mi.Ray3f(o, d)
            ray.maxt = left
            hit = scene.ray_intersect_preliminary(ray, active=going)
            met = going & hit.is_valid()
            own = met & hit.shape.is_emitter() & (mi.Bool(crowded) | same_light(hit, number))
            step = hit.t * (1 + 1e-4)
            return own, seen & (~met | own), dr.select(own, o + d * step, o), left - dr.select(own, step, 0)

        state = mi.Bool(True), mi.Bool(True), mi.Point3f(start), mi.Float(1 - 1e-4)
        return dr.while_loop(state, lambda going, *_: going, body, mode="symbolic")[1]

    def direction(k):
        u, v = read(k)
        radius, turn = dr.sqrt(u), v * (2 * math.pi)
        d = mi.Frame3f(points.n).to_world(mi.Vector3f(radius * dr.cos(turn), radius * dr.sin(turn), dr.sqrt(1 - u)))
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -d
        return sky.eval(si) / mi.Float(count), 1, ~scene.ray_test(mi.Ray3f(start, d))

    numbers = {int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]): i
               for i, shape in enumerate(s for s in scene.shapes() if s.is_emitter())}
    number_of = aligned(mi.Float, np.array([numbers.get(i, -1) for i in range(max(numbers, default=0) + 1)]))
    shape_of = lambda hit: dr.reinterpret_array(mi.UInt32, hit.shape)
    same_light = lambda hit, number: dr.gather(mi.Float, number_of, shape_of(hit), hit.shape.is_emitter()) == number

    def body(k, shadowed, unshadowed, facing):
        radiance, cosine, seen = direction(k) if sky else lamp(k)
        return k + 1, shadowed + dr.select(seen, radiance * cosine, 0), unshadowed + radiance * cosine, facing + radiance

    sums = dr.while_loop((mi.UInt32(0), *(mi.Color3f(0) for _ in range(3))), lambda k, *_: k < count, body, mode="symbolic")[1:]
    result = [mi.luminance(points.reflectance * light) for light in sums]
    dr.eval(result)
    return tuple(np.array(value, dtype=float) for value in result)


# What shprt has.

def shaded(scene, points: Points, **wanted) -> dict:
    """Luminance, bound and deviation of the light that `shprt` finds at points by rays of their own."""
    settings = Settings(transfer_domain="pixel", errors=True, **wanted)
    state = SceneState(scene, settings, Fingerprint(scene))
    lighting = Lighting(state, settings, state.table.attached() if state.table else None, None, None)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(points.lit))
    wavelengths, transfer = dr.zeros(mi.SurfaceInteraction3f).wavelengths, None
    lit = near.Points(points.p, points.n, wavelengths, aligned(mi.UInt32, points.lit) > 0)
    if settings.parts.direct != "unshadowed":
        transfer = HitTransfer(state, settings, settings.parts.direct, settings.order, lighting.table, lit, sampler)
    seen = lambda radiance: mi.luminance(radiance * points.reflectance)
    value = seen(lighting.white(lit, transfer, deltas=False))
    dr.eval(value)
    (bound,), (deviation,) = PointErrors(lighting, state, settings, lambda radiance: [seen(radiance)]).bounds(lit, transfer)
    return arrays(len(points.lit), value=value, truncation_bound=bound, transfer_error=deviation)


def pictured(scene, points: Points, integrator) -> dict:
    """Luminance and errors as a picture by `integrator` has them, for the rays of the points."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(points.lit))
    value, _, aovs, _ = integrator.sample(dr.ADMode.Primal, scene, sampler, mi.RayDifferential3f(points.rays))
    return arrays(len(points.lit), value=mi.luminance(value), **dict(zip(integrator.aov_names(), aovs)))


def arrays(count: int, **values) -> dict:
    dr.eval(values)
    return {name: np.array(value, dtype=float) + np.zeros(count) for name, value in values.items()}


def baked_points(scene, transfer, count: int, seed: int = 2) -> Points:
    """Points of a bake, as good as: moved by a thousandth of a cell, so that rays meet one triangle and interpolation has no share."""
    random, places = np.random.default_rng(seed), []
    size = np.ptp(np.array([np.ravel(scene.bbox().min), np.ravel(scene.bbox().max)]), axis=0).max()
    blocks = {block.content: block for block in transfer.meshes}
    for receiver in receivers(scene, keep_quiet):
        block = blocks.get(receiver.content)
        if block is None or receiver.light >= 0:
            continue
        faces, vertices, _, side = mesh_arrays(receiver.shape)
        face = random.integers(len(faces), size=count)
        k = block.subdivision[face].astype(int)
        i = random.integers(k + 1)
        j = random.integers(k - i + 1)
        share = np.stack([k - i - j, i, j], axis=1) / k[:, None]
        share += 1e-3 / k[:, None] * (1 / 3 - share)
        corners = vertices[faces[face]].astype(float)
        n = side * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        places.append(np.hstack([np.einsum("pk,pkx->px", share, corners), n / np.linalg.norm(n, axis=1, keepdims=True)]))
    places = random.permutation(np.concatenate(places))[:count]
    p, n = (mi.Vector3f(*(aligned(mi.Float, c) for c in places[:, part].T)) for part in (slice(0, 3), slice(3, 6)))
    points = seen_by(scene, mi.Ray3f(mi.Point3f(p + n * (1e-3 * size)), -n))
    near_by = np.array(dr.norm(points.p - p) < 1e-4 * size) & ~np.array(inside_a_body(scene, points.p, points.n))
    return points._replace(lit=points.lit & near_by)       # what is inside a body has its neighbours' transfer


def some_of(points: Points, chosen: np.ndarray) -> Points:
    """Those whose numbers are `chosen`."""
    index = aligned(mi.UInt32, chosen)
    pick = lambda value: dr.gather(type(value), value, index)
    return Points(pick(points.rays), pick(points.p), pick(points.n), pick(points.reflectance), points.lit[chosen])


# Both.

def compared(found: dict, truth: Truth, lit: np.ndarray) -> dict:
    """Violations and ratios of bounds, and errors and bounds over the mean that is due."""
    error, bound, mean = abs(found["value"] - truth.value)[lit], found["truncation_bound"][lit], truth.value[lit].mean()
    doubt, deviation = truth.error[lit], found["transfer_error"][lit]
    told = error > TOLD * doubt
    ratio = bound[told] / error[told]
    quantile = lambda q: float(np.quantile(ratio, q)) if len(ratio) else None
    return {"points": int(lit.sum()), "violations": int((error > bound + doubt).sum()),
            "with 3 transfer_error": int((error > bound + 3 * deviation + doubt).sum()), "told": int(told.sum()),
            "median ratio": quantile(0.5), "10 %": quantile(0.1), "90 %": quantile(0.9),
            "error": float(error.mean() / mean), "bound": float(bound.mean() / mean), "transfer_error": float(deviation.mean() / mean)}


def measure_scene(name: str, plan: Plan) -> tuple:
    """(rows at hits, rows at baked points, rows of pictures, maps) of a scene."""
    scene = SCENES[name](plan.size)
    points = pixels(scene, plan.size)
    truth, unshadowed = truth_of(scene, points, plan)
    rows, baked, sums, maps = [], [], [], None
    for kind, order in cases(name, plan):
        due = unshadowed if kind == "unshadowed" else truth
        wanted = {"order": order, "transfer_samples": plan.rays, **KINDS[kind]}
        found = shaded(scene, points, **wanted)
        row = compared(found, due, points.lit)
        over = np.flatnonzero(points.lit & (abs(found["value"] - due.value) > found["truncation_bound"] + due.error))
        again = {"violations": 0}
        if len(over):
            few = some_of(points, over)
            more = shaded(scene, few, **{**wanted, "transfer_samples": min(32 * plan.rays, 65536)})
            again = compared(more, Truth(*(values[over] for values in due)), few.lit)
        rows.append({"scene": name, "transfer": kind, "order": order, **row, "with 32 times the rays": again["violations"]})
        report(rows[-1])
    for kind, order in (("localised", 4), ("projected", 8)) if name in plan.pictures else ():
        integrator = mi.load_dict({"type": "shprt", "order": order, "errors": True, "transfer_samples": plan.rays, **KINDS[kind]})
        transfer = integrator.prepare_scene(scene)
        places = baked_points(scene, transfer, plan.points)
        about = {"scene": name, "transfer": kind, "order": order}
        baked.append({**about, **compared(pictured(scene, places, integrator), truth_of(scene, places, plan)[0], places.lit)})
        report(baked[-1])
        found = pictured(scene, points, integrator)
        sums.append({**about, **covered(found, truth, points.lit)})
        report(sums[-1])
        if kind == "localised":
            maps = {"due": truth.value, "error": abs(found["value"] - truth.value), "lit": points.lit,
                    **{key: found[key] for key in ("truncation_bound", "transfer_error", "total_error")}}
    return rows, baked, sums, maps


def cases(name: str, plan: Plan):
    """(kind, order) to measure: of a sky all transfer is projected; many lights and ``exact`` at two orders, to save time."""
    for kind in ("unshadowed", "projected") if name == "sky" else KINDS:
        for order in plan.orders:
            if order in plan.few or kind != "exact" and name != "many_lights":
                yield kind, order


def covered(found: dict, truth: Truth, lit: np.ndarray) -> dict:
    """How the sum of the errors goes together with that of a picture."""
    error, doubt, mean = abs(found["value"] - truth.value)[lit], truth.error[lit], truth.value[lit].mean()
    total = found["total_error"][lit]
    rank = lambda values: np.argsort(np.argsort(values))
    return {"points": int(lit.sum()), "error": float(error.mean() / mean), "total_error": float(total.mean() / mean),
            "truncation_bound": float(found["truncation_bound"][lit].mean() / mean),
            "transfer_error": float(found["transfer_error"][lit].mean() / mean), "covered": float((error <= total + doubt).mean()),
            "rank correlation": float(np.corrcoef(rank(total), rank(error))[0, 1])}


def report(row: dict) -> None:
    print("  ".join(f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()), flush=True)


def targets(rows: list, baked: list) -> list:
    """Of the claim."""
    count = lambda key, rows: sum(row[key] for row in rows)
    lines = []
    for kind in KINDS:
        own = [row for row in rows if row["transfer"] == kind]
        lines.append(verdict(f"violations of the bound alone, {kind}, of {count('points', own)} points and orders",
                             count("violations", own), 0, text="{:.0f}"))
    total = count("points", rows)
    lines += [verdict(f"violations of the bound and 3 transfer_error, of {total}", count("with 3 transfer_error", rows), 0, text="{:.0f}"),
              verdict("violations of the bound alone where the rays are 32 times as many", count("with 32 times the rays", rows), 0,
                      text="{:.0f}")]
    if baked:
        lines.append(verdict(f"violations at baked points, with 3 transfer_error, of {count('points', baked)}",
                             count("with 3 transfer_error", baked), 0, text="{:.0f}"))
    for kind in KINDS:
        own = [row["median ratio"] for row in rows if row["transfer"] == kind and row["told"] >= 10]
        limit = 10 if kind in ("localised", "exact") else 5
        lines.append(verdict(f"median over scenes and orders of the median ratio of bound to error, {kind}: at most {limit}",
                             float(np.median(own)) if own else math.nan, limit))
    return lines


def plot_curves(rows: list, path) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(11.5, 3.6), layout="constrained")
    for kind, colour in zip(KINDS, ("0.5", "C3", "C0", "C2")):
        orders = sorted({row["order"] for row in rows if row["transfer"] == kind})
        at = [[row for row in rows if (row["transfer"], row["order"]) == (kind, order) and row["told"] >= 10] for order in orders]
        orders, at = zip(*[(order, own) for order, own in zip(orders, at) if own]) if any(at) else ((), ())
        middle, low, high = ([float(np.median([row[key] for row in own])) for own in at] for key in ("median ratio", "10 %", "90 %"))
        axes[0].plot(orders, middle, marker="o", color=colour, label=kind)
        axes[0].fill_between(orders, low, high, color=colour, alpha=0.12, linewidth=0)
    axes[0].set(title="bound over error: median, 10 and 90 %", xlabel="order", yscale="log")
    axes[0].axhline(1, color="black", linewidth=0.8)
    axes[0].legend(fontsize=7)
    for axis, kind in zip(axes[1:], ("projected", "localised")):
        for i, name in enumerate(dict.fromkeys(row["scene"] for row in rows)):
            own = [row for row in rows if (row["scene"], row["transfer"]) == (name, kind)]
            for key, style in (("error", "-"), ("bound", "--")):
                axis.plot([row["order"] for row in own], [max(row[key], 1e-5) for row in own], style, color=f"C{i}", marker=".",
                          label=name if key == "error" else None)
        axis.set(title=f"{kind}: mean error, bound (dashed)", xlabel="order", yscale="log")
    axes[1].legend(fontsize=7)
    for axis in axes:
        axis.set_xticks(sorted({row["order"] for row in rows}))
        axis.grid(True, which="both", alpha=0.3)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def plot_maps(maps: dict, path) -> None:
    """Localised transfer, order 4: what is due; errors and bounds over its brightest; and their ratio. Grey shows no surface."""
    titles = {"due": "what is due", "error": "error of the picture", "truncation_bound": "truncation_bound",
              "transfer_error": "transfer_error", "total_error": "total_error", "ratio": "total_error / error"}
    figure, axes = plt.subplots(len(maps), len(titles), figsize=(2 * len(titles), 2.05 * len(maps)), layout="constrained", squeeze=False)
    for axis, title in zip(axes[0], titles.values()):
        axis.set_title(title, fontsize=8)
    for line, (name, found) in zip(axes, maps.items()):
        side = math.isqrt(len(found["lit"]))
        white = np.quantile(found["due"][found["lit"]], 0.95)
        ratio = found["total_error"] / np.maximum(found["error"], 1e-4 * white)
        for axis, key in zip(line, titles):
            values = ratio if key == "ratio" else np.maximum(found[key] / white, 1e-4)
            values = np.where(found["lit"], values, np.nan).reshape(side, side)
            style = {"due": {"cmap": "gray", "vmin": 0, "vmax": 1}, "ratio": {"cmap": "RdBu", "norm": LogNorm(0.01, 100)}}
            shown = axis.imshow(values, **style.get(key, {"cmap": "magma", "norm": LogNorm(1e-4, 1)}))
            axis.set(xticks=[], yticks=[])
            axis.set_facecolor("0.8")
            if key in ("total_error", "ratio"):
                figure.colorbar(shown, ax=axis, shrink=0.8).ax.tick_params(labelsize=6)
        line[0].set_ylabel(name, fontsize=8)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main(arguments=None) -> None:
    chosen = options(__doc__, arguments)
    plan = QUICK if chosen.quick else Plan()
    mi.set_variant("llvm_ad_rgb")
    rows, baked, sums, maps = [], [], [], {}
    for name in plan.scenes:
        *found, shown = measure_scene(name, plan)
        for total, part in zip((rows, baked, sums), found):
            total += part
        if shown:
            maps[name] = shown
    lines = targets(rows, baked)
    print_targets(lines)
    write(chosen.out / "bounds.json", {"targets": lines, "plan": plan._asdict(), "hits": rows, "baked points": baked, "pictures": sums},
          chosen.quick)
    plot_curves(rows, chosen.out / "bounds.png")
    plot_maps(maps, chosen.out / "bounds_maps.png")


if __name__ == "__main__":
    main()
