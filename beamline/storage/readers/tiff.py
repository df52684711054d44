"""TIFF images: reading them whole, and the reference frames that a caller names."""

from __future__ import annotations

import logging
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile
from numpy.typing import NDArray
from tifffile import natural_sorted

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.hdf5 import require_real

SUFFIXES = (".tif", ".tiff")
VOLUME = "splatline volume"  # Value of `format` in the facts of a file that is a volume of ours, not a scan
UNREADABLE = (
    tifffile.TiffFileError,
    OSError,
    ValueError,
    LookupError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    MemoryError,
)


class Complaints(logging.Handler):
    """Collects tifffile's messages on a damaged file: it only logs them, and goes on with the pages that it finds."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.said: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.said.append(record.getMessage())

    def __enter__(self) -> Complaints:
        logging.getLogger("tifffile").addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger("tifffile").removeHandler(self)


def load_images(images: Path | str | NDArray[Any]) -> NDArray[Any]:
    """Reference frames [frame, row, col]: from an array, one TIFF (any pages) or a folder of TIFFs, all in memory."""
    if not isinstance(images, Path | str):
        stack = np.asarray(images)
        require_real(stack.dtype, "The array of reference frames")
        return stack[None] if stack.ndim == 2 else stack
    path = Path(images)
    files = (
        [path / name for name in natural_sorted(f.name for f in path.iterdir() if f.suffix.lower() in SUFFIXES)]
        if path.is_dir()
        else [path]
    )
    if not files:
        raise DataError(f"{path} holds no .tif or .tiff file.")
    try:
        parts = [read_image(file) for file in files]
        stack = np.concatenate([part[None] if part.ndim == 2 else part for part in parts])
    except UNREADABLE as error:
        wanted = "" if isinstance(error, OSError) and error.errno else " as TIFFs of one shape"
        raise DataError(f"The reference frames in {path} cannot be read{wanted} ({hdf5.reason(error)}).") from error
    require_real(stack.dtype, str(path))
    return stack


def read_image(file: Path | BinaryIO) -> NDArray[Any]:
    """All pages of a TIFF; [row, col] for one page."""
    with tifffile.TiffFile(file) as tif:
        return np.asarray(tif.asarray(key=slice(None)) if pages_one_by_one(tif) else tif.asarray())


def refuse_volume(path: Path, tif: tifffile.TiffFile) -> None:
    """Raises DataError for slices of a volume that this program wrote."""
    if VOLUME in tif.pages.first.description:
        raise DataError(
            f"{path} is a volume that this program wrote, not a scan: give the scan. `beamline info` says what it holds"
        )


def appended(tif: tifffile.TiffFile) -> bool:
    """Pages that tifffile appended one at a time, as the first of them says, which is a grey image."""
    first = tif.pages.first
    if not tif.is_shaped or first.ndim != 2:
        return False
    said = re.search(r'"shape": \[([\d, ]*)\]', first.description)
    return said is not None and [int(n) for n in said[1].split(",") if n.strip()] == [*first.shape]


def pages_one_by_one(tif: tifffile.TiffFile) -> bool:
    """Pages that were appended one at a time, each an image of its own to tifffile, but all alike: one stack."""
    parts = tif.series
    alike = all(len(part.shape) == 2 and (part.shape, part.dtype) == (parts[0].shape, parts[0].dtype) for part in parts)
    return len(parts) > 1 and alike and len(parts) == len(tif.pages)
