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

_MODULES = {
    ".light.project": ("project_polygon",),
    ".light.gradient": ("project_polygon_gradient", "project_polygon_spatial_gradient"),
    ".light.shade": ("shade_polygon", "shade_polygon_gradient"),
    ".light.mesh": ("project_mesh",),
    ".light.zonal": ("shade_zonal", "zonal_lambert", "zonal_phong"),
    ".light.irradiance": ("polygon_irradiance",),
    ".grid.light_grid": ("LightGrid",),
    ".sh.basis": ("sh_basis",),
    ".environment.cap": ("project_cap", "proxy_shadow"),
    ".environment.sky": ("cie_sky", "project_sky"),
    ".environment.probe": ("project_angle_map", "angle_map_to_latlong", "latlong"),
    ".transfer.rotated": ("rotate_transfer",),
    ".plugins": ("register",),
    ".transfer.bake": ("bake_transfer",),
    ".animation": ("animate",),
    ".transfer.store": ("load_transfer", "Transfer"),
    ".planner.plan": ("plan",),
    ".planner.apply": ("apply_settings",),
}
_LAZY = {name: module for module, names in _MODULES.items() for name in names}

__all__ = ["__version__", *_LAZY]


def __getattr__(name: str):
    if name not in _LAZY:
        raise AttributeError(f"module 'mi_shlight' has no attribute '{name}'")
    return getattr(importlib.import_module(_LAZY[name], __name__), name)


def __dir__():
    return sorted(__all__)


if importlib.util.find_spec("mitsuba") is not None:
    importlib.import_module(".plugins", __name__).register()
