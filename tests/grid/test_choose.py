"""Choice of the resolution: exact for few lights or points, finer for more points."""
import drjit as dr
import numpy as np
from drjit.llvm import Array3f, Float

from mi_shlight.grid.choose import cheapest_grid
from mi_shlight.light.facets import facet_table


SAMPLES = Array3f(np.random.default_rng(2).uniform(0, 1, (3, 1000)))


def chosen(lights, points, max_error=1e-3):
    """Resolution for small triangles above the unit cube, or 0."""
    random = np.random.default_rng(1)
    middle = random.uniform(-1, 2, (lights, 1, 3)) * [1, 1, 0] + [0, 0, 1.2]
    corners = middle + 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    table = facet_table(Float, list(np.arange(3 * lights).reshape(-1, 3)))
    table = table.placed(Float(corners.ravel()), dr.full(Float, 1, lights), 1)
    cells, near = cheapest_grid(table, [0, lights], Array3f(0), Array3f(1), 8, points, SAMPLES, max_error)
    assert (cells is None) == (near is None)
    return cells.resolution if cells else 0


def test_few_lights_are_exact():
    assert chosen(3, 10 ** 7) == 0


def test_few_points_are_exact():
    assert chosen(300, 10) == 0


def test_finer_for_more_points_and_smaller_errors():
    resolutions = [chosen(300, 10 ** k) for k in (4, 6, 8)]
    assert 0 < resolutions[1] <= resolutions[2] and resolutions[0] <= resolutions[1] and resolutions[0] < resolutions[2]
    assert chosen(300, 10 ** 6, 1e-2) < chosen(300, 10 ** 6, 1e-4)
