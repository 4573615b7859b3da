"""The cheapest settings of `shprt` for the error that is asked for."""
from __future__ import annotations

import math
import re
import warnings
from dataclasses import asdict, dataclass, field

import mitsuba as mi
import numpy as np

from ..errors import SHLightWarning, check_number, message
from ..rendering import check_view
from ..shading.settings import Settings, parse_transfer
from .candidates import Candidate, Findings
from .cost import compile_seconds
from .probe import Probe

PLANNED = ("order", "method", "transfer", "transfer_domain", "transfer_samples", "transfer_file", "max_edge", "light_margin", "localised",
           "window", "bounces", "bounce_tolerance", "bounce_samples", "bounce_lighting", "visibility_order", "bsdf_order",
           "grid_resolution", "grid_interpolation", "grid_error")
"""Parameters that a plan decides; all others stay as the scene has them."""


LEAST_ERROR = 1e-6


@dataclass(frozen=True)
class Plan:
    """Settings for a scene, with what they are expected to cost and to miss.

    Attributes
    ----------
    settings : dict
        All parameters of `shprt`, as ``mi.load_dict`` takes them.
    max_error, time_limit : float, float or None
        What was asked for.
    error, spread : float
        Predicted mean relative error, as ``mi-shlight compare`` has it but without the noise of pixel samples, and its standard error:
        it was found at a few hundred points.
    parts : dict of str to float
        Predicted error by cause.
    bake, render, compile : float
        Predicted seconds, of all threads of this machine, for a bake, for a picture of the scene's size and samples, and to compile where
        kernels are not in Dr.Jit's cache. `seconds` is the sum of the first two.
    met : bool
        Whether both the error and the time limit are expected to be kept.
    why : tuple of (str, str)
        For each choice its reason, with numbers.
    left_out : tuple of str
        Parts of the scene that `shprt` cannot render.
    choices : tuple of dict
        ``error``, ``seconds`` and ``settings`` of what else could be chosen: each is more accurate than all cheaper ones.
    largest : dict
        The same of order 14, ``exact``, 1024 rays per point, half the default's cells, all that the scene has, and no grid.
    """

    settings: dict
    max_error: float
    time_limit: float | None
    error: float
    spread: float
    parts: dict
    bake: float
    render: float
    compile: float
    met: bool
    why: tuple
    left_out: tuple
    choices: tuple = field(repr=False)
    largest: dict = field(repr=False)

    @property
    def seconds(self) -> float:
        """Predicted time of a bake and a picture."""
        return self.bake + self.render

    def integrator(self):
        """The `shprt` with the planned settings."""
        return mi.load_dict({"type": "shprt", **self.settings})

    def report(self) -> dict:
        """All of it as plain data, for JSON."""
        return {**asdict(self), "seconds": self.seconds}


def plan(scene, max_error: float, time_limit: float | None = None, *, light_margin: float | None = None, sensor: int = 0, spp: int = 0,
         seed: int = 0) -> Plan:
    """Find the cheapest settings of `shprt` that render a scene within an error.

    The scene is looked at as it is: from a few hundred points that the camera sees, rays find what light arrives (the truth), and what a
    bake would see there and around. From that follow the errors of all orders, kinds of transfer, cell sizes and ray counts, without
    another ray; see :py:mod:`mi_shlight.planner.simulate`. Times come from the sizes of the scene and a measured time of rays.

    Parameters
    ----------
    scene : mi.Scene
        Loaded in a JIT variant, with ``optimize=False``, and any integrator. What that one renders is what errors count against: light
        between surfaces counts if it is ``path`` (or another that has a ``max_depth``) of more than 2, or `shprt` with ``interreflected``.
    max_error : float
        Largest mean relative error, at least 1e-6, such as 0.01.
    time_limit : float, optional
        Seconds that a bake and a picture may take together, without compilation. If what keeps `max_error` takes longer, the plan is the
        most accurate of what does not.
    light_margin : float, optional
        How far lights are going to move, in scene units; by default that of the scene's own `shprt`, or 0.
    sensor, spp, seed : int
        Index of the sensor, samples per pixel (0: the scene's), and of the random numbers. Equal arguments give equal errors; times are
        measured, so where two settings cost nearly the same the choice can differ.

    Returns
    -------
    Plan
        If `max_error` cannot be kept, the most accurate settings there are, with ``met`` False.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, or the scene has no light, no sensor, or no lit surface in view.

    Notes
    -----
    Predictions are meant to be within a factor of 2 (validation/planner.py measures how far they are). Before it is compared with
    `max_error`, the error is taken 1.3 times and twice its standard error, `spread`, is added.
    """
    name = "plan"
    if not isinstance(scene, mi.Scene):
        raise TypeError(message(name, "scene", f"be a mitsuba.Scene of the current variant ({mi.variant()})", scene,
                                "Load it with mi.load_file(path, optimize=False)."))
    hint = "It is a relative error, such as 0.01 for 1 %; rounding alone is more than the least."
    max_error = check_number(name, "max_error", max_error, LEAST_ERROR, hint=hint)
    if time_limit is not None:
        time_limit = check_number(name, "time_limit", time_limit, 0, hint="It is a number of seconds for a bake and a picture.")
    view, spp = check_view(scene, sensor, spp, seed)
    own = scene.integrator()
    parameters = {**asdict(Settings()), **(own.parameters() if type(own).__name__ == "SHPRT" else {})}
    margin = parameters["light_margin"] if light_margin is None else light_margin
    margin = check_number(name, "light_margin", margin, 0, hint="It is a length in scene units.")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", SHLightWarning)
        probe = Probe(scene, view, margin, seed)
        hits = int(np.prod(view.film().crop_size()) * spp * probe.hits.seen)
        findings = Findings(probe, hits, spp, bounces_of(own), max_error, gloss=not parameters["errors"])
    found = findings.candidates()
    chosen = choose(found, max_error, time_limit)
    met = chosen.safe <= max_error and (time_limit is None or chosen.seconds <= time_limit)
    settings = lambda c: {**parameters, **_settings(c, findings, margin, bounces_of(own))}
    entry = lambda c: {"error": c.error, "seconds": c.seconds, "settings": {name: settings(c)[name] for name in PLANNED}}
    left_out = tuple(dict.fromkeys(str(w.message).removeprefix("shprt: ") for w in told if issubclass(w.category, SHLightWarning)))
    bakes = chosen.direct != "unshadowed" and chosen.domain == "vertex"
    why = list(_reasons(chosen, found, findings, margin))
    if parameters["errors"]:
        why.append(("errors", "true, as the scene has it: its layers take a few times as long as the picture, which is not counted here"
                    + ("; gloss does not go with them" if findings.gloss > 0 else "")))
    return Plan(settings(chosen), max_error, time_limit, chosen.error, chosen.spread, chosen.parts, chosen.bake, chosen.picture,
                compile_seconds(chosen.order, bakes), met, tuple(why), left_out,
                tuple(map(entry, pareto(found))), entry(findings.largest()))


def choose(candidates: list, max_error: float, time_limit: float | None) -> Candidate:
    """The cheapest that keeps the error; of those that keep the time limit the most accurate, if both are too much; of all, otherwise."""
    in_time = [c for c in candidates if time_limit is None or c.seconds <= time_limit]
    good = [c for c in in_time if c.safe <= max_error]
    if good:
        fastest = min(c.seconds for c in good)
        return min((c for c in good if c.seconds <= 1.05 * fastest + 0.01), key=_trouble)
    if in_time:
        return _most_accurate(in_time)
    return min(candidates, key=lambda c: c.seconds)


def _trouble(c: Candidate) -> tuple:
    """What decides between settings that take as long: no bake, less to compile, a smaller error."""
    return c.direct != "unshadowed", c.bsdf_order, c.bounce_rays, compile_seconds(c.order, c.domain == "vertex"), c.error


def pareto(candidates: list) -> list:
    """Those that no other beats in both error and time, from cheap to accurate."""
    front = []
    for c in sorted(candidates, key=lambda c: (c.seconds, c.error)):
        if not front or c.error < 0.97 * front[-1].error:
            front.append(c)
    return front


def _most_accurate(candidates: list) -> Candidate:
    """Of those whose error is next to the least one, the cheapest."""
    least = min(c.safe for c in candidates)
    return min((c for c in candidates if c.safe <= 1.02 * least), key=lambda c: c.seconds)


def bounces_of(integrator) -> int | None:
    """Reflections between surfaces that an integrator renders before the one that is seen: 0 for none, None without a limit."""
    if type(integrator).__name__ == "SHPRT":
        if not parse_transfer("plan", integrator.transfer).interreflected:
            return 0
        return integrator.bounces or None
    depth = re.search(r"max_depth = (-?\d+)", str(integrator))
    if depth is None:
        return 0
    depth = int(depth[1])
    return None if depth < 0 or depth > 10 ** 6 else max(depth - 2, 0)


def _settings(c: Candidate, findings: Findings, margin: float, bounces) -> dict:
    shadows = c.direct != "unshadowed"
    transfer = "+".join([c.direct] + ["interreflected"] * (c.bounce_rays > 0) + ["glossy"] * (c.bsdf_order > 0))
    default = asdict(Settings())
    planned = {name: default[name] for name in PLANNED}
    planned.update(order=c.order, transfer=transfer, transfer_domain=c.domain, light_margin=margin)
    if shadows:
        planned.update(transfer_samples=c.rays, max_edge=float(f"{c.edge:.4g}"))
    if c.bounce_rays:
        tolerance = float(f"{min(max(findings.max_error / 20, 1e-6), 1e-2):.2g}")
        planned.update(bounces=bounces or 0, bounce_samples=c.bounce_rays, bounce_tolerance=tolerance)
    if c.bsdf_order:
        planned["bsdf_order"] = c.bsdf_order
    if c.resolution:
        planned.update(grid_resolution=c.resolution, grid_error=float(f"{c.grid_error:.2g}"))
    return planned


def _reasons(c: Candidate, candidates: list, findings: Findings, margin: float):
    """(setting, reason) for each choice."""
    lights = findings.probe.state.lights
    rounded = lambda value: f"{value:.2g}" if value < 99.5 else f"{value:.0f}"
    percent = lambda value: f"{rounded(100 * value)} %"
    cheapest = lambda test: min((k for k in candidates if test(k) and k.safe <= findings.max_error), key=lambda k: k.seconds, default=None)
    least = lambda test: min((k.avoidable for k in candidates if test(k)), default=math.inf)
    besides = " besides what is left out" if c.parts["left out"] > 0 else ""
    same = lambda **other: lambda k: all(getattr(k, name) == other.get(name, getattr(c, name)) for name in
                                         ("direct", "order", "domain", "rays", "edge", "bounce_rays", "bsdf_order"))
    blocked = (f"{percent(findings.blocked)} of the light is blocked, {percent(findings.partly)} of the points see a part of a light")
    if c.direct == "unshadowed":
        zonal = f", and of each light {c.order + 1} zonal coefficients only" if lights else ""
        yield "transfer", f"unshadowed: {blocked}; no bake{zonal}"
    else:
        yield "transfer", f"{c.direct}: {blocked}; unshadowed would be off by {percent(least(lambda k: k.direct == 'unshadowed'))}"
    lower = max((k.order for k in candidates if k.order < c.order), default=None)
    if lower:
        less = percent(least(same(order=lower)))
        yield "order", f"{c.order}: error {percent(c.avoidable)}{besides}, where order {lower} would have {less}"
    else:
        yield "order", f"{c.order}: the lowest will do, with an error of {percent(c.avoidable)}{besides}"
    sizes = findings.apparent_sizes()
    if sizes is not None:
        yield "method", "auto: closed form where lights are near, cubature where they are small; from the points they are " + \
            f"{rounded(sizes[0])} to {rounded(sizes[1])} degrees wide"
    if c.direct != "unshadowed" and c.domain == "vertex":
        points = findings.points[findings.edges.index(c.edge)]
        yield "transfer_domain", f"vertex: {points:,.0f} points to bake, where the picture has {findings.sizes.hits:,} hits"
        coarser = least(lambda k: same(edge=2 * c.edge)(k))
        yield "max_edge", f"{c.edge:.3g}" + (f": cells of twice the size would make the error {percent(coarser)}" if coarser < math.inf
                                             else ": the coarsest cells looked at will do")
    elif c.direct != "unshadowed":
        baked = cheapest(lambda k: k.domain == "vertex" and k.direct != "unshadowed")
        other = f"with a bake that is as good it would take {baked.seconds:.2g} s, not {c.seconds:.2g}" if baked else "no bake is as good"
        yield "transfer_domain", f"pixel: {findings.sizes.hits:,} hits; {other}"
    if c.direct != "unshadowed":
        fewer = least(lambda k: same(rays=c.rays // 4)(k))
        yield "transfer_samples", f"{c.rays}" + (f": {c.rays // 4} would make the error {percent(fewer)}" if fewer < math.inf else
                                                 ": the least number looked at will do")
        if findings.cone() is not None:
            cone = rounded(findings.cone())
            yield "localised", f"true: lights lie in cones of {cone} degrees about their middle, light_margin {margin:g}"
    edges = findings.sizes.edges
    if c.resolution:
        yield "grid_resolution", (f"{c.resolution}: {edges:,} edges of lights at {findings.sizes.hits:,} hits would take "
                                  f"{findings.exact_seconds(c.order):.2g} s one by one; grid_error {c.grid_error:.2g} adds "
                                  f"{percent(c.parts['light grid'])}")
    else:
        yield "grid_resolution", f"0: lights are evaluated one by one, {len(lights)} with {edges:,} edges"
    if findings.between > 0:
        yield "interreflected", (f"{percent(findings.between)} of the light comes by way of other surfaces"
                                 + (f"; {c.bounce_rays} rays per point" if c.bounce_rays else ", too little to matter"
                                    if findings.between < findings.max_error else ", left out"))
    if findings.gloss > 0:
        yield "glossy", (f"{percent(findings.gloss)} of the light is gloss" + (f"; bsdf_order {c.bsdf_order} has it to "
                         f"{percent(c.parts['gloss'])}" if c.bsdf_order else ", too little to matter"
                         if findings.gloss < findings.max_error else ", left out"))
    for what, share in (("emitters that cannot be projected", findings.missing), ("surfaces that are shown black", findings.black)):
        if share > 0:
            yield "left out", f"{percent(share)} of the light: {what}"
