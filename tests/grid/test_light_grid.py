"""The light grid: against exact evaluation, with and without near faces; derivatives; bad input."""
import drjit as dr
import numpy as np
import pytest

from autodiff import derivative
from mi_shlight import LightGrid, project_mesh
from mi_shlight.grid.cells import Cells
from mi_shlight.grid.nodes import NodeTable
from mi_shlight.grid.split import NearLists
from mi_shlight.light.facets import facet_table
from mi_shlight.light.project import light_shader

ORDER = 4
LOWER, UPPER = (0, 0, 0), (2, 2, 2)
POINTS = np.random.default_rng(3).uniform(0, 2, (400, 3))
TRANSFER = np.random.default_rng(4).normal(size=(ORDER + 1) ** 2).tolist()

# Far: above and beside the box, facing it. Near: inside of it, in the plane of grid points, touching one, on the border.
FAR = np.array([[0.2, 0.3, 4], [1.8, 0.1, 4.2], [1.5, 1.9, 4.1], [0.3, 1.6, 3.9], [5, 0.2, 1], [5.2, 1.8, 0.5], [4.8, 1.1, 2.5]])
FAR_FACES = [[0, 1, 2, 3], [4, 5, 6]]
NEAR = np.array([[0.5, 0.5, 1.0], [1.0, 0.5, 1.0], [1.0, 1.0, 1.0], [0.5, 1.0, 1.0], [1.3, 1.2, 0.2], [1.31, 1.2, 0.2], [1.3, 1.21, 0.25],
                 [0, 0, 2], [2, 0, 2], [2, 2, 2], [0, 2, 2]])
NEAR_FACES = [[0, 1, 2, 3], [3, 2, 1, 0], [4, 5, 6], [6, 5, 4], [7, 8, 9, 10]]
RADIANCE = np.array([[1, 0.5, 0.2], [0.3, 0.4, 0.9], [1, 2, 3], [0.5, 0, 0.7], [40, 30, 20], [10, 20, 30], [0.1, 0.2, 0.3]])
ALL, ALL_FACES = np.concatenate([FAR, NEAR]), FAR_FACES + [[k + len(FAR) for k in face] for face in NEAR_FACES]

# 300 small triangles in a layer above the box and into it
MANY = (np.random.default_rng(6).uniform((-1, -1, 1.8), (3, 3, 3), (300, 1, 3))
        + np.random.default_rng(7).uniform(-0.2, 0.2, (300, 3, 3))).reshape(-1, 3)
MANY_FACES = np.arange(900).reshape(-1, 3)


def light_grid(precision, vertices=ALL, faces=ALL_FACES, radiance=RADIANCE, resolution=5, order=ORDER, **options):
    return LightGrid(vertices, faces, radiance, precision.vector(LOWER), precision.vector(UPPER), resolution, order, **options)


def wide(precision, points):
    return precision.Array3(*map(precision.Float, np.asarray(points, dtype=float).T))


def values(coeffs):
    dr.eval(coeffs)
    return np.array([np.array(c) for c in coeffs], dtype=float)


def exact(precision, vertices=ALL, faces=ALL_FACES, radiance=RADIANCE, points=POINTS, order=ORDER):
    return values(project_mesh(vertices, faces, radiance, wide(precision, points), order, "edge", one_sided=True))


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def test_exact_at_the_points_of_the_grid(precision):
    line = np.linspace(0, 2, 5)
    points = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    grid = light_grid(precision, FAR, FAR_FACES, RADIANCE[:2])
    assert grid.near_faces == 0
    expected = exact(precision, FAR, FAR_FACES, RADIANCE[:2], points)
    assert relative(values(grid.eval(wide(precision, points))), expected) < 60 * precision.eps + 1e-11


@pytest.mark.parametrize("interpolation, order", [("hermite", 4), ("tricubic", 3), ("trilinear", 2)])
def test_order_of_convergence(interpolation, order):
    """In space, off the axes: [W20] Algorithm 4 is of third order, the default of fourth."""
    ad = dr.llvm.ad
    grids = [LightGrid(FAR, FAR_FACES, RADIANCE[:2, 0], ad.Array3f64(LOWER), ad.Array3f64(UPPER), m, 2, interpolation) for m in (9, 17)]
    points = ad.Array3f64(*map(ad.Float64, POINTS.T))
    expected = values(project_mesh(FAR, FAR_FACES, RADIANCE[:2, 0], points, 2, "edge"))
    coarse, fine = (relative(values(grid.eval(points)), expected) for grid in grids)
    assert order - 0.4 < np.log2(coarse / fine) < order + 0.5


@pytest.mark.parametrize("interpolation", ["taylor", "inverse_distance"])
def test_baselines_are_baselines(precision, interpolation):
    options = {"vertices": FAR, "faces": FAR_FACES, "radiance": RADIANCE[:2]}
    expected, x = exact(precision, **options), wide(precision, POINTS)
    baseline, hermite = (relative(values(light_grid(precision, **options, interpolation=i).eval(x)), expected)
                         for i in (interpolation, "hermite"))
    assert 10 * hermite < baseline < 0.5


@pytest.mark.parametrize("max_error", [1e-2, 1e-3])
def test_near_faces_keep_the_error_down(precision, max_error):
    """Lights inside the box, through points of the grid and on its border; relative to the light at each point."""
    grid = light_grid(precision, max_error=max_error)
    assert 0 < grid.near_faces < len(ALL_FACES)
    expected, found = exact(precision), values(grid.eval(wide(precision, POINTS)))
    light = expected[0].sum(axis=0) * np.sqrt(4 * np.pi)
    error = np.sqrt(((found - expected) ** 2).sum(axis=(0, 1))) / np.pi / light
    assert np.median(error) < max_error and np.percentile(error, 99) < 8 * max_error
    blurred = values(light_grid(precision).eval(wide(precision, POINTS)))
    blur = np.sqrt(((blurred - expected) ** 2).sum(axis=(0, 1))) / np.pi / light
    assert np.median(blur) > 4 * np.median(error)


def test_lights_in_the_ceiling(precision):
    """Their plane is the box's face: none of it is cut by a cell, but its points lie where the light ends."""
    line = np.linspace(0, 2, 5)
    low = np.array([(x, y) for x in line[:-1] for y in line[:-1]])
    corners = np.concatenate([low + offset for offset in ([0, 0], [0.5, 0], [0.5, 0.5], [0, 0.5])])
    ceiling = {"vertices": np.column_stack([corners, np.full(64, 2.0)]), "faces": np.arange(64).reshape(4, 16).T, "radiance": np.ones(16)}
    points = POINTS * [1, 1, 0.5] + [0, 0, 0.995]
    expected = exact(precision, **ceiling, points=points)
    found = values(light_grid(precision, **ceiling, resolution=8, max_error=1e-3).eval(wide(precision, points)))
    assert np.sqrt(((found - expected) ** 2).sum(axis=0)).max() / np.pi < 4e-3 * expected[0].max() * np.sqrt(4 * np.pi)


def test_radiance_below_zero(precision):
    x = wide(precision, POINTS)
    below, above = (light_grid(precision, radiance=sign * RADIANCE, max_error=1e-2) for sign in (-1, 1))
    assert below.near_faces == above.near_faces > 0
    assert relative(-values(below.eval(x)), values(above.eval(x))) < 4 * precision.eps


def test_everything_near_is_exact(precision):
    grid = light_grid(precision, max_error=0, method="edge")
    x = wide(precision, POINTS)
    assert relative(values(grid.eval(x)), exact(precision)) < 60 * precision.eps
    coarse = light_grid(precision, resolution=2, max_error=0)
    assert relative(values(coarse.eval(x)), exact(precision)) < 60 * precision.eps + 1e-11


def test_points_outside_are_exact(precision):
    points = POINTS + [2.5, 0, 0]
    found = values(light_grid(precision).eval(wide(precision, points)))
    assert relative(found, exact(precision, points=points)) < 60 * precision.eps + 1e-11


def test_shade_is_the_sum_over_the_coefficients(precision):
    for options in ({}, {"max_error": 1e-2}):
        grid, x = light_grid(precision, **options), wide(precision, POINTS)
        coeffs = values(grid.eval(x))
        shaded = np.array(grid.shade(x, TRANSFER), dtype=float)
        assert relative(shaded, np.einsum("k,kcn->cn", TRANSFER, coeffs)) < 100 * precision.eps + 1e-11


def test_one_channel_equals_the_first_of_three(precision):
    x = wide(precision, POINTS)
    three = values(light_grid(precision).eval(x))[:, 0]
    one = light_grid(precision, radiance=RADIANCE[:, 0])
    assert relative(values(one.eval(x)), three) < 4 * precision.eps
    assert np.array(one.shade(x, TRANSFER)).shape == (len(POINTS),)


def test_vertices_and_radiance_as_dr_jit_arrays(precision):
    x, flat = wide(precision, POINTS), precision.Float(ALL.ravel())
    found = values(light_grid(precision, flat, radiance=wide(precision, RADIANCE)).eval(x))
    assert relative(found, values(light_grid(precision).eval(x))) < 10 * precision.eps


def test_points_that_are_not_finite(precision):
    x = precision.Array3([0.5, np.inf, np.nan], 0.5, [0.5, 0.5, 0.5])
    coeffs = values(light_grid(precision, max_error=1e-2).eval(x))
    assert np.isfinite(coeffs[..., 0]).all() and np.isnan(coeffs[..., 1:]).all()
    assert np.isfinite(np.array(light_grid(precision).shade(x, TRANSFER))[:, 0]).all()


def test_lights_that_are_not_finite(precision):
    """Said as in project_mesh, not left out in silence."""
    x, broken = wide(precision, POINTS[:4]), FAR.copy()
    broken[2, 1] = np.nan
    assert np.isnan(values(light_grid(precision, broken, FAR_FACES, RADIANCE[:2]).eval(x))).all()
    dark = wide(precision, [[1, 1, np.inf], [1, 1, 1]])
    assert np.isnan(np.array(light_grid(precision, FAR, FAR_FACES, dark).shade(x, TRANSFER))).all()


@pytest.mark.parametrize("vertices", [ALL * 0, ALL[:1] + 0 * ALL, ALL * [1, 0, 0], np.round(ALL), ALL * 1e-20, ALL * 1e8])
def test_degenerate_lights_stay_finite(precision, vertices):
    """Without area, at points of the grid, tiny and huge."""
    line = np.linspace(0, 2, 5)
    points = np.concatenate([POINTS[:20], np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)])
    for max_error in (None, 1e-3):
        assert np.isfinite(values(light_grid(precision, vertices, max_error=max_error).eval(wide(precision, points)))).all()


def test_dark_lights(precision):
    assert (values(light_grid(precision, radiance=RADIANCE * 0, max_error=1e-3).eval(wide(precision, POINTS))) == 0).all()


def test_groups_stay_apart(precision):
    table = facet_table(precision.Float, [np.array(face) for face in ALL_FACES])
    table = table.placed(precision.Float(ALL.ravel()), precision.Float(RADIANCE.ravel()), 3)
    x, cells = wide(precision, POINTS), Cells(precision.vector(LOWER), precision.vector(UPPER), 5)
    nodes = NodeTable(cells, table, NearLists(cells, table, [0, 2, len(ALL_FACES)], 1e-2), ORDER, "hermite", "edge")
    shade = light_shader([precision.Float(t) for t in TRANSFER], ORDER, "edge")
    for group, part in enumerate((slice(0, 2), slice(2, None))):
        expected = exact(precision, faces=ALL_FACES[part], radiance=RADIANCE[part])
        coeffs, shades = nodes.eval(x, group), nodes.shade(x, [precision.Float(t) for t in TRANSFER], shade, group)
        dr.eval(coeffs, shades)                       # read one by one they would be computed anew each time
        found = np.array([[np.array(c) for c in colour] for colour in coeffs], dtype=float)
        assert relative(found, expected) < 0.02
        shaded = np.array([np.array(c) for c in shades])
        assert relative(shaded, np.einsum("k,kcn->cn", TRANSFER, expected)) < 0.05


@pytest.mark.parametrize("argument, value, text", [
    ("resolution", 1, "from 2 to 256"), ("resolution", "8", "integer"), ("order", -1, "order"), ("interpolation", "cubic", "hermite"),
    ("method", "magic", "recurrence"), ("max_error", 2, "from 0 to 1"), ("max_error", "auto", "number"),
    ("upper", (0, 3, 3), "above 'lower'"), ("upper", (np.inf, 3, 3), "above 'lower'"), ("lower", "here", "3-vector"),
    ("faces", [[0, 1]], "three or more"), ("radiance", [1.0], "one for each face"), ("vertices", "mesh", "vertices"),
])
def test_bad_input(argument, value, text):
    ad = dr.llvm.ad
    given = {"vertices": FAR, "faces": FAR_FACES, "radiance": [1.0, 2.0], "lower": ad.Array3f(LOWER), "upper": UPPER, "resolution": 4}
    with pytest.raises((TypeError, ValueError), match=r"LightGrid\(\)") as caught:
        LightGrid(**{**given, argument: value})
    assert text in str(caught.value)


def test_grids_too_large_for_memory():
    ad = dr.llvm.ad
    with pytest.raises(ValueError, match="numbers to hold, got 200"):
        LightGrid(FAR, FAR_FACES, [1.0, 2.0], ad.Array3f(LOWER), UPPER, 200, 14)
    with pytest.raises(ValueError, match="pairs of cells and polygons, got 256"):
        LightGrid(np.tile(FAR, (6, 1)), np.arange(42).reshape(-1, 3), np.ones(14), ad.Array3f(LOWER), UPPER, 256, 0, max_error=1e-2)


def test_needs_a_jit_backend():
    with pytest.raises(TypeError, match="JIT backend"):
        LightGrid(FAR, FAR_FACES, [1.0, 2.0], LOWER, UPPER, 4)


def test_bad_arguments_of_the_methods():
    ad = dr.llvm.ad
    grid = LightGrid(FAR, FAR_FACES, [1.0, 2.0], ad.Array3f(LOWER), UPPER, 3, 1)
    with pytest.raises(TypeError, match=r"LightGrid.eval\(\): 'x'"):
        grid.eval(3)
    with pytest.raises(TypeError, match="precision of the grid"):
        grid.eval(ad.Array3f64(0, 0, 0))
    with pytest.raises(ValueError, match="'transfer' must be a list of 4 floats"):
        grid.shade(ad.Array3f(0, 0, 0), [1.0])


@pytest.mark.parametrize("vertices, faces, max_error", [(FAR, FAR_FACES, None), (ALL, ALL_FACES, 1e-2), (MANY, MANY_FACES, 1e-2)],
                         ids=["all far", "near and far", "hundreds"])
@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_derivatives_flow_through_the_grid(mode, vertices, faces, max_error):
    """Against differences, along a random displacement of all vertices, and of all radiances."""
    ad, random = dr.llvm.ad, np.random.default_rng(8)
    radiance = np.resize(RADIANCE, (len(faces), 3))
    by_vertices, by_radiance = random.normal(size=vertices.size), random.normal(size=radiance.shape)
    colours = lambda rows: ad.Array3f64(*map(ad.Float64, rows.T))
    for moves, changes in ((1, 0), (0, 1)):
        def value(t):
            positions = ad.Float64(vertices.ravel()) + t * moves * ad.Float64(by_vertices)
            emitted = colours(radiance) + t * changes * colours(by_radiance)
            grid = LightGrid(positions, faces, emitted, ad.Array3f64(LOWER), ad.Array3f64(UPPER), 4, 2, max_error=max_error)
            shaded = grid.shade(ad.Array3f64(*map(ad.Float64, POINTS[:50].T)), TRANSFER[:9])
            return dr.sum(shaded[0] + 0.5 * shaded[1] * shaded[1])

        def at(t):
            t = ad.Float64(t)
            dr.enable_grad(t)                         # which decides which faces are near
            return value(t)[0]

        slope, step = derivative(value, ad.Float64, mode), 1e-6
        difference = (at(step) - at(-step)) / (2 * step)
        assert abs(slope - difference) < 1e-5 * abs(difference)


def test_derivatives_by_the_point(precision):
    """Those of the interpolant itself."""
    grid = light_grid(precision, FAR, FAR_FACES, RADIANCE[:2])
    along = np.array([0.3, -0.5, 0.8])

    def value(t):
        x = wide(precision, POINTS[:20]) + t * precision.vector(along)
        return dr.sum(grid.shade(x, TRANSFER)[0])

    step = 1e-2 if precision.eps > 1e-10 else 1e-5
    difference = (value(precision.Float(step))[0] - value(precision.Float(-step))[0]) / (2 * step)
    for mode in ("forward", "backward"):
        assert abs(derivative(value, precision.Float, mode) - difference) < (2e-2 if precision.eps > 1e-10 else 1e-8) * abs(difference)
