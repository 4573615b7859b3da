"""What the figures of [W18] and [W20] have in common: their scenes anew, from procedural surfaces, and sheets of pictures."""
from __future__ import annotations

import pathlib
from typing import NamedTuple

import matplotlib
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

from validation.grid_cost import exposure  # noqa: E402
from validation.grid_scenes import Lights, Points, frame  # noqa: E402
from mi_shlight.panel import srgb  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

MATT = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_albedo"}}}
GLOSSY = {"type": "principled", "roughness": 0.5, "metallic": 0.5, "base_color": {"type": "rgb", "value": 0.7}}
"""For the papers' glossy surfaces, whose lobe is Phong's: half diffuse, half metal with a lobe about as wide as that of exponent 30."""
SQUARE = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
NO_REFINEMENT = 1e3
"""`max_edge` of ``shprt`` for surfaces that are baked at their own vertices, as in the papers."""


class View(NamedTuple):
    """A camera."""

    origin: tuple
    target: tuple
    fov: float
    """Degrees."""


def surface(name: str, points: Points, bsdf: dict) -> mi.Mesh:
    """A mesh with normals and, as ``vertex_albedo``, colours at its vertices."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(points.positions), len(points.faces), has_vertex_normals=True, props=props)
    mesh.add_attribute("vertex_albedo", 3, points.albedo.astype(np.float32).ravel())
    return filled(mesh, points.positions, points.faces, vertex_normals=points.normals)


def filled(mesh: mi.Mesh, positions: np.ndarray, faces: np.ndarray, **attributes) -> mi.Mesh:
    parameters = mi.traverse(mesh)
    for key, rows in {"vertex_positions": positions, **attributes}.items():
        parameters[key] = np.ravel(rows).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    parameters.update()
    return mesh


def polygon(name: str, corners: np.ndarray, radiance) -> mi.Mesh:
    """A light of uniform `radiance` (3) with the outline `corners` (N, 3), counter-clockwise from where it shines; cut into a fan."""
    props = mi.Properties()
    props["emitter"] = mi.load_dict({"type": "shlight", "radiance": {"type": "rgb", "value": [float(c) for c in radiance]}})
    count = len(corners)
    mesh = mi.Mesh(name, count, count - 2, props=props)
    return filled(mesh, corners, [(0, k, k + 1) for k in range(1, count - 1)])


def facing(outline: np.ndarray, position, target) -> np.ndarray:
    """Corners (N, 3) of a flat outline (N, 2) about `position` that faces `target`: counter-clockwise as seen from there."""
    return np.asarray(position, float) + outline @ frame(position, target)[:, :2].T


def light_triangles(lights: Lights) -> dict:
    """A light ``light_000`` for each triangle."""
    return {f"light_{k:03d}": polygon(f"light_{k:03d}", lights.vertices[face[::-1]], colour)
            for k, (face, colour) in enumerate(zip(lights.faces, lights.radiance))}


def assemble(points: Points, lights: dict, view: View, size: int, bsdf: dict = MATT) -> mi.Scene:
    """A scene of one surface and `lights`, emitters or shapes by name, seen in a square picture."""
    look = mi.ScalarTransform4f().look_at(list(view.origin), list(view.target), [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}
    return mi.load_dict({"type": "scene", "surface": surface("surface", points, bsdf), **lights,
                         "sensor": {"type": "perspective", "fov": view.fov, "to_world": look, "film": film,
                                    "sampler": {"type": "independent"}}}, optimize=False)


def placed_again(scene: mi.Scene, corners: dict, radiance: dict | None = None) -> None:
    """Move lights, by name, to new corners, and give them new colours."""
    parameters = mi.traverse(scene)
    for name, rows in corners.items():
        parameters[f"{name}.vertex_positions"] = mi.Float(np.ravel(rows).tolist())
    for name, colour in (radiance or {}).items():
        parameters[f"{name}.emitter.radiance.value"] = mi.Color3f(np.ravel(colour).tolist())
    parameters.update()


# Sheets of pictures.

class Display:
    """What turns radiance into display values 0 .. 1: sRGB of the exposure that gives a picture the mean 0.4 where it is `seen`."""

    def __init__(self, reference: np.ndarray, seen: np.ndarray):
        self.factor = exposure(reference[seen])

    def __call__(self, image: np.ndarray) -> np.ndarray:
        return srgb(self.factor * image)

    def levels(self, image: np.ndarray) -> np.ndarray:
        """Grey levels, 0 to 255."""
        return np.round(255 * self(image))


def draw_sheet(path: pathlib.Path, rows: list, width: float = 2.2, dpi: int = 72, outlines: list | None = None) -> None:
    """Pictures in `rows` of (label, [(title, picture or None)]): display values (H, W, 3), or signed values (H, W) from blue over white at
    0 to red at 0.1.

    `outlines`: corners of the light in each picture of the first row, drawn from above in its corner, with the scene's centre.
    """
    columns = max(len(row) for _, row in rows)
    figure, axes = plt.subplots(len(rows), columns, figsize=(width * columns, (width + 0.25) * len(rows)), layout="constrained",
                                squeeze=False)
    for (label, row), line in zip(rows, axes):
        line[0].set_ylabel(label, fontsize=8)
        for axis in line[len(row):]:
            axis.set_axis_off()
        for axis, (title, picture) in zip(line, row):
            if picture is None:
                axis.set_axis_off()
                continue
            signed = {"cmap": "RdBu_r", "vmin": -0.1, "vmax": 0.1} if picture.ndim == 2 else {}
            axis.imshow(np.clip(picture, -1, 1), interpolation="nearest", **signed)
            axis.set_title(title, fontsize=8)
            axis.set(xticks=[], yticks=[])
    for axis, corners in zip(axes[0], outlines or ()):
        inset = axis.inset_axes((0.66, 0.66, 0.34, 0.34))
        inset.fill(corners[:, 0], corners[:, 2], facecolor="gold", edgecolor="black", linewidth=0.8)
        inset.plot(0, 0, "k+", markersize=5)
        inset.set(xlim=(-3, 3), ylim=(3.5, -2.5), xticks=[], yticks=[], aspect="equal")
    figure.savefig(path, dpi=dpi)
    plt.close(figure)
