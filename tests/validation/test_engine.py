"""The benchmark measures what it says: lights, points, evaluations, oracle, verdicts. No timing decides a test."""
import json
import math

import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight.light.project import METHODS
from validation import engine, engine_report
from validation.engine import Points
from validation.engine_report import MONOMIAL, Plan, Record

ORDER = 3


@pytest.fixture(autouse=True)
def threads():
    """The benchmark sets the number of threads."""
    before = dr.thread_count()
    yield
    dr.set_thread_count(before)


def transfer(points, order):
    """The transfer vectors of all points, (count, (order + 1)**2), in float64."""
    i = np.arange((order + 1) ** 2)
    return np.array(points.parameter)[:, None] * np.cos(i) + np.sin(i)


def positions(points):
    return np.array([np.array(c) for c in points.x], dtype=np.float64).T


@pytest.mark.parametrize("edges", [3, 4, 7, 64])
def test_ellipse(edges):
    corners = engine.ellipse(edges)
    assert np.linalg.matrix_rank(corners, tol=1e-12) == 2
    assert 0.8 * 0.9 < np.linalg.norm(corners[:, None] - corners, axis=2).max() <= 1 or edges == 3
    normals = np.cross(np.roll(corners, -1, 0) - corners, np.roll(corners, -2, 0) - corners)
    assert (normals @ normals[0] > 0).all()           # convex


@pytest.mark.parametrize("distance", [0.05, 2, 1e4])
def test_points_see_the_front_at_the_distance(distance):
    for corners in (engine.ellipse(5), engine.parallelogram()):
        points = engine.points_around(corners, distance)
        assert np.allclose(np.linalg.norm(points, axis=1), distance, rtol=0.0201)
        assert all(reference.solid_angle(corners, x) > 0 for x in points[:50])
        assert np.linalg.matrix_rank(points) == 3


@pytest.mark.parametrize("distance", [0.05, 1, 1e4])
def test_parallelogram_minus_point_is_exact_in_float32(distance):
    corners, points = engine.parallelogram(), engine.points_around(engine.parallelogram(), distance, engine.GRID)
    assert np.dot(corners[0] - corners[1], np.cross(corners[2] - corners[1], corners[3] - corners[1])) == 0
    for corner in corners:
        assert np.array_equal((corner.astype(np.float32) - points.astype(np.float32)).astype(np.float64), corner - points)


@pytest.mark.parametrize("method", [*METHODS, MONOMIAL])
@pytest.mark.parametrize("group", engine.GROUPS)
def test_evaluations(group, method):
    corners = engine.ellipse(5)
    points = Points(engine.points_around(corners, 2.0)[:8], 16)
    values = np.array(engine.evaluation(group, method, ORDER)(engine.vectors(corners), points))
    exact = [reference.coefficients_quadrature(corners, x, ORDER, n=12) for x in positions(points)]
    expected = np.sum(transfer(points, ORDER) * exact, axis=1)
    assert np.allclose(values, expected, atol=1e-5 * np.linalg.norm(exact[0]) * (ORDER + 1))


def test_unit_is_a_loop_over_the_basis():
    points = Points(engine.points_around(engine.ellipse(3), 2.0)[:8], 8)
    d, expected = positions(points), 0
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = []
    for _ in range(engine.UNIT_LOOP):
        seen.append(d)
        expected = expected + np.sum(transfer(points, 8) * reference.sh_basis(d, 8), axis=1)
        x, y, z = d.T
        d = np.stack([z, 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y], axis=1)
    assert np.allclose(np.array(engine.basis_loop(points)), expected, rtol=1e-3)
    assert len(np.unique(np.round(np.array(seen)[:, 0], 3), axis=0)) == engine.UNIT_LOOP


@pytest.mark.parametrize("method", METHODS)
def test_many_lights(method):
    lights, points = engine.LightBuffers(11), Points(np.array([[0.1, 0.2, -0.3], [0.5, -1, 0]]), 2)
    values = np.array(engine.shade_all(method, ORDER, lights, points))
    centres = np.random.default_rng(2).uniform(-3, 3, (11, 3)) * [1, 1, 0.2] + [0, 0, 4]
    exact = [sum(reference.coefficients_quadrature(engine.ellipse(3 + k % 10) + c, x, ORDER, n=12) for k, c in enumerate(centres))
             for x in positions(points)]
    assert np.allclose(values, np.sum(transfer(points, ORDER) * exact, axis=1), atol=3e-5 * np.linalg.norm(exact[0]))


def test_errors_are_those_of_the_method():
    corners = engine.ellipse(4)
    points = engine.points_around(corners, 2.0)[:4]
    exact = np.array([reference.coefficients_quadrature(corners, x, ORDER, n=12) for x in points])
    assert engine.relative_errors("edge", ORDER, corners, points, exact).max() < 1e-5
    assert np.allclose(engine.relative_errors("edge", ORDER, corners, points, 2 * exact), 0.5, atol=1e-5)


def test_a_failure_is_on_record_and_the_others_are_measured():
    def broken(corners, points):
        raise RuntimeError("no such light")

    record, plan = Record(), Plan(rounds=3, budget=1e-4)
    corners = engine.ellipse(3)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        times = engine.take_turns(record, "test", {"edge": engine.evaluation("shading", "edge", 1), "broken": broken}, corners,
                                  engine.points_around(corners, 2.0), plan)
    assert set(times) == {engine.UNIT, "edge"}
    assert all(len(values) == 3 and min(values) > 0 for values in times.values())
    assert record.failures == ["test, broken: RuntimeError: no such light"]


def test_ratio_is_taken_within_rounds():
    assert engine.ratio([1, 20, 3], [1, 10, 1]) == 2


def test_linear_fit():
    x = [3, 4, 8, 16]
    assert engine_report.linear_fit(x, [2 * v + 1 for v in x]) == pytest.approx((2, 1, 1))
    assert engine_report.linear_fit(x, [1, 3, 1, 3])[2] < 0.9
    assert all(math.isnan(v) for v in engine_report.linear_fit([1, 2], [3, 4]))


def filled_record(edge_units, auto_ratio):
    record = Record()
    for order in (2, 8):
        for group in engine.GROUPS:
            for method, units in (("edge", edge_units), ("recurrence", 60.0), (MONOMIAL, 150.0)):
                record.rows["times"] += [{"group": group, "method": method, "order": order, "edges": n, "units": units * n / 4}
                                         for n in (3, 4, 8)]
    record.rows["distances"] = [{"distance": d, "order": 8, "method": "auto", "error": 1e-6, "units": 3.0, "over_cheapest": auto_ratio}
                                for d in (1, 10)]
    record.rows["first_call"] = [{"method": "edge", "order": 8, "seconds": 0.5}]
    record.rows["lights"] = [{"method": "edge", "ratio": 1.3}]
    return record


PLAN = Plan(orders=(2, 8), edges=(3, 4, 8), distances=(1, 10), sweep_orders=(8,), first_call_orders=(8,))


@pytest.mark.parametrize("edge_units, auto_ratio, met", [(20.0, 1.1, True), (50.0, 1.2, False)])
def test_targets(edge_units, auto_ratio, met):
    verdict = {line["target"]: line["met"] for line in engine_report.targets(filled_record(edge_units, auto_ratio), PLAN)}
    for target in ("shading, order 8, quadrilateral by edge: at most 40 fused dr.sh_eval(8)",
                   "projection, order 8, triangle by edge: at most 30 fused dr.sh_eval(8)",
                   "shading, order 8, quadrilateral: edge at least 2.5 times faster than recurrence",
                   "order 8: auto at most 1.15 times the cheapest accurate method, at every distance"):
        assert verdict[target] is met
    assert verdict["shading, order 8, quadrilateral: recurrence at least 2 times faster than monomials"] is True
    assert verdict["edge: time linear in the number of edges, R^2 at least 0.99"] is True
    assert verdict["edge: time linear in the number of coefficients, R^2 at least 0.99"] is None
    assert verdict["edge, order 8: first call at most 1.5 s"] is True
    assert verdict["recurrence, order 8: first call at most 1.5 s"] is None
    assert verdict["edge, order 8: first call with 100 lights of 3 to 12 edges at most 1.1 times that with one"] is False


def test_break_even():
    record = Record()
    record.rows["distances"] = [{"order": 8, "method": "quadrature", "units": units, "points": points}
                                for units, points in ((40.0, 64), (10.0, 4), (20.0, 16))]
    assert math.isnan(engine_report.break_even(record, 8))
    record.rows["distances"] += [{"order": 8, "method": "edge", "units": units} for units in (19.0, 20.0, 21.0)]
    assert engine_report.break_even(record, 8) == pytest.approx(4)
    assert math.isnan(engine_report.break_even(record, 4))
    record.rows["distances"] += [{"order": 8, "method": "edge", "units": 100.0}] * 7
    assert math.isnan(engine_report.break_even(record, 8))


def test_cubature_points_fall_with_the_distance():
    corners = engine.parallelogram()
    counts = [engine.cubature_points(ORDER, corners, engine.points_around(corners, distance)[:16]) for distance in (1, 10, 1e4)]
    assert counts[0] > counts[1] > counts[2] == 1


def test_a_distance_at_which_auto_failed_is_a_missed_target():
    record = filled_record(20.0, 1.0)
    record.rows["distances"].pop()
    verdict = {line["target"]: line["met"] for line in engine_report.targets(record, PLAN)}
    assert verdict["order 8: auto at most 1.15 times the cheapest accurate method, at every distance"] is False
    assert verdict["order 8: error of auto at most 1e-5 at every distance"] is False


def test_first_call_runs_in_a_fresh_process():
    seconds = engine.in_fresh_process(1, method="edge", order=1)
    assert set(seconds) == {"shading_1", "projection_1", "shading_1024", "projection_1024"} and min(seconds.values()) > 0
    with pytest.raises(RuntimeError, match="exit status 1: ValueError: .*'order' must be at most 14"):
        engine.in_fresh_process(1, method=MONOMIAL, order=15)


def test_whole_run(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(engine, "QUICK", Plan(orders=(1, 2), edges=(3, 4, 8), edge_orders=(2,), distances=(1,), sweep_orders=(2,),
                                              first_call_orders=(), lights_repeats=0, rounds=1, monte_carlo_sides=(1, 2), budget=1e-4))
    for module in (engine, engine_report):
        monkeypatch.setattr(module, "STANDARD_ORDER", 2)
    assert engine.main(["--quick", "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "engine.json").read_text())
    assert report["failures"] == [] and report["quick"] is True
    assert len(report["times"]) == 2 * (3 + 1) * (len(METHODS) + 1)        # order 1: quadrilaterals alone
    assert max(row["max"] for row in report["errors"]) < 1e-4
    assert [row["samples"] for row in report["monte_carlo"]] == [2, 8, 2, 8]
    assert report["versions"]["drjit"] == dr.__version__ and report["versions"]["threads"] == 1
    assert (tmp_path / "engine.png").stat().st_size > 1e4
    printed = capsys.readouterr().out
    assert "recurrence at least 2 times faster than monomials" in printed and "shading    edge           2" in printed
