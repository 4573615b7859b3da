"""What the SH renderer needs to know of a Mitsuba scene: its polygonal lights and its diffuse receivers."""
from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from .errors import UnsupportedSceneWarning
from .light.cut import SUBDIVISIONS, Pieces, boundary_edges, cut, is_convex, strips, weld

PLANARITY = 1e-3
"""Distance of a light's vertices from its mean plane, relative to its extent, up to which its outline stands for it."""


@dataclass
class PolygonLight:
    """One emitting mesh of the scene.

    A planar mesh of uniform radiance is one polygon: the directed boundary edges of its mesh, so holes and concave outlines need no special
    care. Any other, bent, closed or textured, is made of triangles of uniform radiance.
    """

    name: str
    shape: object
    emitter: object
    vertices: np.ndarray = field(repr=False)
    """All vertex positions of the mesh, (V, 3) float64, world space."""
    faces: np.ndarray = field(repr=False)
    """(F, 3), wound clockwise as seen from the emitting side, which makes the solid angle positive for the points they light."""
    uv: np.ndarray = field(repr=False)
    """Texture coordinates at the corners of each face: (F, 3, 2)."""
    two_sided: bool
    """True if all faces emit to the other side, too."""
    textured: bool
    normal: np.ndarray | None
    """Unit normal of the plane, on the side that emits; None if the mesh is not planar."""
    start: np.ndarray | None = None
    end: np.ndarray | None = None
    """Vertex indices of each boundary edge, wound as the faces, of a planar mesh."""
    patches: np.ndarray | None = field(default=None, repr=False)
    """Four vertex indices for each of the strips (P, 4) that fill the outline, wound as the faces; see
    :py:meth:`mi_shlight.light.polygon.VertexList.fold_patches`."""
    pieces: Pieces | None = field(default=None, repr=False)
    """What a texture is cut into."""

    @property
    def is_polygon(self) -> bool:
        """True if one polygon of uniform radiance stands for the light."""
        return self.normal is not None and self.pieces is None

    @property
    def triangles(self) -> np.ndarray:
        """What the light consists of if it is no polygon, (K, 3): corner points of the pieces, or vertices. Neighbours share theirs."""
        return weld(self.vertices)[self.faces] if self.pieces is None else self.pieces.triangles

    @property
    def outline(self) -> np.ndarray:
        """Edges of all faces as points, (E, 2, 3), planar or not: how far the light has moved."""
        return self.vertices[self.faces[:, [0, 1, 1, 2, 2, 0]]].reshape(-1, 2, 3)

    @property
    def polygons(self) -> list:
        """What stands between points and their visibility: (edges as points (E, 2, 3), unit normal) of each planar polygon, one for a
        planar light, otherwise one for each face; once for both sides.
        """
        if self.normal is not None:
            return [(self.vertices[np.stack([self.start, self.end], axis=1)], self.normal)]
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 1] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return list(zip(self.outline.reshape(-1, 3, 2, 3), normals / np.where(length > 0, length, 1)))


@dataclass
class Receiver:
    """A shape that can be lit: which sides scatter, and its geometry if it is a mesh."""

    name: str
    shape: object
    two_sided: bool
    black: bool
    """True if the SH renderer shows the shape black, as nothing of the BSDF can be rendered."""
    diffuse: bool
    """True if the BSDF has a diffuse reflectance to ask for."""
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
        self.geometry, self.lights, self.light_faces = [], [], []
        for shape in scene.shapes():
            (self.lights if shape.is_emitter() else self.geometry).append((shape_index(shape), self._content(shape)))
            if shape.is_emitter():                    # Mitsuba writes the two faces of a rectangle anew when it moves
                fixed = shape.class_name() == "Rectangle" or not shape.is_mesh()
                self.light_faces.append((shape_index(shape), None if fixed else shape.faces_buffer().index))

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

    Accepts ``shlight`` and ``area`` emitters on meshes (rectangles included). Other emitters of shapes are left out; `complain` is called
    with a sentence about each, and about lights whose faces may hide one another, which is not modelled. Those that belong to no shape are
    the concern of :py:class:`mi_shlight.shading.distant.DistantLights`.

    Raises
    ------
    ValueError
        If a light's mesh has no area.
    """
    shapes = []
    for shape in scene.shapes():
        if not shape.is_emitter():
            continue
        emitter, name = shape.emitter(), shape_name(shape)
        if type(emitter).__name__ != "SHLight" and emitter.class_name() != "AreaLight":
            complain(f"emitter of shape '{name}' ({emitter.class_name()}): only 'shlight' and 'area' can be projected. It does not light "
                     "surfaces in this picture; replace it, or render with Mitsuba's 'path'.")
        elif not shape.is_mesh():
            complain(f"emitter on shape '{name}' ({shape.class_name()}): only meshes and rectangles can be projected. It does not "
                     "light surfaces in this picture; replace it by a polygon of the same area, or render with Mitsuba's 'path'.")
        elif "MeshAttribute" in str(emitter):
            complain(f"emitter on shape '{name}': its radiance is a mesh attribute, which cannot be averaged. It does not "
                     "light surfaces in this picture; give it a uniform radiance or a bitmap.")
        else:
            shapes.append(shape)
    lights = [_polygon_light(shape) for shape in shapes]
    for light in lights:
        if light.normal is None and (light.two_sided or not is_convex(light.faces[:, ::-1], light.vertices, PLANARITY)):
            # without a figure: Python shows equal texts once while an optimiser moves vertices
            complain(f"light '{light.name}': its faces hide one another from some points (it is not convex, or it has two sides), which is "
                     "not modelled: such points get too much light. Use convex meshes that emit outwards.")
    return lights


def receivers(scene, complain=warn, glossy: bool = False) -> list:
    """All shapes of the scene that can be lit; `complain` is called with a sentence about each BSDF that is not plainly
    diffuse, or, if gloss is rendered (`glossy`), not plainly a surface that reflects.
    """
    found, seen, emitting = [], set(), 0
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        two_sided, black, complaint = _diffuse_support(bsdf)
        diffuse = not black
        if glossy:
            two_sided, black, complaint = _glossy_support(bsdf)
        if complaint and (complaint, bsdf.id()) not in seen:
            seen.add((complaint, bsdf.id()))
            complain(f"BSDF '{bsdf.id()}' of shape '{shape_name(shape)}' ({bsdf.class_name()}): {complaint}")
        if shape.is_emitter():                        # Mitsuba gives lights without a <bsdf> a black one
            black = black or diffuse and _reflects_nothing(bsdf)
        found.append(Receiver(shape_name(shape), shape, two_sided, black, diffuse, emitting if shape.is_emitter() else -1))
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


def _polygon_light(shape) -> PolygonLight:
    faces, positions, _, _ = mesh_arrays(shape)
    positions = positions.astype(np.float64)
    corners = positions[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    present = np.linalg.norm(areas, axis=1) > 0
    if not present.any() or not np.isfinite(corners).all():
        raise ValueError(f"shprt: light '{shape_name(shape)}' must be a mesh with finite vertices and an area, got one without. Repair it.")
    emitter = shape.emitter()
    uv = _texture_coordinates(shape, faces)
    # Mitsuba decides which side emits: flip_normals and mirroring transforms turn it away from the winding. This is a point of the first
    # face that has an area.
    side = np.ravel(np.array(shape.sample_position(0, mi.Point2f(0.5, 0)).n))
    if areas[np.argmax(present)] @ side > 0:
        faces, uv = faces[:, ::-1], uv[:, ::-1]
    else:
        areas = -areas
    textured = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    light = PolygonLight(shape_name(shape), shape, emitter, positions, faces, uv, getattr(emitter, "two_sided", False), textured,
                         _common_normal(corners.reshape(-1, 3), areas))
    if light.normal is not None:
        light.start, light.end = boundary_edges(faces, positions)
        if len(light.start) < 3:                      # as of a sheet whose faces all stand there twice
            light.normal = None
        else:
            light.patches = strips(light.start, light.end, faces, positions)
    subdivisions = getattr(emitter, "subdivisions", SUBDIVISIONS)
    if textured and (subdivisions > 1 or light.normal is None):
        light.pieces = cut(faces, positions, uv, subdivisions)
    return light


def _texture_coordinates(mesh, faces: np.ndarray) -> np.ndarray:
    """(F, 3, 2) at the corners of the faces; Mitsuba's own choice, barycentric, where the mesh has none."""
    if mesh.has_vertex_texcoords():
        return np.array(mesh.vertex_texcoords_buffer()).reshape(-1, 2).astype(np.float64)[faces]
    return np.broadcast_to([[0.0, 0], [1, 0], [0, 1]], (len(faces), 3, 2))


def _common_normal(points: np.ndarray, areas: np.ndarray):
    """Unit normal of a planar mesh with all faces turned the same way, given their corners and vector areas; otherwise None."""
    normal = areas.sum(axis=0)
    length = np.linalg.norm(normal)
    if not length > 0:
        return None
    normal /= length
    bend = np.abs((points - points.mean(axis=0)) @ normal).max() / np.ptp(points, axis=0).max()
    return normal if bend <= PLANARITY and (areas @ normal >= 0).all() else None


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


def _glossy_support(bsdf) -> tuple:
    """(two-sided, black, complaint): how much of a BSDF is rendered with its gloss."""
    any_of = lambda flags, *wanted: any(mi.has_flag(flags, w) for w in wanted)
    Flags, flags = mi.BSDFFlags, bsdf.flags()
    reflecting = [lobe for lobe in map(bsdf.flags, range(bsdf.component_count()))
                  if any_of(lobe, Flags.DiffuseReflection, Flags.GlossyReflection)]
    two_sided = any(mi.has_flag(lobe, Flags.BackSide) for lobe in reflecting)
    if any_of(flags, Flags.Null):
        return False, True, "opacity is not modelled; it is rendered black."
    if not reflecting:
        return False, True, "it reflects like a mirror, or not at all, and is rendered black."
    if any_of(flags, Flags.DiffuseTransmission, Flags.GlossyTransmission, Flags.DeltaTransmission):
        return two_sided, False, "light that it transmits is left out."
    if any_of(flags, Flags.Delta):
        return two_sided, False, "its mirror reflection is left out."
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
