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
"""Of a file or a caller; transmission is read as counts of a beam of 1 without darks."""
Attributes = Mapping[str, str | float | int]

WHOLE = slice(None)


class NotUsed(NamedTuple):
    """A field of a file that is ignored: its path, its value, the reason or what to do, whether it may matter, and
    whether a volume without it is wrong by more than a hundredth.
    """

    where: str
    value: str
    why: str
    doubt: bool
    wrong: bool = False


class ScanSource(ABC):
    """The frames of one scan and their metadata. Nothing is guessed: unknown values are None, NaN or "unknown".

    A format's subclass has `read` and `close`. It sets `path`, `shape`, `dtype`, `table` and `facts` where it opens the
    file, and those of the other fields that its format states.

    Attributes:
        path: of the opened scan.
        format: "nxtomo", "diamond_nexus", "data_exchange", "tiff_series", "tiff_stack", ...
        shape: (rows, cols) of a frame.
        dtype: of the pixels that read() returns.
        quantity: of the pixels. "unknown" if neither the file nor the caller states it.
        table: the table of the frames; `refresh` replaces it.
        facts: `attributes` of a format in which they do not change.
        pixel_size_mm: pixel size at the sample; for a cone beam, on the detector.
        axis_col: rotation axis in 0-based pixel-centre columns.
        cols: (first, end) columns of the detector that a frame has; None: all.
        cone: mm from the source to the rotation axis and to the detector; None for a parallel beam.
        central_ray: (row, column) at which the central ray meets the detector according to the file; it is shown but
            not used; NaN: not stated.
        unreadable: rows that `read_known` could not read from the file, each with the reason.
        row_pitch_mm: height of a pixel, as `pixel_size_mm`, if it differs from the width; None: pixels are square.
        in_order: the frames are in the order of acquisition. False: darks and flats stand before the projections,
            whenever they were taken.
        untyped: True if the file does not state whether pixels are integers or real numbers.
        pixel_mask: bool [row, col], pixels that must not be used according to the file; None if the file has no mask.
        frames_per_view: number of camera frames that are averaged to one projection.
        not_used: fields on geometry, units, order and validity that the file states but that are not used.
        unpack_bytes: bytes of memory that are taken while a frame's part of a compressed file is unpacked.
        plan: the requested scan, as this program's files record it; empty if unknown.
        row_period: s from the exposure of a row to that of the next; 0: all together, None: unknown.
        decisions: what was chosen after passes, oldest first: values of the event `next_chosen`.
        stated_ending: `ending` of a format in which it does not change.
        angles_unit: the unit of a list of angles in the file that states none; "": such a list is an error.
        side_files: True if a settings file of the scanner's maker may lie next to it.
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
        """Bytes that are decompressed to read a frame, or any row of it."""
        return self.shape[0] * self.shape[1] * self.dtype.itemsize

    @property
    def finished(self) -> bool:
        """True if no more frames will come. Check before refresh(): refresh() then finds all frames."""
        return True

    @property
    def ending(self) -> ScanEnding:
        """How the scan ended, as far as the file states; a copy states the same."""
        return self.stated_ending

    @property
    def attributes(self) -> Attributes:
        """Further metadata of the file, for the record."""
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
        """The frames from `first` on, each with all that is known of it; pixels are of the file's type."""
        for row in range(first, len(table := self.table)):
            counts = read_known(self, [row])[0]
            yield table.frame(row, counts, FrameKind.INVALID if row in self.unreadable else None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def frame_indices(frames: slice | ArrayLike, n: int) -> NDArray[np.int64]:
    """Row numbers of a slice or an array (negative ones count from the end); IndexError beyond the n readable."""
    if isinstance(frames, slice):
        return np.arange(n)[frames]
    indices = np.atleast_1d(np.asarray(frames))
    if indices.size == 0:
        return np.empty(0, np.int64)
    if indices.ndim != 1 or indices.dtype.kind not in "ui":
        raise IndexError(f"Frames are chosen by a slice or by integers, but {indices.dtype} {indices.shape} was given.")
    indices = indices.astype(np.int64)
    if indices.min() < -n or indices.max() >= n:
        raise IndexError(f"Frames {indices.min()}..{indices.max()} were requested, but only 0..{n - 1} can be read.")
    return np.where(indices < 0, indices + n, indices)


def read_known(source: ScanSource, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
    """`source.read`, with NaN (0 for integers) for unreadable frames, see `unreadable`.

    Real numbers beyond LARGEST, which no detector counts and which float32 may not represent, also become NaN.
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
    most = min(LARGEST, float(np.finfo(pixels.dtype).max))  # float16 does not hold LARGEST
    for number, image in enumerate(pixels):
        if (beyond := np.abs(image) > most).any():
            if not pixels.flags.writeable:
                pixels = pixels.copy()
            pixels[number][beyond] = np.nan
    return pixels


class TakesTooLongError(DataError):
    """The check was ended because it would take too long; the findings so far are valid."""


@dataclass(frozen=True)
class Opening:
    """Options for opening a scan.

    Attributes:
        follow: the file may still be growing.
        own_angles: the file's angles are used; False: the caller supplies the angles, so the file need not have any.
        one_series: the caller states the kind of each frame; names of files are not used for that.
        counts: the caller states that pixels are counts, and gives no darks and flats: they may lie next to the
            projections.
    """

    follow: bool = False
    own_angles: bool = True
    one_series: bool = False
    counts: bool = False


@dataclass(frozen=True)
class NamedArrays:
    """The paths of arrays in a file that the caller names as a scan; None for those that are not named.

    Attributes:
        data: of the projections; the order of the dimensions may follow, as in "/images:view,col,row".
        angles: of the angles of the projections alone.
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
        name: for messages.
        recognises: whether a path holds this format. It is asked in the registry's order, and it may raise DataError
            (NotReadyError while following) for a file of its kind that cannot be read.
        open: the reader of a path that is recognised.
        at: the scan to which these arrays of a file belong; None if they are no scan of this format.
        references: the scan in an open HDF5 file with frames of a kind (dark or flat); None if it has none.
    """

    name: str
    recognises: Callable[[Path, Opening], bool]
    open: Callable[[Path, Opening], ScanSource]
    at: Callable[[Path, NamedArrays], ScanSource | None] = lambda path, arrays: None
    references: Callable[[Path, Any, FrameKind], ScanSource | None] = lambda path, file, kind: None
