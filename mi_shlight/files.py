"""Output files that appear complete or not at all."""
from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path

from .errors import message


def check_output(function: str, argument: str, path, suffix: str = "") -> Path:
    """Return `path` as a `Path` if a file can be written there, or raise before any work is done for it.

    Parameters
    ----------
    function, argument : str
        Names for the error message.
    path : str or os.PathLike
        The file to be written; its folder must exist and be writable.
    suffix : str, optional
        Required ending of the name, compared without regard to case, such as ``.exr``.

    Raises
    ------
    ValueError
        The name has another ending.
    OSError
        The folder is missing or not writable, or `path` is itself a folder.
    """
    path = Path(path)
    if suffix and path.suffix.lower() != suffix:
        raise ValueError(message(function, argument, f"end in '{suffix}'", str(path), f"Write '{path.with_suffix(suffix)}'."))
    if path.is_dir():
        raise IsADirectoryError(message(function, argument, "be a file name", str(path), "It is a folder: add a file name to it."))
    if path.exists() and not path.is_file():
        raise OSError(message(function, argument, "be a regular file or a new one", str(path),
                              "It is a device or a pipe: choose another name."))
    folder = path.parent
    if not folder.is_dir():
        raise FileNotFoundError(message(function, argument, "lie in an existing folder", str(path),
                                        f"Create '{folder}' first."))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(message(function, argument, "lie in a folder you may write to", str(path),
                                      f"Change the permissions of '{folder}' or choose another folder."))
    return path


@contextmanager
def replacing(path):
    """Yield a temporary path beside `path`; it takes the place of `path` on success and is deleted on any exception.

    A symbolic link stays: the file that it points to is replaced.
    """
    path = Path(path).resolve()
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
