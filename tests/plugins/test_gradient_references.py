"""Gradients of `shprt` against Lambert's formula, Mitsuba's own references, and what the band limit predicts: the quick part of
validation/gradient_references.py."""
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from validation import gradient_oracle as oracle
from validation import gradient_references as gr
from validation.gradient_references import CASES, Reference, Setting

UNSHADOWED = Setting(4, "unshadowed")
SHADOWED = Setting(4, "pixel")
RECTANGLE, BEHIND = CASES["small rectangle"], CASES["rectangle behind occluder"]
PENTAGON = CASES["pentagon"]
MOTIONS = [pytest.param(case, name, id=f"{case.name}, {name}") for case in (RECTANGLE, CASES["large close rectangle"], PENTAGON)
           for name in case.motions]


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    for module, name, value in ((gr, "SUB", 2), (gr, "FINE", 4), (gr, "DIRECT_SPP", 512), (gr, "PROJECTIVE_SPP", 2048),
                                (oracle, "SPHERE", (32, 96))):
        monkeypatch.setattr(module, name, value)


def predicted(case, name, setting):
    transfer = oracle.transfer(gr.points_of(case, gr.SUB), setting.order, gr.corners(case)[::-1], case.occluder, setting.margin)
    return gr.band_limited(transfer, gr.coefficient_gradient(case, case.motions[name], setting.order), setting.order)


def gradient(case, name, setting):
    return gr.forward(case, case.motions[name], setting.integrator(), 0, gr.SUB ** 2, sensor=1)


@pytest.mark.parametrize("case, name", MOTIONS)
def test_exact_derivatives(case, name):
    """The integral along the outline is the derivative of Lambert's formula, and grown from the centroid the formula itself."""
    points, (vertices, velocity) = gr.points_of(case, 1), gr.outline(case, case.motions[name])
    rate = lambda vertices, velocity: oracle.exact_rate(vertices, velocity, points)
    found = rate(vertices, velocity) if velocity is not None else oracle.grown(rate, vertices)
    truth = gr.lambert(vertices, velocity, points)
    assert gr.rms(found - truth) < 2e-5 * gr.rms(truth)


def test_hidden_part():
    """From below its centre a square hides the middle half of an edge at twice its height that is twice as long as its shadow."""
    square = np.array([[-1, 1, -1], [1, 1, -1], [1, 1, 1], [-1, 1, 1.0]])
    points = np.array([[0, 0, 0], [0, 0, 5], [2, 0, 0.0]])
    for occluder in (square, square[::-1]):
        bounds = oracle.hidden_part(np.array([-4, 2, 0.0]), np.array([4, 2, 0.0]), points, occluder)
        assert bounds[0] == pytest.approx([0.25, 0.75])
        assert bounds[1, 0] == bounds[1, 1]
        assert bounds[2] == pytest.approx([0, 0.5])    # hidden from x = -4 to 0


@pytest.mark.parametrize("case, name", MOTIONS)
def test_unshadowed(case, name):
    """Pixel by pixel what order 4 leaves of the exact derivative, which it misses by percents."""
    found, expected = gradient(case, name, UNSHADOWED), predicted(case, name, UNSHADOWED)
    assert gr.rms(found - expected) < 1e-4 * gr.rms(expected)
    assert 1e-4 < gr.rms(expected - gr.exact(case, case.motions[name])) / gr.rms(expected) < 0.2


def verdicts(case, name, setting, scale=1.0):
    """(reference, agrees) of all references, for a gradient that is too large by `scale`."""
    found = gr.references(case, name, seeds=4)
    rows = gr.judge(case, name, setting, scale * gradient(case, name, setting), predicted(case, name, setting), found)
    return {row.reference: row.agrees for row in rows}, {row.reference: row for row in rows}


@pytest.mark.parametrize("case, name, setting, kinds", [
    (RECTANGLE, "translation y", UNSHADOWED, {"exact", "direct AD", "direct FD"}),
    (RECTANGLE, "radiance", UNSHADOWED, {"exact", "direct AD"}),
    (PENTAGON, "vertex 1 z", UNSHADOWED, {"exact", "direct FD"}),
    (BEHIND, "translation z", SHADOWED, {"exact", "direct FD", "direct_projective"}),
], ids=["translation", "radiance", "vertex", "shadow"])
def test_references(case, name, setting, kinds):
    """Inside the confidence interval of each reference plus the computed band-limit difference."""
    agrees, rows = verdicts(case, name, setting)
    assert set(agrees) == kinds
    assert set(agrees.values()) <= {"yes", "yes*"}, rows
    assert all(row.interval < 0.1 for row in rows.values()), "an interval this wide tells nothing"


def test_verdict_can_fail():
    agrees, _ = verdicts(RECTANGLE, "stretch", UNSHADOWED, scale=1.05)
    assert set(agrees.values()) == {"NO"}


def test_interval():
    """Student's t for two runs: 12.7 standard errors."""
    flat = np.ones((gr.PIXELS, gr.PIXELS)) / gr.WEIGHTS.sum()
    assert Reference(np.array([flat * 1, flat * 3])).interval() == pytest.approx(12.706, abs=1e-3)
    assert Reference(flat[None]).interval() == 0
