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
        self._spectrum = type(mi.unpolarized_spectrum(mi.Spectrum(0)))

    def shadowed(self, points: Points, transfer_of):
        """``sum_k L_k sum_lm T_lm L_lm`` over all lights: with transfer of diffuse reflection, what a white surface would send; spectrum.

        `transfer_of(g, first, last)`: transfer vectors of light group g, lights `first` to `last` - 1. They carry no derivatives.
        """
        def shading_of(g, first, last):
            coeffs = [dr.detach(t) for t in transfer_of(g, first, last)]
            shade, shade_mesh = light_shader(coeffs, self._order, self._method), mesh_shader(coeffs, self._order, self._method)
            return lambda n: coeffs, lambda light, x, apex, n: shade(light, x, apex), lambda light, x, n: shade_mesh(light, x)

        return self._sum(points, shading_of)

    def unshadowed(self, points: Points):
        """The same where nothing casts shadows on diffuse surfaces, to the band limit; follows the normals' derivatives."""
        shading = lambda n: cosine_transfer(n, self._order), *self._unshadowed_shaders(points.n)
        return self._sum(points, lambda g, first, last: shading)

    def exact(self, points: Points):
        """The same without a band limit: Lambert's formula for each facet."""
        table = self._table
        if table is None:
            return self._spectrum(0)

        def body(k, x, n):
            irradiance = irradiance_shader(n)(table.facets.edges(k, x, points.active), x, table.facets.apex(k, x))
            return table.radiance(k, points.wavelengths) * (irradiance * dr.inv_pi)

        return self._each(body, mi.UInt32(0), mi.UInt32(table.count), mi.Point3f(points.p), mi.Normal3f(points.n))

    def coefficients(self, points: Points, weigh) -> list:
        """SH coefficients of all lights at the points; `weigh` makes floats of their radiances."""
        state, table, nodes, wavelengths = self._state, self._table, self._nodes, points.wavelengths
        if table is None:
            return [mi.Float(0)] * (self._order + 1) ** 2
        if nodes is not None:
            groups = [nodes.eval(mi.Point3f(points.p), mi.UInt32(g), points.active) for g in range(state.group_count)]
            return [sum(weigh(table.spectrum(*colour)) for colour in colours) for colours in zip(*groups)]

        def each(body, count):
            def step(k, total, x):
                weight, coeffs = body(k, x)
                return k + 1, [dr.fma(weight, c, t) for c, t in zip(coeffs, total)], x

            start = (mi.UInt32(0), [mi.Float(0) for _ in range((self._order + 1) ** 2)], mi.Point3f(points.p))
            return dr.while_loop(start, lambda k, *_: k < count, step, mode="symbolic", max_iterations=-1)[1]

        def polygon(i, x):
            k = table.polygon(i)
            coeffs = project_light(table.facets.edges(k, x, points.active), x, table.facets.apex(k, x), self._order, self._method)
            return weigh(table.radiance(k, wavelengths)), coeffs

        sums = []
        if len(table.polygons):
            sums.append(each(polygon, len(table.polygons)))
        if len(table.meshes):
            meshes = table.mesh_light(wavelengths, weigh)
            mesh = lambda k, x: (1, project_mesh_light(meshes.part(k), x, self._order, self._method))
            sums.append(each(mesh, len(table.meshes)))
        return [sum(values) for values in zip(*sums)]

    def _sum(self, points: Points, shading_of):
        """Sum over all lights. `shading_of(g, first, last)`: for a light group the transfer as a function of the normal, and the shaders,
        for polygons and for meshes, that meet the group's lights with it.

        All are given the normal, too: only unshadowed transfer follows it, and only from a loop's state come derivatives.
        """
        state, table, nodes, lit = self._state, self._table, self._nodes, points.active
        wavelengths, Spectrum = points.wavelengths, self._spectrum
        if table is None:
            return Spectrum(0)
        meshes = table.mesh_light(wavelengths) if len(table.meshes) and nodes is None else None

        def group_body(g, total, x, n):
            bounds = lambda table: (dr.gather(mi.UInt32, table, g), dr.gather(mi.UInt32, table, g + 1))
            transfer, shade, shade_mesh = shading_of(g, *bounds(state.groups))
            if nodes is not None:
                return g + 1, total + Spectrum(*nodes.shade(x, transfer(n), shade, g, lit, (n,))), x, n

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
            return g + 1, total, x, n

        start = (mi.UInt32(0), Spectrum(0), mi.Point3f(points.p), mi.Normal3f(points.n))
        return dr.while_loop(start, lambda g, *_: g < state.group_count, group_body, mode="symbolic", max_iterations=-1)[1]

    def _each(self, body, first, last, x, n):
        step = lambda k, total, x, n: (k + 1, total + body(k, x, n), x, n)
        start = (first, self._spectrum(0), x, n)
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


def luminance(radiance, wavelengths):
    """Luminance of a spectrum of the current variant."""
    if mi.is_monochromatic:
        return radiance[0]
    return mi.luminance(radiance, wavelengths) if mi.is_spectral else mi.luminance(radiance)
