"""Reads scans of Zeiss (Xradia) microscopes: .txrm, an OLE compound file with a stream for each image and each list.

Stream names, types and units follow two public readers: dxchange (De Carlo et al. 2014, J. Synchrotron Rad. 21, 1224;
also used by CIL's ZEISSDataReader) and txrm2tiff (Diamond Light Source). Both readers divide projections by the single
reference image and subtract no dark, because the instrument has already subtracted it. Images keep the stored
orientation.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.text import count
from beamline.storage import hdf5
from beamline.storage.readers.base import Opening, ScanFormat
from beamline.storage.readers.stacks import FrameStack, StacksSource
from beamline.storage.writers.rows import ScanEnding
from drivers.base.frame import FrameKind

FORMATS = {"txrm": __name__}

_SIGNATURE = bytes.fromhex("d0cf11e0a1b11ae1")
_TYPES: dict[int, np.dtype[Any]] = {5: np.dtype("<u2"), 10: np.dtype("<f4")}
_PER_STORAGE = 100  # images
_CONE = 1  # codes of ImageInfo/XrayGeometry
_ACQUIRED = 0  # codes of ImageInfo/AcquisitionMode; all other codes are volumes


class TxrmFile:
    """The streams of a .txrm file. Use it within hdf5.readable, which converts errors to a DataError."""

    def __init__(self, path: Path) -> None:
        try:
            import olefile
        except ImportError as error:
            raise DataError(
                f"{path} is a .txrm file. Reading it needs the package olefile, which cannot be loaded "
                f'({error}): pip install "splatline[txrm]".'
            ) from error
        self._ole = olefile.OleFileIO(path)

    def bytes_of(self, name: str) -> bytes:
        """The content of a stream. Raises EOFError if the stream does not exist."""
        if not self._ole.exists(name):
            raise EOFError(f"the stream {name} is missing")
        return bytes(self._ole.openstream(name).read())

    def numbers(self, name: str, dtype: str, n: int = 1) -> NDArray[Any] | None:
        """The first n numbers of a stream; None if it is missing or shorter."""
        if not self._ole.exists(name):
            return None
        content, wanted = self.bytes_of(name), n * np.dtype(dtype).itemsize
        return np.frombuffer(content[:wanted], dtype) if len(content) >= wanted else None

    def number(self, name: str) -> int | None:
        """The first integer of a stream; None if there is none."""
        numbers = self.numbers(name, "<i4")
        return None if numbers is None else int(numbers[0])

    def image(self, name: str, shape: tuple[int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
        """An image [row, col]. Raises ValueError if the stream has another size."""
        return np.frombuffer(self.bytes_of(name), dtype).reshape(shape)

    def close(self) -> None:
        self._ole.close()


class _Views:
    """The projections [view, row, col]. Each projection is read when it is needed."""

    ndim = 3

    def __init__(self, file: TxrmFile, path: Path, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> None:
        self._file, self._path, self.shape, self.dtype = file, path, shape, dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[Any]:
        views, rows = key
        wanted = range(len(self))[views]
        out = np.empty((len(wanted), len(range(self.shape[1])[rows]), self.shape[2]), self.dtype)
        with hdf5.readable(self._path):
            # reads a whole image at a time, because the file has no smaller pieces
            for part, i in zip(out, wanted, strict=True):
                name = f"ImageData{i // _PER_STORAGE + 1}/Image{i + 1}"
                part[:] = self._file.image(name, self.shape[1:], self.dtype)[rows]
        return out


def open_txrm(path: Path, *, own_angles: bool = True) -> StacksSource:
    """Open a .txrm file. `own_angles` False: the caller supplies the angles, so the file may lack them.

    Raises DataError if olefile is not installed, if the file contains a volume or a mosaic, or if it is unreadable.
    """
    with hdf5.readable(path):
        file = TxrmFile(path)
        with hdf5.closed_on_error(file):
            return _source(path, file, own_angles)


def _header(path: Path, file: TxrmFile) -> tuple[tuple[int, int, int], np.dtype[Any], int]:
    """Number of images, rows and columns, the type of a pixel, and the planned number of images. Raises DataError if
    these are impossible.
    """
    info = {name: file.number(f"ImageInfo/{name}") for name in ("ImageHeight", "ImageWidth", "NoOfImages", "DataType")}
    lost = [name for name, value in info.items() if value is None]
    if lost:
        lost_stream = lost[0]
        raise DataError(f"{path} is not a .txrm scan: the stream ImageInfo/{lost_stream} is missing.")
    rows, cols, planned, kind = (int(value) for value in info.values() if value is not None)
    n = min(planned, taken if (taken := file.number("ImageInfo/ImagesTaken")) is not None else planned)
    if min(rows, cols) < 1 or rows * cols > 2**31:
        raise DataError(f"{path} is damaged: it states images of {rows} x {cols} pixels.")
    if kind not in _TYPES:
        raise DataError(f"{path} has {rows} x {cols} pixels of type {kind}; expected type 5 (uint16) or 10 (float).")
    if n * rows * cols * _TYPES[kind].itemsize > path.stat().st_size:
        raise DataError(
            f"{path} states {n} images of {rows} x {cols} pixels, but the file is too small for these images."
        )
    return (max(n, 0), rows, cols), _TYPES[kind], planned


def _source(path: Path, file: TxrmFile, own_angles: bool) -> StacksSource:
    shape, dtype, planned = _header(path, file)
    n, rows, cols = shape
    _refuse(path, file)
    stacks = [FrameStack(FrameKind.PROJECTION, "ImageData", _Views(file, path, shape, dtype))]
    reference = _TYPES.get(
        file.number("ReferenceData/DataType") or file.number("ReferenceData/ImageInfo/DataType") or 0
    )
    if reference is not None:
        flat = file.image("ReferenceData/Image", (rows, cols), reference)[None]
        dark = np.zeros_like(flat)  # the instrument has subtracted the darks
        stacks = [
            FrameStack(FrameKind.DARK, "dark", dark),
            FrameStack(FrameKind.FLAT, "ReferenceData/Image", flat),
            *stacks,
        ]
    source = StacksSource(path, file, stacks, format="txrm", facts=_facts(file))
    if (shifts := _shifts(path, file, n)).any():
        before = len(source.table) - n
        source.table = replace(source.table, shifts=np.pad(shifts, ((before, 0), (0, 0)), constant_values=np.nan))
    if n < planned:
        source.stated_ending = ScanEnding(
            "stopped", reason=f"{n} of {count(planned, 'planned projection')} were taken."
        )
    angles = file.numbers("ImageInfo/Angles", "<f4", n)
    if own_angles:
        if angles is None:
            raise DataError(f"Give --angles FILE (degrees): {path} does not state the angles of its {n} projections.")
        source.table.angles[-n:] = np.radians(angles.astype(np.float64))
    _set_exposures(source, file, n)
    _set_scale(source, file)
    return source


def _refuse(path: Path, file: TxrmFile) -> None:
    if file.number("ImageInfo/AcquisitionMode") not in (None, _ACQUIRED):
        raise DataError(f"Give the .txrm file: {path} is a volume (.txm) or a single image, not a scan.")
    # sic: the streams have this spelling
    if any(file.number(f"ImageInfo/{name}") for name in ("MosiacColumns", "MosiacRows")):
        raise DataError(
            f"{path} is a mosaic; expected projections of one field of view each. Stitch the mosaic with the program "
            "of the microscope."
        )


def _shifts(path: Path, file: TxrmFile, n: int) -> NDArray[np.float64]:
    """Displacement of each image, [view, 2] pixels (col, row).

    The file contains the shift that corrects each image (for drift, runout and encoder); txrm2tiff and MBIRTorch move
    images by this shift. In a real file, the displacement between successive projections has the opposite sign, which
    confirms this.
    """
    shifts_by_axis = [file.numbers(f"Alignment/{axis}-Shifts", "<f4", n) for axis in "XY"]
    shifts = np.stack([np.zeros(n) if each is None else -each.astype(np.float64) for each in shifts_by_axis], axis=1)
    if not np.isfinite(shifts).all():
        n_bad = (~np.isfinite(shifts)).sum()
        raise DataError(f"{path} is damaged: {n_bad} shifts of projections are not numbers.")
    return shifts


def _set_exposures(source: StacksSource, file: TxrmFile, n: int) -> None:
    """Exposure of the projections in s, and of the reference, which may be different."""
    views = file.numbers("ImageInfo/ExpTimes", "<f4", n)
    source.table.exposures[-n:] = np.nan if views is None else np.where(views > 0, views, np.nan)
    for name in ("ReferenceData/ImageInfo/ExpTimes", "ReferenceData/ImageInfo/ExpTime", "ReferenceData/ExpTime"):
        seconds = file.numbers(name, "<f4")
        if seconds is not None and seconds[0] > 0:
            source.table.exposures[source.table.flats] = seconds[0]
            break


def _set_scale(source: StacksSource, file: TxrmFile) -> None:
    """Pixel size at the sample (stored in µm), and the distances of a cone beam (stored in mm, with either sign)."""
    pixel, near, far = (
        None if lengths is None else abs(float(lengths[0]))
        for lengths in (
            file.numbers(f"ImageInfo/{name}", "<f4") for name in ("PixelSize", "StoRADistance", "DtoRADistance")
        )
    )
    if pixel is not None and 0 < pixel < math.inf:
        source.pixel_size_mm = pixel * 1e-3
    if file.number("ImageInfo/XrayGeometry") == _CONE and near and far and math.isfinite(near + far):
        source.cone = (near, near + far)
        if source.pixel_size_mm is not None:
            source.pixel_size_mm *= (near + far) / near


def _facts(file: TxrmFile) -> dict[str, str | float | int]:
    """Other facts in the file, in the units of the file."""
    facts: dict[str, str | float | int] = {}
    for name in ("Energy", "Current", "OpticalMagnification", "CamPixelSize", "Temperature"):
        values = file.numbers(f"ImageInfo/{name}", "<f4")
        if values is not None and np.isfinite(values[0]):
            facts[name] = float(values[0])
    return facts


def _recognises(path: Path, opening: Opening) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


FORMAT = ScanFormat(".txrm (Zeiss)", _recognises, lambda path, opening: open_txrm(path, own_angles=opening.own_angles))
