"""The comparison of gradients measures what it says: differences, errors, timed evaluations, verdicts. No timing decides a test."""
import dataclasses
import json

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f, Array3f64

import reference
from validation import gradient_cost, gradients
from validation.engine import Points, vectors
from validation.engine_report import Plan, Record

ORDER = 2


@pytest.fixture(autouse=True)
def threads():
    """The benchmark sets the number of threads."""
    before = dr.thread_count()
    yield
    dr.set_thread_count(before)


def some_cases():
    cases = reference.reference_cases()
    return [next(case for case in cases if case.name == name) for name in ("quad", "distance 100")]


def exact_spatial_gradient(point):
    """(3, C) of the light of the figure."""
    return -reference.gradients_mp(gradients.LIGHT, point, ORDER, digits=20).sum(axis=0)


def test_receiver_is_the_square_of_the_paper_and_exact_in_float32():
    points = gradients.receiver(128)
    assert np.array_equal(points, points.astype(np.float32))
    x, y = points[:, 0].reshape(128, 128), points[:, 1].reshape(128, 128)
    assert (np.diff(x, axis=1) > 0).all() and (np.diff(y, axis=0) > 0).all() and (np.diff(x, axis=0) == 0).all()
    assert points[:, :2].min() == 3 + 3 / 256 and points[:, :2].max() == 6 - 3 / 256 and not points[:, 2].any()
    assert reference.solid_angle(gradients.LIGHT, points[0]) > 0


def test_differences_are_derivatives():
    points = gradients.receiver(2)
    found = gradients.central_differences(points, ORDER, 1e-4)
    exact = np.array([exact_spatial_gradient(point) for point in points])
    assert found.shape == exact.shape == (4, 3, 9)
    assert np.abs(found - exact).max() < 1e-7 * np.abs(exact).max()


def test_images(monkeypatch):
    monkeypatch.setattr(gradients, "SHOWN", ((2, -1), (1, 0)))
    images = gradients.measure_images(2)
    exact = np.array([exact_spatial_gradient(point) for point in gradients.receiver(2)])
    assert list(images) == [(2, -1, 0), (2, -1, 1), (2, -1, 2), (1, 0, 0), (1, 0, 1), (1, 0, 2)]
    for (l, m, axis), image in images.items():
        expected = exact[:, axis, l * (l + 1) + m].reshape(2, 2)
        for name, tolerance in (("edge float64", 1e-13), ("recurrence float64", 1e-13), ("fourth order", 1e-10), ("edge float32", 2e-6),
                                ("recurrence float32", 2e-6), ("differences", 1e-4)):
            assert np.abs(image[name] - expected).max() < tolerance, name


def test_image_errors_are_largest_differences():
    field = np.array([[1.0, -2.0], [0.5, 0.0]])
    image = {"fourth order": field, "differences": field * 1.5, "edge float64": field, "recurrence float64": field + 0.02,
             "edge float32": field, "recurrence float32": field - 0.2}
    edge, recurrence = gradients.image_errors({(7, 2, 1): image})
    assert edge["axis"] == "y" and edge["largest"] == 2
    assert (edge["from_differences"], edge["from_fourth_order"], edge["float32"]) == (0.5, 0, 0)
    assert (recurrence["from_differences"], recurrence["from_fourth_order"], recurrence["float32"]) == (0.51, 0.01, 0.11)


def test_differences_err_by_the_square_of_the_step_and_the_gradients_do_not():
    steps = gradients.measure_steps(some_cases()[0], ORDER, np.array([1e-2, 1e-3]))
    first, second = steps["float64"]["differences"]
    assert first / second == pytest.approx(100, rel=0.05) and second > 1e-8
    assert all(steps["float64"][method] < 1e-9 for method in gradients.METHODS)
    assert all(steps["float32"][method] < 1e-4 for method in gradients.METHODS)


def test_vertex_gradients_of_each_lane():
    corners = some_cases()[0].vertices
    lanes = gradients.corners_of(np.array([corners, 2 * corners]), Array3f64)
    found = gradients.vertex_gradients(lanes, Array3f64(0), ORDER, "edge")
    exact = reference.gradients_mp(corners, (0, 0, 0), ORDER, digits=20)
    assert found.shape == (2, 4, 3, 9)
    assert np.allclose(found[0], exact, atol=1e-13) and np.allclose(found[1], exact / 2, atol=1e-13)


def test_classes_report_the_largest_error_and_what_is_not_finite(monkeypatch):
    case = some_cases()[0]
    cases = tuple(dataclasses.replace(case, name=name) for name in ("quad", "quad", "star"))

    def broken(vertices, x, order, method):
        right = np.stack([case.gradients[..., :(order + 1) ** 2]] * 3)
        if method == "edge":
            right[1] *= 1.25
            right[2, 0, 0, 0] = np.nan
        return right

    monkeypatch.setattr(gradients, "vertex_gradients", broken)
    rows = gradients.measure_classes(cases, ORDER)
    assert len(rows) == 2 * len(gradients.METHODS) * 2
    by = {(row["class"], row["method"], row["precision"]): (row["max"], row["not_finite"]) for row in rows}
    assert by["quad", "edge", "float32"] == (0.25, 0)
    assert by["star", "edge", "float64"] == (0, 1)
    assert by["quad", "auto", "float64"] == (0, 0)


@pytest.mark.parametrize("error, not_finite, met", [(1e-12, 0, True), (1e-3, 1, False)])
def test_verdicts_on_errors(error, not_finite, met):
    rows = [{"class": name, "method": "auto", "precision": precision, "max": error, "not_finite": not_finite}
            for name in ("triangle", "distance 1e+06") for precision in gradients.PRECISIONS]
    assert [line["met"] for line in gradients.targets(rows)] == [met] * 4
    assert [line["met"] for line in gradients.targets([])][:3] == [None] * 3


def test_whole_comparison(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gradients, "SHOWN", ((1, 0),))
    monkeypatch.setattr(gradients, "STEP_ORDER", 1)
    monkeypatch.setattr(gradients.reference, "reference_cases", lambda: tuple(some_cases()))
    gradients.main(["--size", "4", "--order", "1", "--out", str(tmp_path)])
    report = json.loads((tmp_path / "gradients.json").read_text())
    assert report["order"] == 1 and len(report["images"]) == 3 * 2 and len(report["classes"]) == 2 * 4 * 2
    assert all(line["met"] for line in report["targets"])
    assert all((tmp_path / name).stat().st_size > 1e4 for name in ("gradients.png", "gradients_accuracy.png"))
    assert "distance 100" in capsys.readouterr().out


@pytest.fixture(scope="module")
def evaluated():
    """Every evaluation of the benchmark, order 2, as arrays of the three corners (N, 3, points) or totals."""
    corners, base = gradient_cost.light(3)
    corners, points = vectors(corners), Points(base[:4], 8)
    results = {name: function(corners, points) for name, function in gradient_cost.evaluations(ORDER).items()}
    dr.eval(results)
    return corners, points, results


def test_timed_values_are_one_quantity(evaluated):
    corners, points, results = evaluated
    transfer = np.array(points.parameter)[:, None] * np.cos(np.arange(9)) + np.sin(np.arange(9))
    places = np.array([np.array(c) for c in points.x], dtype=float).T
    light = gradient_cost.light(3)[0].astype(np.float32).astype(float)
    expected = [t @ reference.coefficients_quadrature(light, x, ORDER, n=12) for t, x in zip(transfer, places)]
    values = [results[name] for name in gradient_cost.VALUE.values()]
    values += [results[name][0] for name in gradient_cost.GRADIENT.values()]
    values += [results[name][0] for name in (gradient_cost.REVERSE, gradient_cost.FORWARD, gradient_cost.RECURRENCE)]
    for method in gradient_cost.CLOSED_FORMS:
        values.append(results[f"{gradient_cost.COEFFS}, {method}"])
        values += [results[f"{name}, {method}"][0] for name in (gradient_cost.SPATIAL, gradient_cost.VERTICES)]
    assert len(values) == 13
    for value in values:
        assert np.allclose(np.array(value), expected, atol=3e-6)


def test_timed_gradients_are_one_quantity(evaluated):
    corners, points, results = evaluated
    gradient, by_auto = (np.array([[np.array(g[k]) for k in range(3)] for g in results[name][1]])             # (N, 3, points)
                         for name in gradient_cost.GRADIENT.values())
    largest = np.abs(gradient).max()
    assert gradient.shape == (3, 3, 8) and largest > 0.01
    assert np.allclose(by_auto, gradient, atol=2e-5 * largest)
    differences = np.array([np.array(q) for q in results[gradient_cost.DIFFERENCES]]).reshape(gradient.shape)
    assert np.allclose(differences, gradient, atol=5e-3 * largest)
    for name in (gradient_cost.REVERSE, gradient_cost.RECURRENCE):
        total = np.array([[g[k][0] for k in range(3)] for g in results[name][1]])
        assert np.allclose(total, gradient.sum(axis=2), atol=2e-5 * largest), name
    motion = np.array([[np.cos(i), np.sin(i), 0.5] for i in range(3)])
    assert np.allclose(np.array(results[gradient_cost.FORWARD][1]), np.einsum("nk,nkp->p", motion, gradient), atol=2e-5 * largest)
    for method in gradient_cost.CLOSED_FORMS:
        vertex = np.array([[np.array(c) for c in g] for g in results[f"{gradient_cost.VERTICES}, {method}"][1]])
        spatial = np.array([np.array(c) for c in results[f"{gradient_cost.SPATIAL}, {method}"][1]])
        quotients = np.array([np.array(c) for c in results[f"{gradient_cost.POINT_DIFFERENCES}, {method}"]])
        assert np.allclose(vertex, gradient, atol=2e-5 * largest)
        assert np.allclose(spatial, -gradient.sum(axis=0), atol=2e-5 * largest)
        assert np.allclose(quotients, spatial, atol=5e-3 * largest)


def test_reverse_mode_leaves_the_corners_alone(evaluated):
    corners, _, _ = evaluated
    assert not dr.grad_enabled(corners) and all(type(v) is Array3f for v in corners)


@pytest.mark.parametrize("gradient, met", [(14.0, True), (16.0, False)])
def test_verdicts_on_times(gradient, met):
    analytic = gradient_cost.GRADIENT["edge"]
    times = {gradient_cost.VALUE["edge"]: [10.0, 20.0], analytic: [gradient, 2 * gradient], gradient_cost.RECURRENCE: [70, 160]}
    rows = gradient_cost.ratios({"times": times, "first_call": {}}, *gradient_cost.SIZES[0])
    rows += gradient_cost.ratios({"times": times, "first_call": {}}, *gradient_cost.SIZES[1])
    lines = gradient_cost.targets(rows)
    assert len(lines) == len(gradient_cost.LIMITS)
    verdicts = {(entry.numerator, entry.denominator, entry.table): line["met"] for entry, line in zip(gradient_cost.LIMITS, lines)}
    assert verdicts[analytic, gradient_cost.VALUE["edge"], "times"] is met
    assert verdicts[gradient_cost.RECURRENCE, analytic, "times"] is met
    assert verdicts[gradient_cost.RECURRENCE, analytic, "first_call"] is None
    assert "order 8, 4 edges, time: value + vertex gradients, edge / value, edge at most 1.5" in [line["target"] for line in lines]


def test_first_calls_run_in_fresh_processes(monkeypatch):
    analytic = gradient_cost.GRADIENT["edge"]
    monkeypatch.setattr(gradient_cost, "FIRST_CALLS", (analytic, "no such evaluation"))
    record = Record()
    seconds = gradient_cost.measure_first_calls(record, Plan(first_call_repeats=1), 1, 3)
    assert list(seconds) == [analytic] and seconds[analytic][0] > 0
    assert record.rows["first_call"][0]["seconds"] == pytest.approx(seconds[analytic][0], rel=1e-3)
    assert len(record.failures) == 1 and "exit status 1: KeyError: 'no such evaluation'" in record.failures[0]


def test_whole_run(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gradient_cost, "SIZES", ((1, 3),))
    monkeypatch.setattr(gradient_cost, "FIRST_CALLS", ())
    monkeypatch.setattr(gradient_cost, "QUICK", Plan(rounds=1, budget=1e-4))
    assert gradient_cost.main(["--quick", "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "gradient_cost.json").read_text())
    assert report["failures"] == [] and report["quick"] is True and len(report["times"]) == len(gradient_cost.evaluations(1))
    assert all((row["ratio"] is None) == (row["table"] == "first_call") for row in report["ratios"])
    assert (tmp_path / "gradient_cost.png").stat().st_size > 1e4
    assert "value + vertex gradients" in capsys.readouterr().out
