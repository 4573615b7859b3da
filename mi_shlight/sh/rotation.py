"""Rotation of spherical harmonics: any order, one vector of coefficients or many, traced by Dr.Jit or in numpy.

A function turned by R, ``f'(w) = f(R^-1 w)``, has the coefficients ``f' = D(R) f``, one orthogonal block per degree. With the Euler angles
``R = Rz(alpha) Ry(beta) Rz(gamma)`` ([G03] "Rotating Spherical Harmonics"),

    D(R) = Z(alpha) X^T Z(beta) X Z(gamma) ,                                                                              (1)

Z the rotation about z, which mixes m with -m only, and X the constant rotation by 90 degrees about x. X turns the parity in z into that in
y and keeps the one in x, so three quarters of it are zero; its entries are known in integers, hence exact to the last bit.

[G03] finds alpha and gamma from R by a division by sin(beta), and takes other formulas where that is 0. Here only alpha is found that way,
or is 0 at the poles, and gamma from what R does in the frame that alpha and beta span: whatever error alpha has, gamma makes up for, so
there is no special case and nothing to lose near one.

Derivatives. Turned by a small rotation vector r, coefficients change by ``r_x J_x f + r_y J_y f + r_z J_z f``, J the generators of the
rotations about the axes. That is used in place of the derivatives of the angles, which do not exist at the poles.
"""
from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import drjit as dr
import numpy as np

from ..arrays import vectors3
from ..errors import message
from .arguments import check_coefficients, check_leading_axes
from .basis import check_order

_TOLERANCE = 1e-5
"""Largest entry of ``R^T R - 1`` of what passes for a rotation: a few float32 products of rotations stay below."""


class QuarterTurn(NamedTuple):
    """X, the rotation by +90 degrees about x, up to some order: for each flat index the pairs (column, value) of the non-zero entries."""

    rows: tuple
    columns: tuple
    """The same of the transposed, X^-1."""


@functools.lru_cache(maxsize=None)
def quarter_turn(order: int) -> QuarterTurn:
    """Sparse X of all bands to `order`."""
    count = (order + 1) ** 2
    rows, columns = [[] for _ in range(count)], [[] for _ in range(count)]
    for l in range(order + 1):
        x90 = _quarter_turn_band(l)
        for i, j in zip(*np.nonzero(x90)):
            rows[l * l + i].append((l * l + j, float(x90[i, j])))
            columns[l * l + j].append((l * l + i, float(x90[i, j])))
    return QuarterTurn(tuple(map(tuple, rows)), tuple(map(tuple, columns)))


@functools.lru_cache(maxsize=None)
def _quarter_turn_band(l: int) -> np.ndarray:
    """X of one band, (2l + 1, 2l + 1): ``Rx(90) = Rz(-90) Ry(90) Rz(90)``, which is ``i^(a - b) d^l_ab`` in complex harmonics.

    Wigner's ``d^l_ab(90 deg) = (-1)^(a - b) sqrt((l + a)! (l - a)! / ((l + b)! (l - b)! 4^l)) K``, with K the coefficient of t^(l - a) in
    ``(1 - t)^(l + b) (1 + t)^(l - b)``. As the coefficients of a real function have ``c_-b = (-1)^b conj(c_b)``, what ``sqrt2 Re Y_b`` and
    ``sqrt2 Im Y_b`` receive is made of ``d_ab + d_a,-b`` and ``d_ab - d_a,-b``.
    """
    factorials = [math.factorial(l + b) * math.factorial(l - b) for b in range(l + 1)]
    polynomial = [math.comb(2 * l, k) for k in range(2 * l + 1)]              # b = -l
    wigner = np.zeros((l + 1, 2 * l + 1))                                     # rows a >= 0
    for b in range(-l, l + 1):
        for a in range(l + 1):
            k = polynomial[l - a]
            if k:
                size = math.sqrt(k * k * factorials[a] / (factorials[abs(b)] << 2 * l))
                wigner[a, l + b] = size if (k > 0) == ((a - b) % 2 == 0) else -size
        quotient = list(itertools.accumulate(polynomial[:-1], lambda total, p: p - total))     # by 1 + t; times 1 - t is the next one
        polynomial = [p - q for p, q in zip([*quotient, 0], [0, *quotient])]
    x90 = np.zeros((2 * l + 1, 2 * l + 1))
    for a in range(l + 1):
        for b in range(l + 1):
            even, odd = (wigner[a, l + b] + wigner[a, l - b], wigner[a, l + b] - wigner[a, l - b]) if b else (wigner[a, l], 0)
            unit = (math.sqrt(2) ** ((b == 0) - (a == 0))) * (1 if (a - b) % 4 < 2 else -1)     # i^(a - b), without i if that is odd
            if (a - b) % 2 == 0:
                x90[l + a, l + b] = unit * even
                if a and b:
                    x90[l - a, l - b] = unit * odd
            else:
                x90[l + a, l - b] = unit * odd if b else 0
                x90[l - a, l + b] = -unit * even if a else 0
    x90.setflags(write=False)
    return x90


def rotate(coeffs, rotation):
    """Coefficients of the turned function ``f'(w) = f(R^-1 w)``, in which what was along d is along R d ([G03] "Rotating Spherical
    Harmonics").

    Parameters
    ----------
    coeffs : sequence of (n + 1)**2 floats, or ndarray (..., (n + 1)**2)
        Coefficients to the order n, 0 to 64; index ``l * (l + 1) + m``. Dr.Jit floats of any backend and precision, Python floats, or
        a numpy array, real or complex. In a sequence, None is a coefficient known to be zero.
    rotation : 3x3 matrix, or a transform
        R: a Dr.Jit or Mitsuba matrix, a numpy array, three rows, or an object with such an attribute ``matrix``, as
        ``mi.ScalarTransform4f().rotate([0, 0, 1], 90)`` has. Of a 4x4 matrix, the upper left 3x3 entries count: directions do
        not move with a translation. With numpy coefficients, R can be an array (..., 3, 3), one rotation for each vector.

    Returns
    -------
    list of floats as in `coeffs`, or ndarray.

    Raises
    ------
    TypeError, ValueError
        If `coeffs` does not have (n + 1)**2 numbers, or `rotation` is of another form, or scales, shears or mirrors (by more than
        1e-5), or there are not as many rotations as vectors. Matrices that Dr.Jit traces are not read, so not checked.

    Notes
    -----
    Equation (1) of :py:mod:`mi_shlight.sh.rotation`. Error relative to the vector's length at order 20: 3e-6 (float32), 2e-14 (float64);
    no rotation is special. Differentiable once by both arguments, everywhere.
    """
    coeffs, order = check_coefficients("rotate", "coeffs", coeffs, sparse=True)
    if not isinstance(coeffs, np.ndarray):
        return rotate_frame(coeffs, *_axes("rotate", rotation), order)
    matrix = static_rotation("rotate", "rotation", rotation, batched=True)
    check_leading_axes("rotate", "coeffs, rotation", coeffs.shape[:-1], matrix.shape[:-2])
    blocks = rotation_matrices(matrix, order)
    parts = (coeffs[..., l * l:(l + 1) ** 2, None] for l in range(order + 1))
    return np.concatenate([(block @ part)[..., 0] for block, part in zip(blocks, parts)], axis=-1)


def rotate_frame(coeffs: list, s, t, n, order: int, inverse: bool = False) -> list:
    """Coefficients in the world of a function given in the frame with the axes s, t, n, or with `inverse` the other way.

    Parameters
    ----------
    coeffs : list of (order + 1)**2 floats
        None where a coefficient is known to be zero.
    s, t, n : 3-vectors
        The frame's x, y and z axis in the world: orthonormal, right-handed (not checked).
    order : int
        Highest degree, 0 to 64.
    inverse : bool
        From the world to the frame.

    Returns
    -------
    list of (order + 1)**2 floats.

    Raises
    ------
    TypeError, ValueError
        If `coeffs` does not have (order + 1)**2 numbers, an axis is no 3-vector, or `order` not an integer from 0 to 64.

    Notes
    -----
    Accuracy and derivatives as for :py:func:`rotate`.
    """
    order = check_order("rotate_frame", order)
    values, given = check_coefficients("rotate_frame", "coeffs", coeffs, sparse=True)
    if given != order:
        raise ValueError(message("rotate_frame", "coeffs", f"have {(order + 1) ** 2} entries, as 'order' is {order}", coeffs))
    s, t, n = vectors3("rotate_frame", s=s, t=t, n=n)
    axes, bands, x90 = [dr.detach(a) for a in (s, t, n)], range(order + 1), quarter_turn(order)
    alpha, beta, gamma = (multiples(*angle, order) for angle in euler_angles(axes[2], axes[0]))
    turn = None
    if dr.grad_enabled(s, t, n):                      # a x da sums to twice the rotation vector
        turn = 0.5 * sum(dr.cross(a, b - a) for a, b in zip(axes, (s, t, n)))
    if inverse:
        values = values if turn is None else _turned(values, -turn, bands)
        alpha, beta, gamma = ((cosines, [-sine for sine in sines]) for cosines, sines in (gamma, beta, alpha))
    values = rotate_z(values, *gamma, bands)
    values = apply_rows(x90.rows, values, bands)
    values = rotate_z(values, *beta, bands)
    values = apply_rows(x90.columns, values, bands)
    values = rotate_z(values, *alpha, bands)
    if turn is not None and not inverse:
        values = _turned(values, turn, bands)
    return [type(n[0])(0) if value is None else value for value in values]


def rotation_matrices(rotation, order: int) -> list:
    """Matrices D_l(R) of every degree, in float64: ``f'_l = D_l f_l`` for ``f'(w) = f(R^-1 w)``.

    Parameters
    ----------
    rotation : array_like (3, 3) or (..., 3, 3), or a transform as in :py:func:`rotate`
        R, or a batch of them.
    order : int
        Highest degree, 0 to 64.

    Returns
    -------
    list of ``order + 1`` ndarrays (..., 2l + 1, 2l + 1), rows and columns m = -l .. l.

    Raises
    ------
    TypeError, ValueError
        If `order` is not an integer from 0 to 64, or `rotation` is of another form, or scales, shears or mirrors (by more than 1e-5).

    Notes
    -----
    Equation (1) of :py:mod:`mi_shlight.sh.rotation`. Orthogonal to 1e-14 at any order, also where R is only nearly a rotation.
    """
    order = check_order("rotation_matrices", order)
    matrix = static_rotation("rotation_matrices", "rotation", rotation, batched=True)
    s, n = matrix[..., 0], matrix[..., 2]
    rho = np.hypot(n[..., 0], n[..., 1])
    alpha, beta = np.arctan2(n[..., 1], n[..., 0]), np.arctan2(rho, n[..., 2])
    cos_alpha, sin_alpha = np.cos(alpha), np.sin(alpha)
    gamma = np.arctan2(cos_alpha * s[..., 1] - sin_alpha * s[..., 0],
                       (cos_alpha * s[..., 0] + sin_alpha * s[..., 1]) * n[..., 2] - rho * s[..., 2])
    blocks = []
    for l in range(order + 1):
        m, x90 = np.arange(-l, l + 1), _quarter_turn_band(l)
        cosine, sine = (f(np.multiply.outer((alpha, beta, gamma), m)) for f in (np.cos, np.sin))
        from_left = lambda k, d: cosine[k][..., None] * d - sine[k][..., None] * d[..., ::-1, :]
        block = from_left(0, x90.T @ from_left(1, x90))
        blocks.append(block * cosine[2][..., None, :] - (block * sine[2][..., None, :])[..., ::-1])
    return blocks


def _axes(function: str, rotation) -> list:
    """Columns of a rotation matrix, as Dr.Jit 3-vectors."""
    matrix = getattr(rotation, "matrix", rotation)
    if not (isinstance(matrix, dr.ArrayBase) and dr.is_matrix_v(matrix) and dr.is_jit_v(matrix)):
        matrix = static_rotation(function, "rotation", rotation)
    return vectors3(function, **{name: [matrix[i, j] for i in range(3)] for j, name in enumerate("stn")})


def static_rotation(function: str, argument: str, rotation, batched: bool = False) -> np.ndarray:
    """`rotation` as a float64 array (3, 3), or (..., 3, 3) if `batched`, or TypeError/ValueError unless it is one."""
    rule = "be a rotation: a 3x3 matrix with R^T R = 1 and determinant +1"
    try:
        matrix = np.asarray(getattr(rotation, "matrix", rotation), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape[-2:] not in ((3, 3), (4, 4)) or matrix.ndim > 2 and not batched:
        raise TypeError(message(function, argument, rule, rotation, "Pass a matrix, or a transform such as mi.ScalarTransform4f()."))
    matrix = matrix[..., :3, :3]
    error = abs(np.swapaxes(matrix, -1, -2) @ matrix - np.eye(3)).max(initial=0)
    if not error < _TOLERANCE:
        raise ValueError(message(function, argument, rule, rotation,
                                 f"R^T R differs from 1 by {error:.2g}: divide the axes by their lengths, or leave scale and shear out."))
    if (np.linalg.det(matrix) < 0).any():
        raise ValueError(message(function, argument, rule, rotation, "It mirrors: change the sign of one axis, "
                                                                       "or mirror the function before its projection."))
    return matrix


def _turned(values: list, turn, bands: range) -> list:
    """`values` plus their change by the rotation vector `turn`, which is 0 and has derivatives."""
    changes = [apply_rows(rows, values, bands) for rows in _generators(bands[-1])]
    out = []
    for i, value in enumerate(values):
        for k, change in enumerate(changes):
            value = add_product(value, change[i], turn[k])
        out.append(value)
    return out


@functools.lru_cache(maxsize=None)
def _generators(order: int) -> tuple:
    """Derivatives of D by the angle of a rotation about x, y and z, at 0: rows as in :py:class:`QuarterTurn`."""
    axes = [], [], []
    for l in range(order + 1):
        m, x90 = np.arange(-l, l + 1), _quarter_turn_band(l)
        about_z = -np.diag(m)[:, ::-1]
        about_y = x90.T @ about_z @ x90
        quarter = np.diag(np.array([1, 0, -1, 0])[m % 4]) - np.diag(np.array([0, 1, 0, -1])[m % 4])[:, ::-1]
        for rows, matrix in zip(axes, (quarter.T @ about_y @ quarter, about_y, about_z)):
            rows += [tuple((l * l + int(j), float(row[j])) for j in np.flatnonzero(abs(row) > 1e-6)) for row in matrix]
    return tuple(map(tuple, axes))


def multiples(cos, sin, order: int) -> tuple:
    """Cosines and sines of 0, 1, .., `order` times an angle."""
    cosines, sines = [type(cos)(1)], [type(cos)(0)]
    for _ in range(order):
        c, s = cosines[-1], sines[-1]
        cosines.append(dr.fma(c, cos, -(s * sin)))
        sines.append(dr.fma(s, cos, c * sin))
    return cosines, sines


def euler_angles(n, s) -> tuple:
    """(cosine, sine) of alpha, beta and gamma in ``Rz(alpha) Ry(beta) Rz(gamma)``, the rotation that takes z to the unit vector `n` and x
    to `s`, orthogonal to it. The rotation keeps its digits near the poles, the derivatives of alpha and gamma do not.
    """
    squared = n[0] * n[0] + n[1] * n[1]
    tilted = squared > 1e-30                          # else n is the z axis, and any alpha will do
    rho = dr.sqrt(dr.select(tilted, squared, 1))
    inverse = 1 / rho
    rho = dr.select(tilted, rho, 0)
    cos_alpha, sin_alpha = dr.select(tilted, n[0] * inverse, 1), dr.select(tilted, n[1] * inverse, 0)
    cos_gamma = dr.fma(cos_alpha, s[0], sin_alpha * s[1]) * n[2] - rho * s[2]
    sin_gamma = dr.fma(cos_alpha, s[1], -(sin_alpha * s[0]))
    return (cos_alpha, sin_alpha), (n[2], rho), (cos_gamma, sin_gamma)


def flat_indices(bands: range) -> range:
    """Flat indices of whole bands."""
    return range(bands[0] ** 2, (bands[-1] + 1) ** 2)


def add_product(total, value, factor):
    """``total + value * factor`` where None is zero."""
    if value is None:
        return total
    return value * factor if total is None else dr.fma(value, factor, total)


def apply_rows(rows: tuple, vector: list, bands: range, wanted=None) -> list:
    """Some bands of a sparse matrix times a vector, in which None is zero; only the `wanted` entries."""
    out = [None] * len(rows)
    for i in flat_indices(bands):
        if wanted is None or wanted[i]:
            for j, value in rows[i]:
                out[i] = add_product(out[i], vector[j], value)
    return out


def rotate_z(vector: list, cosines: list, sines: list, bands: range, wanted=None) -> list:
    """Rotation about z: (p, q) of (m, -m) becomes (p cos - q sin, p sin + q cos) of m times the angle; only the `wanted` entries."""
    out = list(vector)
    for l in bands:
        for m in range(1, l + 1):
            i, j = l * (l + 1) + m, l * (l + 1) - m
            p, q = vector[i], vector[j]
            out[i] = add_product(add_product(None, p, cosines[m]), q, -sines[m]) if wanted is None or wanted[i] else None
            out[j] = add_product(add_product(None, p, sines[m]), q, cosines[m]) if wanted is None or wanted[j] else None
    return out
