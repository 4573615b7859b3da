"""Random polygons and points that look at them, with every degenerate position in known proportion, and their coefficients.

A polygon has 3 to 12 corners and is stored with 12: entry i is its corner ``i * N // 12``. So all polygons fit into one array, and a list
of the 12 is the same polygon with coincident corners. Coordinates are float32 numbers: every precision sees the same polygon.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import numpy as np

from mi_shlight import project_polygon

CORNERS = 12
AXIS = np.arange(CORNERS)


@dataclass(frozen=True, eq=False)
class Polygons:
    """A number of polygons: vertices (count, 12, 3), points (count, 3), numbers of corners and index of the kind in NAMES (count,)."""

    vertices: np.ndarray
    x: np.ndarray
    corners: np.ndarray
    kind: np.ndarray

    def __len__(self):
        return len(self.x)

    def __getitem__(self, rows):
        return Polygons(self.vertices[rows], self.x[rows], self.corners[rows], self.kind[rows])

    def of(self, *names):
        """Mask: polygons of these kinds."""
        return np.isin(self.kind, [NAMES.index(name) for name in names])

    def outline(self, k):
        """Corners (N, 3) of polygon k without repetitions."""
        return self.vertices[k, -(-np.arange(self.corners[k]) * CORNERS // self.corners[k])]

    @cached_property
    def arcs(self):
        """Angles under which the edges are seen from `x`: (count, 12), in radians."""
        v = self.vertices - self.x[:, None]
        largest = np.abs(v).max(axis=-1, keepdims=True)
        v = v / np.where(largest > 0, largest, 1)
        w = np.roll(v, -1, axis=1)
        return np.arctan2(np.linalg.norm(np.cross(v, w), axis=-1), (v * w).sum(axis=-1))

    @cached_property
    def reach(self):
        """``sum 2 tan(T / 2)`` over the arcs T, (count,)."""
        return (2 * np.tan(np.minimum(self.arcs, np.pi - 1e-16) / 2)).sum(axis=1)


def polygons_from(cases) -> Polygons:
    """Polygons from pairs (list of corners, point); without a kind."""
    vertices = [np.asarray(v, dtype=np.float64)[AXIS * len(v) // CORNERS] for v, _ in cases]
    points = np.array([x for _, x in cases], dtype=np.float64)
    return Polygons(np.array(vertices), points, np.array([len(v) for v, _ in cases]), np.full(len(points), -1))


def wide(precision, rows):
    """Array (count, 3) as one wide vector."""
    dtype = np.dtype(np.float32 if precision.eps > 1e-10 else np.float64)
    return precision.Array3(*(precision.Float(_aligned(column, dtype)) for column in np.transpose(rows)))


def _aligned(values, dtype):
    """A copy at an address divisible by 64. Dr.Jit uses numpy's memory as it is, and compiles a kernel anew for another alignment."""
    memory = np.empty(len(values) * dtype.itemsize + 64, np.uint8)
    start = -memory.ctypes.data % 64
    copy = memory[start:start + len(values) * dtype.itemsize].view(dtype)
    copy[:] = values
    return copy


def coefficients(precision, polygons: Polygons, order: int, method: str, lists) -> np.ndarray:
    """Coefficients ((order + 1)**2, count) by `project_polygon`: of wide lists with as many corners as the polygons have where
    that is one of `lists`, otherwise of lists of all 12."""
    out = np.zeros(((order + 1) ** 2, len(polygons)))
    for corners in (*lists, CORNERS):
        rows = np.flatnonzero(polygons.corners == corners if corners in lists else ~np.isin(polygons.corners, lists))
        if len(rows):
            keep = -(-np.arange(corners) * CORNERS // corners)
            v = [wide(precision, polygons.vertices[rows, k]) for k in keep]
            coeffs = project_polygon(v, wide(precision, polygons.x[rows]), order, method)
            dr.eval(coeffs)
            out[:, rows] = coeffs
    return out


def random_polygons(count: int, seed: int) -> Polygons:
    """`count` polygons of all kinds, in order of their kinds, the shares as in KINDS."""
    rng = np.random.default_rng(seed)
    shares = np.cumsum([0.0, *(share for _, share in KINDS.values())])
    bounds = np.rint(shares / shares[-1] * count).astype(int)
    vertices, x = np.zeros((count, CORNERS, 3)), np.zeros((count, 3))
    corners = np.where(rng.random(count) < 0.5, rng.integers(3, 5, count), rng.integers(5, CORNERS + 1, count))
    kind = np.zeros(count, dtype=int)
    for k, (make, _) in enumerate(KINDS.values()):
        rows = slice(bounds[k], bounds[k + 1])
        vertices[rows], x[rows] = make(rng, corners[rows])
        kind[rows] = k
    as_float32 = lambda a: a.astype(np.float32).astype(np.float64)
    stretch = AXIS * corners[:, None] // CORNERS
    return Polygons(as_float32(np.take_along_axis(vertices, stretch[..., None], axis=1)), as_float32(x), corners, kind)


def random_rotations(rng, count):
    q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return q * np.linalg.det(q)[:, None, None]


def _log_uniform(rng, low, high, shape):
    return 10.0 ** rng.uniform(low, high, shape)


def _outline(rng, corners, shape="any"):
    """Simple polygons of size 1 about the origin of the plane (count, 12, 2), counter-clockwise; what follows the last corner is unused."""
    count = len(corners)
    angle = (AXIS + rng.uniform(0, 0.8, (count, CORNERS))) * 2 * np.pi / corners[:, None]
    convex, rough = np.ones((count, CORNERS)), rng.uniform(0.2, 1, (count, CORNERS))
    star = np.where(AXIS % 2, rng.uniform(0.2, 0.5, (count, 1)), 1)
    choice = {"convex": 0, "rough": 1, "star": 2}.get(shape, rng.integers(0, 3, (count, 1)))
    radius = np.choose(choice, [convex, rough, np.broadcast_to(star, convex.shape)])
    return radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _placed(rng, flat, point):
    """Polygons of the plane z = 0 and points, both turned at random and moved: the light, the point, or neither to the origin."""
    count = len(point)
    turn = np.swapaxes(random_rotations(rng, count), 1, 2)
    if flat.shape[-1] == 2:
        flat = np.concatenate([flat, np.zeros_like(flat[..., :1])], axis=-1)
    vertices, x = flat @ turn, (point[:, None] @ turn)[:, 0]
    shift = np.choose(rng.integers(0, 3, (count, 1)), [np.zeros_like(x), -x, rng.normal(size=x.shape) * np.linalg.norm(x, axis=1)[:, None]])
    return vertices + shift[:, None], x + shift


def _directions(rng, count):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def _either_side(rng, along, height):
    """Points at `along` from the axis and `height` above or below the plane."""
    azimuth = rng.uniform(0, 2 * np.pi, len(height))
    return np.stack([along * np.cos(azimuth), along * np.sin(azimuth), height * rng.choice([-1, 1], len(height))], axis=1)


def _moderate(shape):
    def make(rng, corners):
        count = len(corners)
        return _placed(rng, _outline(rng, corners, shape), _either_side(rng, rng.uniform(0, 2, count), rng.uniform(0.3, 3, count)))
    return make


def _distant(rng, corners):
    return _placed(rng, _outline(rng, corners), _directions(rng, len(corners)) * _log_uniform(rng, 1, 6, (len(corners), 1)))


def _tiny(rng, corners):
    """As distant, but the corners' own rounding matters."""
    vertices, x = _distant(rng, corners)
    scale = 1 / np.linalg.norm(x - vertices[:, 0], axis=1)[:, None]
    return (vertices - x[:, None]) * scale[:, None], np.zeros_like(x)


def _huge(low, high):
    def make(rng, corners):
        count = len(corners)
        size = _log_uniform(rng, low, high, count)
        point = _either_side(rng, size * _log_uniform(rng, -3, 0.1, count), rng.uniform(0.3, 1, count))
        return _placed(rng, _outline(rng, corners) * size[:, None, None], point)
    return make


def _grazing(rng, corners):
    count = len(corners)
    return _placed(rng, _outline(rng, corners), _either_side(rng, rng.uniform(1.2, 3, count), _log_uniform(rng, -7, 0, count)))


def _close_above(rng, corners):
    count = len(corners)
    return _placed(rng, _outline(rng, corners), _either_side(rng, rng.uniform(0, 0.1, count), _log_uniform(rng, -7, 0, count)))


def _sliver(rng, corners):
    count = len(corners)
    width = np.stack([np.ones(count), _log_uniform(rng, -7, 0, count)], axis=1)
    return _placed(rng, _outline(rng, corners) * width[:, None], _either_side(rng, rng.uniform(0, 2, count), rng.uniform(0.1, 2, count)))


def _uneven(rng, corners):
    """Corners off the plane, from rounding to a third of the size."""
    count = len(corners)
    height = rng.normal(size=(count, CORNERS, 1)) * _log_uniform(rng, -7, -0.5, (count, 1, 1))
    flat = np.concatenate([_outline(rng, corners), height], axis=-1)
    return _placed(rng, flat, _either_side(rng, rng.uniform(0, 2, count), rng.uniform(0.3, 3, count)))


def _scaled(low, high):
    def make(rng, corners):
        vertices, x = _moderate("any")(rng, corners)
        scale = _log_uniform(rng, low, high, (len(corners), 1))
        return vertices * scale[:, None], x * scale
    return make


def _lattice(rng, corners):
    """(vertices, sides): polygons with whole coordinates in a plane of whole directions, and two such directions; exact in float32."""
    count = len(corners)
    sides = rng.integers(-8, 9, (count, 2, 3)).astype(float)
    sides[~np.cross(sides[:, 0], sides[:, 1]).any(axis=1)] = np.eye(3)[:2]
    return np.rint(_outline(rng, corners) * 16) @ sides * 4, sides * 4


def _pick(rng, vertices, corners, step=0):
    """A random corner of each polygon, and the one `step` corners after it."""
    i = rng.integers(0, corners)
    rows = np.arange(len(corners))
    return vertices[rows, i], vertices[rows, (i + step) % corners]


def _seen_from(rng, vertices, x, moved=0.0):
    """The polygons from points `moved` away from `x`; half of them shifted, exactly, until `x` is the origin."""
    shift = np.where(rng.integers(0, 2, (len(x), 1)), x, 0)
    return vertices - shift[:, None], x - shift + moved


def _in_plane(low, high):
    def make(rng, corners):
        vertices, sides = _lattice(rng, corners)
        along = rng.integers(low, high + 1, (len(corners), 1, 2)) * rng.choice([-1, 1], (len(corners), 1, 2))
        return _seen_from(rng, vertices, (along @ sides)[:, 0])
    return make


def _on_edge(shares):
    """On the line through an edge: at these shares of its length from its start."""
    def make(rng, corners):
        vertices, _ = _lattice(rng, corners)
        a, b = _pick(rng, vertices, corners, 1)
        return _seen_from(rng, vertices, a + (b - a) * rng.choice(shares, (len(corners), 1)))
    return make


def _near(make):
    """The same positions, left by 1e-7 to 1e-2 of the polygon's size in any direction."""
    def near(rng, corners):
        vertices, x = make(rng, corners)
        size = np.abs(vertices - x[:, None]).max(axis=(1, 2))
        moved = _directions(rng, len(corners)) * (size * _log_uniform(rng, -7, -2, len(corners)))[:, None]
        return vertices - x[:, None], moved
    return near


def _between_corners(rng, corners):
    """Two corners in opposite directions, neighbours only in triangles; in half of the cases the others are off the plane."""
    vertices, _ = _lattice(rng, corners)
    i, rows = rng.integers(0, corners), np.arange(len(corners))
    j = (i + 2) % corners
    x = (vertices[rows, i] + vertices[rows, j]) / 2
    off = rng.integers(-64, 65, vertices.shape) * rng.integers(0, 2, (len(corners), 1, 1))
    off[rows, i] = off[rows, j] = 0
    return _seen_from(rng, vertices + off, x)


def _replaced(new):
    """Polygons one or more of whose corners i are replaced by ``new(corner i - 1, corner i + 1)``."""
    def make(rng, corners):
        vertices, sides = _lattice(rng, corners)
        height = np.cross(sides[:, 0], sides[:, 1]) * rng.integers(1, 9, (len(corners), 1))
        point = (rng.integers(-30, 31, (len(corners), 1, 2)) @ sides)[:, 0] + height
        for i in range(1, CORNERS - 1):
            chosen = (rng.random(len(corners)) < 0.3) & (i + 1 < corners)
            vertices[chosen, i] = new(vertices[chosen, i - 1], vertices[chosen, i + 1])
        return _seen_from(rng, vertices, point)
    return make


def _on_a_line(rng, corners):
    count = len(corners)
    along, start = rng.integers(-8, 9, (count, 1, 3)), rng.integers(-8, 9, (count, 1, 3))
    vertices = (start + along * rng.integers(-8, 9, (count, CORNERS, 1))).astype(float)
    passing = rng.integers(0, 3, (count, 1)) > 0      # otherwise the point lies on the line, perhaps in a corner
    return _seen_from(rng, vertices, np.where(passing, rng.integers(-8, 9, (count, 3)), vertices[:, 0]).astype(float))


def _one_point(rng, corners):
    count = len(corners)
    corner = rng.normal(size=(count, 1, 3))
    return np.repeat(corner, CORNERS, axis=1), np.where(rng.integers(0, 2, (count, 1)), corner[:, 0], rng.normal(size=(count, 3)))


def _whole_numbers(rng, corners):
    """Any closed polygon on a coarse grid, crossing itself, out of plane, with zeros of both signs."""
    count = len(corners)
    vertices = rng.integers(-2, 3, (count, CORNERS, 3)).astype(float)
    return np.where(vertices == 0, rng.choice([0.0, -0.0], vertices.shape), vertices), np.zeros((count, 3))


def _axis_aligned(rng, corners):
    """Polygons in planes z = const and the like, corners on the axes and edges in coordinate planes through the point."""
    count = len(corners)
    flat = np.rint(_outline(rng, corners) * rng.choice([2, 4, 8], (count, 1, 1)))
    flat = flat + rng.integers(-2, 3, (count, 1, 2))
    vertices = np.concatenate([flat, np.broadcast_to(rng.choice([-2.0, -1, 1, 2], (count, 1, 1)), flat[..., :1].shape)], axis=-1)
    order = np.argsort(rng.random((count, 1, 3)), axis=-1)
    return np.take_along_axis(vertices, order, axis=2), np.zeros((count, 3))


_on_corner, _inside_edge = _on_edge([0.0]), _on_edge([0.25, 0.5, 0.75])

# Name -> (maker of corners and points from (rng, numbers of corners), share)
KINDS = {
    "convex": (_moderate("convex"), 2),
    "non-convex": (_moderate("rough"), 2),
    "star": (_moderate("star"), 2),
    "uneven": (_uneven, 1),
    "axis-aligned": (_axis_aligned, 2),
    "tiny": (_tiny, 2),
    "distant": (_distant, 2),
    "huge": (_huge(1, 6), 1),
    "hemisphere": (_huge(3, 12), 1),
    "grazing": (_grazing, 2),
    "close above": (_close_above, 2),
    "sliver": (_sliver, 2),
    "scaled": (_scaled(-30, 30), 1),
    "denormal": (_scaled(-45, -38), 1),
    "in its plane, inside": (_in_plane(0, 1), 1),
    "in its plane, outside": (_in_plane(20, 40), 1),
    "on an edge": (_inside_edge, 1),
    "in line with an edge": (_on_edge([-1.0, 2.0]), 1),
    "on a corner": (_on_corner, 1),
    "near its plane, inside": (_near(_in_plane(0, 1)), 1),
    "near its plane, outside": (_near(_in_plane(20, 40)), 1),
    "near an edge": (_near(_inside_edge), 1),
    "near an edge's line": (_near(_on_edge([-1.0, 2.0])), 1),
    "near a corner": (_near(_on_corner), 1),
    "antipodal corners": (_between_corners, 1),
    "coincident corners": (_replaced(lambda before, after: before), 1),
    "collinear corners": (_replaced(lambda before, after: (before + after) / 2), 1),
    "spikes": (_replaced(lambda before, after: 2 * after - before), 1),
    "on a line": (_on_a_line, 1),
    "one point": (_one_point, 1),
    "whole numbers": (_whole_numbers, 1),
}
NAMES = tuple(KINDS)
