"""Claim: what [G03] prints comes out of ``mi_shlight.sh``, or the paper has a slip; 10,000 random rotations do as rotations should.

    python -m validation.green [--quick] [--out DIR] [--rotations N] [--order N]

writes ``green.json`` and, after the figures of the paper, ``green_basis.png`` (5), ``green_light.png`` (6 to 8), ``green_matrices.png``
(9, X90), ``green_windows.png`` (the cure it names for the fins of 8), ``green_skies.png`` (16 to 18):

- **equation_10**: ratio of the printed Cartesian polynomials to the basis.
- **example_light**: exact coefficients of the light of its Figure 7, standard error of its 10,000 stratified samples, printed ones.
- **matrices**: printed X90 and Z, and the ZYZ matrix of equation 11, as rotations of ours.
- **cap**: Maple's coefficients ("synth_light") against :py:func:`mi_shlight.environment.cap.project_cap`.
- **skies**: the three CIE skies, by :py:func:`mi_shlight.environment.sky.project_sky` and by brute force, and what each order leaves out.
- **rotations**: largest error over random rotations of orthogonality, composition, inverse, and of turned coefficients against the
  projection of the turned function, which is exact; in float32 also against float64.
- **windows**: overshoot, undershoot and error of a cap and a hemisphere by order and window.
"""
from __future__ import annotations

import math
import pathlib

import drjit as dr
import matplotlib
import numpy as np
from drjit.llvm.ad import Array3f, Float
from scipy.spatial.transform import Rotation

from mi_shlight.environment.cap import project_cap
from mi_shlight.environment.sky import SKIES, cie_sky, project_sky
from mi_shlight.sh import (gaunt, project_function, project_function_stratified, reconstruct, rotate, rotate_frame, rotation_matrices,
                           sphere_quadrature, window)
from mi_shlight.sh.lobes import sh_matrix
from mi_shlight.sh.windows import KINDS
from validation import experiment

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

SUN = (-math.cos(math.radians(35)), 0.0, math.sin(math.radians(35)))
POSITIVE, NEGATIVE = np.array([0.3, 0.9, 0.35]), np.array([1.0, 0.25, 0.2])
LAMP = np.array([0.6, -0.5, 0.62])
BATCH = 200

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


def example_light() -> dict:
    exact = light_coefficients(3)
    samples, error = project_function_stratified(light, 3, 10_000, seed=1)
    rows = []
    for i, coefficient in enumerate(exact):
        printed = None if i == MISSING else PRINTED_LIGHT[i - (i > MISSING)]
        rows.append({"index": i, "exact": coefficient, "ours_10000_samples": samples[i], "standard_error": error[i], "printed": printed,
                     "deviations": None if printed is None else (printed - coefficient) / error[i]})
    return {"coefficients": rows, "exact_against_quadrature": abs(project_function(light, 3, latitudes=1000) - exact).max()}


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


def skies(order: int = 8) -> dict:
    rows, (directions, weights) = {}, sphere_quadrature(200)
    for kind in SKIES:
        values = sky(kind, directions)
        coeffs = sky_coefficients(kind, order)
        brute = project_function(lambda d: sky(kind, d), order, latitudes=500)
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


def draw_lobes(axis, function, detail: int = 60) -> None:
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


def draw_basis(path: pathlib.Path) -> None:
    figure, axes = plt.subplots(5, 9, figsize=(13, 7.5), subplot_kw={"projection": "3d"}, layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for l in range(5):
        for m in range(-l, l + 1):
            axis = axes[l, 4 + m]
            draw_lobes(axis, lambda d: sh_matrix(d, l)[:, l * (l + 1) + m])
            axis.set_title(f"{l}, {m}", fontsize=8)
    figure.suptitle("The first five bands by distance from the origin, green > 0, red < 0 ([G03] Figure 5)")
    save(figure, path)


def draw_light(path: pathlib.Path) -> None:
    orders = (1, 2, 3, 5, 8, 14)
    figure = plt.figure(figsize=(14, 3.8), layout="constrained")
    functions = [("the light (Figure 7)", light)]
    for n in orders:
        functions.append((f"order {n}" + (" (Figure 8)" if n == 3 else ""), lambda d, c=light_coefficients(n): reconstruct(c, d)))
    for k, (title, function) in enumerate(functions):
        shown = draw_map(figure.add_subplot(2, len(functions), k + 1), function, -0.2, 1, title)
        draw_lobes(figure.add_subplot(2, len(functions), len(functions) + k + 1, projection="3d"), function, 90)
    figure.colorbar(shown, ax=figure.axes[::2], fraction=0.02)
    figure.suptitle("[G03] Figures 6 to 8: its example light and what the orders make of it, over azimuth and colatitude, and as lobes")
    save(figure, path)


def draw_matrices(path: pathlib.Path) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained")
    table, product = gaunt(2, 4, 4), np.zeros((25, 25))
    chosen = table.indices[:, 0] == 8
    product[tuple(table.indices[chosen][:, 1:].T)] = table.values[chosen]
    x90 = dense(Rotation.from_euler("x", 90, degrees=True).as_matrix(), 4)
    turned = dense(Rotation.from_euler("ZYZ", [0.4, 1.1, -0.6]).as_matrix(), 4)
    titles = ("product with $Y_{2,2}$ (Figure 9)", "rotation by 90° about x", "any rotation")
    for axis, matrix, title in zip(axes, (product, x90, turned), titles):
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


def targets(report: dict) -> list:
    """Verdicts on what must come out but for the paper's slips."""
    light, turned = report["example_light"], report["rotations"]
    off = sum(abs(row["deviations"]) > 3 for row in light["coefficients"] if row["printed"] is not None)
    return [experiment.verdict("example light: printed coefficients more than 3 standard errors off (one is: its sign is a slip)", off, 1),
            experiment.verdict("cap: largest difference to the printed formulas", report["cap"]["largest_difference_printed"], 1e-8),
            *(experiment.verdict(f"{kind} sky: largest difference to brute force, over its largest coefficient",
                                 row["largest_difference_to_quadrature"] / row["largest_coefficient"], 2e-4)
              for kind, row in report["skies"].items()),
            *(experiment.verdict(f"{turned['count']} rotations, order {turned['order']}, {name.replace('_', ' ')}: error at most 1e-12",
                                 turned[name], 1e-12) for name in ("orthogonality", "composition", "inverse", "against_projection"))]


def main(arguments=None) -> None:
    options = experiment.options(
        __doc__, arguments, rotations={"type": int, "default": 10_000, "help": "random rotations (default: %(default)s)"},
        order={"type": int, "default": 20, "help": "their highest degree (default: %(default)s)"})
    if options.quick:
        options.rotations, options.order = 20, 6
    report = {"equation_10": equation_10(), "example_light": example_light(), "matrices": matrices(), "cap": cap(), "skies": skies(),
              "rotations": rotations(options.rotations, options.order), "windows": windows()}
    report = {"targets": targets(report), **report}
    experiment.print_targets(report["targets"])
    experiment.write(options.out / "green.json", report, options.quick)
    for name, draw in (("basis", draw_basis), ("light", draw_light), ("matrices", draw_matrices), ("windows", draw_windows),
                       ("skies", draw_skies)):
        draw(options.out / f"green_{name}.png")


if __name__ == "__main__":
    main()
