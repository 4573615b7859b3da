"""Refinement of meshes for the bake: where points lie, which are shared, and how a hit finds them."""
import numpy as np
import pytest

from mi_shlight.transfer.mesh import RIM, automatic_edge, refine, spread_to_buried

TRIANGLE = np.array([[0, 0, 0], [4, 0, 0], [0, 3, 0]], np.float32)
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
BENT = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]], np.float32)
"""A square with one corner lifted: its two faces meet at an angle along the edge 0-2."""


def interpolate(mesh, face, u, v, values):
    """`values` (R, C) at barycentric (u, v) of a face, written independently of the look-up on the device."""
    k = int(mesh.subdivision[face])
    index = {}
    for j in range(k + 1):
        for i in range(k + 1 - j):
            index[i, j] = len(index)
    j = min(int(v * k), k - 1)
    i = min(int(u * k), k - 1 - j)
    a, b = u * k - i, v * k - j
    if a + b <= 1:
        cell = [((i, j), 1 - a - b), ((i + 1, j), a), ((i, j + 1), b)]
    else:
        cell = [((i + 1, j + 1), a + b - 1), ((i, j + 1), 1 - a), ((i + 1, j), 1 - b)]
    return sum(w * values[mesh.rows[mesh.first[face] + index[key]]] for key, w in cell)


def barycentrics(count, seed):
    uv = np.random.default_rng(seed).uniform(0, 1, (count, 2))
    return np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)


def check_positions(faces, positions, mesh, tolerance, seed=0):
    """Interpolated baked positions equal the surface up to the rim's pull."""
    for face, corners in enumerate(positions[faces].astype(float)):
        cell = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).max() / mesh.subdivision[face]
        for u, v in barycentrics(40, seed + face):
            truth = corners[0] * (1 - u - v) + corners[1] * u + corners[2] * v
            shift = np.linalg.norm(interpolate(mesh, face, u, v, mesh.positions) - truth)
            assert shift <= (RIM + tolerance) * cell


@pytest.mark.parametrize("max_edge, k", [(np.inf, 1), (5.0, 1), (4.9, 2), (2.4, 4), (0.7, 8), (0.001, 256)])
def test_subdivision_is_a_power_of_two(max_edge, k):
    mesh = refine(np.array([[0, 1, 2]]), TRIANGLE, None, max_edge)
    assert mesh.subdivision.tolist() == [k]
    assert len(mesh.rows) == (k + 1) * (k + 2) // 2 == len(mesh.positions), "a single triangle shares no point"
    assert sorted(mesh.rows) == list(range(len(mesh.positions)))


def test_infinite_edge_keeps_the_mesh():
    mesh = refine(SQUARE_FACES, SQUARE, None, np.inf)
    assert len(mesh.positions) == 4
    assert np.abs(mesh.positions[mesh.rows.reshape(2, 3)] - SQUARE[SQUARE_FACES]).max() <= RIM * np.sqrt(2)


def test_coplanar_faces_share_their_edge():
    mesh = refine(SQUARE_FACES, SQUARE, None, 0.4)
    assert mesh.subdivision.tolist() == [4, 4]
    assert len(mesh.positions) == 25, "a 5 x 5 grid, nothing twice"
    np.testing.assert_array_equal(mesh.normals, np.tile([0, 0, 1], (25, 1)).astype(np.float32))


def test_flat_faces_at_an_angle_keep_their_points_apart():
    mesh = refine(SQUARE_FACES, BENT, None, 0.8)
    k = mesh.subdivision[0]
    each = (k + 1) * (k + 2) // 2
    assert len(mesh.positions) == 2 * each
    first, second = set(mesh.rows[:each]), set(mesh.rows[each:])
    assert not first & second
    for rows, corners in ((first, BENT[[0, 1, 2]]), (second, BENT[[0, 2, 3]])):
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        np.testing.assert_allclose(mesh.normals[sorted(rows)], np.tile(normal / np.linalg.norm(normal), (each, 1)), atol=1e-6)


def test_smooth_normals_are_shared_and_interpolated():
    normals = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [0, 0, 1]], np.float32)
    mesh = refine(SQUARE_FACES, BENT, normals, 0.8)
    k = int(mesh.subdivision[0])
    assert len(mesh.positions) == (k + 1) ** 2, "the bent square is smooth: its edge is shared"
    for face, corner in enumerate(SQUARE_FACES):
        for u, v in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.5, 0.0)):
            truth = normals[corner[0]] * (1 - u - v) + normals[corner[1]] * u + normals[corner[2]] * v
            np.testing.assert_allclose(interpolate(mesh, face, u, v, mesh.normals), truth / np.linalg.norm(truth), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)


def test_shading_seam_stays_apart():
    """Vertices at one place with different normals, as modellers write hard edges, are two points."""
    positions = np.concatenate([BENT[[0, 1, 2]], BENT[[0, 2, 3]]])
    normals = np.array([[0, 0, 1]] * 3 + [[0, -0.6, 0.8]] * 3, np.float32)
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    assert len(refine(faces, positions, normals, np.inf).positions) == 6
    same = np.tile(np.float32([0, 0, 1]), (6, 1))
    assert len(refine(faces, positions, same, np.inf).positions) == 4


@pytest.mark.parametrize("max_edge", [np.inf, 0.8, 0.3, 0.1])
@pytest.mark.parametrize("positions", [SQUARE, BENT], ids=["flat", "bent"])
def test_interpolation_reproduces_the_surface(positions, max_edge):
    check_positions(SQUARE_FACES, positions, refine(SQUARE_FACES, positions, None, max_edge), 1e-5)


def test_faces_of_different_size():
    """Small and large faces have their own k in one layout; the shared edge may be cut differently on its two sides."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [8, 8, 0]], np.float32)
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    mesh = refine(faces, positions, None, 1.0)
    assert mesh.subdivision.tolist() == [2, 16]
    assert mesh.first.tolist() == [0, 6]
    assert len(mesh.rows) == 6 + 17 * 18 // 2
    assert len(mesh.positions) == len(mesh.rows) - 3, "the edge's three points of the small face are among those of the large one"
    # a shared point is pulled by the mean over its faces: by up to 5 % of the larger of their cells
    cell = max(np.sqrt(2) / 2, np.sqrt(113) / 16)
    for face in range(2):
        corners = positions[faces[face]].astype(float)
        for u, v in barycentrics(40, face):
            truth = corners[0] * (1 - u - v) + corners[1] * u + corners[2] * v
            assert np.linalg.norm(interpolate(mesh, face, u, v, mesh.positions) - truth) <= (RIM + 1e-5) * cell


def test_rim_pulls_inwards_along_the_surface():
    mesh = refine(np.array([[0, 1, 2]]), TRIANGLE, None, 1.0)
    inside = (mesh.positions[:, 0] > 0) & (mesh.positions[:, 1] > 0) & (mesh.positions[:, 0] / 4 + mesh.positions[:, 1] / 3 < 1)
    assert inside.all(), "no baked point lies on the outline, where another wall may stand"
    assert (mesh.positions[:, 2] == 0).all()


@pytest.mark.parametrize("scale, offset", [(1e-3, 0), (1e3, 0), (1, 1e2)])
def test_points_are_shared_at_any_scale(scale, offset):
    mesh = refine(SQUARE_FACES, SQUARE * scale + np.float32(offset), None, 0.4 * scale)
    assert len(mesh.positions) == 25


def test_degenerate_faces():
    """Faces without area get a normal of length one and no NaN, and leave their neighbours alone."""
    faces = np.array([[0, 1, 2], [0, 0, 1], [0, 2, 3], [1, 1, 1]])
    mesh = refine(faces, SQUARE, None, 0.6)
    assert np.isfinite(mesh.positions).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    assert mesh.subdivision.tolist() == [4, 2, 4, 1]
    check_positions(faces[[0, 2]], SQUARE, _faces(mesh, [0, 2]), 0.06)


def _faces(mesh, chosen):
    return type(mesh)(mesh.positions, mesh.normals, mesh.cells, mesh.subdivision[chosen], mesh.first[chosen], mesh.rows)


def test_empty_mesh():
    mesh = refine(np.zeros((0, 3), int), np.zeros((0, 3), np.float32), None, 1.0)
    assert mesh.positions.shape == (0, 3) and len(mesh.rows) == len(mesh.first) == 0


def test_automatic_edge():
    assert automatic_edge(np.array([[0, 0, 0], [3, 0, 4]])) == pytest.approx(5 / 64)


def test_spread_to_buried():
    """Buried points take the mean of their visible neighbours; those without any, and all visible points, keep their value."""
    mesh = refine(SQUARE_FACES, SQUARE, None, 0.4)
    place = np.round(mesh.positions * 4).astype(int)
    row = {(x, y): r for r, (x, y, _) in enumerate(place.tolist())}
    rng = np.random.default_rng(3)
    values = rng.uniform(1, 2, (2, 25, 4)).astype(np.float32)
    buried = np.array([x <= 2 and y <= 2 for x, y, _ in place.tolist()])
    values[:, buried] = 0
    before = values.copy()
    spread_to_buried(mesh, buried, values)
    np.testing.assert_array_equal(values[:, ~buried], before[:, ~buried])
    np.testing.assert_array_equal(values[:, row[0, 0]], 0)
    np.testing.assert_array_equal(values[:, row[1, 1]], 0)
    # The square is cut along the diagonal 0-2, the grid's third direction is (1, 1) in both halves
    np.testing.assert_allclose(values[:, row[2, 2]], before[:, [row[3, 2], row[2, 3], row[3, 3]]].mean(axis=1), rtol=1e-6)
    np.testing.assert_allclose(values[:, row[2, 0]], before[:, [row[3, 0], row[3, 1]]].mean(axis=1), rtol=1e-6)


def test_spread_to_buried_without_any():
    mesh = refine(SQUARE_FACES, SQUARE, None, 0.4)
    values = np.ones((1, 25, 1), np.float32)
    spread_to_buried(mesh, np.zeros(25, bool), values)
    spread_to_buried(mesh, np.ones(25, bool), values)
    assert (values == 1).all()
