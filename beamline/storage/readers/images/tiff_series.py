"""TIFF series: a folder (or .zip) with one image a file.

The name of a file tells its kind, see `image_names`; all but darks and flats must be one series. They are put in the
order of the numbers in their names, never of a listing. Files are read one at a time, so that memory does not grow with
the scan. Hidden files (`._0001.tif` of a Mac) are not looked at.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tifffile import TiffFile

from beamline.core.errors import DataError
from beamline.core.files import TEXT, decoded
from beamline.core.text import size, spans
from beamline.storage import hdf5
from beamline.storage.datasets import require_real
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.packing import packing
from beamline.storage.readers.base import WHOLE, ScanFormat, ScanSource, frame_indices
from beamline.storage.readers.frames import Frames
from beamline.storage.readers.images.image_names import NamedImages, in_order
from beamline.storage.readers.side_files import offered
from beamline.storage.readers.tiff import (
    SUFFIXES,
    UNREADABLE,
    image_of,
    is_hidden,
    is_untyped,
    opened,
    read_image,
    refuse_volume,
    stated,
)
from beamline.storage.structure import is_blank
from beamline.storage.writers.rows import ScanEnding

MOST_FILES = 100_000
LARGEST_IMAGE = 2**30  # bytes of an image: 16,000 x 16,000 pixels of 4 bytes
_LOOKED, _REFERENCES = 2**30, 1000  # bytes, and number, of darks and flats that are read to tell their type
_MOST_NUMBERS = 2**20  # from the first number of a series to its last
_TRIED = 3  # first images of a series, of which one must be readable, as the others are then
_SCALES = "scaleoffset.json"
ANGLE_FILE = re.compile(r"(?:^|[^a-z])(angle|theta)[^/]*\.(txt|csv|dat)$")


class TiffSeriesSource(ScanSource):
    """A folder or .zip with one image per file; see ScanSource. Frames: darks, flats, then the series."""

    format = "tiff_series"

    def __init__(self, path: Path, *, one_series: bool = False) -> None:
        """Open. `one_series`: all images are one numbered series, whatever the names say of kinds."""
        self.path = path
        self._zip = _open_zip(path) if path.is_file() else None
        with hdf5.closed_on_error(self):
            names = self._names()
            images = in_order(path, [name for name in names if name.lower().endswith(SUFFIXES)], one_series=one_series)
            self._files, self.image_key, self.angles = images.names, images.kinds, images.angles
            self.in_order, self.numbers = images.references == 0, images.numbers
            self.exposures = np.full(len(self._files), np.nan)
            references, series = self._files[: images.references], self._files[images.references :]
            with suppress(UnreadableError, *UNREADABLE), self._tiff(series[0]) as tif:  # damage is told below
                refuse_volume(path, tif)
                self.not_used, self.untyped = stated(path, tif), is_untyped(tif)
            some = references[:: len(references) // _REFERENCES + 1]
            samples = [*self._readable(some), *self._readable(series[:_TRIED], at_least=1)[:1]]
            self.shape = samples[-1][0]
            self.dtype = np.result_type(*(dtype for _, dtype in samples))
            self._texts = [name for name in names if ANGLE_FILE.search(name.lower())]
            self.packing = next((self._text(name) for name in names if name.rpartition("/")[2] == _SCALES), "")
        missing, gaps = _left_out(images)
        self.stated_ending, self.not_used = ScanEnding(missing=missing), self.not_used + offered(self)
        self.facts = {"series": f"{series[0]} ... {series[-1]}"} | ({"missing_numbers": gaps} if gaps else {})
        if np.isfinite(self.angles).any() and len(self._texts) != 1:
            self.facts |= {"angles_from": "the names of the files"}
        if images.doubt:
            self.facts |= {"angles": images.doubt}

    @property
    def angle_text(self) -> tuple[str, str] | None:
        """Name and content of the one file named after angles, or None. Raises DataError if it is too large."""
        return (self._texts[0], self._text(self._texts[0])) if len(self._texts) == 1 else None

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices = frame_indices(frames, self.image_key.size)
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for i, number in enumerate(indices):
            name = self._files[number]
            image = self._image(name)
            if image.shape != self.shape:
                raise DataError(f"{name} in {self.path} is {image.shape}; the other frames are {self.shape}.")
            if not np.can_cast(image.dtype, self.dtype):
                raise DataError(
                    f"{name} in {self.path} holds {image.dtype} pixels, the frames before it {self.dtype}, which "
                    "cannot hold them all. Write all images of a scan in one type."
                )
            out[i] = image[rows]
        return out

    def close(self) -> None:
        if self._zip is not None:
            self._zip.close()

    def _names(self) -> list[str]:
        if self._zip is not None:
            packed = (name for name in self._zip.namelist() if not name.endswith("/") and "__MACOSX" not in name)
            return [name for name in packed if not is_hidden(name)]
        names, places = list[Path](), set[str]()
        for folder, inner, files in os.walk(self.path, followlinks=True):
            inner[:] = [] if (place := os.path.realpath(folder)) in places else inner  # a link to one that was seen
            names += [] if place in places else [Path(folder, name) for name in files]
            places.add(place)
            _refuse_more(self.path, len(names) + len(places))
        return [file.relative_to(self.path).as_posix() for file in names if not is_hidden(file.name) and file.is_file()]

    def _bytes(self, name: str, most: int) -> bytes:
        try:
            with self._opened(name, most) as file:
                return file.read(min(most, self._size(name)))
        except UNREADABLE as error:
            raise UnreadableError(f"{name} in {self.path} cannot be read ({hdf5.reason(error)}).") from error

    def _size(self, name: str) -> int:
        return (self.path / name).stat().st_size if self._zip is None else self._zip.getinfo(name).file_size

    def _opened(self, name: str, most: int) -> IO[bytes]:
        """A file of the series, of so many bytes at most."""
        if (n := self._size(name)) > most:
            raise OSError(errno.EFBIG, f"it has {size(n)}, and at most {size(most)} are read")
        if self._zip is not None and is_blank(n, self._zip.getinfo(name).compress_size, n):
            raise OSError(errno.EFBIG, f"it unpacks to {size(n)} of nearly equal values, which no image has")
        return (self.path / name).open("rb") if self._zip is None else self._zip.open(name)

    @contextmanager
    def _tiff(self, name: str) -> Iterator[TiffFile]:
        """The head of an image, whose pixels are not read."""
        try:
            with self._opened(name, LARGEST_IMAGE) as file, opened(file) as tif:
                yield tif
        except UNREADABLE as error:
            raise UnreadableError(f"{name} in {self.path} cannot be read ({hdf5.reason(error)}).") from error

    def _readable(self, names: list[str], at_least: int = 0) -> list[tuple[tuple[int, int], np.dtype[Any]]]:
        """Shape and type of the images of these files that can be read, by their heads; DataError where they are fewer
        than `at_least`.

        Of many bytes the first ones: to tell their type takes no more.
        """
        images, failed, looked = list[tuple[tuple[int, int], np.dtype[Any]]](), list[UnreadableError](), 0
        for name in names:
            if images and looked > _LOOKED:
                break
            looked += self._size(name)
            try:
                with self._tiff(name) as tif:
                    shape, dtype = image_of(tif)
                images.append((self._require_grey(name, shape, dtype), dtype))
            except UnreadableError as error:
                failed.append(error)
        if len(images) < at_least:
            raise failed[0]
        return images

    def _text(self, name: str) -> str:
        return decoded(self._bytes(name, TEXT), "replace")  # a comment in another alphabet; numbers are told later

    def _image(self, name: str) -> NDArray[Any]:
        content = self._bytes(name, LARGEST_IMAGE)
        try:
            image = read_image(io.BytesIO(content), LARGEST_IMAGE)
        except UNREADABLE as error:
            raise UnreadableError(f"{name} in {self.path} cannot be read as TIFF ({hdf5.reason(error)}).") from error
        self._require_grey(name, image.shape, image.dtype)
        return image

    def _require_grey(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[int, int]:
        if not shape or math.prod(shape) == 0:
            raise UnreadableError(f"{name} in {self.path} cannot be read as TIFF (it contains no image).")
        if len(shape) != 2:
            raise DataError(
                f"{name} in {self.path} is {shape}; expected one grey image a file. Give stacks as FILE --then FILE."
            )
        require_real(dtype, f"{name} in {self.path}")
        return shape


def _open_zip(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except UNREADABLE as error:
        raise DataError(f"{path} cannot be read as a zip file ({hdf5.reason(error)}).") from error


def _refuse_more(path: Path, n: int) -> None:
    if n > MOST_FILES:
        raise DataError(f"{path} holds more than {MOST_FILES} files: it is no scan. Give the folder of its images.")


def _left_out(images: NamedImages) -> tuple[tuple[int, ...], str]:
    """The places in the scan of numbers that a series leaves out, and these numbers in words."""
    numbers = images.of_series
    if numbers is None or np.ptp(numbers) >= _MOST_NUMBERS:  # dates and serial numbers count no images
        return (), ""
    left_out, first = sorted({*range(numbers.min(), numbers.max())} - {*numbers.tolist()}), int(numbers.min())
    return tuple(images.references + number - first for number in left_out), spans(left_out)


def _unpacked(source: TiffSeriesSource) -> ScanSource:
    """The values of a series that CIL packed, by the scale and the offset in the file that it writes beside images."""
    said = json.loads(source.packing) if source.packing else {}
    values = packing(said, source.dtype, f"{_SCALES} in {source.path}", by_cil=True) if isinstance(said, dict) else None
    if values is None:
        return source
    real = np.result_type(source.dtype, np.float32)
    return Frames(source, pixels=lambda read, frames, rows: values(read(frames, rows)), dtype=real)


FORMAT = ScanFormat(
    "a folder or .zip of TIFFs",
    lambda path, opening: path.is_dir() or (path.is_file() and path.suffix.lower() == ".zip"),
    lambda path, opening: _unpacked(TiffSeriesSource(path, one_series=opening.one_series)),
)
