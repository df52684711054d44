"""TIFF images: reading them whole, and what all readers of them ask."""

from __future__ import annotations

import logging
import lzma
import math
import re
import zipfile
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import require_regular
from beamline.storage.hdf5 import ALTERED
from beamline.storage.structure import PACKED, is_blank

_MOST_PAGES = 100_000
SUFFIXES = (".tif", ".tiff")
VOLUME = "splatline volume"  # Value of `format` in the facts of a file that is a volume of ours, not a scan
UNREADABLE = (*ALTERED, ImportError, lzma.LZMAError, tifffile.TiffFileError, zipfile.BadZipFile)
"""What tifffile, zipfile and their decoders raise for a file that they cannot read; none of ours is among them."""
logging.getLogger("tifffile").addHandler(logging.NullHandler())  # else what it logs goes to stderr, beside our sentence


class Complaints(logging.Handler):
    """Collects tifffile's messages on a damaged file: tifffile only logs them, and continues with the pages that it
    finds.
    """

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())

    def __enter__(self) -> Complaints:
        logging.getLogger("tifffile").addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger("tifffile").removeHandler(self)


def is_hidden(name: str) -> bool:
    """Whether a file is a system's companion of another, such as a Mac's `._0001.tif`, and no image."""
    return name.rpartition("/")[2].startswith(".")


def read_image(file: Path | BinaryIO, most: float = math.inf) -> NDArray[Any]:
    """Read all pages of a TIFF; [row, col] for one page. Raises ValueError if it claims more bytes than allowed, or
    than it can contain.
    """
    if isinstance(file, Path):
        require_regular(file)
    with tifffile.TiffFile(file) as tif:
        refuse_packed(tif)
        require_possible(tif, most)
        return np.asarray(tif.asarray(key=slice(None)) if pages_one_by_one(tif) else tif.asarray())


def image_of(tif: tifffile.TiffFile) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of the result of `read_image`, from the headers of its pages. Raises ValueError if they state no
    type.
    """
    refuse_packed(tif)
    require_possible(tif)
    first = tif.series[0]
    if first.dtype is None:
        raise ValueError("its pixels are of an unknown type")
    return ((len(tif.pages), *first.shape) if pages_one_by_one(tif) else first.shape), first.dtype


def require_possible(tif: tifffile.TiffFile, most: float = math.inf) -> None:
    """Raise ValueError for more pages than any scan has, or for more bytes than allowed, or than the file can contain.

    Pages are told without a look at each: tifffile takes minutes for a million.
    """
    with suppress(IndexError):
        tif.pages.get(_MOST_PAGES)
        raise ValueError(f"it has more than {_MOST_PAGES} pages")
    first, stored = tif.pages.first, tif.filehandle.size
    claimed = first.nbytes * len(tif.pages)
    if not first.nbytes or claimed > min(most, PACKED * stored) or is_blank(claimed, stored, first.nbytes):
        raise ValueError(f"it claims {claimed / 1e9:.3g} GB in {stored} bytes")


def refuse_packed(tif: tifffile.TiffFile) -> None:
    """Raise ValueError for packed pixels of 10, 12 or 14 bits if no codec unpacks them."""
    bits = tif.pages.first.bitspersample
    if bits > 8 and bits not in (16, 32, 64) and find_spec("imagecodecs") is None:
        raise ValueError(
            f"its pixels are packed, {bits} bits each: pip install imagecodecs, which unpacks them, or write the "
            "images with 16 bits a pixel"
        )


def refuse_volume(path: Path, tif: tifffile.TiffFile) -> None:
    """Raise DataError for slices of a volume that this program wrote."""
    if VOLUME in tif.pages.first.description:
        raise DataError(
            f"{path} is a volume that this program wrote, not a scan: give the scan. `beamline info` says what it holds"
        )


def appended(tif: tifffile.TiffFile) -> bool:
    """Pages that tifffile appended one at a time, as the first of them says, which is a grey image."""
    first = tif.pages.first
    if not tif.is_shaped or first.ndim != 2:
        return False
    match = re.search(r'"shape": \[([\d, ]*)\]', first.description)
    return match is not None and [int(n) for n in match[1].split(",") if n.strip()] == [*first.shape]


def pages_one_by_one(tif: tifffile.TiffFile) -> bool:
    """Combine pages that were appended one at a time, each a separate image to tifffile, but all alike, into one
    stack."""
    parts = tif.series
    alike = all(len(part.shape) == 2 and (part.shape, part.dtype) == (parts[0].shape, parts[0].dtype) for part in parts)
    return len(parts) > 1 and alike and len(parts) == len(tif.pages)
