"""mi_shlight: polygonal area lights in spherical harmonics, analytically, for Mitsuba 3.

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    import mi_shlight                                      # registers the plugins 'shlight' and 'shprt'
    scene = mi.load_file("scene.xml", optimize=False)
    image = mi.render(scene, integrator=mi.load_dict({"type": "shprt"}), spp=16)

The mathematics (`project_polygon`, `sh_basis`) needs Dr.Jit only; what deals with scenes is loaded on first use.
"""
from __future__ import annotations

import importlib
import importlib.util

__version__ = "0.1.0"

_LAZY = {"project_polygon": ".light.project", "project_mesh": ".light.mesh", "shade_zonal": ".light.zonal", "zonal_lambert": ".light.zonal",
         "zonal_phong": ".light.zonal", "polygon_irradiance": ".light.irradiance", "sh_basis": ".sh.basis", "register": ".plugins",
         "bake_transfer": ".transfer.bake", "load_transfer": ".transfer.store", "Transfer": ".transfer.store"}

__all__ = ["__version__", *_LAZY]


def __getattr__(name: str):
    if name not in _LAZY:
        raise AttributeError(f"module 'mi_shlight' has no attribute '{name}'")
    return getattr(importlib.import_module(_LAZY[name], __name__), name)


def __dir__():
    return sorted(__all__)


if importlib.util.find_spec("mitsuba") is not None:
    importlib.import_module(".plugins", __name__).register()
