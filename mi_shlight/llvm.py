"""Which LLVM library Dr.Jit uses, and whether mi_shlight can run on it.

The ``llvm_*`` variants compile their kernels with LLVM's shared library, which comes from the system. Dr.Jit 1.5
refuses version 14, and accepts 15 and 16 although their first kernel with a minimum or maximum aborts the whole
process; 17 and 18 were never tried. This module therefore asks for version 19 or newer, and does so before a kernel
exists, while a Python exception can still be raised.

Dr.Jit takes the path in the environment variable ``DRJIT_LIBLLVM_PATH`` if that is set; otherwise ``libLLVM.so`` if the
dynamic linker finds one; otherwise the last by name of ``/usr/lib/<machine>-linux-gnu/libLLVM*.so.*``, symbolic links
only if there is nothing else. It does so once, when ``drjit`` is first imported.

Nothing here imports Mitsuba; only `require_llvm` and `llvm_info` import Dr.Jit.
"""
from __future__ import annotations

import os
import re
import sys
from pathlib import Path

MINIMUM_LLVM = 19
PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"

_LIBRARY_NAME = re.compile(r"libLLVM(?:-(?P<prefix>\d+)(?:\.\d+)*)?\.so(?:\.(?P<suffix>\d+)(?:\.\d+)*)?")
_LIBRARY_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/lib/llvm-*/lib",
)


class LLVMError(ImportError):
    """LLVM's shared library is missing or too old for the ``llvm_*`` variants."""


def llvm_major(name: str) -> int | None:
    """Major version that a library's file name carries, or None if it carries none.

    Known forms: ``libLLVM-14.so.1``, ``libLLVM-14.0.6.so.1``, ``libLLVM-19.so``, ``libLLVM.so.19.1``.

    Parameters
    ----------
    name : str
        File name or path; symbolic links are not followed.

    Returns
    -------
    int or None
    """
    match = _LIBRARY_NAME.fullmatch(os.path.basename(name))
    if match is None:
        return None
    version = match["prefix"] or match["suffix"]
    return int(version) if version else None


def installed_llvm() -> list[tuple[int, str]]:
    """LLVM shared libraries in ``LD_LIBRARY_PATH`` and the usual Linux folders, as found by file name.

    Nothing is loaded. Symbolic links are followed, so each library is listed once, under its real path.

    Returns
    -------
    list of (int, str)
        Major version and path, oldest version first. Empty on other systems.
    """
    if not sys.platform.startswith("linux"):
        return []
    own = [folder for folder in os.environ.get("LD_LIBRARY_PATH", "").split(":") if folder]
    found = set()
    for pattern in (*own, *_LIBRARY_FOLDERS):
        folders = Path("/").glob(pattern.lstrip("/")) if "*" in pattern else [Path(pattern)]
        for folder in folders:
            for library in folder.glob("libLLVM*.so*"):
                real = os.path.realpath(library)
                major = llvm_major(real)
                if major is not None and os.path.isfile(real):
                    found.add((major, real))
    return sorted(found)


def select_llvm() -> str | None:
    """Steer Dr.Jit to an LLVM that works, where several are installed and one of them is too old.

    Sets ``DRJIT_LIBLLVM_PATH`` for this process and its children to the newest library found by `installed_llvm`. Does
    nothing if that variable is set already, if Dr.Jit is already imported (it has made its choice then), if every
    library found is new enough, or if none is.

    Returns
    -------
    str or None
        The path chosen, or None if nothing was changed.
    """
    if os.environ.get(PATH_VARIABLE) or "drjit" in sys.modules:
        return None
    libraries = installed_llvm()
    if not libraries or libraries[0][0] >= MINIMUM_LLVM or libraries[-1][0] < MINIMUM_LLVM:
        return None
    os.environ[PATH_VARIABLE] = libraries[-1][1]
    return libraries[-1][1]


def llvm_info() -> dict:
    """Version and path of the LLVM library that Dr.Jit has loaded.

    Returns
    -------
    dict
        ``version``: tuple of three integers, or None if Dr.Jit found no library or refused it; ``path``: str, or None
        if unknown; ``supported``: bool, whether the version is `MINIMUM_LLVM` or newer.
    """
    import drjit

    version = tuple(drjit.detail.llvm_version())
    if version[0] < 0:
        version = None
    return {
        "version": version,
        "path": _loaded_path(),
        "supported": version is not None and version[0] >= MINIMUM_LLVM,
    }


def require_llvm() -> None:
    """Raise unless the ``llvm_*`` variants can run here: call it before ``mitsuba.set_variant``.

    Imports Dr.Jit, after `select_llvm`. Cheap enough to be called any number of times.

    Raises
    ------
    LLVMError
        If LLVM's library is missing or older than version 19. The message says what was found, where, and the remedy.
    """
    select_llvm()
    info = llvm_info()
    if not info["supported"]:
        raise LLVMError(explain(info["version"], info["path"], os.environ.get(PATH_VARIABLE), installed_llvm()))


def explain(version, path, chosen, libraries) -> str:
    """One paragraph on why the LLVM library found will not do, and on the remedy.

    Parameters
    ----------
    version : tuple of int or None
        Version that Dr.Jit reports; None if it found no library or refused it.
    path : str or None
        The library's path.
    chosen : str or None
        Value of ``DRJIT_LIBLLVM_PATH``.
    libraries : list of (int, str)
        What `installed_llvm` found.

    Returns
    -------
    str
    """
    path = path or chosen
    if version is not None:
        found = "version " + ".".join(str(number) for number in version)
    elif path is None:
        found = "no library"
    elif not os.path.exists(path):
        found = "nothing that can be loaded"
    else:
        major = llvm_major(os.path.realpath(path))
        found = f"version {major}" if major else "a library that Dr.Jit cannot use"
    place = f" ({path})" if path else ""
    source = f", to which the environment variable {PATH_VARIABLE} points" if chosen else ""
    usable = [library for major, library in libraries if major >= MINIMUM_LLVM]
    if usable:
        remedy = f"A suitable one is installed: set {PATH_VARIABLE}={usable[-1]} before Python starts"
        if chosen:
            remedy += f", or unset {PATH_VARIABLE}"
    else:
        remedy = (f"Install one, on Debian or Ubuntu with 'apt-get install libllvm{MINIMUM_LLVM}', "
                  f"or set {PATH_VARIABLE} to the path of one before Python starts")
    return (f"The llvm_* variants need LLVM's shared library in version {MINIMUM_LLVM} or newer (with 15 and 16 the "
            f"process would abort at its first kernel), got {found}{place}{source}. {remedy}.")


def _loaded_path() -> str | None:
    try:
        with open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
            paths = {line.split(maxsplit=5)[5].strip() for line in maps if "/libLLVM" in line}
    except OSError:
        return None
    return paths.pop() if len(paths) == 1 else None
