"""OpenEXR files with named channels and the settings that made them."""
from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import OpenEXR

from .errors import message
from .files import check_output, replacing

# Attributes that belong to the file format; metadata may not use these names.
FORMAT_ATTRIBUTES = frozenset((
    "channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name", "pixelAspectRatio",
    "screenWindowCenter", "screenWindowWidth", "tiles", "type", "version", "view"))


def write_exr(path, channels, metadata=None) -> None:
    """Write float32 channels as a scan-line OpenEXR file with lossless ZIP compression.

    The file is written under a temporary name and renamed, so a failure leaves no partial file behind.

    Parameters
    ----------
    path : str or os.PathLike
        File to write; must end in ``.exr`` and lie in an existing folder.
    channels : dict of str to array_like
        Channel name to an (H, W) array; all of one shape. A dot in a name separates layers: ``L.2.-1`` is channel ``-1`` of
        layer ``L.2``.
    metadata : dict of str to (str, int, bool or float), optional
        Stored as header attributes; a bool becomes the integer 0 or 1.

    Raises
    ------
    TypeError
        A metadata value is of another type.
    ValueError
        `channels` is empty, an array is not two-dimensional or differs in shape, or a metadata name belongs to the format.
    OSError
        The file cannot be written.
    """
    path = check_output("write_exr", "path", path, ".exr")
    if not channels:
        raise ValueError(message("write_exr", "channels", "name at least one channel", channels))
    planes = {str(name): np.ascontiguousarray(plane, dtype=np.float32) for name, plane in channels.items()}
    shape = next(iter(planes.values())).shape
    for name, plane in planes.items():
        if plane.ndim != 2 or plane.shape != shape or 0 in shape:
            raise ValueError(message("write_exr", f"channels['{name}']", f"be an (H, W) array like the first channel, {shape}",
                                     plane.shape))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, value in (metadata or {}).items():
        if name in FORMAT_ATTRIBUTES:
            raise ValueError(message("write_exr", "metadata", "not use a name of the file format", name, "Rename the entry."))
        if not isinstance(value, (str, int, float)):
            raise TypeError(message("write_exr", f"metadata['{name}']", "be a string, an integer or a float", value))
        header[name] = int(value) if isinstance(value, bool) else value
    with replacing(path) as temporary:
        try:
            with OpenEXR.File(header, planes) as file:
                file.write(os.fspath(temporary))
        except RuntimeError as error:  # the package reports every failure of the file system this way
            raise OSError(f"write_exr(): cannot write '{path}': {error}") from error


def read_exr(path):
    """Read the first part of an OpenEXR file.

    Parameters
    ----------
    path : str or os.PathLike
        An OpenEXR file.

    Returns
    -------
    channels : dict of str to numpy.ndarray
        Channel name to an (H, W) float32 array.
    metadata : dict
        Header attributes that do not belong to the file format itself.

    Raises
    ------
    OSError
        The file is missing or is not an OpenEXR file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(message("read_exr", "path", "name an existing file", str(path)))
    try:
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels, dtype=np.float32) for name, channel in file.channels().items()}
            metadata = {name: value for name, value in file.header().items() if name not in FORMAT_ATTRIBUTES}
    except RuntimeError as error:
        raise OSError(message("read_exr", "path", "be an OpenEXR file", str(path), str(error))) from error
    return channels, metadata
