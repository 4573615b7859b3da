"""Claim: what [G03] prints comes out of ``mi_shlight.sh``, or the paper has a slip; 10,000 random rotations do as rotations should.

    python -m validation.green [--quick] [--rotations N] [--order N] [--out DIR]

writes ``green.json`` and, after the figures of the paper, ``green_samples.png`` (3, 4), ``green_basis.png`` (5), ``green_light.png`` (6
to 8), ``green_matrices.png`` (9, X90), ``green_product.png`` (10), ``green_renders.png`` (11, 13, 15; validation/green_renders.py),
``green_windows.png`` (the cure it names for the fins of 8), ``green_skies.png`` (16 to 18), ``green_probe.png`` (19):

- **samples**: directions by its equation 4, 10,000 in 100 x 100 cells and as many without cells: how far the basis of order 3 is from
  orthonormal over them.
- **legendre**: its three rules for associated Legendre polynomials against the basis, to order 8.
- **equation_10**: ratio of the printed Cartesian polynomials to the basis.
- **example_light**: exact coefficients of the light of its Figure 7, standard error of its 10,000 stratified samples, printed ones.
- **light_by_order**: relative L2 error of what an order makes of that light.
- **product**: the transfer matrix of the mask y_2^2, number of its entries that are not 0, and what it makes of the light of 25
  coefficients against the projection of light times mask; for the light itself, without a band limit, that is not the same.
- **matrices**: printed X90 and Z, and the ZYZ matrix of equation 11, as rotations of ours.
- **cap**: Maple's coefficients ("synth_light") against :py:func:`mi_shlight.environment.cap.project_cap`.
- **skies**: the three CIE skies, by :py:func:`mi_shlight.environment.sky.project_sky` and by brute force, and what each order leaves out.
- **probe**: a sky and a cap drawn as an angle map of 256 x 256 pixels, projected, against their own projection.
- **renders**: a cup by unshadowed, shadowed and interreflected transfer of 25 coefficients, the first against the exact shading, the
  others against ``path``.
- **rotations**: largest error over random rotations of orthogonality, composition, inverse, and of turned coefficients against the
  projection of the turned function, which is exact; in float32 also against float64.
- **windows**: overshoot, undershoot and error of a cap and a hemisphere by order and window.
"""
from __future__ import annotations

import math
import pathlib
from typing import NamedTuple

import drjit as dr
import matplotlib
import numpy as np
from drjit.llvm.ad import Array3f, Float
from scipy.spatial.transform import Rotation

from mi_shlight import project_angle_map
from mi_shlight.environment.cap import project_cap
from mi_shlight.environment.sky import SKIES, cie_sky, project_sky
from mi_shlight.sh import (gaunt, project_function, project_function_stratified, reconstruct, rotate, rotate_frame, rotation_matrices,
                           sphere_quadrature, window)
from mi_shlight.sh.lobes import sh_matrix
from mi_shlight.sh.windows import KINDS
from validation.experiment import options, print_targets, verdict, write

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

SUN = (-math.cos(math.radians(35)), 0.0, math.sin(math.radians(35)))
POSITIVE, NEGATIVE = np.array([0.3, 0.9, 0.35]), np.array([1.0, 0.25, 0.2])
LAMP = np.array([0.6, -0.5, 0.62])
BATCH = 200


class Plan(NamedTuple):
    """Sizes to measure."""

    rotations: int = 10_000
    order: int = 20
    latitudes: int = 500
    """Of quadrature over the sphere."""
    detail: int = 60
    """Of drawn lobes."""
    renders: tuple = (24_000, 128, 64, 2048, 512)
    """Triangles, pixels along a side, their samples, those of references, and rays of a bake."""


QUICK = Plan(rotations=20, order=6, latitudes=100, detail=16, renders=(2000, 32, 4, 64, 32))

EQUATION_10 = {
    (0, 0): lambda x, y, z: 1 / 2 * math.sqrt(1 / math.pi) + 0 * x,
    (1, -1): lambda x, y, z: 1 / 2 * math.sqrt(3 / math.pi) * y,
    (1, 0): lambda x, y, z: 1 / 2 * math.sqrt(3 / math.pi) * z,
    (1, 1): lambda x, y, z: 1 / 2 * math.sqrt(3 / math.pi) * x,
    (2, -2): lambda x, y, z: 1 / 2 * math.sqrt(15 / math.pi) * y * x,
    (2, -1): lambda x, y, z: 1 / 2 * math.sqrt(15 / math.pi) * y * z,
    (2, 0): lambda x, y, z: 1 / 4 * math.sqrt(5 / math.pi) * (2 * z * z - x * x - y * y),
    (2, 1): lambda x, y, z: 1 / 2 * math.sqrt(15 / math.pi) * z * x,
    (2, 2): lambda x, y, z: 1 / 2 * math.sqrt(15 / math.pi) * (x * x - y * y),
}

PRINTED_LIGHT = (0.39925, -0.21075, 0.28687, 0.28277, -0.31530, -0.00040, 0.13159, 0.00098, -0.09359,
                 -0.00072, 0.12290, 0.30458, -0.16427, -0.00062, -0.09126)
MISSING = 9
"""Flat index of the coefficient that is not printed: the others fit only so."""

H, T = 0.5, math.sqrt(3) / 2
PRINTED_X_MINUS_90 = np.array([
    [1, 0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0, 0, 0, 0], [0, -1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0, 0],
    [0, 0, 0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, -1, 0, 0, 0], [0, 0, 0, 0, 0, 0, -H, 0, -T], [0, 0, 0, 0, -1, 0, 0, 0, 0],
    [0, 0, 0, 0, 0, 0, -T, 0, H]])
PRINTED_X_PLUS_90 = np.array([
    [1, 0, 0, 0, 0, 0, 0, 0, 0], [0, 0, -1, 0, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0, 0],
    [0, 0, 0, 0, 0, 0, 0, -1, 0], [0, 0, 0, 0, 0, -1, 0, 0, 0], [0, 0, 0, 0, 0, 0, -H, 0, -T], [0, 0, 0, 0, 1, 0, 0, 0, 0],
    [0, 0, 0, 0, 0, 0, -T, 0, H]])


def printed_z(a: float) -> np.ndarray:
    c, s, c2, s2 = math.cos(a), math.sin(a), math.cos(2 * a), math.sin(2 * a)
    return np.array([
        [1, 0, 0, 0, 0, 0, 0, 0, 0], [0, c, 0, s, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0, 0, 0, 0], [0, -s, 0, c, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, c2, 0, 0, 0, s2], [0, 0, 0, 0, 0, c, 0, s, 0], [0, 0, 0, 0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, -s, 0, c, 0],
        [0, 0, 0, 0, -s2, 0, 0, 0, c2]])


def printed_equation_11(alpha: float, beta: float, gamma: float) -> np.ndarray:
    (ca, sa), (cb, sb), (cg, sg) = ((math.cos(a), math.sin(a)) for a in (alpha, beta, gamma))
    return np.array([[1, 0, 0, 0], [0, ca * cg - sa * sg * cb, sa * sb, ca * sg + sa * cg * cb], [0, sg * sb, cb, -cg * sb],
                     [0, -ca * sg * cb - sa * cg, ca * sb, ca * cg * cb - sa * sg]])


def light(directions: np.ndarray) -> np.ndarray:
    """The light of Figure 7, with the brackets that its picture has: the 3 is taken off within the second maximum."""
    theta, phi = np.arccos(np.clip(directions[:, 2], -1, 1)), np.arctan2(directions[:, 1], directions[:, 0])
    return np.maximum(0, 5 * np.cos(theta) - 4) + np.maximum(0, -4 * np.sin(theta - math.pi) * np.cos(phi - 2.5) - 3)


def light_coefficients(order: int) -> np.ndarray:
    """Exact: two functions max(0, a t - b) of the cosine t with an axis, whose zonal coefficients are integrals of polynomials."""
    total = np.zeros((order + 1) ** 2)
    for a, b, axis in ((5, 4, (0, 0, 1)), (4, 3, (math.cos(2.5), math.sin(2.5), 0))):
        nodes, weights = np.polynomial.legendre.leggauss(order // 2 + 2)
        t = (1 + b / a) / 2 + (1 - b / a) / 2 * nodes
        legendre = np.polynomial.legendre.legvander(t, order)
        zonal = 2 * math.pi * (weights * (1 - b / a) / 2 * (a * t - b)) @ legendre
        total += np.repeat(zonal, 2 * np.arange(order + 1) + 1) * sh_matrix(np.array([axis]), order)[0]
    return total


def dense(rotation: np.ndarray, order: int, unsigned: bool = False) -> np.ndarray:
    """Matrix of all degrees; `unsigned`: for harmonics without the sign (-1)^m."""
    out = np.zeros(((order + 1) ** 2,) * 2)
    for l, block in enumerate(rotation_matrices(rotation, order)):
        out[l * l:(l + 1) ** 2, l * l:(l + 1) ** 2] = block
    if unsigned:
        sign = np.array([(-1) ** (m % 2) for l in range(order + 1) for m in range(-l, l + 1)])
        out *= sign[:, None] * sign
    return out


def equation_10() -> dict:
    """Printed over ours at random directions: one number for each function."""
    d = np.random.default_rng(0).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    basis, rows = sh_matrix(d, 2), {}
    for (l, m), polynomial in EQUATION_10.items():
        ratio = polynomial(*d.T) / basis[:, l * (l + 1) + m]
        rows[f"{l},{m}"] = {"printed_over_ours": float(np.median(ratio)), "spread": float(np.ptp(ratio))}
    return rows


def example_light(latitudes: int = 1000) -> dict:
    exact = light_coefficients(3)
    samples, error = project_function_stratified(light, 3, 10_000, seed=1)
    rows = []
    for i, coefficient in enumerate(exact):
        printed = None if i == MISSING else PRINTED_LIGHT[i - (i > MISSING)]
        rows.append({"index": i, "exact": coefficient, "ours_10000_samples": samples[i], "standard_error": error[i], "printed": printed,
                     "deviations": None if printed is None else (printed - coefficient) / error[i]})
    return {"coefficients": rows, "exact_against_quadrature": abs(project_function(light, 3, latitudes=latitudes) - exact).max()}


def printed_samples(side: int, stratified: bool, seed: int = 0) -> np.ndarray:
    """(theta, phi) of side^2 directions by equation 4, one in each of side x side cells, or anywhere."""
    rng = np.random.default_rng(seed)
    x, y = rng.random((2, side, side))
    if stratified:
        x, y = (np.arange(side)[:, None] + x) / side, (np.arange(side) + y) / side
    return np.stack([2 * np.arccos(np.sqrt(1 - x)), 2 * np.pi * y], axis=-1).reshape(-1, 2)


def on_sphere(theta, phi) -> np.ndarray:
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def samples(side: int = 100) -> dict:
    """Largest entry of ``4 pi mean Y_i Y_j - delta_ij``, as the weight must be; "1 / 4 pi" is printed, and 4 pi used in the code."""
    rows = {"count": side * side}
    for name, stratified in (("stratified", True), ("independent", False)):
        basis = sh_matrix(on_sphere(*printed_samples(side, stratified).T), 3)
        rows[name] = abs(4 * math.pi * basis.T @ basis / len(basis) - np.eye(16)).max()
    return rows


def printed_legendre(l: int, m: int, x: np.ndarray) -> np.ndarray:
    """``P_l^m`` by the paper's rules 2, 3 and 1."""
    below = (-1) ** m * math.prod(range(1, 2 * m, 2)) * (1 - x * x) ** (m / 2)
    if l == m:
        return below
    value = x * (2 * m + 1) * below
    for degree in range(m + 2, l + 1):
        value, below = (x * (2 * degree - 1) * value - (degree + m - 1) * below) / (degree - m), value
    return value


def legendre(order: int = 8) -> dict:
    """Largest difference of the rules from our basis along the meridian of x, over the largest value of each."""
    theta, worst = np.linspace(0, math.pi, 361), 0.0
    basis = sh_matrix(on_sphere(theta, 0 * theta), order)
    for l in range(order + 1):
        for m in range(l + 1):
            scale = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m) * (2 if m else 1))
            ours = basis[:, l * (l + 1) + m]
            worst = max(worst, abs(scale * printed_legendre(l, m, np.cos(theta)) - ours).max() / abs(ours).max())
    return {"order": order, "largest_difference": worst}


def light_by_order(orders=(1, 2, 3, 5, 8, 14)) -> dict:
    directions, weights = sphere_quadrature(200)
    values = light(directions)
    return {n: relative(light_coefficients(n), values, directions, weights) for n in orders}


def mask_matrix(order: int = 4) -> np.ndarray:
    """Matrix ``int y_2^2 y_i y_j`` of equation 8."""
    table, matrix = gaunt(2, order, order), np.zeros(((order + 1) ** 2,) * 2)
    chosen = table.indices[:, 0] == 8
    matrix[tuple(table.indices[chosen][:, 1:].T)] = table.values[chosen]
    return matrix


def mask(directions: np.ndarray) -> np.ndarray:
    return sh_matrix(directions, 2)[:, 8]


def product(latitudes: int = 500, order: int = 4) -> dict:
    matrix, coeffs = mask_matrix(order), light_coefficients(order)
    limited = project_function(lambda d: mask(d) * reconstruct(coeffs, d), order)
    unlimited = project_function(lambda d: mask(d) * light(d), order, latitudes=latitudes)
    size = np.linalg.norm(limited)
    return {"entries": int((abs(matrix) > 1e-12).sum()), "of": matrix.size,
            "difference_band_limited_light": np.linalg.norm(matrix @ coeffs - limited) / size,
            "difference_light_itself": np.linalg.norm(matrix @ coeffs - unlimited) / size}


def probe_light(directions: np.ndarray) -> np.ndarray:
    """A partly cloudy sky, y up, and a lamp; 0 below the horizon."""
    lamp = np.array([-0.6, 0.4, -0.7])
    d = Array3f(*(Float(c.astype(np.float32)) for c in directions.T))
    values = np.array(cie_sky(d, "partly_cloudy", (0.5, 0.5, -0.7)), dtype=np.float64)
    return 0.4 * values + 6 * (directions @ (lamp / np.linalg.norm(lamp)) > 0.93)


def probe_image(size: int = 256, parts: int = 4) -> np.ndarray:
    """That light as an angle map, each pixel the mean of parts^2 places; looks along -z, y up."""
    places = (np.arange(size * parts) + 0.5) * (2 / (size * parts)) - 1
    right, down = np.meshgrid(places, places)
    r = np.hypot(right, down)
    sine = math.pi * np.sinc(r)
    d = np.stack([right * sine, -down * sine, -np.cos(math.pi * r)], axis=-1).reshape(-1, 3)
    values = np.where(r < 1, probe_light(d).reshape(r.shape), 0)
    return values.reshape(size, parts, size, parts).mean(axis=(1, 3))


def probe(latitudes: int = 500, order: int = 8) -> dict:
    found, exact = project_angle_map(probe_image(), order), project_function(probe_light, order, latitudes=latitudes)
    return {"order": order, "relative_difference": np.linalg.norm(found - exact) / np.linalg.norm(exact)}


def matrices() -> dict:
    """Which rotation each printed matrix is: the one that it differs from by rounding."""
    x90, rows = Rotation.from_euler("x", 90, degrees=True).as_matrix(), {}
    for name, printed in (("X_-90", PRINTED_X_MINUS_90), ("X_+90", PRINTED_X_PLUS_90)):
        for unsigned in (False, True):
            for label, rotation in (("+90", x90), ("-90", x90.T)):
                rows[f"{name} as {label}, {'unsigned' if unsigned else 'signed'}"] = abs(printed - dense(rotation, 2, unsigned)).max()
    angle = 0.7
    z = Rotation.from_euler("z", angle).as_matrix()
    rows["Z_a as +a"], rows["Z_a as -a"] = (abs(printed_z(angle) - dense(r, 2)).max() for r in (z, z.T))
    a, b, c = 0.4, 1.1, -0.6
    composed = printed_z(c) @ PRINTED_X_MINUS_90 @ printed_z(b) @ PRINTED_X_PLUS_90 @ printed_z(a)
    for label, sign in (("+", 1), ("-", -1)):
        rotation = Rotation.from_euler("ZYZ", [c, sign * b, a]).as_matrix()
        rows[f"Z_c X_-90 Z_b X_+90 Z_a as Rz(c) Ry({label}b) Rz(a), signed"] = abs(composed - dense(rotation, 2)).max()
        rows[f"Z_c X_-90 Z_b X_+90 Z_a as Rz(c) Ry({label}b) Rz(a), unsigned"] = abs(composed - dense(rotation, 2, True)).max()
    rows["equation 11 as that product"] = abs(printed_equation_11(a, b, c) - composed[:4, :4]).max()
    rows["equation 11 as that product with a and c exchanged"] = abs(printed_equation_11(c, b, a) - composed[:4, :4]).max()
    return rows


def cap() -> dict:
    """Maple's code for cut-offs from 5 to 175 degrees, against the closed form of any degree; and of a tiny cap."""
    def synth_light(cutoff):
        t5, t14 = math.cos(cutoff), math.sin(cutoff)                          # 0 < cutoff < pi: t3 = 1, t9 = 0
        return (3.544907702 - 1.772453851 - 1.772453851 * t5, 1.534990062 * t14 ** 2, -1.98166365 * t5 ** 3 + 1.98166365 * t5,
                2.930920062 - 2.930920062 * t5 ** 4 - 3.517104075 * t14 ** 2)

    worst = 0.0
    for degrees in range(5, 180, 5):
        ours = project_cap(math.radians(degrees), 3)
        worst = max(worst, *(abs(printed - ours[i]) for printed, i in zip(synth_light(math.radians(degrees)), (0, 2, 6, 12))))
    small = 1e-4
    solid_angle = 2 * math.pi * 2 * math.sin(small / 2) ** 2
    return {"largest_difference_printed": worst, "their_others_are_zero": max(abs(c) for i, c in enumerate(project_cap(1.0, 3))
                                                                            if i not in (0, 2, 6, 12)),
            "cap_of_1e-4_rad_degree_3": {"ours": project_cap(small, 3)[12], "printed_code": synth_light(small)[3],
                                         "expected": solid_angle * math.sqrt(7 / (4 * math.pi))}}


def sky(kind: str, directions: np.ndarray) -> np.ndarray:
    directions = Array3f(*(Float(c.astype(np.float32)) for c in directions.T))
    return np.array(cie_sky(directions, kind, **place(kind)), dtype=np.float64)


def sky_coefficients(kind: str, order: int) -> np.ndarray:
    return np.array(project_sky(kind, order, **place(kind)), dtype=np.float64).ravel()


def place(kind: str) -> dict:
    return {"zenith": (0.0, 0.0, 1.0), **({} if kind == "overcast" else {"sun": SUN})}


def skies(latitudes: int = 500, order: int = 8) -> dict:
    rows, (directions, weights) = {}, sphere_quadrature(200)
    for kind in SKIES:
        values = sky(kind, directions)
        coeffs = sky_coefficients(kind, order)
        brute = project_function(lambda d: sky(kind, d), order, latitudes=latitudes)
        rows[kind] = {"mean_over_zenith": float(weights @ values / (2 * math.pi)), "largest_coefficient": float(abs(coeffs).max()),
                      "largest_difference_to_quadrature": float(abs(coeffs - brute).max()),
                      "relative_l2_error_by_order": {n: relative(coeffs[:(n + 1) ** 2], values, directions, weights)
                                                     for n in (2, 4, order)}}
    return rows


def relative(coeffs, values, directions, weights) -> float:
    """Relative L2 error of a reconstruction."""
    return float(np.sqrt(weights @ (reconstruct(coeffs, directions) - values) ** 2 / (weights @ values ** 2)))


def rotations(count: int, order: int, seed: int = 0) -> dict:
    rng = np.random.default_rng(seed)
    directions, weights = sphere_quadrature(order + 1)
    dual = sh_matrix(directions, order) * weights[:, None]
    coeffs = rng.normal(size=(order + 1) ** 2)
    first = Rotation.random(count, random_state=seed).as_matrix()
    second = Rotation.random(count, random_state=seed + 1).as_matrix()
    worst = {"orthogonality": 0.0, "composition": 0.0, "inverse": 0.0, "against_projection": 0.0}
    note = lambda name, error: worst.__setitem__(name, max(worst[name], float(error)))
    for begin in range(0, count, BATCH):
        a, b = first[begin:begin + BATCH], second[begin:begin + BATCH]
        transposed = lambda d: np.swapaxes(d, -1, -2)
        for da, db, ab, inverse in zip(*(rotation_matrices(r, order) for r in (a, b, a @ b, transposed(a)))):
            note("orthogonality", abs(transposed(da) @ da - np.eye(da.shape[-1])).max())
            note("composition", abs(da @ db - ab).max())
            note("inverse", abs(inverse - transposed(da)).max())
        turned = rotate(np.broadcast_to(coeffs, (len(a), len(coeffs))), a)
        for rotation, vector in zip(a, turned):
            projected = (sh_matrix(directions @ rotation, order) @ coeffs) @ dual
            note("against_projection", np.linalg.norm(projected - vector) / np.linalg.norm(coeffs))
    axes = [Array3f(*(Float(first[:, i, j].astype(np.float32)) for i in range(3))) for j in range(3)]
    traced = rotate_frame([Float(float(c)) for c in coeffs], *axes, order)
    dr.eval(traced)
    traced = np.array([np.broadcast_to(np.array(c), count) for c in traced]).T
    exact = rotate(np.broadcast_to(coeffs, traced.shape), first)
    worst["float32_against_float64"] = float(np.linalg.norm(traced - exact, axis=1).max() / np.linalg.norm(coeffs))
    return {"count": count, "order": order, **worst}


def windows() -> list:
    theta = np.radians(np.linspace(0, 180, 1801))
    directions, rows = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1), []
    area = np.sin(theta)
    for angle in (30, 90):
        inside = (theta < math.radians(angle)) * 1.0
        for order in (4, 8, 14):
            plain = np.array(project_cap(math.radians(angle), order))
            for kind in KINDS:
                value = reconstruct(window(plain, kind), directions)
                rows.append({"half_angle": angle, "order": order, "window": kind, "overshoot": max(0.0, value.max() - 1),
                             "undershoot": max(0.0, -value.min()),
                             "relative_l2_error": math.sqrt((value - inside) ** 2 @ area / (inside @ area))})
    return rows


def draw_lobes(axis, function, detail: int) -> None:
    """|f| as distance from the origin, green where f > 0, red where f < 0 (the paper's colours)."""
    theta, phi = np.meshgrid(np.linspace(0, math.pi, detail), np.linspace(0, 2 * math.pi, detail), indexing="ij")
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    value = function(d.reshape(-1, 3)).reshape(theta.shape)
    points = d * abs(value)[..., None]
    normal = np.cross(*np.gradient(points, axis=(0, 1)))
    normal[[0, -1]] = normal[[1, -2]]                 # none at the poles
    facing = np.maximum(normal @ LAMP, 0) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-12)
    colours = np.where(value[..., None] > 0, POSITIVE, NEGATIVE) * (0.5 + 0.5 * facing[..., None])
    axis.plot_surface(*np.moveaxis(points, -1, 0), facecolors=colours, rstride=1, cstride=1, linewidth=0, antialiased=False, shade=False)
    size = abs(value).max()
    axis.set(xlim=(-size, size), ylim=(-size, size), zlim=(-size, size))
    axis.set_box_aspect((1, 1, 1), zoom=1.5)
    axis.set_axis_off()


def draw_map(axis, function, low, high, title: str) -> None:
    """Values by colatitude and azimuth."""
    theta, phi = np.meshgrid((np.arange(90) + 0.5) * math.pi / 90, (np.arange(180) + 0.5) * math.pi / 90, indexing="ij")
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    shown = axis.imshow(function(d.reshape(-1, 3)).reshape(theta.shape), vmin=low, vmax=high, extent=(0, 360, 180, 0), cmap="viridis")
    axis.set_title(title, fontsize=9)
    axis.set(xticks=[], yticks=[])
    return shown


def save(figure, path: pathlib.Path, dpi: int = 70) -> None:
    figure.savefig(path, dpi=dpi)
    plt.close(figure)


def draw_basis(path: pathlib.Path, detail: int) -> None:
    figure, axes = plt.subplots(5, 9, figsize=(13, 7.5), subplot_kw={"projection": "3d"}, layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for l in range(5):
        for m in range(-l, l + 1):
            axis = axes[l, 4 + m]
            draw_lobes(axis, lambda d: sh_matrix(d, l)[:, l * (l + 1) + m], detail)
            axis.set_title(f"{l}, {m}", fontsize=8)
    figure.suptitle("The first five bands by distance from the origin, green > 0, red < 0 ([G03] Figure 5)")
    save(figure, path)


def draw_light(path: pathlib.Path, detail: int) -> None:
    orders = (1, 2, 3, 5, 8, 14)
    figure = plt.figure(figsize=(14, 3.8), layout="constrained")
    functions = [("the light (Figure 7)", light)]
    for n in orders:
        functions.append((f"order {n}" + (" (Figure 8)" if n == 3 else ""), lambda d, c=light_coefficients(n): reconstruct(c, d)))
    for k, (title, function) in enumerate(functions):
        shown = draw_map(figure.add_subplot(2, len(functions), k + 1), function, -0.2, 1, title)
        draw_lobes(figure.add_subplot(2, len(functions), len(functions) + k + 1, projection="3d"), function, 3 * detail // 2)
    figure.colorbar(shown, ax=figure.axes[::2], fraction=0.02)
    figure.suptitle("[G03] Figures 6 to 8: its example light and what the orders make of it, over azimuth and colatitude, and as lobes")
    save(figure, path)


def draw_matrices(path: pathlib.Path) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained")
    x90 = dense(Rotation.from_euler("x", 90, degrees=True).as_matrix(), 4)
    turned = dense(Rotation.from_euler("ZYZ", [0.4, 1.1, -0.6]).as_matrix(), 4)
    titles = ("product with $Y_{2,2}$ (Figure 9)", "rotation by 90° about x", "any rotation")
    for axis, matrix, title in zip(axes, (mask_matrix(), x90, turned), titles):
        size = abs(matrix).max()
        figure.colorbar(axis.imshow(matrix, cmap="RdBu", vmin=-size, vmax=size), ax=axis, fraction=0.046)
        axis.set_title(f"{title}: {(abs(matrix) > 1e-12).sum()} of 625")
    save(figure, path)


def draw_windows(path: pathlib.Path) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(14, 4), layout="constrained", sharey=True)
    theta = np.linspace(0, 180, 721)
    directions = np.stack([np.sin(np.radians(theta)), 0 * theta, np.cos(np.radians(theta))], axis=1)
    for axis, order in zip(axes, (4, 8, 14)):
        axis.plot(theta, theta < 30, color="grey", ls=":", label="cap of 30°")
        for kind in KINDS:
            axis.plot(theta, reconstruct(window(np.array(project_cap(math.radians(30), order)), kind), directions), label=kind)
        axis.set(title=f"order {order}", xlabel="angle from the axis [°]", xlim=(0, 180))
        axis.axhline(0, color="black", lw=0.5)
    axes[0].legend()
    save(figure, path)


def draw_skies(path: pathlib.Path) -> None:
    figure, axes = plt.subplots(3, 4, figsize=(12, 5.4), layout="constrained")
    for row, kind, number in zip(axes, SKIES, (16, 17, 18)):
        high = np.quantile(sky(kind, sphere_quadrature(60)[0]), 0.995)
        coeffs = sky_coefficients(kind, 8)
        draw_map(row[0], lambda d: sky(kind, d), 0, high, f"{kind} (Figure {number})")
        for axis, n in zip(row[1:], (2, 4, 8)):
            shown = draw_map(axis, lambda d: reconstruct(coeffs[:(n + 1) ** 2], d), 0, high, f"order {n}")
        figure.colorbar(shown, ax=row, fraction=0.02)
    figure.suptitle("Luminance over that of the zenith; sun at 35° above the horizon")
    save(figure, path)


def draw_samples(path: pathlib.Path) -> None:
    theta, phi = printed_samples(100, True).T
    figure = plt.figure(figsize=(13, 4), layout="constrained")
    plane, ball, curves = figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2, projection="3d"), figure.add_subplot(1, 3, 3)
    plane.plot(phi, theta, ",k")
    plane.set(title="10,000 stratified samples (Figure 3)", xlabel="phi", ylabel="theta", ylim=(math.pi, 0))
    d = on_sphere(theta, phi)
    near = d @ [math.cos(0.3) * math.cos(0.5), math.cos(0.3) * math.sin(0.5), math.sin(0.3)] > 0
    ball.plot(*d[near].T, ",k")
    ball.view_init(math.degrees(0.3), math.degrees(0.5))
    ball.set_box_aspect((1, 1, 1))
    ball.set_axis_off()
    x = np.linspace(-1, 1, 301)
    for l in range(3):
        for m in range(l + 1):
            curves.plot(x, printed_legendre(l, m, x), label=f"$P_{l}^{m}$")
    curves.set(title="associated Legendre polynomials (Figure 4)", xlabel="x", ylim=(-1.7, 3.1))
    curves.legend(ncol=2)
    save(figure, path)


def draw_product(path: pathlib.Path) -> None:
    coeffs = light_coefficients(4)
    pictures = (("light, 25 coefficients", lambda d: reconstruct(coeffs, d)), ("mask $y_2^2$", mask),
                ("their product", lambda d: mask(d) * reconstruct(coeffs, d)),
                ("matrix times light, 25 coefficients", lambda d: reconstruct(mask_matrix() @ coeffs, d)))
    figure, axes = plt.subplots(1, 4, figsize=(14, 2.4), layout="constrained")
    for axis, (title, function) in zip(axes, pictures):
        shown = draw_map(axis, function, -0.4, 0.4, title)
    figure.colorbar(shown, ax=axes, fraction=0.02)
    figure.suptitle("[G03] Figure 10: a transfer matrix applied to a light")
    save(figure, path)


def draw_probe(path: pathlib.Path) -> None:
    image, coeffs = probe_image(), project_angle_map(probe_image(), 8)
    figure, axes = plt.subplots(1, 4, figsize=(14, 3), layout="constrained", width_ratios=(1, 2, 2, 2))
    axes[0].imshow(np.minimum(image, 2), cmap="viridis")
    axes[0].set(xticks=[], yticks=[])
    axes[0].set_title("angle map (Figure 19)", fontsize=9)
    turned = lambda function: lambda d: function(np.stack([d[:, 1], d[:, 2], d[:, 0]], axis=1))       # y up, as maps have z
    draw_map(axes[1], turned(probe_light), 0, 2, "over azimuth and colatitude")
    for axis, n in zip(axes[2:], (4, 8)):
        shown = draw_map(axis, turned(lambda d: reconstruct(coeffs[:(n + 1) ** 2], d)), 0, 2, f"projected from the angle map, order {n}")
    figure.colorbar(shown, ax=axes, fraction=0.02)
    save(figure, path)


def targets(report: dict) -> list:
    """Verdicts on what the paper says."""
    out = []
    check = lambda *arguments, **keywords: out.append(verdict(*arguments, **keywords))
    check("Fig. 3: basis over stratified samples at least 5 times nearer to orthonormal than over independent ones",
          report["samples"]["independent"] / report["samples"]["stratified"], 5, at_most=False)
    check("Fig. 4: rules for Legendre polynomials, largest difference from our basis", report["legendre"]["largest_difference"], 1e-12)
    ratios = [abs(abs(row["printed_over_ours"]) - 1) for name, row in report["equation_10"].items() if name != "2,2"]
    check("Fig. 5: printed polynomials are ours but for the sign (-1)^m and a slip in y_2^2", max(ratios), 1e-12)
    errors = list(report["light_by_order"].values())
    check("Fig. 6: every order is nearer to the light, largest ratio of two errors", max(b / a for a, b in zip(errors, errors[1:])), 1)
    rows = [row for row in report["example_light"]["coefficients"] if row["printed"] is not None]
    check("Figs. 7, 8: printed coefficients, their size, standard errors from the exact one",
          max(abs(abs(row["printed"]) - abs(row["exact"])) / row["standard_error"] for row in rows), 3)
    check("Figs. 7, 8: printed coefficients more than 3 standard errors off (one is: its sign is a slip)",
          sum(abs(row["deviations"]) > 3 for row in rows), 1)
    check("Fig. 9: part of the transfer matrix that is not 0", report["product"]["entries"] / report["product"]["of"], 0.1)
    check("Fig. 10: matrix times light against the projection of light times mask",
          report["product"]["difference_band_limited_light"], 1e-12)
    renders = report["renders"]
    check("Fig. 11: shading by a hemisphere of light without shadows, largest error", renders["unshadowed_error"], 1e-5)
    for name, row in renders["pictures"].items():
        check(f"{name}: mean error against path at most 3 %", row["error"], 0.03, text="{:.2%}")
        check(f"{name}: red over green of the white cup as path has it, to 2 %",
              abs(row["redness_of_the_cup"] / row["redness_by_path"] - 1), 0.02, text="{:.2%}")
    for kind, figure in zip(SKIES, (16, 17, 18)):
        row = report["skies"][kind]
        check(f"Fig. {figure}: {kind} sky against quadrature, of its largest coefficient",
              row["largest_difference_to_quadrature"] / row["largest_coefficient"], 2e-4)
    check("Fig. 19: coefficients of a probe from its angle map, relative difference", report["probe"]["relative_difference"], 0.01)
    check("Maple's coefficients of a cap, largest difference", report["cap"]["largest_difference_printed"], 2e-9)
    check("rotations: largest error, float64", max(report["rotations"][name] for name in (
        "orthogonality", "composition", "inverse", "against_projection")), 1e-12)
    return out


def main(arguments=None) -> None:
    parsed = options(__doc__, arguments, rotations={"type": int, "help": "random rotations (default: 10,000; --quick: 20)"},
                     order={"type": int, "help": "their highest degree (default: 20; --quick: 6)"})
    from validation import green_renders

    plan = QUICK if parsed.quick else Plan()
    report = {"equation_10": equation_10(), "samples": samples(), "legendre": legendre(), "light_by_order": light_by_order(),
              "example_light": example_light(2 * plan.latitudes), "product": product(plan.latitudes), "matrices": matrices(), "cap": cap(),
              "skies": skies(plan.latitudes), "probe": probe(plan.latitudes),
              "rotations": rotations(parsed.rotations or plan.rotations, parsed.order or plan.order), "windows": windows(),
              "renders": green_renders.measure(*plan.renders, path=parsed.out / "green_renders.png")}
    report = {"targets": targets(report), **report}
    print_targets(report["targets"])
    write(parsed.out / "green.json", report, parsed.quick)
    for name, draw in (("samples", draw_samples), ("matrices", draw_matrices), ("product", draw_product), ("windows", draw_windows),
                       ("skies", draw_skies), ("probe", draw_probe)):
        draw(parsed.out / f"green_{name}.png")
    draw_basis(parsed.out / "green_basis.png", plan.detail)
    draw_light(parsed.out / "green_light.png", plan.detail)


if __name__ == "__main__":
    main()
