"""ScanSource: the interface of a scan file of any format. A format adds a subclass, and a ScanFormat for the
registry.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.monitor.digest import LARGEST
from beamline.storage.frame_table import FrameTable
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.writers.rows import ScanEnding
from drivers.base.frame import Frame, FrameKind
from recon.base.arrays import Mask

Quantity = Literal["counts", "line_integrals", "unknown"]
Stated = Quantity | Literal["transmission"]
"""A quantity that a file or a caller states. Transmission is read as counts with flats of 1 and darks of 0."""
Attributes = Mapping[str, str | float | int]

WHOLE = slice(None)


class NotUsed(NamedTuple):
    """A field of a file that is not used: its path, its value, the reason or what to do. Also whether the value may
    matter, and whether ignoring it makes the volume wrong by more than 1 %.
    """

    where: str
    value: str
    why: str
    doubt: bool
    wrong: bool = False


class ScanSource(ABC):
    """The frames of one scan and their metadata. No value is guessed: unknown values are None, NaN or "unknown".

    The subclass of a format defines `read` and `close`. When it opens the file, it sets `path`, `shape`, `dtype`,
    `table`, `facts`, and the other fields that the format states.

    Attributes:
        path: path of the opened scan.
        format: "nxtomo", "diamond_nexus", "data_exchange", "tiff_series", "tiff_stack", ...
        shape: (rows, cols) of a frame.
        dtype: type of the pixels that read() returns.
        quantity: quantity of the pixels; "unknown" if neither the file nor the caller states it.
        table: the table of the frames; `refresh` replaces it.
        facts: the values of `attributes`, for a format in which they do not change.
        pixel_size_mm: pixel size at the sample; for a cone beam, on the detector.
        axis_col: column of the rotation axis, counted from 0 at the centre of the first column.
        cols: (first, end) detector columns that a frame contains; None: all.
        cone: mm from the source to the rotation axis and to the detector; None for a parallel beam.
        central_ray: (row, column) at which the central ray meets the detector according to the file; it is shown but
            not used; NaN: not stated.
        unreadable: rows that `read_known` could not read from the file, each with the reason.
        row_pitch_mm: height of a pixel, measured like `pixel_size_mm`, if it differs from the width; None: pixels are
            square.
        in_order: the frames are in the order of acquisition. False: darks and flats come first in the table, whenever
            they were taken.
        untyped: True if the file does not state whether pixels are integers or real numbers.
        pixel_mask: bool [row, col], pixels that must not be used according to the file; None if the file has no mask.
        frames_per_view: number of camera frames that are averaged to one projection.
        not_used: fields of the file about geometry, units, order or validity that are not used.
        unpack_bytes: bytes of memory that are needed while the data of a frame are decompressed.
        plan: the requested scan, as this program's files record it; empty if unknown.
        row_period: s between the exposures of two neighbouring rows; 0: all rows are exposed together; None: unknown.
        decisions: the choices after passes, oldest first, as values of the event `next_chosen`.
        stated_ending: the value of `ending`, for a format in which it does not change.
        angles_unit: unit that is assumed if a list of angles in the file states no unit; "": such a list is an error.
        side_files: True if a settings file of the manufacturer may lie next to the scan.
    """

    path: Path
    format: str
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    table: FrameTable
    facts: Attributes
    quantity: Quantity = "unknown"
    pixel_size_mm: float | None = None
    energy_kev: float | None = None
    axis_col: float | None = None
    cols: tuple[int, int] | None = None
    cone: tuple[float, float] | None = None
    central_ray: tuple[float, float] | None = None
    unreadable: Mapping[int, str] = MappingProxyType({})
    row_pitch_mm: float | None = None
    in_order: bool = True
    untyped: bool = False
    pixel_mask: Mask | None = None
    frames_per_view: int = 1
    not_used: tuple[NotUsed, ...] = ()
    unpack_bytes: int = 0
    plan: Mapping[str, Any] = MappingProxyType({})
    row_period: float | None = None
    decisions: tuple[Mapping[str, Any], ...] = ()
    stated_ending: ScanEnding = ScanEnding()
    angles_unit: str = ""
    side_files: bool = False

    @property
    def angle_text(self) -> tuple[str, str] | None:
        """Name and content of a text file with angles next to the frames, or None."""
        return None

    @property
    def stack_options(self) -> tuple[str, str]:
        """Path of the dataset of the projections, and the options that name the other datasets; "" for formats whose
        datasets cannot be chosen by options."""
        return str(self.attributes.get("data", "")), ""

    def exchange_sinogram(self, *, views_first: bool) -> str:
        """What the user can do to exchange the two dimensions of a sinogram, of which the first is now that of the
        projections or of the columns."""
        return f"give --order {'col,view' if views_first else 'view,col'}"

    @property
    def frame_bytes(self) -> int:
        """Number of bytes that are decompressed to read a frame, or any row of a frame."""
        return self.shape[0] * self.shape[1] * self.dtype.itemsize

    @property
    def finished(self) -> bool:
        """True if no more frames will come. Check before refresh(): refresh() then finds all frames."""
        return True

    @property
    def ending(self) -> ScanEnding:
        """How the scan ended, as far as the file states it. A copy of the file states the same."""
        return self.stated_ending

    @property
    def attributes(self) -> Attributes:
        """Further metadata of the file, to show and to store."""
        return self.facts

    @property
    def checksummed(self) -> bool:
        """True if the file has a checksum for every frame."""
        return False

    @property
    def damaged(self) -> frozenset[int]:
        """Rows read so far whose pixels differ from their checksums.

        A frame is compared with its checksum only if at least half of it is read.
        """
        return frozenset()

    @abstractmethod
    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        """Pixels [frame, row, col] of the requested frames, in that order. Raises IndexError beyond the readable
        frames.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    def refresh(self) -> int:
        """Read the state of a growing file again; returns the number of readable frames."""
        return len(self.table)

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yields the frames from `first` on with all known values. Pixels have the type that the file has."""
        for row in range(first, len(table := self.table)):
            counts = read_known(self, [row])[0]
            yield table.frame(row, counts, FrameKind.INVALID if row in self.unreadable else None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def frame_indices(frames: slice | ArrayLike, n: int) -> NDArray[np.int64]:
    """The row numbers of a slice or an array. Negative numbers count from the end. Raises IndexError for rows beyond
    the n readable ones.
    """
    if isinstance(frames, slice):
        return np.arange(n)[frames]
    indices = np.atleast_1d(np.asarray(frames))
    if indices.size == 0:
        return np.empty(0, np.int64)
    if indices.ndim != 1 or indices.dtype.kind not in "ui":
        raise IndexError(f"Frames are chosen by a slice or by integers, but {indices.dtype} {indices.shape} was given.")
    indices = indices.astype(np.int64)
    if indices.min() < -n or indices.max() >= n:
        last = n - 1
        raise IndexError(f"Frames {indices.min()}..{indices.max()} were requested, but only 0..{last} can be read.")
    return np.where(indices < 0, indices + n, indices)


def read_known(source: ScanSource, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
    """Like `source.read`, but the pixels of an unreadable frame become NaN (0 for integers), see `unreadable`.

    Real numbers beyond LARGEST also become NaN: no detector counts so many, and float32 may not represent them.
    """
    try:
        return measured(source.read(frames) if rows == WHOLE else source.read(frames, rows))
    except UnreadableError:
        indices = frame_indices(frames, len(source.table))
    out = np.zeros((indices.size, len(range(source.shape[0])[rows]), source.shape[1]), source.dtype)
    for image, row in zip(out, indices.tolist(), strict=True):
        try:
            image[...] = measured(source.read([row], rows))[0]
        except UnreadableError as error:
            source.unreadable = {**source.unreadable, row: str(error)}
            if source.dtype.kind == "f":
                image[...] = np.nan
    return out


def measured(pixels: NDArray[Any]) -> NDArray[Any]:
    """Pixels [frame, row, col] with NaN for real numbers beyond LARGEST."""
    if pixels.dtype.kind != "f":
        return pixels
    most = min(LARGEST, float(np.finfo(pixels.dtype).max))  # float16 cannot represent LARGEST
    for number, image in enumerate(pixels):
        if (beyond := np.abs(image) > most).any():
            if not pixels.flags.writeable:
                pixels = pixels.copy()
            pixels[number][beyond] = np.nan
    return pixels


class TakesTooLongError(DataError):
    """A check ended early because it would take too long. Its findings so far are valid."""


@dataclass(frozen=True)
class Opening:
    """Options for opening a scan.

    Attributes:
        follow: the file may still be growing.
        own_angles: True: the angles in the file are used. False: the caller supplies the angles, so the file need not
            have any.
        one_series: True if the caller states the kind of each frame, so that file names are not used for it.
        counts: True if the caller states that pixels are counts, but gives no darks and flats. The darks and flats may
            then lie next to the projections.
    """

    follow: bool = False
    own_angles: bool = True
    one_series: bool = False
    counts: bool = False


@dataclass(frozen=True)
class NamedArrays:
    """The paths of the arrays in a file that the caller names as a scan; None for arrays that are not named.

    Attributes:
        data: path of the projections; the order of the dimensions may follow, as in "/images:view,col,row".
        angles: path of the angles of the projections (not of darks and flats).
        own_angles: as in `Opening`.
    """

    data: str
    darks: str | None = None
    flats: str | None = None
    angles: str | None = None
    own_angles: bool = True

    @property
    def alone(self) -> bool:
        """True if neither darks nor flats are named."""
        return not (self.darks or self.flats)


@dataclass(frozen=True)
class ScanFormat:
    """A file format in the registry `storage.readers.formats.FORMATS`.

    Attributes:
        name: name of the format for messages.
        recognises: function that returns whether the file at a path has this format. Formats are asked in the order of
            the registry. The function may raise DataError for a file of this format that cannot be read, or
            NotReadyError while following it.
        open: function that opens a path that is recognised.
        at: function that returns the scan to which these arrays of a file belong; None if they are not a scan of this
            format.
        references: function that returns the scan in an open HDF5 file that has frames of one kind (dark or flat); None
            if the file has no such scan.
    """

    name: str
    recognises: Callable[[Path, Opening], bool]
    open: Callable[[Path, Opening], ScanSource]
    at: Callable[[Path, NamedArrays], ScanSource | None] = lambda path, arrays: None
    references: Callable[[Path, Any, FrameKind], ScanSource | None] = lambda path, file, kind: None
