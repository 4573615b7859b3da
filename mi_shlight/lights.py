"""The lights of a scene as tables on the device: what symbolic loops over all of them read."""
from __future__ import annotations

import copy
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from .light.cut import lattice
from .light.facets import FacetTable
from .light.mesh import MeshLight
from .light.polygon import strip_corners
from .light.topology import MeshTables, mesh_topology
from .scene import aligned

SAMPLE_RANKS = 8
"""A texture is averaged over the centres of the parts of a triangle whose sides are cut in so many: 64 samples."""

SPECTRAL_STEP, SPECTRAL_NODES = 5.0, 96
"""Distance in nm and number of the wavelengths, from 360 nm, at which the radiance of triangles is held: as Mitsuba's own tables."""


class LightTable:
    """Lights of a scene as flat Dr.Jit buffers for symbolic loops.

    A light that is one polygon of uniform radiance is one *facet*; otherwise each of its triangles is one. Those of a two-sided light stand
    there twice, once for each side. What depends on the lights' topology alone is made once; :py:meth:`attached` adds what a user may
    change or differentiate between renders.

    Attributes
    ----------
    count : int
        Number of facets.
    first_facet : ndarray (L + 1,)
        Light i has the facets ``first_facet[i] .. first_facet[i + 1] - 1``.
    facets : FacetTable
        Geometry of the facets, one by one; once attached, in variants without wavelengths with their radiance.
    polygons : ndarray (N,)
        Facets that are a whole side of their light, ascending.
    meshes : ndarray (M,)
        Light to which each part of :py:meth:`mesh_light` belongs, ascending. A part is one side of a light of triangles.
    spectrum : type
        Of radiances: unpolarised.
    """

    DRJIT_STRUCT = dict.fromkeys(("facets", "_outlines", "_polygon", "_cut_vertices", "_cut_weights", "_mesh", "_mesh_facet",
                                  "_row", "_uniform", "_row_emitter", "_first_sample", "_samples", "_one"), object)
    """Buffers that `dr.freeze` must know of, as it has to of all that an integrator holds."""

    def __init__(self, lights: list):
        self._lights, self.spectrum = lights, type(mi.unpolarized_spectrum(mi.Spectrum(0)))
        offsets = np.cumsum([0] + [len(light.vertices) for light in lights])
        points = np.cumsum([offsets[-1]] + [len(light.pieces.index) if light.pieces else 0 for light in lights])
        sides = [_sides(light, point if light.pieces else offset) for light, offset, point in zip(lights, offsets, points)]
        self.facets = _facet_table([side for both in sides for side in both])
        self._outlines = _facet_table([_outline(light, offset) for light, offset in zip(lights, offsets)])
        self.first_facet = np.cumsum([0] + [sum(len(side.edges) for side in both) for both in sides])
        self.count = int(self.first_facet[-1])
        light_of = np.repeat(np.arange(len(lights)), np.diff(self.first_facet))
        whole = np.array([light.is_polygon for light in lights])
        self.polygons, meshes = np.flatnonzero(whole[light_of]), np.flatnonzero(~whole)
        self._polygon = _index(self.polygons)
        self._cut_vertices = self._cut_weights = self._mesh = self._mesh_facet = None
        cuts = [(light.pieces, offset) for light, offset in zip(lights, offsets) if light.pieces]
        if cuts:
            self._cut_vertices = [_index(np.concatenate([pieces.index[:, k] + offset for pieces, offset in cuts])) for k in range(3)]
            self._cut_weights = [aligned(mi.Float, np.concatenate([pieces.weight[:, k] for pieces, _ in cuts])) for k in range(3)]
        self.meshes = np.repeat(meshes, [len(sides[i]) for i in meshes])
        if len(self.meshes):
            triangles = [side.triangles for i in meshes for side in sides[i]]
            topology = mesh_topology(list(np.concatenate(triangles)), np.repeat(np.arange(len(triangles)), list(map(len, triangles))))
            self._mesh = MeshTables(mi.UInt32, topology, flat=all(lights[i].normal is not None for i in meshes))
            self._mesh_facet = _index(np.flatnonzero(~whole[light_of]))
        self._list_radiance([len(both) for both in sides])
        self._one = dr.opaque(mi.Float, 1)
        self._vertices = self._emitted = self._spectra = None

    def _list_radiance(self, side_counts: list) -> None:
        """Rows: facets of equal radiance, and the points of their light over which it is averaged."""
        rows, emitters, uniform, samples, sample_counts, count = [], [], [], [], [], 0
        for light, side_count in zip(self._lights, side_counts):
            points, weights = _radiance_samples(light)
            facets = 1 if light.is_polygon else len(light.triangles)
            own = np.arange(len(points)) if len(points) > 1 else np.zeros(facets, int)
            rows += [count + own] * side_count
            emitters += [dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(light.emitter))[0]] * len(points)
            uniform += [light.is_polygon and not light.textured] * (facets * side_count)
            samples.append(np.concatenate([weights.reshape(-1, 1), points.reshape(-1, 5)], axis=1))
            sample_counts += [points.shape[1]] * len(points)
            count += len(points)
        self._row, self._row_emitter, self._row_count = _index(np.concatenate(rows)), _index(emitters), count
        self._all_uniform, self._none_uniform, self._uniform = all(uniform), not any(uniform), _index(uniform)
        self._first_sample = _index(np.cumsum([0, *sample_counts]))
        self._samples = [aligned(mi.Float, value) for value in np.concatenate(samples).T]

    def attached(self) -> "LightTable":
        """A copy with the current vertex positions and radiance, which carry derivatives if derivatives are on."""
        table = copy.copy(self)
        # Dr.Jit 1.5.0 gets derivatives wrong of flat buffers that are gathered as vectors both inside and outside of symbolic loops and
        # calls. So Mitsuba's own buffer is not gathered here, and there is one copy for the loops and one for the rest.
        flat = dr.concat([light.shape.vertex_positions_buffer() for light in self._lights]) * self._one
        vertices = dr.unravel(mi.Point3f, flat)
        if self._cut_vertices:
            corners = [dr.gather(mi.Point3f, vertices, corner) * w for corner, w in zip(self._cut_vertices, self._cut_weights)]
            vertices = mi.Point3f(*(dr.concat([v, a + b + c]) for v, a, b, c in zip(vertices, *corners)))
        table._vertices, positions = vertices, dr.ravel(vertices)
        if not mi.is_spectral:
            emitted = dr.gather(self.spectrum, self._mean_radiance(dr.arange(mi.UInt32, self._row_count), None), self._row)
            table._emitted = emitted
            table.facets = self.facets.placed(positions, dr.ravel(emitted), len(emitted))
        else:
            table._spectra = None if self._all_uniform else self._mean_spectra()
            table.facets = self.facets.placed(positions)
        return table

    def outlines(self) -> tuple:
        """(edges, normals) of the lights as :py:attr:`mi_shlight.scene.PolygonLight.polygons` has them, one light after the other: start
        and end of all edges, and the unit normals of the polygons, flat x, y, z, without derivatives.
        """
        outlines = self._outlines.placed(dr.detach(self.facets.positions))
        edge = dr.arange(mi.UInt32, 2 * dr.width(outlines.start))
        ends = [dr.gather(mi.UInt32, table, edge >> 1) for table in (outlines.start, outlines.end)]
        edges = dr.ravel(outlines.vector(outlines.positions, dr.select((edge & 1) == 0, *ends)))
        dr.eval(edges)
        return edges, outlines.normal

    def polygon(self, i):
        """Facet that is number `i` of :py:attr:`polygons`."""
        return dr.gather(mi.UInt32, self._polygon, i)

    def radiance(self, facet, wavelengths):
        """Radiance of a facet, averaged over its area; unpolarised spectrum.

        In spectral variants that of uniform polygons is exact, any other interpolated between wavelengths `SPECTRAL_STEP` apart.
        """
        if not mi.is_spectral:
            return dr.gather(self.spectrum, self.facets.emitted, facet)
        row = dr.gather(mi.UInt32, self._row, facet)
        if self._none_uniform:
            return self._interpolated(row, wavelengths)
        uniform = dr.gather(mi.UInt32, self._uniform, facet) > 0
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi, si.wavelengths = mi.Vector3f(0, 0, 1), wavelengths
        exact = mi.unpolarized_spectrum(self._emitter(row).eval(si, uniform))
        return exact if self._all_uniform else dr.select(uniform, exact, self._interpolated(row, wavelengths))

    def mesh_light(self, wavelengths, weigh=None) -> MeshLight:
        """The lights of triangles, for rays that carry `wavelengths`; part k is a side of light ``meshes[k]``.

        Parameters
        ----------
        weigh : function, optional
            From the radiance as a spectrum to the list of floats to take in its place.
        """
        channels = weigh or list
        if mi.is_spectral:
            row = lambda face: dr.gather(mi.UInt32, self._row, dr.gather(mi.UInt32, self._mesh_facet, face))
            emitted = lambda face: channels(self._interpolated(row(face), wavelengths))
        else:
            emitted = channels(dr.gather(self.spectrum, self._emitted, self._mesh_facet))
        return MeshLight(self._vertices, self._mesh, emitted, True)

    def _emitter(self, row):
        return dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self._row_emitter, row))

    def _mean_radiance(self, row, wavelengths):
        """Radiance averaged over the sample points of a row; spectrum."""
        def body(i, last, total, row, wavelengths):
            weight, x, y, z, u, v = (dr.gather(mi.Float, values, i) for values in self._samples)
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.p, si.uv, si.wi = mi.Point3f(x, y, z), mi.Point2f(u, v), mi.Vector3f(0, 0, 1)
            if wavelengths is not None:
                si.wavelengths = wavelengths
            return i + 1, last, total + mi.unpolarized_spectrum(self._emitter(row).eval(si)) * weight, row, wavelengths

        bounds = (dr.gather(mi.UInt32, self._first_sample, row + k) for k in range(2))
        state = *bounds, self.spectrum(0), row, wavelengths
        return dr.while_loop(state, lambda i, last, *_: i < last, body, mode="symbolic", max_iterations=-1)[2]

    def _mean_spectra(self):
        """Radiance of each row at all wavelengths of the grid: flat table."""
        channels = len(self.spectrum(0))
        packs = SPECTRAL_NODES // channels
        lane = dr.arange(mi.UInt32, self._row_count * packs)
        row = lane // packs
        node = (lane - row * packs) * channels
        kind = type(dr.zeros(mi.SurfaceInteraction3f).wavelengths)
        wavelengths = kind([mi.MI_CIE_MIN + SPECTRAL_STEP * mi.Float(node + k) for k in range(channels)])
        return dr.ravel(self._mean_radiance(row, wavelengths))

    def _interpolated(self, row, wavelengths):
        place = (wavelengths - mi.MI_CIE_MIN) * (1 / SPECTRAL_STEP)
        values = []
        for at in place:
            node = mi.UInt32(dr.clip(at, 0, SPECTRAL_NODES - 2))
            below, above = (dr.gather(mi.Float, self._spectra, row * SPECTRAL_NODES + node + k) for k in range(2))
            values.append(dr.lerp(below, above, at - mi.Float(node)))
        return self.spectrum(values)


class _Side(NamedTuple):
    """Polygons of one side of a light."""

    start: np.ndarray
    end: np.ndarray
    """Vertices of all edges."""
    edges: np.ndarray
    """Number of edges of each polygon."""
    patches: np.ndarray
    """(P, 4) vertices of all strips."""
    strips: np.ndarray
    """Number of strips of each polygon."""
    triangles: np.ndarray | None = None
    """(K, 3) if the polygons are triangles."""


def _sides(light, offset: int) -> list:
    """Facets of the front of a light, and of its back if it emits there, too. `offset`: number of its first vertex."""
    if not light.is_polygon:
        front = light.triangles + offset
        return [_triangles(front), _triangles(front[:, ::-1])][:1 + light.two_sided]
    front = _outline(light, offset)
    return [front, front._replace(start=front.end, end=front.start, patches=front.patches[:, ::-1])][:1 + light.two_sided]


def _outline(light, offset: int) -> _Side:
    if light.normal is None:
        return _triangles(light.faces + offset)
    return _Side(light.start + offset, light.end + offset, np.array([len(light.start)]), light.patches + offset,
                 np.array([len(light.patches)]))


def _triangles(corners: np.ndarray) -> _Side:
    count = len(corners)
    return _Side(corners.ravel(), np.roll(corners, -1, axis=1).ravel(), np.full(count, 3), corners[:, strip_corners(0, 3)],
                 np.full(count, 1), corners)


def _facet_table(sides: list) -> FacetTable:
    start, end, edges, patches, strips = (np.concatenate(column) for column in list(zip(*sides))[:5])
    first = lambda counts: _index(np.cumsum([0, *counts]))
    return FacetTable(None, _index(start), _index(end), first(edges), _index(patches.ravel()), first(strips), bool((strips == 1).all()))


def _radiance_samples(light) -> tuple:
    """Points (R, S, 5) as x, y, z, u, v and their weights (R, S) for each of the R radiances that a light has."""
    if not light.textured:
        return np.zeros((1, 1, 5)), np.ones((1, 1))
    shares = lattice(SAMPLE_RANKS).mean(axis=1) / SAMPLE_RANKS
    if light.pieces:
        vertices = np.einsum("ck,ckx->cx", light.pieces.weight, light.vertices[light.pieces.index])
        corners, uv = vertices[light.pieces.triangles], light.pieces.uv
    else:
        corners, uv = light.vertices[light.faces], light.uv
    points = np.einsum("sk,tkx->tsx", shares, np.concatenate([corners, uv], axis=-1))
    weights = np.full(points.shape[:2], 1 / len(shares))
    if light.pieces:
        return points, weights
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return points.reshape(1, -1, 5), (weights * (area / area.sum())[:, None]).reshape(1, -1)


def _index(values) -> "mi.UInt32":
    return aligned(mi.UInt32, np.asarray(values))
