"""What rays find at a few hundred points that the camera sees: the material from which errors of any setting are computed.

All that needs Dr.Jit is here, in five small kernels that do not depend on what is being chosen; numpy takes it from there
(:py:mod:`mi_shlight.planner.simulate`).
"""
from __future__ import annotations

import math
import time
from types import SimpleNamespace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene import Fingerprint, aligned, mesh_arrays, shape_index
from ..sh.rotation import rotate_frame
from ..shading.near import NearLights, Points, luminance
from ..shading.settings import Settings
from ..shading.state import SceneState
from ..transfer.localised import LEVELS, MAX_FIT_ORDER, ConeFit, cone_eps, sample_transfer
from ..transfer.mesh import RIM, subdivision_of
from ..transfer.visibility import BakeLights, LightSight, Occluders, SkySight, inside_a_body, lifted

ORDER = MAX_FIT_ORDER
"""Highest order that is looked at."""

POINTS = 768
CANDIDATES = 4
"""Camera rays for each point wanted: many miss, or see a light."""

TRUTH_SAMPLES = 4096
"""Shadow rays per point to places all over the lights; a square number."""

PATHS = 64
"""Light paths per point, for the share of light that arrives by way of other surfaces."""

R2 = 0.7548776662466927, 0.5698402909980532
"""Steps of a set of points that covers the square evenly (Roberts 2018)."""


class Hits(NamedTuple):
    """Points that the camera sees, as numpy arrays over P."""

    o: np.ndarray
    d: np.ndarray
    """Rays of the camera, (P, 3)."""
    p: np.ndarray
    n: np.ndarray
    """Points and unit shading normals on the side that is seen, (P, 3)."""
    shape: np.ndarray
    face: np.ndarray
    uv: np.ndarray
    """Registry number of the shape, number of the face and barycentric coordinates (P, 2)."""
    back: np.ndarray
    """True where the back is seen."""
    lit: np.ndarray
    """False where `shprt` shows the surface black."""
    albedo: np.ndarray
    """Luminance of the diffuse reflectance."""
    wavelengths: np.ndarray
    """In nm, (P, K); none in variants without."""
    seen: float
    """Share of the camera's rays that meet a surface."""


class Truth(NamedTuple):
    """Light at the points, (groups, P) each: radiance that a white diffuse surface sends, luminance."""

    open: np.ndarray
    """If nothing were in the way."""
    seen: np.ndarray
    """Visible part of it, 0 to 1."""
    noise: np.ndarray
    """Standard error of `seen`."""
    other: np.ndarray
    other_open: np.ndarray
    """(P,): exact light of emitters without an extent, with shadows and without."""
    missing: np.ndarray
    """(P,): light of emitters that cannot be modelled."""
    gloss: np.ndarray
    """(P,): radiance that the surface itself sends beyond its diffuse reflection."""


class Rows(NamedTuple):
    """Where transfer is baked for the points: for each of several lengths of `max_edge`, and at the points themselves."""

    position: np.ndarray
    normal: np.ndarray
    cell: np.ndarray
    """(R, 3), (R, 3) and (R,), as :py:class:`mi_shlight.transfer.mesh.BakeMesh` has them."""
    owner: np.ndarray
    """(R,): point that the row belongs to."""
    corner: np.ndarray
    weight: np.ndarray
    """(H, P, 3): rows and weights between which transfer is interpolated; the last of the H sets is the points themselves."""
    buried: np.ndarray
    """(R,): inside a solid body."""


class Sight(NamedTuple):
    """What rays from the rows see of a light group."""

    visible: np.ndarray
    """(R, rays) bool, in the order of :py:func:`~mi_shlight.transfer.localised.sample_transfer`."""
    level: np.ndarray
    """(R,): level of the cone, see :py:class:`~mi_shlight.transfer.localised.ConeFit`."""
    dips: np.ndarray
    """(R,): the cone may reach below the horizon."""
    normal: np.ndarray
    """(R, 3): the normal in the frame of the rays."""
    light: np.ndarray
    """(R, (ORDER + 1)^2): luminance of the lights' coefficients at the point that the row belongs to, in the frame of the rays."""
    shift: np.ndarray
    """(R,): where the rings begin."""
    seconds: float
    """Time of the processor for a ray."""


class Probe:
    """The scene as `shprt` sees it, and points that the camera sees.

    Parameters
    ----------
    scene : mi.Scene
    sensor : mi.Sensor
    margin : float
        Distance by which lights may move.
    seed : int
    """

    def __init__(self, scene, sensor, margin: float, seed: int):
        self.scene, self.margin, self._seed, self._points = scene, margin, seed, POINTS
        with dr.suspend_grad():
            transfer = "shadowed" if mi.is_spectral else "shadowed+glossy"
            self.state = SceneState(scene, Settings(order=ORDER, transfer=transfer), Fingerprint(scene))
            self.hits = self._camera_hits(sensor)
        state = self.state
        self.near_count = state.group_count if state.lights else 0
        self.group_count = self.near_count + state.distant.projected
        self._count = len(self.hits.p)
        self._p, self._n = (_vectors(kind, rows) for kind, rows in ((mi.Point3f, self.hits.p), (mi.Normal3f, self.hits.n)))
        self.table = state.table.attached() if state.table else None
        self._lights = (Occluders(scene, state.lights), BakeLights(state.lights, margin)) if state.lights else None
        self._fit = ConeFit(1, cone_eps(1024))        # of any order and eps: only its levels count

    def _camera_hits(self, sensor) -> Hits:
        count = CANDIDATES * self._points
        place = (np.arange(count)[:, None] * R2 + np.random.default_rng(self._seed).random(2)) % 1
        where = mi.Point2f(aligned(mi.Float, place[:, 0]), aligned(mi.Float, place[:, 1]))
        colour = aligned(mi.Float, np.arange(count) * R2[1] % 1)
        ray, _ = sensor.sample_ray(0.0, colour, where, mi.Point2f(0.5))
        pi = self.scene.ray_intersect_preliminary(ray)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        state, valid = self.state, si.is_valid() & (dr.reinterpret_array(mi.UInt32, si.emitter(self.scene)) == 0)
        front = mi.Frame3f.cos_theta(si.wi) > 0
        lit = valid & (front | state.flag(state.two_sided, si.shape, valid)) & ~state.flag(state.black, si.shape, valid)
        n = dr.select(front, si.sh_frame.n, -si.sh_frame.n)
        albedo = brightness(si.bsdf().eval_diffuse_reflectance(si, lit), si.wavelengths)
        if state.gloss:
            albedo *= state.gloss.share(si.shape, ~front, lit)
        albedo = dr.select(lit, albedo, 0)
        values = [*ray.wavelengths, *ray.o, *ray.d, *si.p, *n, dr.reinterpret_array(mi.UInt32, pi.shape), pi.prim_index, *pi.prim_uv,
                  ~front, lit, albedo, si.is_valid(), valid]
        values = [v + dr.zeros(mi.Float, count) if dr.is_float_v(v) else v for v in values]
        dr.eval(values)
        *columns, surface, usable = (np.array(v) for v in values)
        wavelengths, columns = columns[:len(ray.wavelengths)], columns[len(ray.wavelengths):]
        chosen = np.flatnonzero(usable)
        if not len(chosen):
            raise ValueError("plan(): 'scene' must show a surface that is no light, got a view without one. Check the scene's camera.")
        chosen = chosen[:self._points]
        o, d, p, n = (np.stack(columns[3 * k:3 * k + 3], axis=1)[chosen] for k in range(4))
        shape, face, u, v, back, lit, albedo = (column[chosen] for column in columns[12:])
        wavelengths = np.stack([w[chosen] for w in wavelengths], axis=1) if wavelengths else np.zeros((len(chosen), 0))
        return Hits(o, d, p, n, shape, face, np.stack([u, v], axis=1), back, lit, albedo, wavelengths, float(surface.mean()))

    # Truth

    def truth(self, glossy: bool) -> Truth:
        """Light at the points by rays to the lights; what is all visible, or not at all, is exact."""
        count, groups, side = self._count, self.group_count, math.isqrt(TRUTH_SAMPLES)
        scene, state, lanes = self.scene, self.state, self._count * TRUTH_SAMPLES
        table = {shape_index(light.shape): g for g, light in enumerate(state.lights)}
        bounds = np.array(state.groups)
        lane = dr.arange(mi.UInt32, lanes)
        point, sample = lane // TRUTH_SAMPLES, lane % TRUTH_SAMPLES
        random = mi.PCG32(size=lanes, initstate=mi.UInt64(self._seed))
        place = mi.Point2f((mi.Float(sample % side) + random.next_float32()) / side,
                           (mi.Float(sample // side) + random.next_float32()) / side)
        si = scene.ray_intersect(self._rays(point))
        lit = si.is_valid() & (dr.gather(mi.UInt32, aligned(mi.UInt32, self.hits.lit.astype(np.uint32)), point) > 0)
        n = dr.gather(mi.Normal3f, self._flat(self.hits.n), point)
        ds, weight = scene.sample_emitter_direction(si, place, False, lit)
        weight = mi.unpolarized_spectrum(weight)
        white = brightness(weight, si.wavelengths) * dr.maximum(dr.dot(n, ds.d), 0) * dr.inv_pi
        visible = lit & (white > 0) & ~scene.ray_test(si.spawn_ray_to(ds.p), coherent=False, active=lit & (white > 0))
        number = dr.reinterpret_array(mi.UInt32, ds.emitter)
        group = dr.gather(mi.UInt32, self._emitter_groups(table, bounds), number, lit)
        total = lambda value: dr.block_sum(value, TRUTH_SAMPLES)
        second = (sample & 1) == 1
        sums = []
        for g in range(groups):
            there = group == g
            sums += [total(dr.select(there, white, 0)), total(dr.select(there & visible, white, 0)),
                     total(dr.select(there & second, white, 0)), total(dr.select(there & second & visible, white, 0))]
        sums += [total(dr.select((group == groups + k) & seen, white, 0)) for k, seen in ((0, visible), (0, True), (1, visible))]
        if glossy:
            whole = mi.unpolarized_spectrum(si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d), lit))
            whole = brightness(whole * weight, si.wavelengths)
            albedo = brightness(mi.unpolarized_spectrum(si.bsdf().eval_diffuse_reflectance(si, lit)) * weight, si.wavelengths)
            back = dr.gather(mi.UInt32, aligned(mi.UInt32, self.hits.back.astype(np.uint32)), point) > 0
            diffuse = albedo * dr.maximum(dr.dot(n, ds.d), 0) * dr.inv_pi * state.gloss.share(si.shape, back, lit)
            sums.append(total(dr.select(visible & (group < groups + 1), whole - diffuse, 0)))
        dr.eval(sums)
        sums = [np.array(v, np.float64) / TRUTH_SAMPLES for v in sums]
        every, seen, late, late_seen = (np.reshape(sums[k:4 * groups:4], (groups, count)) for k in range(4))
        ratio = lambda a, b: np.divide(a, b, out=np.zeros_like(a), where=b > 0)
        early = ratio(seen - late_seen, every - late)
        noise = abs(early - ratio(late_seen, late)) / 2
        other, other_open, missing = sums[4 * groups:4 * groups + 3]
        gloss = sums[-1] if glossy else np.zeros(count)
        return Truth(self._open(every), ratio(seen, every), noise, other, other_open, missing, gloss)

    def _emitter_groups(self, table: dict, bounds: np.ndarray):
        """Light group of each emitter, by registry number; after them emitters without an extent, and those that are not modelled."""
        from ..shading.distant import has

        groups = {}
        for emitter in self.scene.emitters():
            number = int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0])
            shape = emitter.get_shape() if has(emitter, "Surface") else None
            if shape is not None:
                light = table.get(shape_index(shape))
                group = self.group_count + 1 if light is None else int(np.searchsorted(bounds, light, side="right")) - 1
            elif emitter.is_environment():
                group = self.near_count if self.state.distant.projected else self.group_count + 1
            else:
                group = self.group_count
            groups[number] = group
        return mi.UInt32([groups.get(i, self.group_count + 1) for i in range(1 + max(groups, default=0))])

    def _open(self, estimated: np.ndarray) -> np.ndarray:
        """Light of each group if nothing were in the way, without a band limit; `estimated` is taken for what has no formula."""
        out, points = estimated.copy(), self._shaded_points()
        for g in range(self.near_count):
            near = NearLights(self._only(g), self.table, None, ORDER, "auto")
            value = brightness(near._exact(points, [mi.Float(1)]), points.wavelengths)
            dr.eval(value)
            out[g] = np.array(value)
        return out

    def _shaded_points(self) -> Points:
        return Points(self._p, self._n, self._rays(dr.arange(mi.UInt32, self._count)).wavelengths, mi.Bool(True))

    def _rays(self, point):
        """The camera's rays to some of the points."""
        ray = mi.Ray3f(dr.gather(mi.Point3f, self._flat(self.hits.o), point), dr.gather(mi.Vector3f, self._flat(self.hits.d), point))
        if mi.is_spectral:
            ray.wavelengths = dr.gather(type(ray.wavelengths), self._flat(self.hits.wavelengths), point)
        return ray

    def _only(self, g: int):
        """What `NearLights` reads of the scene's state, for one light group alone."""
        part = lambda table: mi.UInt32(np.array(table)[g:g + 2].tolist())
        state = self.state
        return SimpleNamespace(group_count=1, **{name: part(getattr(state, name)) for name in ("groups", "facets", "polygons", "meshes")})

    # What the bake would see

    def rows(self, edges) -> Rows:
        """Where a bake with each of the lengths `edges` of `max_edge` would put the points between which it interpolates."""
        hits, count = self.hits, self._count
        place = np.arange(count)
        corners, normals, meshed = self._faces()
        triangles = np.arange(3 * count).reshape(-1, 3)
        parts = np.array([subdivision_of(triangles, corners.reshape(-1, 3), edge)[0] for edge in edges], np.int64) * meshed
        keys, slot = np.unique(parts * count + place, return_inverse=True)
        slot = slot.reshape(parts.shape)
        k, point = np.divmod(keys, count)
        cut, own = np.flatnonzero(k), 3 * np.count_nonzero(k)
        position, normal, cell, weight = _cells(corners, normals, hits, k[cut], point[cut])
        first, weights = np.zeros(len(keys), np.int64), np.zeros((len(keys), 3))
        first[cut], weights[cut] = 3 * np.arange(len(cut)), weight
        corner = np.empty((len(edges) + 1, count, 3), np.int64)
        corner[:], share = (own + place)[:, None], np.tile([1.0, 0, 0], corner.shape[:2] + (1,))
        baked = np.flatnonzero(parts.ravel())
        corner[:-1].reshape(-1, 3)[baked] = first[slot.ravel()[baked], None] + np.arange(3)
        share[:-1].reshape(-1, 3)[baked] = weights[slot.ravel()[baked]]
        position, normal = np.concatenate([position.reshape(-1, 3), hits.p]), np.concatenate([normal.reshape(-1, 3), hits.n])
        buried = np.array(inside_a_body(self.scene, _vectors(mi.Point3f, position), _vectors(mi.Normal3f, normal)))
        buried[own:] = False
        return Rows(position, normal, np.concatenate([np.repeat(cell, 3), np.zeros(count)]),
                    np.concatenate([np.repeat(point[cut], 3), place]), corner, share, buried)

    def _faces(self) -> tuple:
        """Corners (P, 3, 3), their normals, and whether there is such a face, of what the points lie on."""
        hits, count = self.hits, self._count
        corners, normals, meshed = np.zeros((count, 3, 3)), np.zeros((count, 3, 3)), np.zeros(count, bool)
        for receiver in self.state.receivers:
            there = np.flatnonzero(hits.shape == shape_index(receiver.shape))
            if not (receiver.baked and len(there)):
                continue
            faces, positions, vertex_normals, side = mesh_arrays(receiver.shape)
            own = faces[hits.face[there]]
            corners[there], meshed[there] = positions[own], True
            flat = side * np.cross(corners[there, 1] - corners[there, 0], corners[there, 2] - corners[there, 0])
            normals[there] = flat[:, None] if vertex_normals is None else vertex_normals[own]
        return corners, normals, meshed

    def sights(self, rows: Rows, samples: int) -> list:
        """What the rows see of each light group by so many rays each."""
        shift = np.random.default_rng(self._seed + 1).random(len(rows.cell)).astype(np.float32)
        out = []
        for g in range(self.group_count):
            watch, seconds, compiled = self._look(g, rows, shift, samples)
            if compiled:                              # to measure rays alone
                watch, seconds, _ = self._look(g, rows, shift, samples)
            level, dips, axis = watch.cone_of(rows.normal)
            visible = watch.visible()
            out.append(Sight(visible, level, dips, *self._lights_in_frames(g, rows, axis), shift, seconds / visible.size))
        return out

    def sights_again(self, rows: Rows, sights: list, samples: int, repeats: int = 0) -> list:
        """The same with another number of rays; with `repeats` at the points themselves alone, so many times with the rays turned
        differently: the points, and again the points, and so on.
        """
        own = slice(len(rows.cell) - self._count if repeats else 0, None)
        again = lambda values: np.concatenate([values[own]] * max(repeats, 1))
        rows = rows._replace(position=again(rows.position), normal=again(rows.normal), cell=again(rows.cell))
        shift = np.random.default_rng(self._seed + 2).random(len(rows.cell)).astype(np.float32)
        return [Sight(self._look(g, rows, shift, samples)[0].visible(), *map(again, (sight.level, sight.dips, sight.normal, sight.light)),
                      shift, sight.seconds) for g, sight in enumerate(sights)]

    def _look(self, g: int, rows: Rows, shift: np.ndarray, samples: int) -> tuple:
        """(what was seen of a light group, seconds of the processor that it took, whether to compile was part of it)."""
        if g < self.near_count:
            group = tuple(mi.UInt32(int(self.state.groups[g + k])) for k in (0, 1))
            dr.make_opaque(group)
            sight, fit = LightSight(*self._lights, group), self._fit
        else:
            sight, fit = SkySight(self.scene), None
        watch = _Watched(sight, fit, len(rows.cell), samples)
        p, n = _vectors(mi.Point3f, rows.position), _vectors(mi.Normal3f, rows.normal)
        found = sample_transfer(watch, p, n, 1, samples, aligned(mi.Float, shift), fit=fit, cell=aligned(mi.Float, rows.cell))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            start = time.process_time()
            dr.eval(found.coeffs, watch.seen)
            dr.sync_thread()
            seconds, kernels = time.process_time() - start, dr.kernel_history()
        return watch, seconds, not all(k["cache_hit"] or k["cache_disk"] for k in kernels if "cache_hit" in k)

    def _lights_in_frames(self, g: int, rows: Rows, axis) -> tuple:
        """(normals, coefficients) of rows in the frames about `axis` that their rays have."""
        points = self._shaded_points()
        if g < self.near_count:
            near = NearLights(self._only(g), self.table, None, ORDER, "auto")
            coeffs = near.coefficients(points, lambda radiance: [brightness(radiance, points.wavelengths)])[0]
        else:
            distant = self.state.distant.attached().coefficients(points.wavelengths, points.p)
            coeffs = [brightness(c, points.wavelengths) + dr.zeros(mi.Float, self._count) for c in distant[:(ORDER + 1) ** 2]]
        flat = dr.concat(coeffs)
        dr.eval(flat)
        owner, n = aligned(mi.UInt32, rows.owner), _vectors(mi.Normal3f, rows.normal)
        frame = mi.Frame3f(axis)
        turned = rotate_frame([dr.gather(mi.Float, flat, owner + i * self._count) for i in range((ORDER + 1) ** 2)],
                              frame.s, frame.t, frame.n, ORDER, inverse=True)
        local = frame.to_local(mi.Vector3f(n))
        dr.eval(turned, local)
        return np.array(local).T, np.stack([np.array(c) for c in turned], axis=1)

    # Light by way of other surfaces

    def radiance(self, depth: int) -> np.ndarray:
        """(P,) luminance that the points send to the camera, by Mitsuba's ``path`` with `depth` as its ``max_depth``."""
        return self.shaded_by({"type": "path", "max_depth": depth}, PATHS)

    def shaded_by(self, integrator: dict, samples: int = 1) -> np.ndarray:
        """The same by any integrator, in the mean over so many samples."""
        lanes = self._count * samples
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(self._seed, lanes)
        point = dr.arange(mi.UInt32, lanes) // samples
        ray = mi.RayDifferential3f(self._rays(point))
        with dr.suspend_grad():
            mode = (dr.ADMode.Primal,) if integrator["type"] == "shprt" else ()
            value = mi.load_dict(integrator).sample(*mode, self.scene, sampler, ray)[0]
        value = dr.block_sum(brightness(value, ray.wavelengths), samples)
        dr.eval(value)
        return np.array(value, np.float64) / samples

    def arriving(self, rows: Rows, bounces: int | None) -> np.ndarray:
        """(2, R) luminance that a white surface at the rows sends of light from other surfaces, after at most `bounces` reflections or
        without a limit; twice, with other random numbers. All rows of a point follow the same paths as far as they can, so that what they
        differ by has little noise.
        """
        order, own = np.argsort(rows.owner, kind="stable"), len(rows.owner) - self._count + np.arange(self._count)
        owner = rows.owner[order]
        rank, out = np.arange(len(order)) - np.searchsorted(owner, owner), np.zeros((2, len(order)))
        for k in range(rank.max() + 1):
            row, there = own.copy(), rank == k
            row[owner[there]] = order[there]
            out[:, row] = self._arriving(rows.position[row], rows.normal[row], -1 if bounces is None else bounces + 1)
        return out

    def _arriving(self, position: np.ndarray, normal: np.ndarray, depth: int) -> np.ndarray:
        """(2, P) of the same, for one row of each point; equal random numbers in each call."""
        lanes = 2 * PATHS * self._count
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(self._seed, lanes)
        point = dr.arange(mi.UInt32, lanes) // (2 * PATHS)
        p, n = (dr.gather(kind, self._flat(values), point) for kind, values in ((mi.Point3f, position), (mi.Normal3f, normal)))
        ray = mi.RayDifferential3f(self._rays(point))
        ray.o, ray.d = lifted(p, n), mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
        value, seen = (mi.load_dict({"type": "path", "max_depth": last}).sample(self.scene, sampler, ray)[0] for last in (depth, 1))
        value = dr.block_sum(brightness(value - seen, ray.wavelengths), PATHS)
        dr.eval(value)
        return np.array(value, np.float64).reshape(-1, 2).T / PATHS

    @staticmethod
    def _flat(rows: np.ndarray):
        return aligned(mi.Float, rows.ravel())


class _Watched:
    """A sight that keeps what rays find."""

    def __init__(self, sight, fit, rows: int, samples: int):
        self._sight, self._fit, self._cone, self._samples = sight, fit, None, samples
        self._row, self._count = dr.arange(mi.UInt32, rows), dr.zeros(mi.UInt32, rows)
        self.seen = dr.zeros(mi.UInt32, rows * samples)

    def visible(self) -> np.ndarray:
        return np.array(self.seen, bool).reshape(-1, self._samples)

    def cone(self, p, n, cell):
        self._cone = self._sight.cone(p, n, cell)
        return self._cone

    def look(self, origin, n, d, met, active):
        found = self._sight.look(origin, n, d, met, active)
        number = dr.scatter_inc(self._count, self._row)
        dr.scatter(self.seen, dr.select(found[0], mi.UInt32(1), 0), self._row * self._samples + number)
        return found

    def cone_of(self, normals: np.ndarray) -> tuple:
        """(level, dips, axis): of the cones as numpy arrays, and their axes on the device."""
        n = _vectors(mi.Vector3f, normals)
        if self._cone is None:
            return np.full(len(normals), LEVELS), np.ones(len(normals), bool), n
        level = self._fit.level(self._cone.angle)
        axis, dips = dr.select(level < LEVELS, self._cone.axis, n), mi.Bool(self._cone.dips)
        dr.eval(level, axis, dips)
        return np.array(level), np.array(dips), axis


def _cells(corners, normals, hits: Hits, k, point) -> tuple:
    """(positions, normals, cell, weights) of the cells around points, in faces that are cut k x k, as
    :py:meth:`mi_shlight.transfer.store.TransferLookup.rows_at` finds them.
    """
    corners, normals = corners[point], normals[point]
    u, v = (np.clip(c, 0, 1) * k for c in hits.uv[point].T)
    j = np.minimum(v.astype(int), k - 1)
    i = np.minimum(u.astype(int), k - 1 - j)
    fu, fv = np.clip(u - i, 0, 1), np.clip(v - j, 0, 1)
    upper = (fu + fv > 1) & (i + j < k - 1)
    one = upper.astype(int)
    grid = np.stack([np.stack([i + one, j + one]), np.stack([i + 1 - one, j + one]), np.stack([i + one, j + 1 - one])])   # (3, 2, N)
    total = np.maximum(fu + fv, 1)
    w1, w2 = np.where(upper, 1 - fu, fu / total), np.where(upper, 1 - fv, fv / total)
    share = np.stack([k - grid.sum(axis=1), *np.moveaxis(grid, 1, 0)]) / k                       # (barycentric, corner, N)
    position = np.einsum("bcn,nbx->ncx", share, corners)
    normal = _unit(np.einsum("bcn,nbx->ncx", share, normals))
    normal *= np.where(hits.back[point], -1, 1)[:, None, None]
    cell = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1) / k
    rim = (share <= 0).any(axis=0).T
    pull = _unit(corners.mean(axis=1)[:, None] - position) * (rim * cell[:, None])[..., None]
    pull -= normal * (pull * normal).sum(axis=2, keepdims=True)
    return position + RIM * pull, normal, cell, np.stack([1 - w1 - w2, w1, w2], axis=1)


def brightness(value, wavelengths):
    """Luminance of a spectrum; where it is known at some wavelengths only, its mean over these, weighted as the eye does."""
    value = mi.unpolarized_spectrum(value)
    if not mi.is_spectral:
        return luminance(value, wavelengths)
    return luminance(value, wavelengths) / dr.maximum(luminance(type(value)(1), wavelengths), 1e-9)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-30)


def _vectors(kind, rows: np.ndarray):
    return dr.gather(kind, aligned(mi.Float, np.ravel(rows)), dr.arange(mi.UInt32, len(rows)))
