"""Spherical harmonics: basis, projection and reconstruction, rotation, products, windows, and the conventions of others.

Needs Dr.Jit and numpy only. Real orthonormal harmonics with the sign (-1)^m, as ``dr.sh_eval``; flat index ``l * (l + 1) + m``; `order` is
the highest degree.
"""
from __future__ import annotations

import importlib

_MODULES = {
    ".basis": ("sh_basis",),
    ".functions": ("project_function", "project_function_stratified", "project_image", "reconstruct", "sphere_quadrature"),
    ".rotation": ("rotate", "rotate_frame", "rotation_matrices"),
    ".products": ("product", "triple_product", "product_matrix", "gaunt"),
    ".windows": ("window", "window_factors"),
    ".conventions": ("Convention", "CONVENTIONS", "to_convention", "from_convention"),
}
_LAZY = {name: module for module, names in _MODULES.items() for name in names}

__all__ = list(_LAZY)


def __getattr__(name: str):
    if name not in _LAZY:
        raise AttributeError(f"module 'mi_shlight.sh' has no attribute '{name}'")
    return getattr(importlib.import_module(_LAZY[name], __name__), name)


def __dir__():
    return sorted(__all__)
