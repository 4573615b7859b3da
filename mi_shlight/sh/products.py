"""Products of functions given by their coefficients.

The product of two functions of the orders p and q has the order p + q, and

    c_k = sum_ij G_ijk a_i b_j ,     G_ijk = int Y_i Y_j Y_k dw                                                           (1)

with the real Gaunt coefficients G ([G03] eq. 8 with ``b = Y_k``). Of these ``O(n^5)`` are not zero, 24,000 for the order 8. A matrix
needs them all; the product itself is cheaper along circles of latitude, where functions are Fourier series:

    a(z, phi) = sum_m A_m(z) {cos, sin}(m phi) ,     A_m(z) = sum_l P_lm(z) a_lm ,                                        (2)

the product of two series is a sum over pairs of frequencies, and ``n_z > (p + q + n) / 2`` Gauss-Legendre latitudes project it to order n
exactly: ``O(n^4)``, 7,000 multiplications at order 8. Latitudes z and -z share (2): their sums over even and odd l + m are the same.
"""
from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from .arguments import as_arrays, check_coefficients
from .basis import check_order
from .functions import sphere_quadrature
from .lobes import sh_matrix
from .rotation import add_product


class Gaunt(NamedTuple):
    """Non-zero integrals ``int Y_i Y_j Y_k dw`` of real spherical harmonics."""

    indices: np.ndarray
    """Flat indices i, j, k: (count, 3)."""
    values: np.ndarray
    """(count,), float64."""


def gaunt(order_a: int, order_b: int, order_c: int) -> Gaunt:
    """Real Gaunt coefficients ``G_ijk = int Y_i Y_j Y_k dw`` that are not zero, i, j, k to the orders given.

    Parameters
    ----------
    order_a, order_b, order_c : int
        Highest degrees, 0 to 64.

    Returns
    -------
    Gaunt
        Read-only, sorted by i, j, k, cached. There are 24 thousand at order 8, 1.8 million at order 20.

    Raises
    ------
    TypeError, ValueError
        If an order is not an integer from 0 to 64.

    Notes
    -----
    Integrals over z by Gauss-Legendre quadrature, exact for these polynomials, over the azimuth by equal steps; error 1e-14.
    """
    orders = {"order_a": order_a, "order_b": order_b, "order_c": order_c}
    return _gaunt(*(check_order("gaunt", order, name) for name, order in orders.items()))


@functools.lru_cache(maxsize=None)
def _gaunt(*orders: int) -> Gaunt:
    z, weights = np.polynomial.legendre.leggauss(sum(orders) // 2 + 1)
    legendre = sh_matrix(np.stack([np.sqrt(1 - z * z), np.zeros_like(z), z], axis=1), max(orders))       # columns m >= 0
    indices, values = [], []
    for m1 in range(orders[0] + 1):
        for m2 in range(orders[1] + 1):
            for m3 in {m1 + m2, abs(m1 - m2)}:
                if m3 > orders[2]:
                    continue
                degrees = [np.arange(m, order + 1) for m, order in zip((m1, m2, m3), orders)]
                waves = [legendre[:, l * (l + 1) + m] for l, m in zip(degrees, (m1, m2, m3))]
                along = np.einsum("z,zi,zj,zk->ijk", weights, *waves, optimize=True)
                l1, l2, l3 = np.meshgrid(*degrees, indexing="ij")
                allowed = ((l1 + l2 + l3) % 2 == 0) & (l3 <= l1 + l2) & (l3 >= abs(l1 - l2)) & (abs(along) > 1e-14)
                phi = np.arange(m1 + m2 + m3 + 1) * (2 * math.pi / (m1 + m2 + m3 + 1))
                for signs in np.ndindex(*(1 + (m > 0) for m in (m1, m2, m3))):
                    around = 1
                    for negative, m in zip(signs, (m1, m2, m3)):
                        around = around * (np.sin(m * phi) if negative else np.cos(m * phi))
                    if abs(around.mean()) > 1e-9:
                        flat = [l * (l + 1) + (-m if negative else m) for l, m, negative in zip((l1, l2, l3), (m1, m2, m3), signs)]
                        indices.append(np.stack([i[allowed] for i in flat], axis=1))
                        values.append(along[allowed] * (2 * math.pi * around.mean()))
    indices, values = np.concatenate(indices), np.concatenate(values)
    sort = np.lexsort(indices.T[::-1])
    table = Gaunt(indices[sort], values[sort])
    for array in table:
        array.setflags(write=False)
    return table


def product(a, b, order: int = None):
    """Coefficients of the product of two functions, ``c_k = int a(w) b(w) Y_k(w) dw``.

    Parameters
    ----------
    a, b : sequence of (n + 1)**2 floats, or ndarray (..., (n + 1)**2)
        Coefficients; the orders may differ. Dr.Jit or Python floats, or numpy arrays, real or complex, whose leading axes are
        broadcast. In a sequence, None is a coefficient known to be zero. Beside an array, a sequence holds Python floats.
    order : int
        Highest degree wanted, 0 to 64. Default: the sum of the two orders, which is the product itself; less cuts it off.

    Returns
    -------
    list of (order + 1)**2 floats, or ndarray.

    Raises
    ------
    TypeError, ValueError
        If an argument does not have (n + 1)**2 numbers, or `order` is not an integer from 0 to 64.

    Notes
    -----
    Exact but for rounding, 1e-6 (float32) and 2e-15 (float64) of the product's length at order 8. Differentiable. Multiplications
    to the orders 4 x 4 -> 4: 1000, 4 x 8 -> 4: 2000, 8 x 8 -> 8: 7000, 14 x 14 -> 14: 33,000, as straight code.
    """
    (a, order_a), (b, order_b) = (check_coefficients("product", name, f, sparse=True) for name, f in (("a", a), ("b", b)))
    orders, order = (order_a, order_b), check_order("product", order_a + order_b if order is None else order)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a, b = as_arrays("product", a=a, b=b)
        directions, weights = sphere_quadrature((sum(orders) + order) // 2 + 1)
        values = [f @ sh_matrix(directions, n).T for f, n in zip((a, b), orders)]
        return (values[0] * values[1] * weights) @ sh_matrix(directions, order)
    out = [None] * (order + 1) ** 2
    for legendre, weight, symmetric in _latitudes(sum(orders) + order, max(*orders, order)):
        series = (_series(f, n, legendre, symmetric) for f, n in zip((a, b), orders))
        sides = [_multiply(p, q, order) for p, q in zip(*series)]
        for k in range(-order, order + 1):
            values = [side[k] for side in sides]
            if values[0] is None:
                continue
            for parity, value in enumerate((values[0] + values[1], values[0] - values[1]) if symmetric else values):
                for l in range(abs(k) + parity, order + 1, 2):
                    i = l * (l + 1) + k
                    out[i] = add_product(out[i], value, weight * legendre[l * (l + 1) + abs(k)])
    zero = next((type(v)(0) for v in out if v is not None), 0.0)
    return [zero if value is None else value for value in out]


def triple_product(a, b, c):
    """``int a(w) b(w) c(w) dw`` of three functions given by their coefficients ([G03] eq. 8; [W18] section 6, glossy).

    Parameters
    ----------
    a, b, c : sequence of (n + 1)**2 floats, or ndarray (..., (n + 1)**2)
        Coefficients as for :py:func:`product`; the orders may differ.

    Returns
    -------
    float of the type of the arguments, or ndarray.

    Raises
    ------
    TypeError, ValueError
        If an argument does not have (n + 1)**2 numbers, or leading axes cannot be broadcast.

    Notes
    -----
    The dot product of :py:func:`product` of a and b with c; cost and accuracy are the same whichever is c. Where two of the three stay,
    their product serves for all of the third.
    """
    given = {name: check_coefficients("triple_product", name, f, sparse=True) for name, f in (("a", a), ("b", b), ("c", c))}
    order, factors = given["c"][1], {name: coeffs for name, (coeffs, _) in given.items()}
    if any(isinstance(f, np.ndarray) for f in factors.values()):
        a, b, c = as_arrays("triple_product", **factors)
        return (product(a, b, order) * c).sum(axis=-1)
    total = None
    for p, q in zip(product(factors["a"], factors["b"], order), factors["c"]):
        total = add_product(total, q, p)
    return 0.0 if total is None else total


def product_matrix(a, order_in: int, order_out: int = None):
    """Matrix ``M_ij = int a(w) Y_i(w) Y_j(w) dw`` that multiplies a function by `a` ([G03] eqs. 8, 9).

    Parameters
    ----------
    a : sequence of (n + 1)**2 floats, or ndarray (..., (n + 1)**2)
        Coefficients as for :py:func:`product`.
    order_in, order_out : int
        Orders of the function multiplied and of the result, 0 to 64; `order_out` defaults to `order_in`.

    Returns
    -------
    list of (order_out + 1)**2 rows of (order_in + 1)**2 floats each, or ndarray (..., (order_out + 1)**2, (order_in + 1)**2).

    Raises
    ------
    TypeError, ValueError
        If `a` does not have (n + 1)**2 numbers, or an order is not an integer from 0 to 64.

    Notes
    -----
    From :py:func:`gaunt`: 2200 multiplications for the orders 8, 4 -> 4, 24,000 for 8, 8 -> 8. Accuracy as of :py:func:`product`.
    """
    a, order_a = check_coefficients("product_matrix", "a", a, sparse=True)
    order_in = check_order("product_matrix", order_in, "order_in")
    order_out = order_in if order_out is None else check_order("product_matrix", order_out, "order_out")
    shape = (order_out + 1) ** 2, (order_in + 1) ** 2
    if isinstance(a, np.ndarray):
        directions, weights = sphere_quadrature((order_a + order_in + order_out) // 2 + 1)
        values = (a @ sh_matrix(directions, order_a).T) * weights
        return (sh_matrix(directions, order_out).T * values[..., None, :]) @ sh_matrix(directions, order_in)
    indices, values = gaunt(order_a, order_in, order_out)
    matrix = [[None] * shape[1] for _ in range(shape[0])]
    for (k, j, i), value in zip(indices.tolist(), values.tolist()):
        if max(i, j) < min(shape) and i > j:          # symmetric: only once
            continue
        matrix[i][j] = add_product(matrix[i][j], a[k], value)
    zero = next((type(v)(0) for v in a if v is not None), 0.0)
    for i in range(shape[0]):
        for j in range(shape[1]):
            mirrored = matrix[j][i] if max(i, j) < min(shape) and i > j else matrix[i][j]
            matrix[i][j] = zero if mirrored is None else mirrored
    return matrix


@functools.lru_cache(maxsize=None)
def _latitudes(degree: int, order: int) -> tuple:
    """Latitudes z >= 0 that integrate polynomials of `degree`: (P_lm(z) by flat index of m >= 0, doubled for m = 0; weight of the product,
    which :py:func:`_multiply` doubles; whether -z is another one).
    """
    z, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    legendre = sh_matrix(np.stack([np.sqrt(1 - z * z), np.zeros_like(z), z], axis=1), order)
    legendre[:, [l * (l + 1) for l in range(order + 1)]] *= 2
    return tuple((tuple(row), w * math.pi / 2, node > 1e-9)
                 for row, w, node in zip(legendre.tolist(), weights.tolist(), z.tolist()) if node > -1e-9)


def _series(coeffs: list, order: int, legendre: tuple, symmetric: bool) -> list:
    """Fourier series (2) at z, and if `symmetric` at -z: by m = -order .. order, sines for m < 0, ``A_0`` doubled; None where zero."""
    sides = [[None] * (2 * order + 1) for _ in range(1 + symmetric)]
    for m in range(-order, order + 1):
        even, odd = None, None                        # sums over even and odd l + m; the latter change sign with z
        for l in range(abs(m), order + 1, 2):
            even = add_product(even, coeffs[l * (l + 1) + m], legendre[l * (l + 1) + abs(m)])
        for l in range(abs(m) + 1, order + 1, 2):
            odd = add_product(odd, coeffs[l * (l + 1) + m], legendre[l * (l + 1) + abs(m)])
        if odd is None or not symmetric:
            values = even, even
        else:
            values = (odd, -odd) if even is None else (even + odd, even - odd)
        for side, value in zip(sides, values):
            side[m] = value
    return sides


def _multiply(a: list, b: list, order: int) -> list:
    """Twice the product of two Fourier series, to `order`, in which all terms but the zeroth are as they are, and that is doubled."""
    out = [None] * (2 * order + 1)
    minus = [None if q is None else -q for q in b]

    def add(m, p, q):
        if abs(m) <= order and p is not None and q is not None:
            out[m] = add_product(out[m], p, q)

    for i in range(len(a) // 2 + 1):
        for j in range(len(b) // 2 + 1):
            if i and j:
                add(i + j, a[i], b[j])
                add(i + j, a[-i], minus[-j])
                add(-i - j, a[i], b[-j])
                add(-i - j, a[-i], b[j])
                add(abs(i - j), a[i], b[j])
                add(abs(i - j), a[-i], b[-j])
                if i != j:
                    add(-abs(i - j), a[-i], b[j] if i > j else minus[j])
                    add(-abs(i - j), a[i], minus[-j] if i > j else b[-j])
            elif i or j:
                add(i + j, a[i], b[j])
                add(-i - j, a[-i], b[-j])
            elif a[0] is not None:
                add(0, 0.5 * a[0], b[0])
    return out
