"""Parameters of the integrator `shprt`, checked."""
from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from typing import NamedTuple

import mitsuba as mi

from ..errors import check_choice, check_integer, check_number, check_parameters, message
from ..grid.cells import INTERPOLATIONS, MAX_RESOLUTION
from ..light.project import METHODS
from ..sh.basis import check_order
from ..sh.lobes import MAX_ORDER
from ..sh.windows import KINDS as WINDOWS
from ..transfer.bounce import MAX_BOUNCES

DEFAULT_SAMPLES = {"vertex": 1024, "pixel": 64}

DIRECT = ("unshadowed", "shadowed", "exact")
"""Transfer of light that comes straight from its source; ``interreflected`` and ``glossy`` add to it."""


class Parts(NamedTuple):
    """What a value of the parameter `transfer` asks for."""

    direct: str
    interreflected: bool
    glossy: bool


def parse_transfer(function: str, text) -> Parts:
    """The parts named in `text`, joined by "+" in any order; ``interreflected`` and ``glossy`` alone mean ``shadowed`` besides.

    TypeError or ValueError, in the name of `function`, if `text` is no such sum.
    """
    hint = "Join a base (unshadowed, shadowed, exact) and additions (interreflected, glossy) by +, as exact+interreflected."
    if not isinstance(text, str):
        raise TypeError(message(function, "transfer", "be text", text, hint))
    names = [name.strip() for name in text.split("+")]
    known = (*DIRECT, "interreflected", "glossy")
    if any(name not in known for name in names) or len(set(names)) < len(names) or sum(name in DIRECT for name in names) > 1:
        rule = f"be one of {', '.join(map(repr, known))}, or a sum with one base at most"
        raise ValueError(message(function, "transfer", rule, text, hint))
    parts = Parts(next((name for name in names if name in DIRECT), "shadowed"), "interreflected" in names, "glossy" in names)
    if parts.interreflected and parts.direct == "unshadowed":
        raise ValueError(message(function, "transfer", "not join unshadowed and interreflected", text,
                                 "Where nothing casts shadows light would be reflected through walls. Choose shadowed or exact."))
    return parts


@dataclass(frozen=True)
class Settings:
    """Parameters of `shprt` with their defaults; the plugin's manual page says what they mean."""

    order: int = 8
    method: str = "auto"
    transfer: str = "shadowed"
    transfer_domain: str = "vertex"
    transfer_samples: int = 0
    transfer_file: str = ""
    max_edge: float = 0.0
    light_margin: float = 0.0
    localised: bool = True
    window: str = "none"
    bounces: int = 0
    bounce_tolerance: float = 1e-3
    bounce_samples: int = 256
    bounce_lighting: str = "gather"
    visibility_order: int = 4
    bsdf_order: int = 8
    grid_resolution: int | str = 0
    grid_interpolation: str = "hermite"
    grid_error: float = 1e-3
    strict: bool = False
    coefficients: bool = False
    errors: bool = False

    @property
    def pixel_samples(self) -> int:
        """Rays per camera hit where transfer is not baked."""
        return self.transfer_samples if self.transfer_domain == "pixel" and self.transfer_samples else DEFAULT_SAMPLES["pixel"]

    @property
    def gloss_light_order(self) -> int:
        """Highest degree of the lights that meet gloss: of less, the products with what is blocked would be cut off, and transfer that is
        fitted to the lights' directions means nothing band by band.
        """
        return self.bsdf_order + (0 if self.parts.direct == "unshadowed" else self.visibility_order)

    @property
    def parts(self) -> Parts:
        """What `transfer` asks for."""
        return parse_transfer("shprt", self.transfer)


def read_settings(props) -> Settings:
    """Checked parameters of the plugin; TypeError or ValueError names a bad one, its rule and the fix."""
    check_parameters("shprt", props, tuple(asdict(Settings())))
    value = {name: props.get(name, default) for name, default in asdict(Settings()).items()}
    value["order"] = check_order("shprt", value["order"])
    check_choice("shprt", "method", value["method"], METHODS)
    for name in ("strict", "coefficients", "errors", "localised"):
        if not isinstance(value[name], bool):
            raise TypeError(message("shprt", name, "be true or false", value[name]))
    parts = parse_transfer("shprt", value["transfer"])
    check_choice("shprt", "transfer_domain", value["transfer_domain"], tuple(DEFAULT_SAMPLES))
    hint = "It is a number of rays; 0 chooses by transfer_domain."
    value["transfer_samples"] = check_integer("shprt", "transfer_samples", value["transfer_samples"], 0, 65536, hint)
    for name in ("max_edge", "light_margin"):
        value[name] = check_number("shprt", name, value[name], 0, hint="It is a length in scene units.")
    check_choice("shprt", "window", value["window"], WINDOWS)
    hint = "It is the number of reflections between surfaces before the one that is seen; 0: as many as bounce_tolerance asks for."
    value["bounces"] = check_integer("shprt", "bounces", value["bounces"], 0, MAX_BOUNCES, hint)
    hint = "Reflections are added until the next adds less than this share."
    value["bounce_tolerance"] = check_number("shprt", "bounce_tolerance", value["bounce_tolerance"], 1e-6, 1, hint)
    hint = "It is the number of rays of each baked point that look for light from other surfaces."
    value["bounce_samples"] = check_integer("shprt", "bounce_samples", value["bounce_samples"], 1, 65536, hint)
    check_choice("shprt", "bounce_lighting", value["bounce_lighting"], ("gather", "transfer"))
    if parts.interreflected and value["bounce_lighting"] == "transfer" and value["localised"]:
        raise ValueError(message("shprt", "localised", "be false with bounce_lighting='transfer'", True,
                                 "Localised transfer is of use at its own point only. Or choose 'gather'."))
    for name in ("visibility_order", "bsdf_order"):
        value[name] = check_order("shprt", value[name], name)
    if parts.glossy and value["bsdf_order"] + value["visibility_order"] > MAX_ORDER:
        raise ValueError(message("shprt", "bsdf_order", f"be at most {MAX_ORDER} together with visibility_order",
                                 f"{value['bsdf_order']} and {value['visibility_order']}", "8 and 4 are the default."))
    if parts.glossy and mi.is_spectral:
        raise ValueError(message("shprt", "transfer", "do without glossy in spectral variants", value["transfer"],
                                 "BSDFs are tabulated for a few channels. Use an rgb or mono variant."))
    if value["errors"] and (mi.is_spectral or parts.glossy):
        rule = "be false in spectral variants" if mi.is_spectral else "be false with glossy transfer"
        raise ValueError(message("shprt", "errors", rule, True, "Errors are known of diffuse reflection in rgb and mono variants."))
    if value["errors"] and parts.interreflected and value["bounce_lighting"] == "transfer":
        raise ValueError(message("shprt", "errors", "be false with bounce_lighting='transfer'", True,
                                 "That errs by its very assumption, which no bound knows of. Choose 'gather'."))
    if parts.interreflected and value["transfer_domain"] != "vertex":
        raise ValueError(message("shprt", "transfer_domain", "be vertex with interreflected transfer", value["transfer_domain"],
                                 "Light between surfaces is gathered at baked points."))
    if isinstance(value["grid_resolution"], str) and value["grid_resolution"].isdigit():       # -D name=value gives text
        value["grid_resolution"] = int(value["grid_resolution"])
    if value["grid_resolution"] != "auto":
        hint = "It is a number of grid points along an axis; 0: no grid, 'auto': what costs least."
        value["grid_resolution"] = check_integer("shprt", "grid_resolution", value["grid_resolution"], 0, MAX_RESOLUTION, hint)
        if value["grid_resolution"] == 1:
            raise ValueError(message("shprt", "grid_resolution", "be 0, 'auto', or two or more", 1, hint))
    if value["grid_resolution"] != 0 and mi.is_spectral:
        raise ValueError(message("shprt", "grid_resolution", "be 0 in spectral variants", value["grid_resolution"],
                                 "A grid holds sums over lights for a few channels. Use an rgb or mono variant."))
    check_choice("shprt", "grid_interpolation", value["grid_interpolation"], INTERPOLATIONS)
    hint = "It is a relative error; 0 interpolates all lights."
    value["grid_error"] = check_number("shprt", "grid_error", value["grid_error"], 0, 1, hint)
    if value["grid_resolution"] == "auto" and value["grid_error"] == 0:
        rule = "be above 0 with grid_resolution='auto', which chooses by it"
        raise ValueError(message("shprt", "grid_error", rule, value["grid_error"], "For instance 1e-3."))
    if not isinstance(value["transfer_file"], str):
        raise TypeError(message("shprt", "transfer_file", "be the path of a baked file", value["transfer_file"]))
    if value["transfer_file"]:
        if parts.direct == "unshadowed" or value["transfer_domain"] != "vertex":
            raise ValueError(message("shprt", "transfer_file", "go with transfer that is baked, and transfer_domain='vertex'",
                                     value["transfer_file"], "Leave it out, or change those."))
        path = str(mi.file_resolver().resolve(value["transfer_file"]))
        if not os.path.isfile(path):
            raise FileNotFoundError(message("shprt", "transfer_file", "name an existing file", value["transfer_file"],
                                            "Bake one with 'mi-shlight bake SCENE -o FILE', or leave it out to bake at the first render."))
        value["transfer_file"] = path
    return Settings(**value)
