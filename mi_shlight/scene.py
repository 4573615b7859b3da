"""What the SH renderer needs to know of a Mitsuba scene: its polygonal lights and its diffuse receivers."""
from __future__ import annotations

import copy
import hashlib
import warnings
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from .errors import UnsupportedSceneWarning
from .light.polygon import EdgeBuffer, apex_direction, direction, strip_corners, strip_count

PLANARITY, BENT = 1e-3, 0.1
"""Distances of a light's vertices from its mean plane, relative to its extent: beyond the first the light is reported, beyond the second
refused."""

RADIANCE_SAMPLES = 64
"""Stratified points over which the mean radiance of a textured light is taken."""


@dataclass
class PolygonLight:
    """One polygonal emitter: directed boundary edges of its mesh, so holes and concave outlines need no special care.

    The light of a uniform surface depends on its outline alone wherever all of its faces turn their front to the point, so corners need not
    lie in one plane. Points that see only a part of the faces from the front, near the mean plane, get the difference of fronts and backs;
    those behind the mean plane get nothing.
    """

    name: str
    shape: object
    emitter: object
    start: np.ndarray
    end: np.ndarray
    """Vertex indices of each boundary edge. Seen from the emitting side the polygon lies to the right of its edges, which makes
    the solid angle positive for the points it lights."""
    patches: np.ndarray = field(repr=False)
    """Four vertex indices for each of the strips (P, 4) that fill the polygon, oriented as the edges; see
    :py:meth:`mi_shlight.light.polygon.VertexList.fold_patches`."""
    vertices: np.ndarray = field(repr=False)
    """All vertex positions of the mesh, (V, 3) float64, world space."""
    normal: np.ndarray = field(repr=False)
    """Unit normal of the mean plane, on the side that emits."""
    bend: float = 0.0
    """Largest distance of a vertex from the mean plane, relative to the light's extent."""
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
    light: int
    """Position among the scene's emitting shapes; -1 if it does not emit."""

    @property
    def baked(self) -> bool:
        """True if per-vertex transfer applies to the shape."""
        return self.shape.is_mesh() and not self.black

    @property
    def content(self) -> str:
        """Key of the shape in a bake: its geometry and lit sides. A light may move, so it goes by its place among the
        lights.
        """
        if self.light >= 0:
            faces = np.array(self.shape.faces_buffer())
            return hashlib.sha256(f"light {self.light} {self.two_sided}".encode() + faces.tobytes()).hexdigest()
        return content_hash(self.shape, self.two_sided)


def mesh_arrays(mesh) -> tuple:
    """Faces (F, 3) int64, positions (V, 3) float32, vertex normals (V, 3) or None, and side of a Mitsuba mesh, as numpy copies.

    `side` is -1 where ``flip_normals`` turns the surface inside out, which the normals given here already include, else 1.
    """
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3).astype(np.int64)
    positions = np.array(dr.detach(mesh.vertex_positions_buffer())).reshape(-1, 3)
    normals = np.array(dr.detach(mesh.vertex_normals_buffer())).reshape(-1, 3) if mesh.has_vertex_normals() else None
    side = -1.0 if mesh.has_flipped_normals() else 1.0
    return faces, positions, None if normals is None else side * normals, side


def shape_name(shape) -> str:
    """The id a user gave the shape, or its class and place when it has none."""
    if shape.id():
        return shape.id()
    centre = ", ".join(f"{v:.4g}" for v in shape.bbox().center())
    return f"<unnamed {shape.class_name()} at ({centre})>"


class Fingerprint:
    """Identity of a scene's shapes, cheap to compare between two renders.

    A Dr.Jit variable index names one immutable content as long as somebody holds the variable; equal indices mean that nothing
    moved.
    """

    def __init__(self, scene):
        self._held = []
        self.geometry, self.lights = [], []
        for shape in scene.shapes():
            (self.lights if shape.is_emitter() else self.geometry).append((shape_index(shape), self._content(shape)))

    def _content(self, shape) -> tuple:
        if not shape.is_mesh():
            return (content_hash(shape, False),)
        buffers = [dr.detach(shape.vertex_positions_buffer()), shape.faces_buffer()]
        if shape.has_vertex_normals():
            buffers.append(dr.detach(shape.vertex_normals_buffer()))
        self._held += buffers
        return tuple(b.index for b in buffers)


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
    called with a sentence about each, and about lights whose vertices are farther off a plane than `PLANARITY`.

    Raises
    ------
    ValueError
        If a light's mesh is bent by more than `BENT` of its extent or has no area, or if the scene has no polygonal light at all.
    """
    lights = []
    for shape in scene.shapes():
        if not shape.is_emitter():
            continue
        emitter, name = shape.emitter(), shape_name(shape)
        if type(emitter).__name__ != "SHLight" and emitter.class_name() != "AreaLight":
            complain(f"emitter of shape '{name}' ({emitter.class_name()}): only 'shlight' and 'area' can be projected. It does not light "
                     "surfaces in this picture; replace it, or render with Mitsuba's 'path'.")
        elif not shape.is_mesh():
            complain(f"emitter on shape '{name}' ({shape.class_name()}): only planar meshes and rectangles can be projected. It does not "
                     "light surfaces in this picture; replace it by a polygon of the same area, or render with Mitsuba's 'path'.")
        elif "MeshAttribute" in str(emitter):
            complain(f"emitter on shape '{name}': its radiance is a mesh attribute, which cannot be averaged. It does not "
                     "light surfaces in this picture; give it a uniform radiance or a bitmap.")
        else:
            lights.append(_polygon_light(shape))
            if lights[-1].textured:
                complain(f"texture of emitter '{name}': the light is taken as uniform with the texture's mean radiance.")
            if lights[-1].bend > PLANARITY:           # without a figure: Python shows equal texts once while an optimiser moves vertices
                complain(f"light '{name}': vertices lie more than {PLANARITY:g} of its extent off a plane. It is shaded by its outline, "
                         "exact only where all faces are seen from the front; keep it planar, or split it into planar lights.")
    for emitter in scene.emitters():
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            complain(f"emitter '{emitter.id()}' ({emitter.class_name()}): only polygonal area lights can be projected. It does not light "
                     "surfaces in this picture; remove it, or render with Mitsuba's 'path'.")
    if not lights:
        raise ValueError("shprt: 'scene' must have at least one polygonal area light, got none. Put <emitter type=\"shlight\"> or "
                         "<emitter type=\"area\"> inside a rectangle or a planar mesh.")
    return lights


def receivers(scene, complain=warn) -> list:
    """All shapes of the scene that can be lit; `complain` is called with a sentence about each BSDF that is not plainly
    diffuse.
    """
    found, seen, emitting = [], set(), 0
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        two_sided, black, complaint = _diffuse_support(bsdf)
        if complaint and (complaint, bsdf.id()) not in seen:
            seen.add((complaint, bsdf.id()))
            complain(f"BSDF '{bsdf.id()}' of shape '{shape_name(shape)}' ({bsdf.class_name()}): {complaint}")
        if shape.is_emitter():                        # Mitsuba gives lights without a <bsdf> a black one
            black = black or _reflects_nothing(bsdf)
        found.append(Receiver(shape_name(shape), shape, two_sided, black, emitting if shape.is_emitter() else -1))
        emitting += shape.is_emitter()
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


def weld(positions: np.ndarray) -> np.ndarray:
    """One number for all vertices at equal positions, as meshes often repeat them per face."""
    return np.unique(positions, axis=0, return_inverse=True)[1].reshape(-1)


def boundary_edges(faces: np.ndarray, positions: np.ndarray) -> tuple:
    """Directed edges of a mesh that no other face shares: arrays of start and end vertex indices. Welded vertices count as one."""
    welded = weld(positions)
    start = faces.ravel()
    end = np.roll(faces, -1, axis=1).ravel()
    a, b = welded[start], welded[end]
    count = int(welded.max()) + 1
    boundary = ~np.isin(a * count + b, b * count + a) & (a != b)
    return start[boundary], end[boundary]


def strips(start: np.ndarray, end: np.ndarray, faces: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Corners (P, 4) of the strips that fill a polygon: cut across from its outline if that is one loop, otherwise its triangles."""
    welded = weld(positions)
    following = dict(zip(welded[start].tolist(), range(len(start))))
    loop, edge = [], 0
    while len(loop) < len(start):
        loop.append(int(start[edge]))
        edge = following.get(int(welded[end[edge]]))
        if not edge:                                  # back at the first edge, or at a loose end
            break
    n = len(loop)
    if n == len(start) == len(following) and edge == 0:
        return np.array([[loop[k] for k in strip_corners(i, n)] for i in range(strip_count(n))])
    return faces[:, [0, 1, 1, 2]]


def _polygon_light(shape) -> PolygonLight:
    faces, positions, _, _ = mesh_arrays(shape)
    positions = positions.astype(np.float64)
    corners = positions[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = areas.sum(axis=0)
    length = np.linalg.norm(normal)
    extent = np.ptp(positions, axis=0).max() if len(positions) else 0.0
    fault = None
    if not np.isfinite(positions).all() or extent == 0 or not length > 0:
        fault = "a closed one or one without area"
    else:
        normal /= length
        points = corners.reshape(-1, 3)
        bend = float(np.abs((points - points.mean(axis=0)) @ normal).max() / extent)
        start, end = boundary_edges(faces, positions)
        if bend > BENT:
            fault = f"vertices up to {bend:.3g} of its extent off the plane"
        elif (areas @ normal < 0).any():
            fault = "faces wound both ways"
        elif len(start) < 3:
            fault = "one without an outline"
    if fault:
        raise ValueError(f"shprt: light '{shape_name(shape)}' must be a planar polygon (all faces wound the same way, vertices within "
                         f"{BENT:g} of its extent of one plane), got {fault}. Split it into planar lights, one shape each, or "
                         "repair its mesh.")
    emitter = shape.emitter()
    textured = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    # Mitsuba decides which side emits: flip_normals and mirroring transforms turn it away from the winding.
    if np.ravel(np.array(shape.sample_position(0, mi.Point2f(0.5)).n)) @ normal > 0:
        start, end, faces = end, start, faces[:, ::-1]
    else:
        normal = -normal
    return PolygonLight(shape_name(shape), shape, emitter, start, end, strips(start, end, faces, positions), positions, normal, bend,
                        textured)


def _diffuse_support(bsdf) -> tuple:
    """(two-sided, black, complaint): how much of a BSDF the diffuse SH renderer reproduces."""
    kind, flags = bsdf.class_name(), bsdf.flags()
    has = lambda flags, *wanted: all(mi.has_flag(flags, w) for w in wanted)
    lobes = [bsdf.flags(i) for i in range(bsdf.component_count())]
    two_sided = any(has(lobe, mi.BSDFFlags.BackSide, mi.BSDFFlags.DiffuseReflection) for lobe in lobes)
    specular = has(flags, mi.BSDFFlags.Glossy) or has(flags, mi.BSDFFlags.Delta)
    if not has(flags, mi.BSDFFlags.DiffuseReflection):
        return False, True, "it has no diffuse reflection and is rendered black."
    if has(flags, mi.BSDFFlags.Null):
        return False, True, "opacity is not modelled; it is rendered black."
    if kind == "BlendBSDF" and specular:
        return False, True, "a blend with a specular part has no diffuse reflectance to ask for; it is rendered black."
    if "Principled" in str(bsdf):
        return two_sided, False, "rendered as a diffuse surface of its base colour, too bright for metals; the rest is left out."
    if specular:
        return two_sided, False, "only its diffuse reflection is rendered, the specular part is left out."
    if kind not in ("SmoothDiffuse", "TwoSidedBRDF", "BlendBSDF"):
        return two_sided, False, "rendered with its diffuse reflectance; perturbed normals are left out."
    return two_sided, False, None


def _reflects_nothing(bsdf) -> bool:
    """True if the diffuse reflectance is zero at 64 scattered texture coordinates."""
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    index = dr.arange(mi.Float, 64)
    si.uv = mi.Point2f(index * 0.7548777 - dr.floor(index * 0.7548777), index * 0.5698403 - dr.floor(index * 0.5698403))
    si.wi = mi.Vector3f(0, 0, 1)
    if mi.is_spectral:
        si.wavelengths = mi.sample_shifted(index / 64) * (mi.MI_CIE_MAX - mi.MI_CIE_MIN) + mi.MI_CIE_MIN
    return not dr.any(mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si)) != 0, axis=None)


class LightTable:
    """Lights of a scene as flat Dr.Jit buffers for symbolic loops.

    What depends on the lights' topology alone is made once; :py:meth:`attached` adds what a user may change or differentiate between
    renders.
    """

    DRJIT_STRUCT = dict.fromkeys(("start", "end", "ends", "first_edge", "patches", "first_patch", "_emitters", "_surface"), object)
    """Buffers that `dr.freeze` must know of, as it has to of all that an integrator holds."""

    def __init__(self, lights: list):
        self.count = len(lights)
        self._lights = lights
        offsets = np.cumsum([0] + [light.shape.vertex_count() for light in lights])
        ends = np.concatenate([np.stack([light.start, light.end], axis=1) + o for light, o in zip(lights, offsets)])
        self.start, self.end, self.ends = _index(ends[:, 0]), _index(ends[:, 1]), _index(ends.ravel())
        self.first_edge = _index(np.cumsum([0] + [len(light.start) for light in lights]))
        self.patches = _index(np.concatenate([light.patches.ravel() + o for light, o in zip(lights, offsets)]))
        self.first_patch = _index(np.cumsum([0] + [len(light.patches) for light in lights]))
        self._emitters = _index([dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(light.emitter))[0] for light in lights])
        self._samples = RADIANCE_SAMPLES if any(light.textured for light in lights) else 1
        self._surface = self._surface_points()
        self.positions = self.centroid = self.normal = self._radiance = None

    def attached(self) -> "LightTable":
        """A copy with the current vertex positions and radiance, which carry derivatives if derivatives are on."""
        table = copy.copy(self)
        table.positions = dr.concat([light.shape.vertex_positions_buffer() for light in self._lights])
        table.centroid, table.normal = self._planes(dr.detach(table.positions))
        if not mi.is_spectral:
            table._radiance = dr.ravel(self._mean_radiance(dr.arange(mi.UInt32, self.count), None))
        return table

    def outlines(self):
        """Start and end of all edges: flat x, y, z, without derivatives."""
        points = dr.ravel(dr.gather(mi.Point3f, dr.detach(self.positions), self.ends))
        dr.eval(points)
        return points

    def edges(self, light, x, active) -> EdgeBuffer:
        """Edges and strips of light number `light` for the points that it lights: none where `x` lies behind it or `active` is false."""
        facing = dr.dot(dr.gather(mi.Vector3f, self.normal, light), dr.detach(x) - dr.gather(mi.Point3f, self.centroid, light)) > 0

        def owned(table):
            first, last = dr.gather(mi.UInt32, table, light), dr.gather(mi.UInt32, table, light + 1)
            return first, dr.select(active & facing, last, first)

        return EdgeBuffer(self.positions, self.start, self.end, *owned(self.first_edge), (self.patches, *owned(self.first_patch)),
                          all(len(light.patches) == 1 for light in self._lights))

    def apex(self, light, x):
        """Unit vector from `x` into the light: apex of the solid angle's fan."""
        middle = direction(dr.gather(mi.Point3f, self.centroid, light) - dr.detach(x))
        return apex_direction(middle, dr.gather(mi.Vector3f, self.normal, light), -1)

    def radiance(self, light, wavelengths):
        """Emitted radiance of light number `light`, averaged over its area; unpolarised spectrum."""
        if self._radiance is None:
            return self._mean_radiance(light, wavelengths)
        return dr.gather(_spectrum_type(), self._radiance, light)

    def _planes(self, positions) -> tuple:
        """Mean corner of each light's outline, and its mean normal, on the side that emits: flat x, y, z."""
        vertex = lambda table, e: dr.gather(mi.Vector3f, positions, dr.gather(mi.UInt32, table, e))
        light = dr.arange(mi.UInt32, self.count)
        first, last = dr.gather(mi.UInt32, self.first_edge, light), dr.gather(mi.UInt32, self.first_edge, light + 1)
        origin = vertex(self.start, first)

        def body(e, last, total, area, origin):
            a, b = vertex(self.start, e) - origin, vertex(self.end, e) - origin
            return e + 1, last, total + a, area + dr.cross(a, b), origin

        state = first, last, mi.Vector3f(0), mi.Vector3f(0), origin
        _, _, total, area, _ = dr.while_loop(state, lambda e, last, *_: e < last, body, mode="symbolic")
        planes = dr.ravel(origin + total / mi.Float(last - first)), dr.ravel(-direction(area))
        dr.eval(planes)
        return planes

    def _surface_points(self) -> dict:
        """Area-uniform stratified points of each light as a flat table: what a radiance texture is looked up with."""
        side = int(self._samples ** 0.5)
        cell = dr.arange(mi.UInt32, self._samples)
        sample = (mi.Point2f(cell % side, cell // side) + 0.5) / side
        points = [light.shape.sample_position(0, sample) for light in self._lights]
        broadcast = lambda v: v + dr.zeros(type(v), self._samples)
        return {name: aligned(mi.Float, np.concatenate([np.array(broadcast(getattr(p, name))).T.ravel() for p in points]))
                for name in ("p", "n", "uv")}

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


def aligned(kind, values: np.ndarray):
    """Device copy of a numpy array. Dr.Jit would alias numpy's memory, whose alignment changes and doubles the kernels in the
    cache.
    """
    dtype = {mi.Float: np.float32, mi.UInt32: np.uint32}[kind]
    source = kind(np.ascontiguousarray(values, dtype=dtype))
    copy = dr.zeros(kind, len(values))
    dr.scatter(copy, source, dr.arange(mi.UInt32, len(values)))
    dr.eval(copy)
    dr.sync_thread()
    return copy


def _index(values) -> "mi.UInt32":
    return mi.UInt32([int(v) for v in values])


def _spectrum_type():
    return type(mi.unpolarized_spectrum(mi.Spectrum(0)))
