"""What [G03] prints: each number is ours, or one of the slips that are known; and the recorded run holds what it claims."""
import json
import pathlib

import numpy as np
import pytest

from mi_shlight.sh.windows import KINDS
from validation import green

RECORDED = json.loads((pathlib.Path(green.__file__).parent / "results" / "green.json").read_text())


def test_equation_10():
    """Without the sign (-1)^m, and with the last factor 1/2 where it must be 1/4."""
    for name, row in green.equation_10().items():
        m = int(name.split(",")[1])
        assert row["printed_over_ours"] == pytest.approx({"2,2": 2}.get(name, (-1) ** m)) and row["spread"] < 1e-13


def test_example_light():
    """Within its Monte Carlo noise, but for the one that is missing and the sign of the one before it."""
    report = green.example_light()
    assert report["exact_against_quadrature"] < 1e-6
    rows = report["coefficients"]
    assert [row["index"] for row in rows if row["printed"] is None] == [9]
    deviations = [(abs(row["printed"]) - abs(row["exact"])) / row["standard_error"] for row in rows if row["printed"] is not None]
    assert np.abs(deviations).max() < 3 and 0.2 < np.mean(np.square(deviations)) < 2.5
    wrong = [row["index"] for row in rows if row["printed"] is not None and abs(row["deviations"]) > 3]
    assert wrong == [8]
    assert all(abs(row["ours_10000_samples"] - row["exact"]) < 4 * row["standard_error"] for row in rows)


def test_matrices():
    rows = green.matrices()
    small = {name for name, error in rows.items() if error < 1e-14}
    assert small == {"X_-90 as +90, signed", "X_-90 as -90, unsigned", "X_+90 as -90, signed", "X_+90 as +90, unsigned", "Z_a as +a",
                     "Z_c X_-90 Z_b X_+90 Z_a as Rz(c) Ry(+b) Rz(a), unsigned", "Z_c X_-90 Z_b X_+90 Z_a as Rz(c) Ry(-b) Rz(a), signed",
                     "equation 11 as that product with a and c exchanged"}
    assert all(error > 0.1 for name, error in rows.items() if name not in small)


def test_cap():
    report = green.cap()
    assert report["largest_difference_printed"] < 2e-9 and report["their_others_are_zero"] == 0


def test_rotations():
    report = green.rotations(12, 5)
    errors = {name: error for name, error in report.items() if name not in ("count", "order")}
    assert errors.pop("float32_against_float64") < 2e-6 and max(errors.values()) < 1e-13 and len(errors) == 4


def test_windows_trade_ringing_for_sharpness():
    rows = {(row["half_angle"], row["order"], row["window"]): row for row in green.windows()}
    for (angle, order, kind), row in rows.items():
        plain = rows[angle, order, "none"]
        assert kind == "none" or row["undershoot"] < 0.4 * plain["undershoot"] and row["overshoot"] < 0.4 * plain["overshoot"]
        assert kind == "none" or plain["relative_l2_error"] < row["relative_l2_error"] < 1.6 * plain["relative_l2_error"]
    # The table of mi_shlight.sh.window.
    table = {kind: [rows[30, 8, kind][name] for name in ("overshoot", "undershoot", "relative_l2_error")] for kind in KINDS}
    expected = {"none": (0.26, 0.075, 0.38), "lanczos": (0.075, 0.015, 0.43), "hann": (0, 0.010, 0.47), "gauss": (0, 0.010, 0.46)}
    for kind, row in expected.items():
        np.testing.assert_allclose(table[kind], row, atol=5e-3)


def test_recorded_run():
    rotations = RECORDED["rotations"]
    assert rotations["count"] >= 10_000 and rotations["order"] == 20 and rotations["float32_against_float64"] < 5e-6
    assert max(rotations[name] for name in ("orthogonality", "composition", "inverse", "against_projection")) < 1e-12
    for sky in RECORDED["skies"].values():
        assert sky["largest_difference_to_quadrature"] < 2e-4 * sky["largest_coefficient"]
        errors = list(sky["relative_l2_error_by_order"].values())
        assert errors == sorted(errors, reverse=True) and errors[-1] < 0.3
