"""Single images: reads a TIFF, .npy or PNG as a whole; helper functions for all readers of images."""

from __future__ import annotations

import logging
import lzma
import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from beamline.core.errors import DataError
from beamline.core.files import require_regular
from beamline.storage.hdf5 import ALTERED
from beamline.storage.readers.base import NotUsed
from beamline.storage.structure import PACKED, is_blank

_MOST_PAGES = 100_000
SUFFIXES = (".tif", ".tiff")
VOLUME = "splatline volume"  # Value of `format` in the facts of a file that is not a scan but a volume of this program
UNREADABLE = (*ALTERED, ImportError, lzma.LZMAError, tifffile.TiffFileError, Image.DecompressionBombError)
"""Errors that tifffile, zipfile, Pillow and their decoders raise for an unreadable file. Errors of this program are not
among them.
"""
OTHER_FILES = "images of an OME set in other files"
_NO_IMAGE = 1 | 4  # bits of NewSubfileType: an image with reduced resolution, and a mask
# otherwise the messages of tifffile appear on stderr next to ours
logging.getLogger("tifffile").addHandler(logging.NullHandler())


class Complaints(logging.Handler):
    """Collects tifffile's messages on a damaged file: tifffile only logs such messages, and continues with the pages
    that it finds.
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
    """True if a file is not an image, but was created by the operating system, such as `._0001.tif` on a Mac."""
    return name.rpartition("/")[2].startswith(".")


def open_tiff(file: Path | IO[bytes]) -> tifffile.TiffFile:
    """A TIFF and its pages. If it is one file of a set, its metadata list the pages of all files."""
    if isinstance(file, Path):
        require_regular(file)
    return tifffile.TiffFile(file, is_ome=False, is_mmstack=False, is_ndtiff=False)


def images_of(tif: tifffile.TiffFile) -> list[tifffile.TiffPageSeries]:
    """The groups of pages with the same shape and type. Copies with reduced resolution, masks and thumbnails are left
    out.

    In a TIFF written by tifffile, all pages are used, whether they were written together or appended, unless the file
    states that only its first page has a header.
    """
    tif.is_shaped = tif.is_shaped and '"truncated": true' in tif.pages.first.description
    return [part for part in tif.series if not part.keyframe.subfiletype & _NO_IMAGE] or [*tif.series]


def orientation(tif: tifffile.TiffFile) -> int:
    """The orientation of an image: which sides the first row and the first column are, as a number from 1 to 8 (tag 274
    of TIFF 6.0).
    """
    tag = images_of(tif)[0].keyframe.tags.get(274)
    return int(tag.value) if tag is not None and tag.value in range(1, 9) else 1


def is_untyped(tif: tifffile.TiffFile) -> bool:
    """True if a TIFF does not state the type of its pixels: it has no SampleFormat (tag 339), or the value 4
    (undefined).
    """
    tag = images_of(tif)[0].keyframe.tags.get(339)
    return tag is None or int(np.ravel(tag.value)[0]) not in (1, 2, 3)


def upright(images: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Images [..., row, col] with the first row at the top and the first column at the left."""
    images = images.swapaxes(-1, -2) if orientation >= 5 else images
    images = images[..., ::-1] if orientation in (2, 3, 6, 7) else images
    return images[..., ::-1, :] if orientation in (3, 4, 7, 8) else images


def stated(path: Path, tif: tifffile.TiffFile) -> tuple[NotUsed, ...]:
    """The images of a TIFF that are not used: copies, and images in other files.

    Raises:
        DataError: the OME metadata state several axes, and it is unclear which of them counts the projections.
    """
    listed, reason = 0, "the full-resolution images of this file are used as frames"
    for pixels in re.findall(r"<Pixels\b[^>]*>", tif.pages.first.description):
        sizes = {axis: int(n) for axis, n in re.findall(r'\bSize([CZT])="(\d+)"', pixels) if int(n) > 1}
        listed += math.prod(sizes.values())
        if len(sizes) > 1:
            raise DataError(
                f"{path} contains images along several axes (OME: {sizes}). Save only the projections, along one axis."
            )
    copies = sum(len(part.levels) for part in tif.series) - len(images_of(tif))
    notes = [("pages of other resolutions or masks", copies, False)] if copies else []
    if path.suffix.lower() in SUFFIXES and listed > len(tif.pages):
        notes += [(OTHER_FILES, listed - len(tif.pages), True)]
    return tuple(NotUsed(where, str(n), reason, doubt) for where, n, doubt in notes)


def read_image(file: Path | IO[bytes], most: float = math.inf) -> NDArray[Any]:
    """Read all pages of a TIFF; [row, col] for one page. Raises ValueError if the header states more bytes than are
    allowed, or more than the file can contain.
    """
    with open_tiff(file) as tif:
        refuse_packed(tif)
        require_possible(tif, most)
        return upright(images_of(tif)[0].asarray(), orientation(tif))


def _of_png(file: IO[bytes], most: float = math.inf) -> NDArray[Any]:
    """A grey picture. Raises ValueError for colours, a palette, or more bytes than allowed."""
    with Image.open(file, formats=["PNG"]) as picture:
        if not picture.mode.startswith(("L", "I")) or picture.mode == "LA" or 4 * math.prod(picture.size) > most:
            raise ValueError(
                f"the image has {picture.width} x {picture.height} pixels of kind {picture.mode}; expected grey pixels"
            )
        return np.asarray(picture)


DECODERS: dict[str, Callable[..., NDArray[Any]]] = {
    ".tif": read_image,
    ".tiff": read_image,
    ".npy": lambda file, most=0: np.load(file, allow_pickle=False),
    ".png": _of_png,
}
"""Functions that read the images of a folder, by suffix. Their arguments are an open file, and the largest number of
bytes of the decompressed image.
"""
# formats of pictures that are not read, because nearly all of them have 8 bits or lossy compression
FOREIGN = ".jpg", ".jpeg", ".bmp", ".gif", ".jp2"


def images_among(names: Sequence[str]) -> list[str]:
    """The images among files. Only the first kind in `DECODERS` that occurs is used; files of other kinds are not
    frames of the scan.
    """
    kinds = (SUFFIXES, (".npy",), (".png",))
    by_kind = ([name for name in names if name.lower().endswith(kind) and not is_hidden(name)] for kind in kinds)
    return next(filter(None, by_kind), [])


def no_image(path: Path, names: Sequence[str]) -> str:
    """A sentence that says that a folder contains no readable images, or that a picture has a format that is not
    read.
    """
    foreign = next((name for name in names if name.lower().endswith(FOREIGN)), None)
    if foreign is None:
        return f"{path} contains no image: no .tif, .tiff, .npy or .png file."
    return (
        f"Export 16-bit TIFF or PNG from the program that has the frames: in {path}, pictures such as "
        f"{foreign} are not read, because 8 bits or lossy compression make line integrals wrong. If there "
        'are no other images, convert them to PNG in the folder: python -c "from PIL import Image; '
        "import glob; [Image.open(n).convert('L').save(n + '.png') for n in "
        f"glob.glob('*{foreign[foreign.rfind('.') :]}')]\"."
    )


def image_of(tif: tifffile.TiffFile) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of the result of `read_image`, from the headers of its pages. Raises ValueError if they state no
    type.
    """
    refuse_packed(tif)
    require_possible(tif)
    first = images_of(tif)[0]
    if first.dtype is None:
        raise ValueError("its pixels have an unknown type")
    return upright(np.broadcast_to(0, first.shape), orientation(tif)).shape, first.dtype


def require_possible(tif: tifffile.TiffFile, most: float = math.inf) -> None:
    """Raise ValueError if a TIFF has more pages than any scan, or states more bytes than are allowed or than the file
    can contain.

    The pages are grouped without reading each of them, because tifffile would need minutes for a million pages.
    """
    with suppress(IndexError):
        tif.pages.get(_MOST_PAGES)
        raise ValueError(f"it has more than {_MOST_PAGES} pages")
    first, stored = tif.pages.first, tif.filehandle.size
    claimed = first.nbytes * len(tif.pages)
    if not first.nbytes or claimed > min(most, PACKED * stored) or is_blank(claimed, stored, first.nbytes):
        claimed_gb = claimed / 1e9
        raise ValueError(f"the header states {claimed_gb:.3g} GB, but the file has {stored} bytes")


def refuse_packed(tif: tifffile.TiffFile) -> None:
    """Raise ValueError for packed pixels of 10, 12 or 14 bits if no codec for them is installed."""
    bits = tif.pages.first.bitspersample
    if bits > 8 and bits not in (16, 32, 64) and find_spec("imagecodecs") is None:
        raise ValueError(
            f"the pixels are packed with {bits} bits each: pip install imagecodecs, which unpacks such pixels, or "
            "write the images with 16 bits per pixel"
        )


def refuse_volume(path: Path, tif: tifffile.TiffFile) -> None:
    """Raise DataError for slices of a volume that this program wrote."""
    if VOLUME in tif.pages.first.description:
        raise DataError(
            f"{path} is a volume that this program wrote, not a scan. Give the scan; `beamline info` "
            "shows what the volume contains"
        )
