"""Products of functions: against values multiplied point by point, and the three ways to a triple product among themselves."""
import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight.sh import gaunt, product, product_matrix, triple_product

RNG = np.random.default_rng(11)


def coefficients(order, *shape):
    return RNG.normal(size=(*shape, (order + 1) ** 2))


def integrate(order, *factors):
    """``int prod_i f_i Y_k dw`` of functions given by their coefficients, by quadrature with scipy's harmonics."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    phi = 2 * np.pi * np.arange(48) / 48
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, phi, indexing="ij"))
    rho = np.sqrt(1 - z * z)
    basis = reference.sh_basis(np.stack([rho * np.cos(phi), rho * np.sin(phi), z], axis=1), 14)
    values = np.repeat(weights, 48) * (2 * np.pi / 48)
    for f in factors:
        values = values * (f @ basis[:, :f.shape[-1]].T)
    return values @ basis[:, :(order + 1) ** 2]


@pytest.mark.parametrize("orders", [(0, 0, 0), (1, 1, 1), (2, 3, 4), (4, 2, 6)])
def test_gaunt(orders):
    table = gaunt(*orders)
    dense = np.zeros([(n + 1) ** 2 for n in orders])
    dense[tuple(table.indices.T)] = table.values
    units = [np.eye((n + 1) ** 2) for n in orders]
    expected = integrate(orders[2], units[0][:, None], units[1][None])
    np.testing.assert_allclose(dense, expected, atol=1e-14)
    assert (abs(expected) > 1e-12).sum() == len(table.values)
    assert table.indices.tolist() == sorted(table.indices.tolist())


@pytest.mark.parametrize("orders", [(0, 0, 0), (0, 3, 2), (1, 1, 2), (3, 2, 5), (2, 5, 7), (4, 8, 4)])
def test_product(precision, orders):
    a, b = coefficients(orders[0], 5), coefficients(orders[1], 5)
    out = product(*([precision.Float(c.copy()) for c in f.T] for f in (a, b)), orders[2])
    dr.eval(out)
    expected = integrate(orders[2], a, b)
    tolerance = 20 * precision.eps * np.linalg.norm(a, axis=1, keepdims=True) * np.linalg.norm(b, axis=1, keepdims=True)
    assert (abs(np.array(out).T - expected) < tolerance).all()
    np.testing.assert_allclose(product(a, b, orders[2]), expected, atol=1e-12)


def test_the_product_is_complete_by_default():
    a, b = coefficients(3).tolist(), coefficients(2).tolist()
    assert len(product(a, b)) == 36
    np.testing.assert_allclose(product(a, b), integrate(5, np.array(a), np.array(b)), atol=1e-13)
    np.testing.assert_allclose(product(a, b, 3), product(a, b)[:16], atol=1e-13)


def test_one_is_neutral():
    a, one = coefficients(6), [np.sqrt(4 * np.pi)]
    np.testing.assert_allclose(product(a.tolist(), one), a, atol=1e-14)
    np.testing.assert_allclose(product(one, a.tolist()), a, atol=1e-14)


@pytest.mark.parametrize("orders", [(4, 8, 4), (4, 4, 8), (3, 0, 2)])
def test_triple_product_equals_transfer_matrix(orders):
    """The two routes share no code: latitudes and Fourier series here, Gaunt coefficients there."""
    a, b, c = (coefficients(n) for n in orders)
    matrix = np.array(product_matrix(a.tolist(), orders[1], orders[2]))
    value = triple_product(a.tolist(), b.tolist(), c.tolist())
    size = np.linalg.norm(a) * np.linalg.norm(b) * np.linalg.norm(c)
    assert abs(c @ matrix @ b - value) < 1e-15 * size
    assert abs(integrate(orders[2], a, b) @ c - value) < 1e-15 * size
    for swapped in ((b, c, a), (c, b, a)):
        assert abs(triple_product(*(f.tolist() for f in swapped)) - value) < 1e-15 * size
    assert triple_product(a, b, c) == pytest.approx(value, abs=1e-14 * size)


@pytest.mark.parametrize("orders", [(2, 3, 3), (4, 2, 5), (3, 4, 1)])
def test_product_matrix(precision, orders):
    a = coefficients(orders[0], 3)
    rows = product_matrix([precision.Float(c.copy()) for c in a.T], orders[1], orders[2])
    dr.eval(rows)
    expected = np.moveaxis(integrate(orders[2], a[:, None], np.eye((orders[1] + 1) ** 2)[None]), -1, -2)
    got = np.array([[np.broadcast_to(np.array(v), 3) for v in row] for row in rows])
    assert np.abs(np.moveaxis(got, -1, 0) - expected).max() < 20 * precision.eps * np.linalg.norm(a, axis=1).max()
    np.testing.assert_allclose(product_matrix(a, orders[1], orders[2]), expected, atol=1e-13)


def test_matrix_is_square_by_default():
    a = coefficients(2)
    assert np.array_equal(product_matrix(a, 3), product_matrix(a, 3, 3))
    assert np.array_equal(product_matrix(a.tolist(), 2), product_matrix(a.tolist(), 2, 2))


def test_none_is_zero():
    a, b = coefficients(4), coefficients(3)
    zonal = [c if i in (0, 2, 6, 12, 20) else 0.0 for i, c in enumerate(a)]
    sparse = [c if i in (0, 2, 6, 12, 20) else None for i, c in enumerate(a.tolist())]
    for other in (b.tolist(), [None, *b.tolist()[1:]], [None] * 16):
        full = [0.0 if c is None else c for c in other]
        np.testing.assert_allclose(product(sparse, other, 5), product(zonal, full, 5), atol=1e-14)
        assert triple_product(sparse, other, other) == pytest.approx(triple_product(zonal, full, full), abs=1e-13)
    np.testing.assert_allclose(product_matrix(sparse, 2), product_matrix(zonal, 2), atol=1e-15)
    np.testing.assert_allclose(product(np.array([b, b]), sparse), [product(b, zonal)] * 2, atol=1e-14)


def test_leading_axes_are_broadcast():
    a, b = coefficients(2, 4, 1), coefficients(3, 5)
    assert product(a, b).shape == (4, 5, 36)
    np.testing.assert_allclose(product(a, b)[2, 3], product(a[2, 0], b[3]), atol=1e-14)
    assert triple_product(a, b, coefficients(1)).shape == (4, 5)
    np.testing.assert_allclose(product(a, b[3].tolist()), product(a, b[3]), atol=1e-14)


def test_complex_functions():
    a, b, c = (coefficients(n) + 1j * coefficients(n) for n in (2, 3, 4))
    parts = product(a.real, b.real) - product(a.imag, b.imag) + 1j * (product(a.real, b.imag) + product(a.imag, b.real))
    np.testing.assert_allclose(product(a, b), parts, atol=1e-13)
    np.testing.assert_allclose(product_matrix(a, 3, 5) @ b, parts, atol=1e-13)
    assert triple_product(a, b, c) == pytest.approx(parts[:25] @ c, abs=1e-12)


def test_derivative_is_the_product_with_the_other():
    number = dr.llvm.ad.Float64
    a, b, step = coefficients(2), coefficients(3), coefficients(2)
    t = number(0)
    dr.enable_grad(t)
    out = product([number(p) + t * q for p, q in zip(a.tolist(), step.tolist())], [number(c) for c in b.tolist()], 4)
    dr.forward(t)
    np.testing.assert_allclose(np.array([dr.grad(c)[0] for c in out]), integrate(4, step, b), atol=1e-13)


@pytest.mark.parametrize("call, argument", [
    (lambda: product([1.0] * 3, [1.0]), "a"), (lambda: product([1.0], [1.0] * 3), "b"), (lambda: product([1.0], [1.0], -1), "order"),
    (lambda: product(np.ones(4), np.ones(5)), "b"), (lambda: triple_product([1.0], [1.0], [1.0] * 2), "c"),
    (lambda: product_matrix([1.0] * 2, 2), "a"), (lambda: product_matrix([1.0], 99), "order_in"), (lambda: gaunt(1, 2, 3.5), "order_c"),
    (lambda: product(np.ones((2, 4)), np.ones((3, 4))), "a, b"),
    (lambda: triple_product(np.ones((2, 4)), np.ones(1), np.ones((3, 4))), "a, b, c")])
def test_bad_values(call, argument):
    with pytest.raises(ValueError, match=rf"\(\): '{argument}' must "):
        call()


@pytest.mark.parametrize("call, argument", [
    (lambda: product("a", "b"), "a"), (lambda: product([1.0], ["b"]), "b"), (lambda: product(np.array(["a"]), [1.0]), "a"),
    (lambda: product(np.ones(4), [dr.llvm.Float(1)]), "b"), (lambda: product([1.0], None), "b"),
    (lambda: triple_product([1.0], [1.0], [1j]), "c"), (lambda: triple_product([dr.llvm.Float(1)], [1.0], np.ones(1)), "a"),
    (lambda: product_matrix(["a"], 1), "a"), (lambda: product_matrix(np.array(["a"]), 1), "a"), (lambda: gaunt([1], 1, 1), "order_a")])
def test_bad_types(call, argument):
    with pytest.raises(TypeError, match=rf"\(\): '{argument}' must "):
        call()
