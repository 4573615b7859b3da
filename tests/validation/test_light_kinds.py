"""The figures of light kinds: what they are made of, small."""
import numpy as np
import pytest

pytest.importorskip("mitsuba")

from validation.light_kinds import CAP_COLOUR, SUN, light_kinds, proxy_shadow_on_floor, scene, sky_map


def test_proxy_shadow_converges():
    low, high = (error["mean_of_shadow"] for error in proxy_shadow_on_floor(12, (2, 5))["errors"].values())
    assert low > 2 * high > 0 and high < 0.1


def test_the_map_holds_sky_and_cap():
    plain, both = sky_map("clear", SUN, False, 33), sky_map("clear", SUN, True, 33)
    assert plain.shape == both.shape == (33, 66, 3) and plain[20:].max() == 0
    np.testing.assert_allclose((both - plain).reshape(-1, 3).max(axis=0), CAP_COLOUR, rtol=1e-5)


def test_every_kind_makes_a_scene():
    emitters = {kind: len(scene(**lights).emitters()) for kind, lights in light_kinds().items()}
    assert emitters == {"polygon": 1, "sky and cap": 1, "constant": 1, "directional and spot": 2, "all together": 4}
