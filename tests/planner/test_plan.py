"""Plans follow what a scene needs; their errors are those of pictures; their predictions keep limits."""
import json
import re
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins"))
from shprt_scenes import GREY, block, camera, direct, emitter, floor, light, mean_error, mesh, scene  # noqa: E402

from mi_shlight import plan  # noqa: E402
from mi_shlight.planner.plan import bounces_of, choose, pareto  # noqa: E402
from mi_shlight.planner.candidates import Candidate  # noqa: E402

BLOCK = ((-0.5, 0.3, -0.2), (0.2, 0.7, 0.5))


@pytest.fixture(scope="module")
def shaded():
    mi.set_variant("llvm_ad_rgb")
    return scene(floor=floor(), block=block(*BLOCK), light=light())


@pytest.fixture(scope="module")
def plans(shaded):
    return {error: plan(shaded, error, spp=16) for error in (0.05, 0.01)}


def test_nothing_in_the_way_needs_no_shadows():
    found = plan(scene(floor=floor(), light=light()), 0.01)
    assert found.met and found.settings["transfer"] == "unshadowed" and found.bake == 0
    assert found.settings["grid_resolution"] == 0 and found.error < 0.01
    assert "0 % of the light is blocked" in dict(found.why)["transfer"]


def test_an_obstacle_asks_for_shadows(plans):
    for found in plans.values():
        assert found.met and found.settings["transfer"] in ("shadowed", "exact") and found.settings["grid_resolution"] == 0
        assert found.error + found.spread <= found.max_error


def test_looser_is_cheaper(plans):
    assert plans[0.05].seconds <= plans[0.01].seconds and plans[0.05].error > plans[0.01].error


def test_the_picture_has_the_error_of_the_plan(shaded, plans):
    truth = direct(shaded, 4096)
    for error, found in plans.items():
        measured = mean_error(np.array(mi.render(shaded, integrator=found.integrator(), spp=1024)), truth)
        assert found.error / 2 - 0.003 < measured < 2 * found.error + 0.003, (error, found.error)


def test_equal_arguments_give_equal_errors(shaded, plans):
    again = plan(shaded, 0.05, spp=16)
    by_settings = lambda p: {json.dumps(c["settings"]): c["error"] for c in p.choices}
    a, b = by_settings(plans[0.05]), by_settings(again)
    common = set(a) & set(b)
    assert len(common) > 3 and all(a[k] == b[k] for k in common)


def test_choices_lead_from_cheap_to_accurate(plans):
    choices = plans[0.01].choices
    seconds, errors = zip(*((c["seconds"], c["error"]) for c in choices))
    assert list(seconds) == sorted(seconds) and list(errors) == sorted(errors, reverse=True)
    assert plans[0.01].largest["seconds"] > plans[0.01].seconds
    json.dumps(plans[0.01].report())


def test_lights_by_the_hundred_ask_for_a_grid():
    x, z = (c.ravel() for c in np.meshgrid(np.linspace(-2, 2, 16), np.linspace(-2, 2, 12)))
    corners = np.stack([x, np.full_like(x, 3.0), z], axis=1)[:, None] + 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]])
    faces = np.arange(3 * len(x)).reshape(-1, 3)
    lights = mesh(corners.reshape(-1, 3) + [0, 0.4, 0] * np.repeat(np.arange(len(x)) % 2, 3)[:, None], faces, emitter=emitter())
    found = plan(scene(camera(size=64), floor=floor(), lights=lights), 0.02, spp=512)
    assert found.met and found.settings["grid_resolution"] > 0 and found.settings["grid_error"] > 0
    assert found.parts["light grid"] < 0.02 and "one by one" in dict(found.why)["grid_resolution"]


def test_light_between_surfaces_is_modelled_if_it_is_asked_for(shaded):
    parts = dict(floor=floor(), wall=block((-2, 0, -1), (2, 2, -0.9)), light=light())
    alone = plan(scene(**parts, integrator={"type": "path", "max_depth": 2}), 0.02, spp=1)
    all_of_it = plan(scene(**parts, integrator={"type": "path"}), 0.02, spp=1)
    assert "interreflected" not in alone.settings["transfer"] and "interreflected" not in dict(alone.why)
    assert "interreflected" in all_of_it.settings["transfer"] and all_of_it.settings["transfer_domain"] == "vertex"
    assert all_of_it.settings["bounces"] == 0 and 0 < all_of_it.parts["light between surfaces"] < 0.02


@pytest.mark.parametrize("kind, bounces", [({"type": "path"}, None), ({"type": "path", "max_depth": 5}, 3), ({"type": "direct"}, 0),
                                           ({"type": "path", "max_depth": 1}, 0), ({"type": "shprt"}, 0),
                                           ({"type": "shprt", "transfer": "interreflected", "bounces": 2}, 2),
                                           ({"type": "aov", "aovs": "dd:depth", "inner": {"type": "path", "max_depth": 4}}, 2)])
def test_bounces_that_integrators_ask_for(kind, bounces):
    assert bounces_of(mi.load_dict(kind)) == bounces


def test_a_mirror_is_named_and_its_share_makes_the_plan_fail():
    found = plan(scene(floor=floor(), block=block(*BLOCK, bsdf={"type": "conductor"}), light=light()), 1e-4)
    assert not found.met and any("like a mirror" in text for text in found.left_out)


def test_a_point_light_alone_has_exact_shadows():
    point = {"type": "point", "position": [0.3, 1.5, 0.2], "intensity": {"type": "rgb", "value": 2.0}}
    found = plan(scene(floor=floor(), block=block(*BLOCK), light=point), 0.001)
    assert found.met and found.settings["transfer"] == "exact" and 0 < found.error < 1e-5
    assert not plan(scene(floor=floor(), block=block(*BLOCK), light=point), 1e-6).met          # rounding is never less


def test_own_parameters_stay(shaded):
    own = mi.load_dict({"type": "shprt", "strict": True, "light_margin": 0.125, "order": 11})
    found = plan(scene(floor=floor(), light=light(), integrator=own), 0.05)
    assert found.settings["strict"] is True and found.settings["light_margin"] == 0.125
    assert plan(scene(floor=floor(), light=light(), integrator=own), 0.05, light_margin=0).settings["light_margin"] == 0


@pytest.mark.parametrize("arguments, text", [
    (dict(max_error=0), "'max_error' must be a finite number >= 1e-06"),
    (dict(max_error=-1), "'max_error' must be a finite number >= 1e-06"),
    (dict(max_error="1"), "'max_error' must"), (dict(max_error=0.1, time_limit=-1), "'time_limit' must"),
    (dict(max_error=0.1, sensor=3), "'sensor' must"), (dict(max_error=0.1, light_margin=-1), "'light_margin' must"),
])
def test_bad_arguments_are_named(shaded, arguments, text):
    with pytest.raises((TypeError, ValueError), match=text):
        plan(shaded, **arguments)


def test_scenes_that_cannot_be_planned_for():
    with pytest.raises(TypeError, match="'scene' must be a mitsuba.Scene"):
        plan("scene.xml", 0.1)
    with pytest.raises(ValueError, match="must have a light"):
        plan(scene(floor=floor()), 0.1)
    with pytest.raises(ValueError, match="must have a sensor"):
        plan(mi.load_dict({"type": "scene", "floor": floor(), "light": light()}, optimize=False), 0.1)
    with pytest.raises(ValueError, match="must show a surface"):
        plan(scene(camera(target=(0, 9, 0)), floor=floor(bsdf=GREY), light=light()), 0.1)


@pytest.mark.parametrize("kind", ["direct", "path"])
def test_a_dark_view_is_refused(kind):
    with pytest.raises(ValueError, match="must light something"):
        plan(scene(floor=floor(), light=light(up=True), integrator={"type": kind}), 0.1)


def test_errors_and_gloss_do_not_meet():
    plastic = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": {"type": "rgb", "value": 0.4}}
    found = plan(scene(floor=floor(bsdf=plastic), light=light(), integrator={"type": "shprt", "errors": True}), 0.01)
    assert found.settings["errors"] is True and "glossy" not in found.integrator().transfer
    assert not found.met and "gloss does not go with them" in dict(found.why)["errors"]
    assert "besides what is left out" in dict(found.why)["order"]


def test_spectral_scenes_are_looked_at_in_their_wavelengths():
    mi.set_variant("llvm_ad_spectral")
    try:
        found = plan(scene(floor=floor(), light=light()), 0.02)
        assert found.met and found.settings["transfer"] == "unshadowed" and 1e-4 < found.error < 0.02
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_wide_angles_are_whole_degrees():
    found = plan(scene(floor=floor(), light=light(y=0.35)), 0.05)
    assert re.search(r"to 1\d\d degrees wide", dict(found.why)["method"])


def candidate(error, seconds, direct="shadowed"):
    return Candidate(direct, 4, "vertex", 64, 0.1, 0, 1e-3, 0, 0, error, 0.0, {}, seconds / 2, seconds / 2)


def test_choice_by_error_and_time():
    options = [candidate(0.1, 1), candidate(0.01, 2), candidate(0.001, 10)]
    assert choose(options, 0.02, None).error == 0.01
    assert choose(options, 0.001, 5).error == 0.01           # the most accurate within the limit
    assert choose(options, 1e-9, None).error == 0.001
    assert choose(options, 0.02, 0.5).seconds == 1           # nothing is: the fastest
    assert choose([candidate(0.01, 1), candidate(0.01, 1.01, "unshadowed")], 0.1, None).direct == "unshadowed"
    assert [c.error for c in pareto([*options, candidate(0.05, 3)])] == [0.1, 0.01, 0.001]
