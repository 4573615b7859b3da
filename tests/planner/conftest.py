"""A planner that looks at fewer points, so that tests are quick."""
import pytest

from mi_shlight.planner import candidates, probe


@pytest.fixture(autouse=True, scope="session")
def few_points():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(probe, "POINTS", 96)
        patch.setattr(probe, "TRUTH_SAMPLES", 1024)
        patch.setattr(candidates, "RAYS", (16, 64, 256))
        patch.setattr(candidates, "EDGES", (2, 1, 1 / 2))
        yield
