"""What nothing blocks: `exact` is Mitsuba's `direct`, to the noise of the latter."""
import numpy as np
import pytest

pytest.importorskip("mitsuba")
pytest.importorskip("matplotlib")

from validation import exact


def test_standard_errors():
    rng = np.random.default_rng(0)
    images = list(rng.normal(1, 0.1, (16, 64, 64)))
    assert exact.in_standard_errors(images, np.ones((64, 64))) == pytest.approx(1.08, rel=0.05)   # Student's t with 15 degrees of freedom
    assert exact.in_standard_errors(images, np.full((64, 64), 1.1)) == pytest.approx(4.4, rel=0.1)


def test_open_floor():
    """Nothing is left but noise; without `exact`, at order 2, the same comparison sees the band limit."""
    rows = {row["transfer"]: row["standard errors"] for row in exact.measure_floor(8, 16, 1024, (2,))}
    assert rows["exact"] < 1.5 and rows["exact, projected"] < 1.5 and rows["projected"] > 5
