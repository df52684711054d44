"""TIFF scans: a folder (or .zip) with one image a file, and one file with a page for each frame.

Files tell what they are by name: `dark`, `flat`, `white` or `open_beam` at the start of a word of the name or of a
folder above it; the others must be one series. They are put in the order of the numbers in their names, never of a
listing. Pages and files are read one at a time, so that memory does not grow with the scan.
"""

from __future__ import annotations

import io
import logging
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import tifffile
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.hdf5 import require_real
from beamline.storage.readers.base import WHOLE, Quantity, bare_frames, frame_indices
from drivers.frame import Frame, FrameKind

SUFFIXES = (".tif", ".tiff")
REFERENCE = re.compile(r"(?:^|[^a-z])(dark|flat|white|open[ _-]?beam)")
ANGLE_FILE = re.compile(r"(?:^|[^a-z])(angle|theta)[^/]*\.(txt|csv|dat)$")
UNREADABLE = (tifffile.TiffFileError, OSError, ValueError, LookupError, EOFError, zipfile.BadZipFile, zlib.error)


class _Complaints(logging.Handler):
    """What tifffile says about a damaged file: it logs that, and goes on with the pages that it finds."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.said: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.said.append(record.getMessage())

    def __enter__(self) -> None:
        logging.getLogger("tifffile").addHandler(self)

    def __exit__(self, *_: object) -> None:
        logging.getLogger("tifffile").removeHandler(self)


class TiffStack:
    """One TIFF with a page for each frame, read page by page; see ScanSource. Angles come from the caller."""

    format = "tiff_stack"
    finished = True
    quantity: Quantity = "unknown"
    pixel_size_mm: float | None = None
    energy_kev: float | None = None
    axis_col: float | None = None
    cone: tuple[float, float] | None = None

    def __init__(self, path: Path) -> None:
        self.path = path
        complaints = _Complaints()
        with complaints:
            try:
                self._tif = tifffile.TiffFile(path)
            except UNREADABLE as error:
                raise DataError(f"{path} cannot be read as TIFF ({hdf5.reason(error)}).") from error
            try:
                n = self._look()
            except UNREADABLE as error:
                complaints.said.append(str(error))
            except BaseException:
                self._tif.close()
                raise
        if complaints.said:
            self._tif.close()
            raise DataError(f"{path} cannot be read whole: it is cut or damaged ({complaints.said[0]}).")
        self.image_key = np.full(n, FrameKind.PROJECTION, np.int32)
        self.angles = np.full(n, np.nan)
        self.exposures = np.full(n, np.nan)
        self.attributes: dict[str, str | float | int] = {
            "pages": len(self._tif.pages),
            "bigtiff": "yes" if self._tif.is_bigtiff else "no",
        }

    def _look(self) -> int:
        """Shape, type and place of the frames, and how many there are."""
        series = self._tif.series[0]
        one_by_one = _pages_one_by_one(self._tif)
        if len(series.shape) not in (2, 3) or (len(self._tif.series) != 1 and not one_by_one):
            shapes = ", ".join(str(part.shape) for part in self._tif.series[:6])
            shapes += f", ... ({len(self._tif.series)} in all)" if len(self._tif.series) > 6 else ""
            raise DataError(f"{self.path} holds {shapes}; expected one stack of grey images [page, row, col].")
        self.shape = (int(series.shape[-2]), int(series.shape[-1]))
        self.dtype: np.dtype[Any] = np.dtype(series.dtype)
        require_real(self.dtype, str(self.path))
        # Uncompressed stacks are one run of bytes: any frame, or some of its rows, is where arithmetic says.
        self._offset = None if one_by_one else series.dataoffset
        self._stored = self.dtype.newbyteorder(self._tif.byteorder)
        if one_by_one:
            return len(self._tif.pages)
        return 1 if len(series.shape) == 2 else int(series.shape[0])

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        """Pixels [frame, row, col] of the pages asked for, in that order."""
        indices = frame_indices(frames, self.image_key.size)
        wanted = range(self.shape[0])[rows]
        out = np.empty((indices.size, len(wanted), self.shape[1]), self.dtype)
        for i, page in enumerate(indices):
            try:
                self._fill(out[i], int(page), rows)
            except UNREADABLE as error:
                raise DataError(f"Page {page} of {self.path} cannot be read ({hdf5.reason(error)}).") from error
        return out

    def _fill(self, out: NDArray[Any], page: int, rows: slice) -> None:
        if self._offset is None:
            out[...] = self._tif.pages[page].asarray()[rows]
        elif rows.step not in (None, 1):
            whole = np.empty(self.shape, self.dtype)
            self._fill(whole, page, WHOLE)
            out[...] = whole[rows]
        else:
            first = rows.indices(self.shape[0])[0]
            self._tif.filehandle.seek(self._offset + (page * self.shape[0] + first) * self.shape[1] * out.itemsize)
            n = self._tif.filehandle.readinto(out)
            if n != out.nbytes:
                raise EOFError(f"{n} of {out.nbytes} bytes are there")
            if not self._stored.isnative:
                out.byteswap(inplace=True)

    def frames(self) -> Iterator[Frame]:
        return bare_frames(self)

    def refresh(self) -> int:
        return int(self.image_key.size)

    def close(self) -> None:
        self._tif.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class TiffSeries:
    """A folder or .zip with one image a file; see ScanSource. Frames: darks, flats, then the series.

    Attribute `angle_text`: (name, content) of the one file that is named after angles, or None.
    """

    format = "tiff_series"
    finished = True
    quantity: Quantity = "unknown"
    pixel_size_mm: float | None = None
    energy_kev: float | None = None
    axis_col: float | None = None
    cone: tuple[float, float] | None = None

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip = _open_zip(path) if path.is_file() else None
        try:
            names = self._names()
            images = sorted((name for name in names if name.lower().endswith(SUFFIXES)), key=natural)
            kinds = {name: kind_of(name) for name in images}
            series = [name for name in images if kinds[name] is FrameKind.PROJECTION]
            _check_one_series(path, series)
            order = [name for kind in (FrameKind.DARK, FrameKind.FLAT) for name in images if kinds[name] is kind]
            self._files = order + series
            self.image_key = np.array([kinds[name] for name in self._files], np.int32)
            self.angles = np.full(len(self._files), np.nan)
            self.exposures = np.full(len(self._files), np.nan)
            samples = [self._image(name) for name in (*order, series[0])]
            self.shape: tuple[int, int] = samples[-1].shape[0], samples[-1].shape[1]
            self.dtype: np.dtype[Any] = np.result_type(*(image.dtype for image in samples))
            texts = [name for name in names if ANGLE_FILE.search(name.lower())]
            self.angle_text = (texts[0], self._bytes(texts[0]).decode("utf-8", "replace")) if len(texts) == 1 else None
        except BaseException:
            self.close()
            raise
        self.attributes: dict[str, str | float | int] = {"series": f"{series[0]} ... {series[-1]}"}
        gaps = _gaps(series)
        if gaps:
            self.attributes["missing_numbers"] = ", ".join(map(str, gaps[:20]))

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        """Pixels [frame, row, col] of the files asked for, in that order."""
        indices = frame_indices(frames, self.image_key.size)
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        for i, number in enumerate(indices):
            name = self._files[number]
            image = self._image(name)
            if image.shape != self.shape:
                raise DataError(f"{name} in {self.path} is {image.shape}; the other frames are {self.shape}.")
            out[i] = image[rows]
        return out

    def frames(self) -> Iterator[Frame]:
        return bare_frames(self)

    def refresh(self) -> int:
        return int(self.image_key.size)

    def close(self) -> None:
        if self._zip is not None:
            self._zip.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _names(self) -> list[str]:
        if self._zip is not None:
            return [name for name in self._zip.namelist() if not name.endswith("/") and "__MACOSX" not in name]
        return [item.relative_to(self.path).as_posix() for item in self.path.rglob("*") if item.is_file()]

    def _bytes(self, name: str) -> bytes:
        return (self.path / name).read_bytes() if self._zip is None else self._zip.read(name)

    def _image(self, name: str) -> NDArray[Any]:
        try:
            image = read_image(io.BytesIO(self._bytes(name)))
        except UNREADABLE as error:
            raise DataError(f"{name} in {self.path} cannot be read as TIFF ({hdf5.reason(error)}).") from error
        if image.ndim != 2:
            raise DataError(f"{name} in {self.path} is {image.shape}; expected one grey image a file.")
        require_real(image.dtype, f"{name} in {self.path}")
        return image


def load_images(images: Path | str | NDArray[Any]) -> NDArray[Any]:
    """Reference frames [frame, row, col]: from an array, one TIFF (any pages) or a folder of TIFFs, all in memory."""
    if not isinstance(images, Path | str):
        stack = np.asarray(images)
        require_real(stack.dtype, "The array of reference frames")
        return stack[None] if stack.ndim == 2 else stack
    path = Path(images)
    files = (
        sorted((item for item in path.iterdir() if item.suffix.lower() in SUFFIXES), key=lambda f: natural(f.name))
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
        return np.asarray(tif.asarray(key=slice(None)) if _pages_one_by_one(tif) else tif.asarray())


def _pages_one_by_one(tif: tifffile.TiffFile) -> bool:
    """Pages that were appended one at a time, each an image of its own to tifffile, but all alike: one stack."""
    parts = tif.series
    alike = all(len(part.shape) == 2 and (part.shape, part.dtype) == (parts[0].shape, parts[0].dtype) for part in parts)
    return len(parts) > 1 and alike and len(parts) == len(tif.pages)


def kind_of(name: str) -> FrameKind:
    """What a file shows, by its name relative to the scan's folder."""
    match = REFERENCE.search(name.lower())
    if match is None:
        return FrameKind.PROJECTION
    return FrameKind.DARK if match[1] == "dark" else FrameKind.FLAT


def natural(name: str) -> list[tuple[int, str]]:
    """A sort key by which image_9 comes before image_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name.lower())]


def _open_zip(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except UNREADABLE as error:
        raise DataError(f"{path} cannot be read as a zip file ({hdf5.reason(error)}).") from error


def _prefix(name: str) -> str:
    return re.sub(r"\d+(?=\.\w+$)", "", name)


def _check_one_series(path: Path, names: list[str]) -> None:
    prefixes = sorted({_prefix(name) for name in names})
    if not names:
        raise DataError(f"{path} holds no projections: no .tif or .tiff file but those named as darks or flats.")
    if len(prefixes) > 1:
        found = ", ".join(f"{sum(_prefix(name) == prefix for name in names)} of {prefix!r}" for prefix in prefixes[:6])
        raise DataError(
            f"{path} holds several series of images: {found}. Name darks and flats so (dark_0001.tif, flat_0001.tif), "
            "or give the folder of the projections, and the others apart, with --darks and --flats."
        )


def _gaps(names: list[str]) -> list[int]:
    """Numbers that a series leaves out between its first and its last."""
    found = [re.search(r"(\d+)\.\w+$", name) for name in names]
    numbers = {int(match[1]) for match in found if match is not None}
    return sorted(set(range(min(numbers), max(numbers))) - numbers) if numbers else []
