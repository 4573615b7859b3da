"""Derivatives of the light that a floor reflects, for a polygonal light that moves, in plain numpy: exact, and as a band limit leaves them.

Only the light's outline moves ([W20] section 5 differentiates the same way), so the radiance ``L_r = int_Q f(omega) d omega`` changes by

    dL_r/dt = sum over edges  int_0^1 f(omega(s)) r(s) . (u(s) x e) / |r(s)|^3 ds ,                                          (1)

r(s) = p_i + s e - x the point on the edge, e = p_j - p_i, u(s) its velocity: the area that the edge sweeps, seen from x. With
``f = rho V max(0, n . omega) / pi`` this is the true derivative, with the order-n projection of f the one that a renderer with the same
baked visibility should give. Nothing of the package's own light integrals is used; shared is ``sh_basis``, which tests judge on its own.

Floors face +y; lights and occluders are convex, lie above the floor, the occluder between the two.
"""
from __future__ import annotations

import functools

import drjit as dr
import numpy as np
from drjit.llvm.ad import Array3f64, Float64

from mi_shlight import sh_basis

NODES = 16
"""Gauss-Legendre points on each visible piece of an edge."""
SIZES = 10
"""And of the sizes through which a light grows."""
SPHERE = 48, 144
"""Directions of the projection: heights and azimuths over the hemisphere."""
LANES = 1 << 20
"""Directions looked at together."""


def edges_of(vertices: np.ndarray):
    return zip(vertices, np.roll(vertices, -1, axis=0))


def hidden_part(start: np.ndarray, end: np.ndarray, points: np.ndarray, occluder: np.ndarray) -> np.ndarray:
    """Bounds (P, 2) in [0, 1] of the piece of each segment `start` + s (`end` - `start`) that a convex occluder hides from `points`; equal
    where it hides nothing.
    """
    bounds = np.tile([0.0, 1.0], (len(points), 1))
    turn = np.sign(np.linalg.det(occluder[:3] - points[0]))
    for a, b in edges_of(occluder):
        plane = turn * np.cross(a - points, b - points)
        at_start, slope = (plane * (start - points)).sum(axis=1), plane @ (end - start)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -at_start / slope
        bounds[:, 0] = np.where(slope > 0, np.maximum(bounds[:, 0], crossing), bounds[:, 0])
        bounds[:, 1] = np.where(slope < 0, np.minimum(bounds[:, 1], crossing), bounds[:, 1])
        bounds[(slope == 0) & (at_start < 0)] = 0
    bounds[bounds[:, 0] >= bounds[:, 1]] = 0
    return bounds


def outline_rate(vertices: np.ndarray, velocity: np.ndarray, points: np.ndarray, integrand, pieces) -> np.ndarray:
    """Equation (1) at `points` (P, 3) for several functions at once, (P, N). `integrand(omega)`: their values (P, K, N) in directions
    (P, K, 3), K for each point; `pieces(start, end)`: list of (P, 2) bounds of what is integrated of an edge.
    """
    node, weight = np.polynomial.legendre.leggauss(NODES)
    total = 0
    for (start, end), (v_start, v_end) in zip(edges_of(vertices), edges_of(velocity)):
        for bounds in pieces(start, end):
            length = bounds[:, 1:] - bounds[:, :1]
            s = (bounds[:, :1] + length * (node + 1) / 2)[..., None]
            r = start + s * (end - start) - points[:, None]
            distance = np.linalg.norm(r, axis=2)
            swept = (r * np.cross(v_start + s * (v_end - v_start), end - start)).sum(axis=2) / distance ** 3
            total = total + np.einsum("pkn,pk->pn", integrand(r / distance[..., None]), swept * weight * length / 2)
    return total


def whole(points):
    return lambda start, end: [np.tile([0.0, 1.0], (len(points), 1))]


def visible(points, occluder):
    """Pieces of an edge beside the occluder."""
    def pieces(start, end):
        hidden = hidden_part(start, end, points, occluder)
        zero = np.zeros(len(points))
        return [np.stack([zero, hidden[:, 0]], axis=1), np.stack([hidden[:, 1], zero + 1], axis=1)]
    return pieces


def exact_rate(vertices, velocity, points, occluder=None) -> np.ndarray:
    """Derivative of the radiance of a white floor (P,) under a light of unit radiance, shadows included."""
    pieces = whole(points) if occluder is None else visible(points, occluder)
    return outline_rate(vertices, velocity, points, lambda omega: omega[..., 1:2] / np.pi, pieces)[:, 0]


def coefficient_rate(vertices, velocity, points, order: int) -> np.ndarray:
    """Derivative of the light's coefficients, (P, (order + 1)**2). Times :py:func:`transfer`, summed up to a lower order, it is what that
    order leaves of :py:func:`exact_rate`.
    """
    return outline_rate(vertices, velocity, points, lambda omega: basis(omega, order), whole(points))


def grown(rate, vertices) -> np.ndarray:
    """What ``rate(vertices, velocity)`` is the derivative of: the light grows from its centroid."""
    centre = vertices.mean(axis=0)
    node, weight = np.polynomial.legendre.leggauss(SIZES)
    return sum(w / 2 * rate(centre + s * (vertices - centre), vertices - centre) for s, w in zip((node + 1) / 2, weight))


def columns(rows: np.ndarray) -> Array3f64:
    return Array3f64(*(Float64(np.ascontiguousarray(rows[..., c].ravel())) for c in range(3)))


def basis(omega: np.ndarray, order: int) -> np.ndarray:
    values = sh_basis(columns(omega), order)
    dr.eval(values)
    return np.stack([np.broadcast_to(np.array(v), omega[..., 0].size) for v in values], axis=1).reshape(*omega.shape[:-1], -1)


def sphere() -> tuple:
    """Directions (K, 3) of the hemisphere about +y and their solid angles (K,)."""
    node, weight = np.polynomial.legendre.leggauss(SPHERE[0])
    height, azimuth = (node + 1) / 2, (np.arange(SPHERE[1]) + 0.5) * (2 * np.pi / SPHERE[1])
    radius = np.sqrt(1 - height ** 2)
    omega = np.stack(np.broadcast_arrays(radius[:, None] * np.cos(azimuth), height[:, None], radius[:, None] * np.sin(azimuth)), axis=-1)
    return omega.reshape(-1, 3), np.repeat(weight / 2 * (2 * np.pi / SPHERE[1]), SPHERE[1])


def transfer(points, order: int, vertices, occluder=None, margin: float = 0.0) -> np.ndarray:
    """Coefficients (P, (order + 1)**2) of ``V n . omega / pi``, V as a bake with `light_margin` = `margin` defines it: for directions that
    pass the light's outline by more than `margin`, that of the nearest direction that does not.
    """
    omega, weight = sphere()
    table = basis(omega, order) * (weight * omega[:, 1] / np.pi)[:, None]
    if occluder is None:
        return np.tile(table.sum(axis=0), (len(points), 1))
    rows = []
    for part in np.array_split(points, 1 + len(points) * len(omega) // LANES):
        x, d = columns(np.repeat(part, len(omega), axis=0)), columns(np.tile(omega, (len(part), 1)))
        seen = ~inside(corners_from(occluder, x), towards(corners_from(vertices, x), d, margin))
        rows.append(np.array(seen).reshape(len(part), -1) @ table)
    return np.concatenate(rows)


def corners_from(vertices: np.ndarray, x) -> list:
    return [Array3f64(*map(float, v)) - x for v in vertices]


def inside(v: list, omega):
    """True for directions in the convex cone of `v`, of either orientation."""
    heights = [dr.dot(dr.cross(a, b), omega) for a, b in zip(v, v[1:] + v[:1])]
    low, high = functools.reduce(dr.minimum, heights), functools.reduce(dr.maximum, heights)
    return (low > 0) | (high < 0)


def towards(v: list, omega, margin: float):
    """Directions in which visibility is looked up: `omega` itself, or the nearest that passes the outline `v` by no more than `margin`."""
    near, nearest, distance = Float64(-2), Array3f64(0), Float64(0)
    for v_i, v_j in zip(v, v[1:] + v[:1]):
        a, b = dr.normalize(v_i), dr.normalize(v_j)
        normal = dr.normalize(dr.cross(a, b))
        q = dr.normalize(omega - normal * dr.dot(omega, normal))
        within = (dr.dot(q, dr.cross(normal, a)) > 0) & (dr.dot(q, dr.cross(normal, b)) < 0)
        q = dr.select(within, q, dr.select(dr.dot(omega, a) > dr.dot(omega, b), a, b))
        s_i, s_j = dr.norm(dr.cross(v_i, q)), dr.norm(dr.cross(q, v_j))
        cos, reach = dr.dot(q, omega), dr.norm(v_i + s_i / (s_i + s_j) * (v_j - v_i))
        near, nearest, distance = (dr.select(cos > near, new, old) for new, old in ((cos, near), (q, nearest), (reach, distance)))
    across = omega - nearest * near
    angle = dr.minimum(dr.atan(margin / distance), dr.acos(dr.minimum(near, 1)))
    moved = nearest * dr.cos(angle) + across * (dr.sin(angle) / dr.maximum(dr.norm(across), 1e-300))
    return dr.select(inside(v, omega), omega, moved)
