"""TIFF stacks: one file with a page for each frame, read page by page, so that memory does not grow with the scan."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.datasets import require_real
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.readers.base import WHOLE, ScanFormat, ScanSource, frame_indices
from beamline.storage.readers.side_files import offered
from beamline.storage.readers.tiff import (
    SUFFIXES,
    UNREADABLE,
    Complaints,
    appended,
    pages_one_by_one,
    refuse_packed,
    refuse_volume,
    require_possible,
)
from drivers.base.frame import FrameKind

MANY_PAGES = 500  # pages; tifffile takes the square of their number to tell how appended ones belong together


class TiffStackSource(ScanSource):
    """One TIFF with one page per frame, read page by page; see ScanSource. The caller supplies the angles."""

    format = "tiff_stack"

    def __init__(self, path: Path) -> None:
        self.path = path
        complaints = Complaints()
        with complaints:
            try:
                self._tif = tifffile.TiffFile(path)
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
            raise DataError(f"{path} cannot be read whole: it is cut or damaged ({complaints.messages[0]}).")
        self.image_key = np.full(n, FrameKind.PROJECTION, np.int32)
        self.angles = np.full(n, np.nan)
        self.exposures = np.full(n, np.nan)
        self.facts = {"pages": len(self._tif.pages), "bigtiff": "yes" if self._tif.is_bigtiff else "no"}
        self.not_used = offered(self)

    def _look(self) -> int:
        """Shape, type and place of the frames, and how many there are."""
        refuse_volume(self.path, self._tif)
        refuse_packed(self._tif)
        require_possible(self._tif)
        if len(self._tif.pages) > MANY_PAGES and appended(self._tif):
            first = self._tif.pages.first
            self.shape, self.dtype = (int(first.imagelength), int(first.imagewidth)), np.dtype(first.dtype)
            self._offset = None
            require_real(self.dtype, str(self.path))
            return len(self._tif.pages)
        series = self._tif.series[0]
        one_by_one = pages_one_by_one(self._tif)
        if len(series.shape) not in (2, 3) or (len(self._tif.series) != 1 and not one_by_one):
            shapes = ", ".join(str(part.shape) for part in self._tif.series[:6])
            shapes += f", ... ({len(self._tif.series)} in all)" if len(self._tif.series) > 6 else ""
            raise DataError(f"{self.path} holds {shapes}; expected one stack of grey images [page, row, col].")
        self.shape = (int(series.shape[-2]), int(series.shape[-1]))
        self.dtype = np.dtype(series.dtype)
        require_real(self.dtype, str(self.path))
        # Uncompressed stacks are one run of bytes: any frame, or some of its rows, is where arithmetic says.
        self._offset = None if one_by_one else series.dataoffset
        self._stored = self.dtype.newbyteorder(self._tif.byteorder)
        if one_by_one:
            return len(self._tif.pages)
        return 1 if len(series.shape) == 2 else int(series.shape[0])

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices = frame_indices(frames, self.image_key.size)
        wanted = range(self.shape[0])[rows]
        out = np.empty((indices.size, len(wanted), self.shape[1]), self.dtype)
        for i, page in enumerate(indices):
            try:
                self._fill(out[i], int(page), rows)
            except UNREADABLE as error:
                raise UnreadableError(f"Page {page} of {self.path} cannot be read ({hdf5.reason(error)}).") from error
        return out

    def _fill(self, out: NDArray[Any], page: int, rows: slice) -> None:
        if self._offset is None:
            image = self._tif.pages[page].asarray()
            if (image.shape, image.dtype) != (self.shape, self.dtype):
                raise ValueError(f"it is {image.dtype} {image.shape}, the first {self.dtype} {self.shape}")
            out[...] = image[rows]
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

    def close(self) -> None:
        self._tif.close()


FORMAT = ScanFormat(
    "a multi-page TIFF",
    lambda path, opening: path.is_file() and path.suffix.lower() in SUFFIXES,
    lambda path, opening: TiffStackSource(path),
)
