"""What the SH renderer needs to know of a Mitsuba scene: its polygonal lights and its diffuse receivers."""
from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from .errors import UnsupportedSceneWarning
from .light.polygon import direction

PLANARITY = 1e-3
"""Largest distance of a light's vertex from the light's plane, relative to the light's extent."""

RADIANCE_SAMPLES = 64
"""Stratified points over which the mean radiance of a textured light is taken."""


@dataclass
class PolygonLight:
    """One planar polygonal emitter: directed boundary edges of its mesh, so holes and concave outlines need no special care."""

    name: str
    shape: object
    emitter: object
    start: np.ndarray
    end: np.ndarray
    """Vertex indices of each boundary edge. Seen from the emitting side the polygon lies to the right of its edges, which makes
    the solid angle positive for the points it lights."""
    vertices: np.ndarray = field(repr=False)
    """All vertex positions of the mesh, (V, 3) float64, world space."""
    normal: np.ndarray = field(repr=False)
    textured: bool = False

    @property
    def centroid(self) -> np.ndarray:
        return self.vertices[self.start].mean(axis=0)

    @property
    def outline(self) -> np.ndarray:
        """Boundary edges as points: (E, 2, 3)."""
        return self.vertices[np.stack([self.start, self.end], axis=1)]


@dataclass
class Receiver:
    """A shape that can be lit: which sides scatter, and its geometry if it is a mesh."""

    name: str
    shape: object
    two_sided: bool
    black: bool
    """True if the BSDF has no diffuse part: the SH renderer shows the shape black."""


def mesh_arrays(mesh) -> tuple:
    """Faces (F, 3) int64, positions (V, 3) float32 and vertex normals (V, 3) or None of a Mitsuba mesh, as numpy copies."""
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3).astype(np.int64)
    positions = np.array(dr.detach(mesh.vertex_positions_buffer())).reshape(-1, 3)
    normals = np.array(dr.detach(mesh.vertex_normals_buffer())).reshape(-1, 3) if mesh.has_vertex_normals() else None
    return faces, positions, normals


def shape_name(shape) -> str:
    """The id a user gave the shape, or its class when it has none."""
    return shape.id() or f"<unnamed {shape.class_name()}>"


def fingerprint(scene) -> list:
    """Identity of all geometry in the scene, cheap to compare: [(shape, detached vertex buffer or None)].

    A Dr.Jit variable index names one immutable content as long as somebody holds the variable, so equal indices mean that
    nothing moved.
    """
    held = []
    for shape in scene.shapes():
        buffer = dr.detach(shape.vertex_positions_buffer()) if shape.is_mesh() else None
        held.append((shape, buffer))
    return held


def same_fingerprint(a: list, b: list) -> bool:
    """True if no shape was added, removed or moved between two fingerprints."""
    key = lambda held: [(shape_index(s), None if v is None else v.index) for s, v in held]
    return key(a) == key(b)


def shape_index(shape) -> int:
    """Registry number of a shape: what ``SurfaceInteraction3f.shape`` holds for hits on it."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def warn(text: str) -> None:
    """Report a part of the scene that is left out: the default for `complain` below."""
    warnings.warn(f"shprt: {text}", UnsupportedSceneWarning, stacklevel=4)


def refuse(text: str) -> None:
    """A `complain` that makes it an error."""
    raise ValueError(f"shprt: {text} (an error because 'strict' is true)")


def keep_quiet(text: str) -> None:
    """A `complain` for callers whose user has been told already."""


def polygon_lights(scene, complain=warn) -> list:
    """Polygonal area lights of a scene, in the scene's order.

    Accepts ``shlight`` and ``area`` emitters on planar meshes (rectangles included). Other emitters are left out; `complain` is
    called with a sentence about each.

    Raises
    ------
    ValueError
        If a light's mesh is not planar or has no area, or if the scene has no polygonal light at all.
    """
    lights = []
    for shape in scene.shapes():
        if shape.is_emitter():
            kind = shape.class_name()
            if not shape.is_mesh():
                complain(f"emitter on shape '{shape_name(shape)}' ({kind}): only planar meshes and rectangles can be projected. "
                                  "Replace it by a polygon of the same area, or render it with Mitsuba's 'path'.")
                continue
            lights.append(_polygon_light(shape))
            if lights[-1].textured:
                complain(f"texture of emitter '{shape_name(shape)}': the light is taken as uniform with the texture's mean radiance.")
    for emitter in scene.emitters():
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            complain(f"emitter '{emitter.id()}' ({emitter.class_name()}): only polygonal area lights can be projected. "
                              "Its light is missing in the picture; remove it, or render with Mitsuba's 'path'.")
    if not lights:
        raise ValueError("shprt: 'scene' must have at least one polygonal area light, got none. Put <emitter type=\"shlight\"> or "
                         "<emitter type=\"area\"> inside a rectangle or a planar mesh.")
    return lights


def receivers(scene, complain=warn) -> list:
    """All shapes of the scene that can be lit; `complain` is called with a sentence about each BSDF that is not plainly
    diffuse.
    """
    found, seen = [], set()
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        two_sided, black, complaint = _diffuse_support(bsdf)
        if complaint and (complaint, bsdf.id()) not in seen:
            seen.add((complaint, bsdf.id()))
            complain(f"BSDF '{bsdf.id()}' of shape '{shape_name(shape)}' ({bsdf.class_name()}): {complaint}")
        found.append(Receiver(shape_name(shape), shape, two_sided, black))
    return found


def occluder_hash(scene) -> str:
    """Hash over all shapes that can block light, independent of their order."""
    parts = sorted(content_hash(s, False) for s in scene.shapes() if not s.is_emitter())
    return hashlib.sha256("".join(parts).encode()).hexdigest()


def content_hash(shape, two_sided: bool) -> str:
    """Hash of what a bake depends on: geometry and lit sides; independent of ids, order and materials' colours."""
    digest = hashlib.sha256(b"two-sided" if two_sided else b"one-sided")
    if shape.is_mesh():
        for array in mesh_arrays(shape):
            digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    else:
        digest.update(shape.class_name().encode())
        parameters = mi.traverse(shape)
        for key in sorted(parameters.keys()):
            if not key.startswith(("bsdf", "emitter", "interior", "exterior")):
                digest.update(f"{key}={parameters[key]}".encode())
    return digest.hexdigest()


def boundary_edges(faces: np.ndarray, positions: np.ndarray) -> tuple:
    """Directed edges of a mesh that no other face shares: arrays of start and end vertex indices.

    Vertices at equal positions count as one, as meshes often repeat them per face.
    """
    _, welded = np.unique(positions, axis=0, return_inverse=True)
    welded = welded.reshape(-1)
    start = faces.ravel()
    end = np.roll(faces, -1, axis=1).ravel()
    a, b = welded[start], welded[end]
    count = int(welded.max()) + 1
    boundary = ~np.isin(a * count + b, b * count + a) & (a != b)
    return start[boundary], end[boundary]


def _polygon_light(shape) -> PolygonLight:
    faces, positions, _ = mesh_arrays(shape)
    positions = positions.astype(np.float64)
    name = shape_name(shape)
    corners = positions[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    length = np.linalg.norm(normal)
    extent = np.ptp(positions, axis=0).max() if len(positions) else 0.0
    start, end = boundary_edges(faces, positions) if len(faces) else (np.zeros(0, int),) * 2
    points = corners.reshape(-1, 3)
    offset = np.abs((points - points.mean(axis=0)) @ (normal / length)).max() if length > 0 else np.inf
    if not np.isfinite(positions).all() or extent == 0 or offset > PLANARITY * extent or len(start) < 3:
        worst = "no area" if not np.isfinite(offset) else f"vertices up to {offset / extent:.3g} of the light's extent off its plane"
        raise ValueError(f"shprt: light '{name}' must be a planar polygon (vertices within {PLANARITY:g} of its extent of one "
                         f"plane), got {worst}. Split it into planar lights, one shape each, or flatten it.")
    emitter = shape.emitter()
    textured = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    return PolygonLight(name, shape, emitter, end, start, positions, normal / length, textured)


def _diffuse_support(bsdf) -> tuple:
    """(two-sided, black, complaint): how much of a BSDF the diffuse SH renderer reproduces."""
    kind, flags = bsdf.class_name(), bsdf.flags()
    lobes = [bsdf.flags(i) for i in range(bsdf.component_count())]
    two_sided = any(mi.has_flag(lobe, mi.BSDFFlags.BackSide) and mi.has_flag(lobe, mi.BSDFFlags.DiffuseReflection) for lobe in lobes)
    diffuse = mi.has_flag(flags, mi.BSDFFlags.DiffuseReflection)
    smooth = mi.has_flag(flags, mi.BSDFFlags.Glossy) or mi.has_flag(flags, mi.BSDFFlags.Delta)
    if not diffuse:
        return False, True, "it has no diffuse reflection and is rendered black."
    if smooth:
        return two_sided, False, "only its diffuse reflection is rendered, the specular part is left out."
    if kind not in ("SmoothDiffuse", "TwoSidedBRDF"):
        return two_sided, False, ("rendered as a plain diffuse surface with its diffuse reflectance; perturbed normals and opacity "
                                  "are left out.")
    return two_sided, False, None


class LightTable:
    """Lights of a scene as flat Dr.Jit buffers for symbolic loops; vertex positions and radiance stay differentiable."""

    def __init__(self, lights: list):
        self.count = len(lights)
        offsets = np.cumsum([0] + [light.shape.vertex_count() for light in lights])
        self.positions = dr.concat([light.shape.vertex_positions_buffer() for light in lights])
        self.start = _index(np.concatenate([light.start + o for light, o in zip(lights, offsets)]))
        self.end = _index(np.concatenate([light.end + o for light, o in zip(lights, offsets)]))
        self.first_edge = _index(np.cumsum([0] + [len(light.start) for light in lights]))
        flat = lambda rows: mi.Float(np.asarray(rows, dtype=np.float64).ravel().tolist())
        self.centroid = flat([light.centroid for light in lights])
        self.normal = flat([light.normal for light in lights])
        self._emitters = _index([dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(light.emitter))[0] for light in lights])
        self._samples = RADIANCE_SAMPLES if any(light.textured for light in lights) else 1
        self._surface = self._surface_points(lights)
        self._radiance = None if mi.is_spectral else dr.ravel(self._mean_radiance(dr.arange(mi.UInt32, self.count), None))

    def edge_range(self, light):
        """First edge of light number `light` and one past its last."""
        return dr.gather(mi.UInt32, self.first_edge, light), dr.gather(mi.UInt32, self.first_edge, light + 1)

    def facing(self, light, x):
        """True where `x` lies on the emitting side of light number `light`."""
        return dr.dot(dr.gather(mi.Vector3f, self.normal, light), dr.detach(x) - dr.gather(mi.Point3f, self.centroid, light)) > 0

    def apex(self, light, x):
        """Unit vector from `x` towards the light's centroid: apex of the solid angle's fan."""
        return direction(dr.gather(mi.Point3f, self.centroid, light) - dr.detach(x))

    def radiance(self, light, wavelengths):
        """Emitted radiance of light number `light`, averaged over its area; unpolarised spectrum."""
        if self._radiance is None:
            return self._mean_radiance(light, wavelengths)
        return dr.gather(_spectrum_type(), self._radiance, light)

    def _surface_points(self, lights):
        """Area-uniform stratified points of each light as a flat table: what a radiance texture is looked up with."""
        side = int(self._samples ** 0.5)
        shape = dr.repeat(_index([shape_index(light.shape) for light in lights]), self._samples)
        cell = dr.tile(dr.arange(mi.UInt32, self._samples), self.count)
        sample = (mi.Point2f(cell % side, cell // side) + 0.5) / side
        points = dr.reinterpret_array(mi.ShapePtr, shape).sample_position(0, sample)
        table = {"p": dr.ravel(points.p), "n": dr.ravel(points.n), "uv": dr.ravel(points.uv)}
        dr.eval(table)
        return dr.detach(table)

    def _mean_radiance(self, light, wavelengths):
        def body(i, total, light, wavelengths):
            si = dr.zeros(mi.SurfaceInteraction3f)
            row = light * self._samples + i
            si.p = dr.gather(mi.Point3f, self._surface["p"], row)
            si.n = dr.gather(mi.Normal3f, self._surface["n"], row)
            si.sh_frame = mi.Frame3f(si.n)
            si.uv = dr.gather(mi.Point2f, self._surface["uv"], row)
            si.wi = mi.Vector3f(0, 0, 1)
            if wavelengths is not None:
                si.wavelengths = wavelengths
            emitter = dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self._emitters, light))
            return i + 1, total + mi.unpolarized_spectrum(emitter.eval(si)), light, wavelengths

        state = (mi.UInt32(0), _spectrum_type()(0), light, wavelengths)
        if self._samples == 1:
            return body(*state)[1]
        return dr.while_loop(state, lambda i, *_: i < self._samples, body, mode="symbolic",
                             max_iterations=-1)[1] / self._samples


def _index(values) -> "mi.UInt32":
    return mi.UInt32([int(v) for v in values])


def _spectrum_type():
    return type(mi.unpolarized_spectrum(mi.Spectrum(0)))
