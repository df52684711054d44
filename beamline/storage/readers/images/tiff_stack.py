"""TIFF stacks: one file with a page for each frame, read page by page, so that the memory needed does not grow with
the scan.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.datasets import require_real
from beamline.storage.frame_table import FrameTable
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.readers.base import WHOLE, ScanFormat, ScanSource, frame_indices
from beamline.storage.readers.side_files import offered
from beamline.storage.readers.tiff import (
    SUFFIXES,
    UNREADABLE,
    Complaints,
    images_of,
    is_untyped,
    open_tiff,
    orientation,
    refuse_packed,
    refuse_volume,
    require_possible,
    stated,
    upright,
)
from drivers.base.frame import FrameKind


class TiffStackSource(ScanSource):
    """One TIFF with one page per frame, read page by page; see ScanSource. The caller supplies the angles."""

    format = "tiff_stack"
    side_files = True

    def __init__(self, path: Path) -> None:
        self.path = path
        complaints = Complaints()
        with complaints:
            try:
                self._tif = open_tiff(path)
            except UNREADABLE as error:
                raise DataError(f"{path} cannot be read as TIFF ({hdf5.reason(error)}).") from error
            try:
                n = self._look()
            except UNREADABLE as error:
                complaints.messages.append(str(error))
            except BaseException:
                self._tif.close()
                raise
        if complaints.messages:
            self._tif.close()
            complaint = complaints.messages[0]
            raise DataError(f"{path} cannot be read completely: the file is cut off or damaged ({complaint}).")
        self.table = FrameTable.of(np.full(n, FrameKind.PROJECTION))
        self.facts = {"pages": len(self._tif.pages), "bigtiff": "yes" if self._tif.is_bigtiff else "no"}
        self.not_used += offered(self)

    def _look(self) -> int:
        """Find shape, type and position of the frames. Returns the number of frames."""
        refuse_volume(self.path, self._tif)
        refuse_packed(self._tif)
        require_possible(self._tif)
        series, *others = parts = images_of(self._tif)
        # the letter S stands for the samples of a colour image
        if len(series.shape) not in (2, 3) or others or "S" in series.axes:
            shapes = ", ".join(f"{part.shape} along {part.axes}" for part in parts[:6])
            shapes += f", ... ({len(parts)} in all)" if len(parts) > 6 else ""
            raise DataError(f"{self.path} contains {shapes}; expected one stack of grey images [page, row, col].")
        self.not_used, self.untyped = stated(self.path, self._tif), is_untyped(self._tif)
        self._stored, self.dtype, self._orientation = series.shape[-2:], np.dtype(series.dtype), orientation(self._tif)
        # An uncompressed stack is one block of bytes, so the position of any frame and row can be computed.
        self._pages, self._offset = series.pages, series.dataoffset
        self.shape = self._stored[::-1] if self._orientation >= 5 else self._stored
        require_real(self.dtype, str(self.path))
        return 1 if len(series.shape) == 2 else int(series.shape[0])

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices = frame_indices(frames, len(self.table))
        wanted = range(self.shape[0])[rows]
        out = np.empty((indices.size, len(wanted), self.shape[1]), self.dtype)
        for i, page in enumerate(indices):
            try:
                if self._offset is not None and self._orientation == 1 and rows.step in (None, 1):
                    self._fill(out[i], int(page), rows.indices(self.shape[0])[0])
                else:
                    out[i] = upright(self._page(int(page)), self._orientation)[rows]
            except UNREADABLE as error:
                raise UnreadableError(f"Page {page} of {self.path} cannot be read ({hdf5.reason(error)}).") from error
        return out

    def _page(self, page: int) -> NDArray[Any]:
        """A page with the orientation in which it is stored."""
        if self._offset is None:
            image = self._tif.pages.get(self._pages[page].index, aspage=True, cache=False).asarray()
            if (image.shape, image.dtype) != (self._stored, self.dtype):
                raise ValueError(
                    f"the page has {image.dtype} pixels and the shape {image.shape}, but the first page has "
                    f"{self.dtype} pixels and the shape {self._stored}"
                )
            return np.asarray(image)
        whole = np.empty(self._stored, self.dtype)
        self._fill(whole, page, 0)
        return whole

    def _fill(self, out: NDArray[Any], page: int, first: int) -> None:
        """Fill `out` with rows of a page, beginning at row `first`."""
        self._tif.filehandle.seek(self._offset + (page * self._stored[0] + first) * self._stored[1] * out.itemsize)
        n = self._tif.filehandle.readinto(out)
        if n != out.nbytes:
            raise EOFError(f"only {n} of {out.nbytes} bytes exist")
        if not self.dtype.newbyteorder(self._tif.byteorder).isnative:
            out.byteswap(inplace=True)

    def close(self) -> None:
        self._tif.close()


FORMAT = ScanFormat(
    "a multi-page TIFF",
    lambda path, opening: path.is_file() and path.suffix.lower() in SUFFIXES,
    lambda path, opening: TiffStackSource(path),
)
