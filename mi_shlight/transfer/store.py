"""Baked transfer of a scene: arrays, file format, and the look-up of a hit's transfer vector."""
from __future__ import annotations

import functools
import json
import math
import os
import zipfile
from dataclasses import asdict, dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import check_choice, check_integer, check_number, message
from ..files import check_output, replacing
from ..light.polygon import direction
from ..scene import aligned, keep_quiet, occluder_hash, receivers, shape_index
from ..sh.basis import check_order
from .localised import KINDS, Quality, cone_fit
from .visibility import light_groups

FORMAT = "mi_shlight transfer"
FORMAT_VERSION = 3
ARRAYS = ("coeffs", "visibility", "variance", "residual", "cones")
SCALARS = ("order", "transfer", "localised", "distant", "samples", "light_margin", "max_edge", "conflict", "occluders", "versions")


@dataclass
class MeshBlock:
    """Part of a bake that belongs to one mesh."""

    name: str
    content: str
    """Hash of geometry and lit sides (:py:func:`mi_shlight.scene.content_hash`): the key under which a scene's mesh finds its
    block.
    """
    two_sided: bool
    first_row: int
    """Row of the mesh's first front point; the back points, if any, follow the `row_count` front ones."""
    row_count: int
    subdivision: np.ndarray = field(repr=False)
    first: np.ndarray = field(repr=False)
    rows: np.ndarray = field(repr=False)


@dataclass
class Transfer:
    """Baked radiance transfer of a scene (:py:func:`mi_shlight.bake_transfer`).

    Attributes
    ----------
    order : int
        Highest degree. A localised bake is of use at this order only: without its higher bands nothing holds the lower ones.
    transfer : str
        What `coeffs` are: ``"shadowed"``, ``"exact"`` or ``"visibility"``.
    localised : bool
        True if they are fitted to the directions of the lights, False if they are projected over the sphere.
    distant : bool
        True if one more group, after those of `groups`, is for lights at an infinite distance: its V is that a ray leaves the scene. Its
        coefficients are projected, and with ``"exact"`` they are those of ``"shadowed"``.
    samples : int
        Rays per point and group.
    coeffs : ndarray (G, R, (order + 1)**2), float32
        SH coefficients for each light group and baked point: in 1/sr of ``V max(0, n . omega) / pi`` if `transfer` is ``"shadowed"``; of
        ``(V - v) max(0, n . omega) / pi``, with v from `visibility`, if it is ``"exact"``; of 1 - V if it is ``"visibility"``.
    visibility : ndarray (G, R), float32
        Cosine-weighted mean of V over the directions looked at, 0 to 1.
    variance : ndarray (G, R), float32
        Estimated variance of `visibility`, which is that of a point's irradiance relative to the unshadowed one
        (:py:class:`mi_shlight.transfer.localised.Sampled`).
    residual : ndarray (G, R), float32
        Integral, in 1/sr, of the square of what the expansion leaves of V times the cosine over pi, over the cone of the fit or, projected,
        over the sphere; without the part v of the cosine, which is known. With the lights' solid angles it bounds the error of a shaded
        value (:py:mod:`mi_shlight.transfer.localised`, equation (2)).
    cones : ndarray (G, R, 4), float32
        Unit axis and half-angle of the cone to which the coefficients are fitted; pi where they are projected.
    groups : ndarray
        Light group g holds the lights ``groups[g] .. groups[g + 1] - 1`` in the scene's order. Up to four lights have a group
        each.
    outlines : list of ndarray (E, 2, 3)
        The lights' boundary edges at bake time.
    light_margin : float
        Scene units by which lights may move before the bake is stale.
    max_edge : float
        Longest edge of a baked triangle, scene units.
    conflict : float
        Largest cosine-weighted part, 0 to 1, of the directions looked at from a point in which two lights of one group stand behind each
        other with an occluder between: bounds the relative error of that point's irradiance from those directions.
    meshes : list of MeshBlock
    occluders : str
        Hash over all shapes of the scene that can block light.
    versions : dict
        Versions of mi_shlight, mitsuba and drjit that baked it.
    """

    order: int
    transfer: str
    localised: bool
    distant: bool
    samples: int
    coeffs: np.ndarray = field(repr=False)
    visibility: np.ndarray = field(repr=False)
    variance: np.ndarray = field(repr=False)
    residual: np.ndarray = field(repr=False)
    cones: np.ndarray = field(repr=False)
    groups: np.ndarray
    outlines: list = field(repr=False)
    light_margin: float
    max_edge: float
    conflict: float
    meshes: list = field(repr=False)
    occluders: str
    versions: dict

    def save(self, path) -> None:
        """Write the bake to one compressed file (numpy's .npz format). The file appears only when it is complete.

        Raises
        ------
        OSError
            If the folder of `path` does not exist or cannot be written to.
        """
        path = check_output("Transfer.save", "path", path)
        header = {"format": FORMAT, "format_version": FORMAT_VERSION, **{name: getattr(self, name) for name in SCALARS},
                  "lights": len(self.outlines),
                  "meshes": [{k: v for k, v in asdict(b).items() if not isinstance(v, np.ndarray)} for b in self.meshes]}
        arrays = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8), "groups": self.groups,
                  **{name: getattr(self, name) for name in ARRAYS}}
        for i, outline in enumerate(self.outlines):
            arrays[f"outline_{i}"] = outline
        for i, block in enumerate(self.meshes):
            arrays.update({f"subdivision_{i}": block.subdivision, f"first_{i}": block.first, f"rows_{i}": block.rows})
        with replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **arrays)

    def check(self, scene, lit=None) -> None:
        """Raise ValueError unless the bake belongs to the geometry of `scene`; `lit`: its receivers, if they are known."""
        known = {block.content for block in self.meshes}
        strange = [r.name for r in lit or receivers(scene, keep_quiet) if r.baked and r.content not in known]
        if strange or self.occluders != occluder_hash(scene):
            what = (f"these meshes differ or are new: {', '.join(strange[:5])}" if strange
                    else "a shape that can cast shadows was added, removed or moved")
            raise ValueError(f"Transfer.check(): 'scene' must have the geometry it was baked for, got one where {what}. Bake again; "
                             "always load scenes with optimize=False (Mitsuba otherwise merges meshes in an order that changes from "
                             "load to load).")

    def fits(self, scene, lit=None) -> bool:
        """True if :py:meth:`check` would pass."""
        try:
            self.check(scene, lit)
        except ValueError:
            return False
        return True

    def look_up(self, lit: list, quality: bool = False) -> "TransferLookup":
        """Device-side tables for the receivers `lit` of a scene in the current variant; with `quality` those of errors, too."""
        return TransferLookup(self, lit, quality)


def load_transfer(path) -> Transfer:
    """Read a file written by :py:meth:`Transfer.save`.

    Raises
    ------
    FileNotFoundError
        If `path` does not exist.
    ValueError
        If it is not a transfer file, is damaged, or was written by an incompatible version. Nothing in the file is executed.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(message("load_transfer", "path", "be the path of a file", path))
    path = os.fspath(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(message("load_transfer", "path", "name an existing file", path,
                                        "Bake one with 'mi-shlight bake SCENE -o FILE'."))
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("it is of another format")
        with np.load(path, allow_pickle=False) as data:
            header = json.loads(bytes(data["header"]))
            if not isinstance(header, dict) or header.get("format") != FORMAT:
                raise ValueError("no mi_shlight header")
            if header["format_version"] != FORMAT_VERSION:
                raise ValueError(f"format version {header['format_version']}, this release reads {FORMAT_VERSION}; bake again")
            meshes = [MeshBlock(**block, subdivision=data[f"subdivision_{i}"], first=data[f"first_{i}"], rows=data[f"rows_{i}"])
                      for i, block in enumerate(header["meshes"])]
            outlines = [data[f"outline_{i}"] for i in range(header["lights"])]
            scalars = {name: header[name] for name in SCALARS}
            _check_scalars(scalars)
            result = Transfer(**scalars, **{name: data[name] for name in ARRAYS}, groups=data["groups"], outlines=outlines, meshes=meshes)
        shape = (len(result.groups) - 1 + result.distant, sum(b.row_count * (1 + b.two_sided) for b in meshes), (result.order + 1) ** 2)
        if result.coeffs.shape != shape:
            raise ValueError(f"coefficients of shape {result.coeffs.shape} where {shape} is due")
        for name, due in {"visibility": shape[:2], "variance": shape[:2], "residual": shape[:2], "cones": (*shape[:2], 4)}.items():
            if getattr(result, name).shape != due:
                raise ValueError(f"{name} of shape {getattr(result, name).shape} where {due} is due")
        if not all(np.isfinite(getattr(result, name)).all() for name in ARRAYS):
            raise ValueError("coefficients that are no numbers")
        if not np.array_equal(result.groups, light_groups(len(outlines))):
            raise ValueError(f"groups {result.groups.tolist()} of {len(outlines)} lights")
        for block in meshes:
            points = (block.subdivision.astype(np.int64) + 1) * (block.subdivision.astype(np.int64) + 2) // 2
            if (not np.array_equal(block.first, np.cumsum(points) - points) or len(block.rows) != points.sum()
                    or block.rows.max(initial=0) >= max(block.row_count, 1)):
                raise ValueError(f"the points of mesh '{block.name}' do not fit together")
        return result
    except Exception as error:                        # a damaged archive can make zipfile, zlib and numpy raise anything
        raise ValueError(message("load_transfer", "path", "name a file written by Transfer.save()", path,
                                 f"Reason: {str(error).rstrip('.')}.")) from None


def _check_scalars(scalars: dict) -> None:
    """Raise ValueError or TypeError unless the header's entries are what a bake writes."""
    check_order("load_transfer", scalars["order"])
    check_choice("load_transfer", "transfer", scalars["transfer"], KINDS)
    for name in ("localised", "distant"):
        if not isinstance(scalars[name], bool):
            raise TypeError(f"{name} is {scalars[name]!r}")
    check_integer("load_transfer", "samples", scalars["samples"], 1, 2**31)
    for name in ("light_margin", "max_edge", "conflict"):
        check_number("load_transfer", name, scalars[name], 0)


class TransferLookup:
    """Tables on the device that turn a ray hit into the rows and weights of its transfer vector."""

    DRJIT_STRUCT = dict.fromkeys(("baked", "first_face", "back", "subdivision", "first", "rows", "coeffs", "means", "row_count", "fit",
                                  "_variance", "_residual", "_cones", "_samples"), object)

    def __init__(self, transfer: Transfer, lit: list, quality: bool = False):
        blocks = {block.content: block for block in transfer.meshes}
        shapes = [(shape_index(r.shape), r, blocks.get(r.content)) for r in lit if r.baked]
        size = 1 + max((shape_index(r.shape) for r in lit), default=0)
        self.size, self.kind, self.localised = size, transfer.transfer, transfer.localised
        baked, first_face, back = np.zeros(size, bool), np.zeros(size, np.uint32), np.zeros(size, np.uint32)
        subdivision, first, rows = [], [], []
        faces = points = 0
        for number, receiver, block in shapes:
            if block is None:
                continue
            baked[number], first_face[number] = True, faces
            back[number] = block.row_count if block.two_sided else 0
            subdivision.append(block.subdivision)
            first.append(block.first + np.uint32(points))
            rows.append(block.rows + np.uint32(block.first_row))
            faces += len(block.first)
            points += len(block.rows)
        join = lambda parts: aligned(mi.UInt32, np.concatenate(parts) if parts else np.zeros(1, np.uint32))
        self.baked, self.first_face, self.back = (aligned(mi.UInt32, table) for table in (baked, first_face, back))
        self.subdivision, self.first, self.rows = join(subdivision), join(first), join(rows)
        flat = lambda values: aligned(mi.Float, values.ravel() if values.size else np.zeros(transfer.coeffs.shape[2]))
        self.coeffs, self.means = flat(transfer.coeffs), flat(transfer.visibility)
        self.fit = self._variance = self._residual = self._cones = self._samples = None
        if quality:
            self._samples = dr.opaque(mi.Float, transfer.samples)
            self.fit = cone_fit(transfer.order, transfer.samples) if transfer.localised else None
            self._variance, self._residual, self._cones = map(flat, (transfer.variance, np.sqrt(transfer.residual), transfer.cones))
        self.count, self.row_count = transfer.coeffs.shape[2], mi.UInt32(transfer.coeffs.shape[1])
        dr.make_opaque(self.row_count)                # a literal would compile the kernels of a picture anew for each bake

    def rows_at(self, pi, shape, back_side, active) -> tuple:
        """(rows, weights, valid) of a preliminary intersection `pi`: three baked points and their barycentric weights."""
        number = dr.reinterpret_array(mi.UInt32, shape)
        valid = active & (number < self.size)
        valid &= dr.gather(mi.UInt32, self.baked, number, valid) > 0
        face = pi.prim_index + dr.gather(mi.UInt32, self.first_face, number, valid)
        k = dr.gather(mi.UInt32, self.subdivision, face, valid)
        # On a miss Mitsuba leaves the coordinates undefined, NaN included.
        u, v = (dr.clip(dr.select(valid, c, 0), 0, 1) * k for c in dr.detach(pi.prim_uv))
        last = dr.select(k > 0, k, 1) - 1
        i, j = dr.minimum(mi.UInt32(u), last), dr.minimum(mi.UInt32(v), last)
        i = dr.minimum(i, last - j)
        fu, fv = dr.clip(u - i, 0, 1), dr.clip(v - j, 0, 1)
        upper = (fu + fv > 1) & (i + j < last)
        first = dr.gather(mi.UInt32, self.first, face, valid)
        offset = dr.select(back_side, dr.gather(mi.UInt32, self.back, number, valid), 0)

        def row(i, j):
            return dr.gather(mi.UInt32, self.rows, first + j * (k + 1) - j * (j - 1) // 2 + i, valid) + offset

        rows = [row(i + dr.select(upper, mi.UInt32(1), 0), j + dr.select(upper, mi.UInt32(1), 0)),
                row(dr.select(upper, i, i + 1), dr.select(upper, j + 1, j)),
                row(dr.select(upper, i + 1, i), dr.select(upper, j, j + 1))]
        total = dr.maximum(fu + fv, 1)                # rounding may leave the cell by an ulp
        w1, w2 = dr.select(upper, 1 - fu, fu / total), dr.select(upper, 1 - fv, fv / total)
        return rows, [1 - w1 - w2, w1, w2], valid

    def coefficients(self, rows, weights, valid, group, order: int) -> list:
        """Interpolated transfer vector of light group `group`: list of ``(order + 1)**2`` floats."""
        base = [(r + group * self.row_count) * self.count for r in rows]
        value = [mi.Float(0)] * (order + 1) ** 2
        for b, w in zip(base, weights):
            value = [dr.fma(dr.gather(mi.Float, self.coeffs, b + c, valid), w, t) for c, t in enumerate(value)]
        return value

    def visibility(self, rows, weights, valid, group):
        """Interpolated mean visibility of light group `group`, 0 to 1."""
        values = [dr.gather(mi.Float, self.means, row + group * self.row_count, valid) for row in rows]
        return sum((value * weight for value, weight in zip(values, weights)), mi.Float(0))

    def quality(self, rows, weights, valid, group) -> Quality:
        """What is known about the errors of the interpolated transfer vector; of a look-up made for it."""
        at = [row + group * self.row_count for row in rows]
        read = lambda table: [dr.gather(mi.Float, table, i, valid) for i in at]
        mean = lambda values: sum((value * weight for value, weight in zip(values, weights)), mi.Float(0))
        visible, cones = read(self.means), [dr.gather(mi.Vector4f, self._cones, i, valid) for i in at]
        axes, angles = [mi.Vector3f(*cone[:3]) for cone in cones], [cone[3] for cone in cones]
        axis = direction(sum((a * w for a, w in zip(axes, weights)), mi.Vector3f(0)))
        reach = [angle + 2 * dr.asin(dr.minimum(dr.norm(a - axis) / 2, 1)) for a, angle in zip(axes, angles)]
        v = mean(visible)
        return Quality(v, mean(read(self._residual)), mean([dr.select(a < math.pi - 1e-3, 0, v) for a, v in zip(angles, visible)]), axis,
                       dr.minimum(functools.reduce(dr.maximum, reach), math.pi),
                       dr.sqrt(sum((value * w * w for value, w in zip(read(self._variance), weights)), mi.Float(0))),
                       dr.sqrt(mean([dr.square(value - v) for value in visible])), self._samples)
