"""ScanSource: one view of a scan, whatever the file; open_scan recognises the format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Literal, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.frame import Frame

Quantity = Literal["counts", "line_integrals", "unknown"]
Attributes = Mapping[str, str | float | int]
Angles = Path | str | ArrayLike  # a text file in degrees, or an array in radians
Images = Path | str | NDArray[np.generic]  # a file or folder of images, or [frame, row, col]

WHOLE = slice(None)


class ScanSource(Protocol):
    """The frames of one scan and what is known about them. Nothing is guessed: unknown is None, NaN or "unknown".

    Attributes:
        path: what was opened.
        format: "nxtomo", "diamond_nexus", "data_exchange", "tiff_series", "tiff_stack", ...
        shape: (rows, cols) of a frame.
        dtype: of the pixels that read() returns.
        quantity: what a pixel is. "unknown" where the file does not say and the caller did not.
        image_key: int32 [frame], values of drivers.frame.FrameKind.
        angles: float64 [frame] radians, NaN where unknown.
        pixel_size_mm: at the sample.
        axis_col: rotation axis in 0-based pixel-centre columns.
        attributes: whatever else the file says, for the record.
        finished: no more frames will come.
    """

    @property
    def path(self) -> Path: ...
    @property
    def format(self) -> str: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    @property
    def dtype(self) -> np.dtype[np.generic]: ...
    @property
    def quantity(self) -> Quantity: ...
    @property
    def image_key(self) -> NDArray[np.int32]: ...
    @property
    def angles(self) -> NDArray[np.float64]: ...
    @property
    def pixel_size_mm(self) -> float | None: ...
    @property
    def energy_kev(self) -> float | None: ...
    @property
    def axis_col(self) -> float | None: ...
    @property
    def attributes(self) -> Attributes: ...
    @property
    def finished(self) -> bool: ...

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[np.generic]:
        """Pixels [frame, row, col] of the frames asked for, in that order. IndexError beyond the readable frames."""
        ...

    def frames(self) -> Iterator[Frame]:
        """The frames one after the other, as a camera gave them. DataError where pixels are not uint16 counts."""
        ...

    def refresh(self) -> int:
        """Look again at a growing file; how many frames can be read now."""
        ...

    def close(self) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def open_scan(
    path: Path | str,
    *,
    angles: Angles | None = None,
    angle_rows: str | None = None,
    darks: Images | None = None,
    flats: Images | None = None,
    quantity: Quantity | None = None,
    follow: bool = False,
) -> ScanSource:
    """Open a scan in any format that we read.

    Args:
        path: HDF5 file (NXtomo, Diamond NeXus, Data Exchange), multi-page TIFF, folder or .zip of TIFFs.
        angles: replace the file's: a text file in degrees (one a line), or an array in radians; one angle for each
            projection, or one for each frame.
        angle_rows: "a:b", which rows of `angles` to use.
        darks, flats: replace the file's.
        quantity: what the pixels are, where the file does not say.
        follow: the file may still be growing; refresh() then finds new frames.

    Raises:
        DataError: not there, not a format that we read, or not consistent; the message says what was found.
        NotReadyError: the file is just being created; try again.
    """
    raise NotImplementedError
