"""Functions and images to coefficients of spherical harmonics, and back ([G03] "SH Projection")."""
from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ..arrays import vectors3
from ..errors import check_choice, check_integer, message
from .arguments import as_arrays, check_coefficients, evaluate, numeric_array
from .basis import check_order, sh_basis
from .lobes import sh_matrix
from .rotation import rotate, static_rotation

ENVMAP_FRAME = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
"""x, y, z of the world by rows: columns are the directions of azimuth 0 and 90 degrees against the map's u, and of its upper pole."""

MAX_LATITUDES = 4096

MAX_FLOATS = 2 ** 21
"""Harmonics evaluated in one step, which bounds the memory."""

_ROWS_PER_STEP = 256


def sphere_quadrature(latitudes: int) -> tuple:
    """Product quadrature of the sphere: Gauss-Legendre in z, twice as many equal steps in azimuth.

    Parameters
    ----------
    latitudes : int
        Number of nodes in z, 1 to 4096.

    Returns
    -------
    (directions, weights) : ndarrays (2 latitudes**2, 3) and (2 latitudes**2,)
        Unit vectors, and weights whose sum is 4 pi: exact for polynomials, hence products of spherical harmonics, of degree
        ``2 latitudes - 1``.

    Raises
    ------
    TypeError, ValueError
        If `latitudes` is not an integer from 1 to 4096.
    """
    latitudes = check_integer("sphere_quadrature", "latitudes", latitudes, 1, MAX_LATITUDES)
    z, weights = np.polynomial.legendre.leggauss(latitudes)
    azimuth = (np.arange(2 * latitudes) + 0.5) * (math.pi / latitudes)
    rho = np.sqrt(1 - z * z)
    directions = np.stack(np.broadcast_arrays(np.outer(rho, np.cos(azimuth)), np.outer(rho, np.sin(azimuth)), z[:, None]), axis=-1)
    return directions.reshape(-1, 3), np.repeat(weights * (math.pi / latitudes), 2 * latitudes)


def project_function(f, order: int, latitudes: int = None, vector: type = None):
    """Coefficients ``int f(w) Y_lm(w) dw`` by deterministic quadrature.

    Parameters
    ----------
    f : callable
        Takes unit vectors as an ndarray (N, 3) and returns values (N,), or (N, K) of K functions. Called for a part of them at a time.
    order : int
        Highest degree, 0 to 64.
    latitudes : int
        Circles of latitude, 1 to 4096, of twice as many directions each: exact where f is a polynomial, or has coefficients, up to
        the degree ``2 latitudes - 1 - order``. Default: ``4 (order + 8)``.
    vector : type
        Dr.Jit or Mitsuba 3-vector to call `f` with instead; `f` returns a float or 3-vector (colour).

    Returns
    -------
    ndarray ((order + 1)**2,), or (K, (order + 1)**2); with `vector` a list of (order + 1)**2 of what `f` returns, of width 1.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of its range or `vector` no such type, or what `f` returns does not have one real value per direction.

    Notes
    -----
    For f with a kink or a jump the error falls with the spacing, as ``latitudes**-2`` or ``latitudes**-1.5``. Differentiable with respect
    to what `f` depends on, if that is Dr.Jit's.
    """
    order = check_order("project_function", order)
    default = 4 * (order + 8)
    latitudes = check_integer("project_function", "latitudes", default if latitudes is None else latitudes, 1, MAX_LATITUDES)
    directions, weights = sphere_quadrature(latitudes)
    if vector is None:
        coeffs, step = 0, max(1, MAX_FLOATS // (order + 1) ** 2)
        for begin in range(0, len(weights), step):
            part = slice(begin, begin + step)
            values = evaluate("project_function", "f", f, directions[part])
            coeffs = coeffs + (values.T * weights[part]) @ sh_matrix(directions[part], order)
        return coeffs
    values, number = evaluate("project_function", "f", f, directions, vector), dr.value_t(vector)
    basis = sh_matrix(directions, order) * weights[:, None]
    if dr.depth_v(values) == 1:
        return [dr.sum(values * number(row)) for row in basis.T]
    return [type(values)(*(dr.sum(component * number(row)) for component in values)) for row in basis.T]


def project_function_stratified(f, order: int, samples: int = 10_000, seed: int = 0) -> tuple:
    """Coefficients ``int f(w) Y_lm(w) dw`` by Monte Carlo, one random direction in each of N x N cells ([G03] eqs. 3, 4 and its code).

    Parameters
    ----------
    f : callable
        Takes unit vectors as an ndarray (N, 3) and returns values (N,), or (N, K) of K functions. Called for some rows of cells at a time.
    order : int
        Highest degree, 0 to 64.
    samples : int
        9 to 100 million; the next larger square number is taken.
    seed : int
        Seed of the random numbers, 0 to 2**63; the same one gives the same result.

    Returns
    -------
    (coeffs, error) : two ndarrays ((order + 1)**2,), or (K, (order + 1)**2)
        Unbiased coefficients, and their standard errors from the second differences between neighbouring cells: slightly too large where
        f bends within a cell.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of its range, or what `f` returns does not have one real value per direction.
    """
    order = check_order("project_function_stratified", order)
    side = math.isqrt(check_integer("project_function_stratified", "samples", samples, 9, 10 ** 8) - 1) + 1
    rng = np.random.default_rng(check_integer("project_function_stratified", "seed", seed, 0, 2 ** 63))
    total, variance = 0, 0
    step = max(1, MAX_FLOATS // (side * (order + 1) ** 2))
    for begin in range(0, side, step):
        cells = np.meshgrid(np.arange(begin, min(side, begin + step)), np.arange(side), indexing="ij")
        u, v = ((cell + rng.random(cell.shape)) / side for cell in cells)
        z, rho, phi = 1 - 2 * u, 2 * np.sqrt(u * (1 - u)), 2 * math.pi * v    # theta = 2 acos(sqrt(1 - u)), [G03] eq. 4
        directions = np.stack([rho * np.cos(phi), rho * np.sin(phi), z], axis=-1).reshape(-1, 3)
        values, basis = evaluate("project_function_stratified", "f", f, directions), sh_matrix(directions, order)
        products = (values.T[..., None] * basis).reshape(*values.T.shape[:-1], *u.shape, -1)     # [K,] rows, side, C
        total = total + products.sum(axis=(-3, -2))
        bend = np.roll(products, 1, axis=-2) - 2 * products + np.roll(products, -1, axis=-2)
        variance = variance + (bend ** 2).sum(axis=(-3, -2)) / 6
    scale = 4 * math.pi / side ** 2
    return total * scale, np.sqrt(variance) * scale


def project_image(image, order: int, to_world=None, interpolation: str = "bilinear") -> np.ndarray:
    """Coefficients of a latitude-longitude map, its pixels weighted by the integrals over the sphere of what they stand for.

    Parameters
    ----------
    image : array_like (H, W) or (H, W, K)
        Finite values, e.g. ``mi.Bitmap("sky.exr")``; H at least 2. Oriented as Mitsuba's ``envmap``: y is up and on top, and
        the direction of azimuth ``phi = 2 pi u`` and colatitude theta is ``(sin phi sin theta, cos theta, -cos phi sin theta)``,
        columns centred at ``u = (j + 1/2) / W``.
    order : int
        Highest degree, 0 to 64.
    to_world : rotation
        From the map to the world, as `rotation` of :py:func:`mi_shlight.sh.rotate`; ``envmap`` has it as ``to_world``.
    interpolation : str
        ``bilinear``: between the pixels as ``envmap`` does, with the first and the last row on the poles, ``theta = pi i / (H - 1)``.
        ``box``: constant over pixels of equal height, ``theta = pi (i + 1/2) / H`` at their centres.

    Returns
    -------
    ndarray ((order + 1)**2,), or (K, (order + 1)**2).

    Raises
    ------
    TypeError, ValueError
        If an argument is not as above.

    Notes
    -----
    Exact but for rounding (1e-13): the integrals over azimuth are elementary, those over the colatitude are taken by Gauss-Legendre
    quadrature within each row, with as many nodes as the order takes. There is no pixel so bright or small that it would be missed.
    """
    order = check_order("project_image", order)
    bilinear = check_choice("project_image", "interpolation", interpolation, ("bilinear", "box")) == "bilinear"
    rule = "be an array (H, W) or (H, W, K) of finite numbers with H >= 2"
    pixels = numeric_array("project_image", "image", rule, image, "Pass a mi.Bitmap, or an array.")
    finite = np.isfinite(pixels).all()
    if pixels.ndim not in (2, 3) or len(pixels) < 2 or pixels.size == 0 or not finite:
        raise ValueError(message("project_image", "image", rule, f"an array {pixels.shape}" + ("" if finite else " with inf or nan")))
    height, width = pixels.shape[:2]
    frame = ENVMAP_FRAME if to_world is None else static_rotation("project_image", "to_world", to_world) @ ENVMAP_FRAME

    weights = map_weights(height, width, order, bilinear)
    angle = np.outer((np.arange(width) + 0.5) * (2 * math.pi / width), np.arange(order + 1))
    waves = np.concatenate([np.cos(angle), -np.sin(angle)], axis=1)           # azimuth runs against u
    series = np.concatenate([np.tensordot(waves, pixels[k:k + _ROWS_PER_STEP].astype(np.float64), axes=(0, 1))
                             for k in range(0, height, _ROWS_PER_STEP)], axis=1)
    coeffs = [np.tensordot(weights[l * (l + 1) // 2 + abs(m)], series[m if m >= 0 else order + 1 - m], axes=1)
              for l in range(order + 1) for m in range(-l, l + 1)]
    return rotate(np.stack(coeffs, axis=-1), frame)


def map_weights(rows: int, columns: int, order: int, bilinear: bool = True) -> np.ndarray:
    """Integrals over the sphere of what the pixels of a latitude-longitude map stand for, times the harmonics of azimuth 0 at the pixel.

    Pixel (i, j) has the weight ``map_weights[l (l + 1) / 2 + m, i] {cos, sin}(m phi_j)`` in the coefficients of l and +-m. Returns an array
    ((order + 1)(order + 2) / 2, rows). `bilinear`, and where the pixels are: as in :py:func:`project_image`.

    In the azimuth a tent, or a box, times ``cos(m phi)`` is elementary; in the colatitude Gauss-Legendre's rule is exact to rounding.
    """
    bands = rows - 1 if bilinear else rows
    node, weight = np.polynomial.legendre.leggauss(4 + math.ceil(2 * (order + 2) * math.pi / bands))
    shares = ((1 - node) / 2, (1 + node) / 2) if bilinear else (np.ones_like(node),)
    positive = [l * (l + 1) + m for l in range(order + 1) for m in range(l + 1)]
    out = np.zeros((len(positive), rows))
    for begin in range(0, bands, _ROWS_PER_STEP):
        first = np.arange(begin, min(bands, begin + _ROWS_PER_STEP))
        theta = ((first[:, None] + (node + 1) / 2) * (math.pi / bands)).ravel()
        harmonics = sh_matrix(np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=1), order)[:, positive]
        harmonics = (harmonics * np.sin(theta)[:, None]).reshape(len(first), len(node), -1)
        for k, share in enumerate(shares):
            out[:, first + k] += np.einsum("iqc,q->ci", harmonics, share * weight * (math.pi / (2 * bands)))
    spacing = 2 * math.pi / columns
    tent = spacing * np.sinc(np.arange(order + 1) / columns) ** (2 if bilinear else 1)        # numpy's sinc: sin(pi x) / (pi x)
    return out * np.concatenate([tent[:l + 1] for l in range(order + 1)])[:, None]


def reconstruct(coeffs, directions):
    """Function values ``sum_lm c_lm Y_lm(w)`` ([G03] "SH Projection").

    Parameters
    ----------
    coeffs : sequence of (n + 1)**2 floats, or ndarray ((n + 1)**2,) or (K, (n + 1)**2)
        Coefficients, e.g. of :py:func:`project_function`; arrays real or complex.
    directions : 3-vector, or ndarray (N, 3)
        Unit vectors. Dr.Jit's go with a sequence of coefficients only.

    Returns
    -------
    Float of the type of `coeffs` and `directions`, or ndarray (N,) or (N, K).

    Raises
    ------
    TypeError, ValueError
        If `coeffs` does not have (n + 1)**2 numbers, or `directions` are no 3-vectors.

    Notes
    -----
    Differentiable by both. Accuracy as :py:func:`mi_shlight.sh_basis`.
    """
    name, rule = "reconstruct", "be unit vectors (N, 3)"
    coeffs, order = check_coefficients(name, "coeffs", coeffs)
    if isinstance(coeffs, np.ndarray) or isinstance(directions, np.ndarray):
        (coeffs,) = as_arrays(name, coeffs=coeffs)
        if coeffs.ndim > 2:
            raise ValueError(message(name, "coeffs", "be an array ((n + 1)**2,) or (K, (n + 1)**2)", f"an array {coeffs.shape}"))
        directions = numeric_array(name, "directions", rule, directions)
        if directions.shape[-1:] != (3,) or directions.ndim > 2:
            raise ValueError(message(name, "directions", rule, f"an array {directions.shape}", "Dr.Jit's go with a list of coefficients."))
        return (sh_matrix(directions.reshape(-1, 3), order) @ coeffs.T).reshape(directions.shape[:-1] + coeffs.shape[:-1])
    total = 0
    for basis, coefficient in zip(sh_basis(*vectors3(name, directions=directions), order), coeffs):
        total = coefficient * basis + total
    return total
