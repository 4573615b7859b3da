"""The stability maps show lights where they say, and the errors of the methods; what is not finite is a failure."""
import json

import numpy as np
import pytest

import reference
from mi_shlight.light.project import MAX_ERROR, METHODS
from validation import stability_maps
from validation.stability_maps import FAMILIES, Maps

ORDER = 1
FEW = {name: family._replace(rows=family.rows[-5::4], columns=family.columns[-5::4]) for name, family in FAMILIES.items()}


def lights(name, row, column, count=50):
    """Triangles of one cell (count, 3, 3), their unit normals, and how far the point is from their planes."""
    family = FAMILIES[name]._replace(rows=np.array([row]), columns=np.array([column]))
    corners = stability_maps.lights_of(family, "float64", count)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return corners, normal, abs((normal * corners[:, 0]).sum(axis=1))


def circumcentre(corners):
    """Of triangles of diameter 1: from the first corner along both the bisector and the normal."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross, square = np.cross(a, b), lambda v: (v * v).sum(axis=1, keepdims=True)
    return corners[:, 0] + (square(a) * np.cross(b, cross) - square(b) * np.cross(a, cross)) / (2 * square(cross))


@pytest.mark.parametrize("name, unit, distance, sine", [("distance and angle", 1, 1e-2, 1), ("distance and angle", 1, 10, 1e-3),
                                                        ("scale", 1e20, 0.1, None), ("scale", 1e-20, 1e3, None)])
def test_distance_and_angle(name, unit, distance, sine):
    corners, _, height = lights(name, *((unit, distance) if name == "scale" else (distance, sine)))
    centre = circumcentre(corners)
    assert np.allclose(np.linalg.norm(centre, axis=1), distance * unit, rtol=1e-9)
    assert np.allclose(np.linalg.norm(corners - centre[:, None], axis=2), unit / 2, rtol=1e-9)
    if sine is not None:
        assert np.allclose(height, distance * sine, rtol=1e-9)
    else:
        assert (height >= 0.1 * distance * unit * (1 - 1e-9)).all()


def test_slivers():
    corners, _, height = lights("sliver", 10.0, 1e-3)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert (abs(np.linalg.norm(corners, axis=2) - 10) <= 0.5).all() and (sides.max(axis=1) > 0.5).all()
    assert (2 * area / sides.max(axis=1) < 1e-3).all() and (height >= 1 - 1e-9).all()


def test_border():
    corners, normal, height = lights("border", 1e-3, 1e-2)
    along = corners[:, 1] - corners[:, 0]
    outward = np.cross(along, normal) / np.linalg.norm(along, axis=1, keepdims=True)
    sideways = (outward * corners[:, 0]).sum(axis=1)
    beyond = -(along * corners[:, 0]).sum(axis=1) / (along * along).sum(axis=1)
    assert np.allclose(height, 1e-3, rtol=1e-9) and np.allclose(abs(sideways), 1e-2, rtol=1e-9)
    assert 0.2 < (sideways > 0).mean() < 0.8
    assert -0.2 <= beyond.min() < 0 and 1 < beyond.max() <= 1.2


def test_lights_are_numbers_of_their_precision():
    family = FEW["border"]
    single, double = (stability_maps.lights_of(family, precision, 2) for precision in ("float32", "float64"))
    assert single.shape == (len(family.rows) * len(family.columns) * 2, 3, 3)
    assert np.array_equal(single, single.astype(np.float32)) and not np.array_equal(double, double.astype(np.float32))


def test_reach_of_an_octant():
    assert stability_maps.reach(np.array([np.eye(3) * [[1], [5], [1e-9]]])) == pytest.approx(6)


def test_one_size_away():
    for name, count in (("distance and angle", 13 * 13), ("sliver", 9 * 13), ("border", 0), ("scale", 13 * 7)):
        assert stability_maps.from_one_size(FAMILIES[name]).sum() == count


def test_limits_are_exactly_in_the_plane():
    for name, corners in stability_maps.limit_lights().items():
        assert np.array_equal(corners, corners.astype(np.float32)) and corners.shape == (6, 3, 3)
        scaled = corners / abs(corners).max(axis=(1, 2), keepdims=True)
        assert abs(np.linalg.det(scaled)).max() < 1e-15, name
        assert np.linalg.norm(np.cross(scaled[:, 1] - scaled[:, 0], scaled[:, 2] - scaled[:, 0]), axis=1).min() > 0.1


@pytest.mark.parametrize("precision, tolerance", [("float32", 1e-3), ("float64", 1e-2)])
def test_errors_are_those_of_the_methods(precision, tolerance):
    """Against 60 digits, light by light: those of the closed forms, which are large enough to be compared, to `tolerance`."""
    family = FEW["sliver"]
    maps = stability_maps.measure("sliver", family, precision, ORDER, 1)
    polygons = stability_maps.lights_of(family, precision, 1)
    exact = np.array([reference.coefficients_mp(p, (0, 0, 0), ORDER, digits=60) for p in polygons])
    found = stability_maps.compute(polygons, stability_maps.PRECISIONS[precision], ORDER, ("edge",), ()).coefficients["edge"]
    error = np.linalg.norm(found - exact, axis=1) / np.linalg.norm(exact, axis=1)
    large = error > (1e-4 if precision == "float32" else 1e-13)
    assert large.any() and maps.coefficients["edge"].shape == (2, 2, 1)
    assert np.allclose(maps.coefficients["edge"].ravel()[large], error[large], rtol=tolerance)
    eps = np.finfo(stability_maps.DTYPES[precision]).eps
    assert maps.coefficients["auto"].max() < 3 * MAX_ERROR[precision == "float64"]
    assert max(maps.gradients[method].max() for method in METHODS if method != "recurrence") < 100 * eps
    assert maps.cubature.max() == 1 and 0.01 < maps.law < 4 and maps.regret == 0


def errors(lights):
    return dict.fromkeys(METHODS, np.array(lights, dtype=float))


def test_summary():
    family = FAMILIES["distance and angle"]._replace(rows=np.array([0.1, 1]), columns=np.array([1e-3, 1]))
    found = stability_maps.summary(family, np.array([[[1e-3, 1e-7], [1e-7, np.nan]], [[1e-6, 1e-6], [2e-6, 1e-6]]]), 1e-5)
    assert found == {"max": 1e-3, "at": {"distance": 0.1, "sine of the angle with the plane": 1e-3}, "max_from_one_size": 2e-6,
                     "median": 1.5e-6, "above": 0.25, "not_finite": 1}


def test_targets():
    families = {"sliver": FAMILIES["sliver"]._replace(rows=np.array([0.1, 1]), columns=np.array([1.0]))}
    maps = Maps("sliver", "float32", 8, errors([[[1e-3]], [[1e-6]]]), errors([[[1e-6]], [[1e-6]]]), np.zeros((2, 1)), 6.0, 0.5)
    limits = [{"solid_angle": 2 * np.pi, "not_finite": 0}]
    lines = stability_maps.targets(stability_maps.rows_of(families, [maps]), [maps], limits)
    assert [line["met"] for line in lines] == [True, False, False, False, True, True, True]
    limits[0]["not_finite"] = 1
    assert stability_maps.targets(stability_maps.rows_of(families, [maps]), [maps], limits)[-2]["met"] is False


def test_whole_run(tmp_path, monkeypatch, capsys):
    """Of one family, in which a method gives a NaN: it is counted, and the exit status tells."""
    monkeypatch.setattr(stability_maps, "FAMILIES", {"sliver": FEW["sliver"]})
    monkeypatch.setattr(stability_maps, "ORDERS", (ORDER, 0))
    assert stability_maps.main(["--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "stability_maps.json").read_text())
    assert [len(report[key]) for key in ("targets", "rows", "limits", "maps")] == [16, 2 * 8 + 4, 40, 2]
    assert all(row["not_finite"] == 0 for row in report["rows"] + report["limits"])
    edge = next(row for row in report["rows"] if row["method"] == "edge")
    assert abs(max(map(max, report["maps"][0]["coefficients_db"]["edge"])) - 10 * np.log10(edge["max"])) <= 0.5
    for name in ("float32", "float64", "gradients"):
        assert (tmp_path / f"stability_maps_{name}.png").stat().st_size > 1e4
    assert "from one size away" in capsys.readouterr().out

    whole = stability_maps.coefficients
    monkeypatch.setattr(stability_maps, "coefficients",
                        lambda vertices, x, order, method: whole(vertices, x, order, method) * (np.nan if method == "edge" else 1))
    assert stability_maps.main(["--out", str(tmp_path)]) == 1
    assert json.loads((tmp_path / "stability_maps.json").read_text())["targets"][-2]["met"] is False
