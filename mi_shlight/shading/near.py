"""Light of the polygonal lights of a scene at surface points, by transfer vectors."""
from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ..light.irradiance import irradiance_shader
from ..light.mesh import mesh_shader, project_mesh_light, zonal_mesh_shader
from ..light.project import light_shader, project_light
from ..light.zonal import times_pole_value, zonal_lambert, zonal_light_shader, zonal_shader
from ..transfer.cosine import cosine_transfer


class Points(NamedTuple):
    """Surface points to be lit."""

    p: object
    n: object
    """Unit normal on the side that is seen."""
    wavelengths: object
    active: object


class NearLights:
    """The polygonal lights for one picture.

    Parameters
    ----------
    state : SceneState
    table : LightTable or None
        Attached; None if the scene has none of these lights.
    nodes : NodeTable or None
        The light grid for this picture, if there is one.
    order, method : int, str
    """

    def __init__(self, state, table, nodes, order: int, method: str):
        self._state, self._table, self._nodes = state, table, nodes
        self._order, self._method = order, method if nodes is None else nodes.method
        self.spectrum = type(mi.unpolarized_spectrum(mi.Spectrum(0)))

    def shadowed(self, points: Points, transfer_of, exact: bool = False):
        """``sum_k L_k sum_lm T_lm L_lm`` over all lights: with transfer of diffuse reflection, what a white surface would send; spectrum.

        `transfer_of(g, lights)`: (coefficients, visible) of light group g, `lights` being the first and one past the last. Coefficients
        come on top of the part `visible` of the exact unshadowed light, Lambert's formula, if it is `exact`. They carry no derivatives.
        """
        def shading_of(g, lights):
            coeffs, visible = dr.detach(transfer_of(g, lights))
            shade, shade_mesh = light_shader(coeffs, self._order, self._method), mesh_shader(coeffs, self._order, self._method)
            return (lambda n: coeffs, lambda light, x, apex, n: shade(light, x, apex), lambda light, x, n: shade_mesh(light, x), visible)

        total, seen = self._sum(points, shading_of, self._state.group_count if exact else 0)
        return total + self._exact(points, seen) if exact and self._table else total

    def unshadowed(self, points: Points):
        """The same where nothing casts shadows on diffuse surfaces, to the band limit; follows the normals' derivatives."""
        shading = lambda n: cosine_transfer(n, self._order), *self._unshadowed_shaders(points.n), None
        return self._sum(points, lambda g, lights: shading)[0]

    def coefficients(self, points: Points, weigh=list, shadow_of=None, order: int | None = None) -> list:
        """SH coefficients of all lights at the points, for each of the floats that `weigh` makes of a radiance.

        `shadow_of(g, lights)`: for a light group a function from such lists of coefficients to what of the group's light arrives, as lists
        to degree `order`. It carries no derivatives.
        """
        state, table, nodes, lit, wavelengths = self._state, self._table, self._nodes, points.active, points.wavelengths
        count, channels = (self._order + 1) ** 2, len(weigh(self.spectrum(0)))
        zeros = lambda size: [[mi.Float(0) for _ in range(size)] for _ in range(channels)]
        nothing, size = lambda: zeros(count), count if order is None else (order + 1) ** 2
        if table is None:
            return zeros(size)
        meshes = table.mesh_light(wavelengths, weigh) if len(table.meshes) and nodes is None else None

        def each(body, total, first, last, x):
            step = lambda k, total, x: (k + 1, body(k, total, x), x)
            return added(total, dr.while_loop((first, nothing(), x), lambda k, *_: k < last, step, mode="symbolic", max_iterations=-1)[1])

        def polygon(i, total, x):
            k = table.polygon(i)
            coeffs = project_light(table.facets.edges(k, x, lit), x, table.facets.apex(k, x), self._order, self._method)
            return [[dr.fma(r, c, t) for c, t in zip(coeffs, part)] for r, part in zip(weigh(table.radiance(k, wavelengths)), total)]

        def mesh(k, total, x):
            coeffs = project_mesh_light(meshes.part(k), x, self._order, self._method)
            return added(total, [coeffs] if channels == 1 else [[c[i] for c in coeffs] for i in range(channels)])

        def group_body(g, total, x):
            bounds = lambda table: (dr.gather(mi.UInt32, table, g), dr.gather(mi.UInt32, table, g + 1))
            light = nothing()
            if nodes is not None:
                light = [list(values) for values in zip(*(weigh(table.spectrum(*colour)) for colour in nodes.eval(x, g, lit)))]
            elif len(table.polygons):
                light = each(polygon, light, *bounds(state.polygons), x)
            if meshes:
                light = each(mesh, light, *bounds(state.meshes), x)
            if shadow_of:
                light = shadow_of(g, bounds(state.groups))(light)
            return g + 1, added(total, light), x

        start = mi.UInt32(0), zeros(size), mi.Point3f(points.p)
        return dr.while_loop(start, lambda g, *_: g < state.group_count, group_body, mode="symbolic", max_iterations=-1)[1]

    def _sum(self, points: Points, shading_of, groups: int = 0) -> tuple:
        """(sum over all lights, parts of the exact light that are seen, of the first `groups` groups).

        `shading_of(g, lights)`: for a light group the transfer as a function of the normal, the shaders, for polygons and for meshes, that
        meet the group's lights with it, and the part of the exact light that is seen.
        All are given the normal, too: only unshadowed transfer follows it, and only from a loop's state come derivatives.
        """
        state, table, nodes, lit = self._state, self._table, self._nodes, points.active
        wavelengths, Spectrum = points.wavelengths, self.spectrum
        if table is None:
            return Spectrum(0), []
        meshes = table.mesh_light(wavelengths) if len(table.meshes) and nodes is None else None

        def group_body(g, total, seen, x, n):
            bounds = lambda table: (dr.gather(mi.UInt32, table, g), dr.gather(mi.UInt32, table, g + 1))
            transfer, shade, shade_mesh, visible = shading_of(g, bounds(state.groups))
            seen = [dr.select(g == i, visible, before) for i, before in enumerate(seen)]
            if nodes is not None:
                return g + 1, total + Spectrum(*nodes.shade(x, transfer(n), shade, g, lit, (n,))), seen, x, n

            def polygon(i, x, n):
                k = table.polygon(i)
                return table.radiance(k, wavelengths) * shade(table.facets.edges(k, x, lit), x, table.facets.apex(k, x), n)

            def mesh(k, x, n):
                value = shade_mesh(meshes.part(k), x, n)
                return Spectrum(value) if dr.depth_v(value) == 1 else Spectrum(*value)

            if len(table.polygons):
                total = total + self._each(polygon, *bounds(state.polygons), x, n)
            if meshes:
                total = total + self._each(mesh, *bounds(state.meshes), x, n)
            return g + 1, total, seen, x, n

        start = mi.UInt32(0), Spectrum(0), [mi.Float(0) for _ in range(groups)], mi.Point3f(points.p), mi.Normal3f(points.n)
        _, total, seen, *_ = dr.while_loop(start, lambda g, *_: g < state.group_count, group_body, mode="symbolic", max_iterations=-1)
        return total, seen

    def _exact(self, points: Points, seen: list):
        """Light without a band limit, Lambert's formula, of which each group's part `seen` arrives.

        Two loops over the same lights inside of one over the groups would be too much for Dr.Jit's derivatives.
        """
        state, table = self._state, self._table

        def facet(k, x, n, part):
            irradiance = irradiance_shader(n)(table.facets.edges(k, x, points.active), x, table.facets.apex(k, x))
            return table.radiance(k, points.wavelengths) * (irradiance * part * dr.inv_pi)

        def group_body(g, total, seen, x, n):
            first, last = (dr.gather(mi.UInt32, state.facets, g + k) for k in range(2))
            part = sum((dr.select(g == i, part, 0) for i, part in enumerate(seen)), mi.Float(0))
            return g + 1, total + self._each(facet, first, last, x, n, part), seen, x, n

        start = mi.UInt32(0), self.spectrum(0), seen, mi.Point3f(points.p), mi.Normal3f(points.n)
        return dr.while_loop(start, lambda g, *_: g < state.group_count, group_body, mode="symbolic", max_iterations=-1)[1]

    def _each(self, body, first, last, x, n, *others):
        step = lambda k, total, x, n, *others: (k + 1, total + body(k, x, n, *others), x, n, *others)
        start = (first, self.spectrum(0), x, n, *others)
        return dr.while_loop(start, lambda k, *_: k < last, step, mode="symbolic", max_iterations=-1)[1]

    def _unshadowed_shaders(self, n):
        """Shaders for points with normal `n` where nothing casts shadows."""
        order, method = self._order, self._method
        weights = times_pole_value(zonal_lambert(order))            # symmetric about n: order + 1 numbers instead of (order + 1)^2
        by_zones = zonal_shader if method == "edge" else zonal_light_shader
        zonal = lambda light, x, apex, n: by_zones(n, weights)(light, x, apex)
        if method in ("auto", "edge"):
            return zonal, zonal_mesh_shader(weights, method)
        transfer = cosine_transfer(dr.detach(n), order)
        full, full_mesh = (make(transfer, order, method) for make in (light_shader, mesh_shader))
        if not dr.grad_enabled(n):
            return lambda light, x, apex, n: full(light, x, apex), lambda light, x, n: full_mesh(light, x)

        def shade(light, x, apex, n):
            turned = zonal(light.detached(), dr.detach(x), apex, n)
            return full(light, x, apex) + dr.replace_grad(mi.Float(0), turned)

        def shade_mesh(light, x, n):
            value, turned = full_mesh(light, x), zonal_mesh_shader(weights)(light.detached(), dr.detach(x), n)
            return value + dr.replace_grad(type(value)(0), turned)

        return shade, shade_mesh


def added(lists: list, others: list) -> list:
    """Sums of the entries of two lists of lists."""
    return [[a + b for a, b in zip(*pair)] for pair in zip(lists, others)]


def luminance(radiance, wavelengths):
    """Luminance of a spectrum of the current variant."""
    if mi.is_monochromatic:
        return radiance[0]
    return mi.luminance(radiance, wavelengths) if mi.is_spectral else mi.luminance(radiance)
