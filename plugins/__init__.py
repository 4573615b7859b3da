"""Mitsuba plugins of mi_shlight, one module each, named as the plugin: `shlight` (emitter) and `shprt` (integrator).

A Mitsuba class belongs to one variant, so the plugins' classes are built once per variant, when it is first active:
each module's ``build()`` holds the class statement and returns the class.
"""
from __future__ import annotations

from ..llvm import require_llvm, select_llvm

# Mitsuba looks up what kind of plugin a name stands for in this variant, whichever one is active.
_KIND_VARIANT = "scalar_rgb"
_registered = set()


def register() -> None:
    """Make the plugins ``shlight`` and ``shprt`` known to Mitsuba: now, and in every variant set later.

    ``import mi_shlight`` has called it already; call it again only after ``mitsuba.detail.clear_variant_callbacks()``.
    Before ``mitsuba.set_variant`` it leaves the work to the moment that a variant is set. Each variant is registered
    once, however often the variants are switched, and its classes stay the same.

    In scalar variants only the emitter works; creating ``shprt`` there raises RuntimeError, as it needs Dr.Jit's
    just-in-time compiler.

    Raises
    ------
    LLVMError
        In an ``llvm_*`` variant, if LLVM's library is older than version 19. Then ``mitsuba.set_variant`` raises it too.
    """
    select_llvm()  # has an effect only before Dr.Jit is imported, which `import mitsuba` does
    import mitsuba as mi

    mi.detail.add_variant_callback(_register_variant)
    _register_variant(None, mi.variant())


def _register_variant(_previous: str | None, variant: str | None) -> None:
    if variant is None or variant in _registered:
        return
    if variant.startswith("llvm_"):
        require_llvm()
    import mitsuba as mi

    from . import shlight
    mi.register_emitter("shlight", shlight.build())
    if variant.startswith("scalar_"):
        mi.register_integrator("shprt", _needs_jit(variant))
    else:
        from . import shprt
        mi.register_integrator("shprt", shprt.build())
    _registered.add(variant)
    if _KIND_VARIANT not in _registered:
        _register_kinds(getattr(mi, _KIND_VARIANT))


def _register_kinds(module) -> None:
    """Tell Mitsuba that ``shlight`` is an emitter and ``shprt`` an integrator.

    Without this, ``load_dict`` takes them for objects of an unknown kind and merges two equal lights into one, which it
    then refuses to attach to two shapes.
    """
    def not_active(props):
        raise RuntimeError(f"{props.plugin_name()}: the variant '{_KIND_VARIANT}' is not active. "
                           f"Call mitsuba.set_variant('{_KIND_VARIANT}') first.")

    module.register_emitter("shlight", not_active)
    module.register_integrator("shprt", not_active)


def _needs_jit(variant: str):
    def refuse(props):
        raise RuntimeError(f"shprt: this integrator needs a JIT variant such as 'llvm_ad_rgb', got '{variant}'. "
                           "Call mitsuba.set_variant('llvm_ad_rgb') before loading the scene.")

    return refuse
