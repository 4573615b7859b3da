"""Rotation of coefficients: against turned functions, as a representation of the rotations, at the poles, differentiated."""
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reference
from mi_shlight.sh import rotate, rotate_frame, rotation_matrices

# Identity, half turns and quarter turns about the axes, z on its head, z a little off the poles, and any.
SPECIAL = np.array([np.eye(3), np.diag([1, -1, -1]), np.diag([-1, 1, -1]), np.diag([-1, -1, 1]),
                    *(Rotation.from_euler(axis, angle, degrees=True).as_matrix() for axis in "xyz" for angle in (90, -90))])
TILTED = np.array([(Rotation.from_euler("zyz", (50, angle, 20), degrees=True)).as_matrix() for angle in (1e-7, 1e-4, 1e-2, 179.999)])
ROTATIONS = np.concatenate([SPECIAL, TILTED, Rotation.random(20, random_state=7).as_matrix()])
RNG = np.random.default_rng(5)
DIRECTIONS = RNG.normal(size=(300, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def coefficients(order, *shape):
    return np.random.default_rng(order).normal(size=(*shape, (order + 1) ** 2))


def turned(coeffs, rotation):
    """D(R) applied to a vector, one block per degree."""
    blocks = rotation_matrices(rotation, int(np.sqrt(len(coeffs))) - 1)
    return np.concatenate([block @ coeffs[l * l:(l + 1) ** 2] for l, block in enumerate(blocks)])


@pytest.mark.parametrize("order", [0, 1, 4, 20])
def test_turns_the_function(order):
    """f'(w) = f(R^-1 w), evaluated by scipy's harmonics."""
    coeffs = coefficients(order)
    for rotation in ROTATIONS:
        expected = reference.sh_basis(DIRECTIONS @ rotation, order) @ coeffs
        assert np.abs(reference.sh_basis(DIRECTIONS, order) @ rotate(coeffs, rotation) - expected).max() < 1e-13 * (order + 1) ** 2


def test_moves_a_lobe_as_the_matrix_moves_its_axis():
    """Degree 1 is a vector, (-y, z, -x) in our signs: what stands along z goes to R z."""
    for rotation in ROTATIONS:
        moved = rotate(np.array([0.0, 0, 1, 0]), rotation)
        np.testing.assert_allclose([-moved[3], -moved[1], moved[2]], rotation[:, 2], atol=1e-15)


@pytest.mark.parametrize("order", [20, 64])
def test_matrices_are_orthogonal(order):
    for block in rotation_matrices(ROTATIONS[9:15], order):
        assert np.abs(np.swapaxes(block, -1, -2) @ block - np.eye(block.shape[-1])).max() < 1e-13


def test_matrices_are_orthogonal_for_rounded_rotations():
    for block in rotation_matrices(ROTATIONS.astype(np.float32), 20):
        assert np.abs(np.swapaxes(block, -1, -2) @ block - np.eye(block.shape[-1])).max() < 1e-13


def test_composition_and_inverse():
    first, second = ROTATIONS, np.roll(ROTATIONS, 5, axis=0)
    blocks = zip(rotation_matrices(first @ second, 20), rotation_matrices(first, 20), rotation_matrices(second, 20),
                 rotation_matrices(np.swapaxes(first, -1, -2), 20))
    for both, a, b, inverse in blocks:
        assert np.abs(both - a @ b).max() < 1e-12
        assert np.abs(inverse - np.swapaxes(a, -1, -2)).max() < 1e-12


@pytest.mark.parametrize("order", [1, 6])
def test_traced_equals_matrices(precision, order):
    coeffs = coefficients(order, len(ROTATIONS))
    axes = [precision.Array3(*(precision.Float(ROTATIONS[:, i, j].copy()) for i in range(3))) for j in range(3)]
    local = [precision.Float(c.copy()) for c in coeffs.T]
    world = rotate_frame(local, *axes, order)
    back = rotate_frame(world, *axes, order, inverse=True)
    dr.eval(world, back)
    expected = rotate(coeffs, ROTATIONS)
    tolerance = 10 * (order + 1) * precision.eps * np.linalg.norm(coeffs, axis=1).max()
    assert np.abs(np.array(world).T - expected).max() < tolerance
    assert np.abs(np.array(back).T - coeffs).max() < 2 * tolerance


@pytest.mark.parametrize("arguments, error, text", [
    (([1.0] * 4, 3), ValueError, "'coeffs' must have 16 entries, as 'order' is 3"), (([1.0] * 9, 1), ValueError, "'coeffs' must have 4"),
    (([1.0] * 4, -1), ValueError, "'order' must be an integer"), ((1.0, 0), TypeError, "'coeffs' must have"),
    ((["a"] * 4, 1), TypeError, "'coeffs' must hold Python or Dr.Jit floats"), (([1.0], 0, "z"), TypeError, "'n' must be a 3-vector")])
def test_bad_frame_arguments(arguments, error, text):
    coeffs, order, n = (*arguments, (0, 0, 1))[:3]
    with pytest.raises(error, match=r"rotate_frame\(\): " + text):
        rotate_frame(coeffs, (1, 0, 0), (0, 1, 0), n, order)


def test_none_is_zero():
    frame = [dr.llvm.Array3f64(*map(float, column)) for column in ROTATIONS[-1].T]
    zonal = [None] * 16
    zonal[6], zonal[12] = dr.llvm.Float64(0.7), dr.llvm.Float64(-0.3)
    dense = [dr.llvm.Float64(0) if c is None else c for c in zonal]
    for inverse in (False, True):
        sparse = rotate_frame(zonal, *frame, 3, inverse)
        assert type(sparse[0]) is dr.llvm.Float64 and sparse[0][0] == 0
        np.testing.assert_allclose(np.array(sparse), np.array(rotate_frame(dense, *frame, 3, inverse)), atol=1e-15)


@pytest.mark.parametrize("kind", ["list", "numpy", "scalar transform", "transform", "matrix"])
def test_forms_of_a_rotation(kind):
    transform = mi.ScalarTransform4f().translate([1, 2, 3]).rotate([0.6, 0, 0.8], 40)
    matrix = np.array(transform.matrix)[:3, :3]
    given = {"list": matrix.tolist(), "numpy": matrix, "scalar transform": transform, "transform": mi.Transform4f(transform),
             "matrix": mi.Matrix3f(matrix.tolist())}[kind]
    coeffs = coefficients(2)
    values = [c[0] if dr.is_jit_v(c) else c for c in rotate(coeffs.tolist(), given)]
    np.testing.assert_allclose(values, turned(coeffs, matrix), atol=2e-6)


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("start", [np.eye(3), np.diag([1.0, -1, -1]), ROTATIONS[-1]], ids=["pole", "lower pole", "any"])
def test_derivatives(start, inverse):
    """By a rotation on top of `start` and by the coefficients, against differences of the matrices."""
    number, vector = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    coeffs, weights = coefficients(3), RNG.normal(size=16)

    def value(by, factor):
        rotation = Rotation.from_rotvec(by).as_matrix() @ start
        return weights @ turned(coeffs * factor, rotation.T if inverse else rotation)

    turn, factor = vector(0, 0, 0), number(1)
    dr.enable_grad(turn, factor)
    axes = [vector(*map(float, column)) for column in start.T]
    out = rotate_frame([factor * float(c) for c in coeffs], *(axis + dr.cross(turn, axis) for axis in axes), 3, inverse)
    dr.backward(sum(o * float(w) for o, w in zip(out, weights)))
    step = 1e-5
    expected = [(value(h, 1) - value(-h, 1)) / (2 * step) for h in np.eye(3) * step]
    np.testing.assert_allclose([dr.grad(turn)[k][0] for k in range(3)], expected, atol=1e-8)
    assert dr.grad(factor)[0] == pytest.approx(value(np.zeros(3), 1), rel=1e-12)


@pytest.mark.parametrize("rotation, error, hint", [
    (np.diag([1.0, 1, -1]), ValueError, "It mirrors"), (2 * np.eye(3), ValueError, "divide the axes by their lengths"),
    (np.full((3, 3), np.nan), ValueError, "divide the axes"), (np.eye(2), TypeError, "Pass a matrix"), ("x", TypeError, "Pass a matrix"),
    (ROTATIONS[:2], TypeError, "Pass a matrix"), (None, TypeError, "Pass a matrix")])
def test_bad_rotation(rotation, error, hint):
    with pytest.raises(error, match=r"rotate\(\): 'rotation' must be a rotation: .*" + hint):
        rotate([1.0] * 4, rotation)


@pytest.mark.parametrize("coeffs, error", [([1.0] * 5, ValueError), ([], ValueError), (np.ones(8), ValueError), (3.0, TypeError),
                                           (np.float64(3), TypeError), (np.array(3.0), TypeError)])
def test_bad_coefficients(coeffs, error):
    with pytest.raises(error, match=r"rotate\(\): 'coeffs' must have \(order \+ 1\)\*\*2 entries"):
        rotate(coeffs, np.eye(3))


@pytest.mark.parametrize("coeffs, rotation, error, text", [
    (["a"] * 4, np.eye(3), TypeError, "'coeffs' must hold Python or Dr.Jit floats"),
    (np.array(["a"] * 4), np.eye(3), TypeError, "'coeffs' must hold numbers"),
    (np.ones((2, 4)), ROTATIONS[:3], ValueError, "'coeffs, rotation' must have leading axes that can be broadcast, got .*2,.*3,")])
def test_bad_entries(coeffs, rotation, error, text):
    with pytest.raises(error, match=r"rotate\(\): " + text):
        rotate(coeffs, rotation)
