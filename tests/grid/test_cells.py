"""Interpolation in a cell: what it reproduces, and the numbering of points, cells and corners."""
import itertools

import drjit as dr
import numpy as np
import pytest
from drjit.llvm import Array3f64, Float64, UInt32

from mi_shlight.grid.cells import CORNERS, INTERPOLATIONS, Cells, corner_weights

SIZE = np.array([0.5, 1.2, 2.0])
PLACES = np.concatenate([np.random.default_rng(0).uniform(0, 1, (40, 3)), [[0, 0, 0], [1, 1, 1], [1, 0, 1]]])
UPPER = np.array([[k >> a & 1 for a in range(3)] for k in range(CORNERS)])


def weights(interpolation, places=PLACES):
    """(8, 4, N): weights of value and derivatives at each corner."""
    at = corner_weights(interpolation, Array3f64(*map(Float64, np.asarray(places, dtype=float).T)), Array3f64(*map(float, SIZE)))
    rows = [[w + dr.zeros(Float64, len(places)) for w in at(UInt32(k))] for k in range(CORNERS)]
    dr.eval(rows)
    return np.array([[np.array(w) for w in row] for row in rows])


def error(interpolation, powers):
    """Largest error for the monomial with exponents `powers`, over places in the cell at the origin."""
    def monomial(p, powers):
        return np.prod(p ** np.array(powers), axis=-1) if min(powers) >= 0 else np.zeros(len(p))

    def slopes(p):
        lowered = [tuple(np.array(powers) - np.eye(3, dtype=int)[a]) for a in range(3)]
        return np.stack([powers[a] * monomial(p, lowered[a]) for a in range(3)], axis=-1)

    corners = UPPER * SIZE
    table = np.concatenate([monomial(corners, powers)[:, None], slopes(corners)], axis=1)
    found = np.einsum("kjn,kj->n", weights(interpolation), table)
    return abs(found - monomial(PLACES * SIZE, powers)).max()


def powers_up_to(degree):
    return [p for p in itertools.product(range(degree + 1), repeat=3) if sum(p) <= degree]


@pytest.mark.parametrize("interpolation, exact, inexact", [
    ("hermite", powers_up_to(3) + [(3, 1, 0), (0, 3, 1), (1, 1, 3), (1, 1, 1), (2, 1, 1)], [(2, 2, 0), (4, 0, 0)]),
    ("tricubic", [(0, 0, 0), (1, 1, 0), (1, 1, 1), (3, 0, 0), (0, 3, 0), (0, 0, 3), (2, 0, 0)], [(2, 1, 0), (2, 0, 1), (4, 0, 0)]),
    ("trilinear", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1)], [(2, 0, 0)]),
    ("taylor", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(1, 1, 0)]),
    ("inverse_distance", [(0, 0, 0)], [(1, 0, 0)]),
])
def test_polynomials(interpolation, exact, inexact):
    """``hermite`` has all cubics, which makes it of fourth order; [W20] Algorithm 4 lacks x^2 y."""
    for powers in exact:
        assert error(interpolation, powers) < 1e-13, powers
    for powers in inexact:
        assert error(interpolation, powers) > 1e-3, powers


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_corners_keep_their_value(interpolation):
    table = weights(interpolation, UPPER)
    assert abs(table[:, 0] - np.eye(CORNERS)).max() < 2e-5 and np.isfinite(table).all()
    if interpolation in ("hermite", "tricubic", "trilinear"):
        assert abs(table[:, 1:]).max() < 1e-14


@pytest.mark.parametrize("interpolation", ["hermite", "tricubic", "trilinear"])
@pytest.mark.parametrize("axis", range(3))
def test_continuous_between_cells(interpolation, axis):
    """On a face, what the four corners of the face say is all that counts."""
    for side in (0, 1):
        places = PLACES.copy()
        places[:, axis] = side
        assert abs(weights(interpolation, places)[UPPER[:, axis] != side]).max() < 1e-14


@pytest.mark.parametrize("interpolation", ["hermite", "tricubic"])
def test_cubic_of_the_paper_along_an_edge(interpolation):
    """[W20] eqs. 33 and 35."""
    f_l, f_r, d_l, d_r, h = 0.3, -1.1, 2.0, 0.7, SIZE[0]
    t = PLACES * [1, 0, 0]
    x, s = t[:, 0] * h, (f_r - f_l) / h
    expected = f_l + d_l * x + (s - d_l) / h * x ** 2 + (d_l + d_r - 2 * s) / h ** 2 * x ** 2 * (x - h)
    table = np.zeros((CORNERS, 4))
    table[0, :2], table[1, :2] = (f_l, d_l), (f_r, d_r)
    assert abs(np.einsum("kjn,kj->n", weights(interpolation, t), table) - expected).max() < 1e-14


def test_numbering():
    cells = Cells(Array3f64(-1, 0, 2), Array3f64(1, 3, 4), 4)
    cell = dr.arange(UInt32, cells.cell_count)
    for corner in range(CORNERS):
        point = cells.corner_point(cell, corner)
        back, exists = cells.adjacent_cell(point, corner)
        assert dr.all(exists & (back == cell))
        offset = cells.point(point) - cells.centre(cell)
        expected = (UPPER[corner] - 0.5) * np.array(cells.size).ravel()
        assert abs(np.array(offset) - expected[:, None]).max() < 1e-14
    found, t = cells.locate(cells.centre(cell))
    assert dr.all(found == cell) and abs(np.array(t) - 0.5).max() < 1e-14
    around = sum(np.array(cells.adjacent_cell(dr.arange(UInt32, cells.point_count), k)[1]).astype(int) for k in range(CORNERS))
    assert sorted(set(around.tolist())) == [1, 2, 4, 8] and around.sum() == CORNERS * cells.cell_count


def test_points_on_and_beyond_the_border():
    cells = Cells(Array3f64(-1, 0, 2), Array3f64(1, 3, 4), 4)
    found, t = cells.locate(Array3f64([-1, 1, 1, 1.1, -3, 0], [0, 3, 3.0001, 3, 1, 1e30], [2, 4, 4, 4, 3, 3]))
    last, outside = cells.cell_count - 1, cells.cell_count
    assert np.array(found).tolist() == [0, last, last, outside, outside, outside]
    assert np.array(t)[:, :3].min() == 0 and np.array(t)[:, :3].max() < 1.001
