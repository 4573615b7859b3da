"""Parameters of the integrator `shprt`, checked."""
from __future__ import annotations

import os
from dataclasses import asdict, dataclass

import mitsuba as mi

from ..errors import check_choice, check_integer, check_number, check_parameters, message
from ..grid.cells import INTERPOLATIONS, MAX_RESOLUTION
from ..light.project import METHODS
from ..sh.basis import check_order

DEFAULT_SAMPLES = {"vertex": 1024, "pixel": 64}


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
    grid_resolution: int | str = 0
    grid_interpolation: str = "hermite"
    grid_error: float = 1e-3
    strict: bool = False
    coefficients: bool = False


def read_settings(props) -> Settings:
    """Checked parameters of the plugin; TypeError or ValueError names a bad one, its rule and the fix."""
    check_parameters("shprt", props, tuple(asdict(Settings())))
    value = {name: props.get(name, default) for name, default in asdict(Settings()).items()}
    value["order"] = check_order("shprt", value["order"])
    check_choice("shprt", "method", value["method"], METHODS)
    check_choice("shprt", "transfer", value["transfer"], ("unshadowed", "shadowed"))
    check_choice("shprt", "transfer_domain", value["transfer_domain"], tuple(DEFAULT_SAMPLES))
    hint = "It is a number of rays; 0 chooses by transfer_domain."
    value["transfer_samples"] = check_integer("shprt", "transfer_samples", value["transfer_samples"], 0, 65536, hint)
    for name in ("max_edge", "light_margin"):
        value[name] = check_number("shprt", name, value[name], 0, hint="It is a length in scene units.")
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
    for name in ("strict", "coefficients"):
        if not isinstance(value[name], bool):
            raise TypeError(message("shprt", name, "be true or false", value[name]))
    if not isinstance(value["transfer_file"], str):
        raise TypeError(message("shprt", "transfer_file", "be the path of a baked file", value["transfer_file"]))
    if value["transfer_file"]:
        if value["transfer"] != "shadowed" or value["transfer_domain"] != "vertex":
            raise ValueError(message("shprt", "transfer_file", "go with transfer='shadowed' and transfer_domain='vertex'",
                                     value["transfer_file"], "Leave it out, or change those."))
        path = str(mi.file_resolver().resolve(value["transfer_file"]))
        if not os.path.isfile(path):
            raise FileNotFoundError(message("shprt", "transfer_file", "name an existing file", value["transfer_file"],
                                            "Bake one with 'mi-shlight bake SCENE -o FILE', or leave it out to bake at the first render."))
        value["transfer_file"] = path
    return Settings(**value)
