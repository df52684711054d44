"""ScanFile: a scan file of this program, opened for reading while it may still grow. All commands that read frames of
such a file use it.

Data are read at the paths in `writers.layout`, without a search. Files of other programs are opened by the list of
formats (`readers.formats`).
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py

from beamline.core.errors import DataError
from beamline.storage import datasets, hdf5
from beamline.storage.writers import layout


class ScanFile:
    """A scan file of this program. All calls must come from one thread (HDF5).

    Errors of HDF5 are not converted. A caller that shows errors uses `hdf5.readable`.

    Attributes:
        path: path of the file.
        file: the open HDF5 file.
        data: pixels [frame, row, col]. It stays open, because HDF5 2.0 reads wrong values if a growing dataset that is
            open twice is refreshed. All other datasets are opened when they are read.
        shape: (rows, cols) of a frame.
        dtype: type of the pixels.
        n: frames that were complete when `committed` was last called.
    """

    def __init__(self, path: Path, file: h5py.File) -> None:
        """Read an open file, which this object closes later."""
        self.path, self.file, self.n = path, file, 0
        data = datasets.dataset(file, layout.DATA)
        if data is None or data.ndim != 3:
            raise DataError(f"{path} has no frames [frame, row, col] in {layout.DATA}.")
        self.data: h5py.Dataset = data
        self.shape, self.dtype = (int(self.data.shape[1]), int(self.data.shape[2])), self.data.dtype

    def committed(self) -> int:
        """The number of frames that the writer has marked as complete. If the number has grown, the dataset of pixels
        is refreshed.

        Raises:
            DataError: the file stores fewer frames.
            ValueError: the stored number is negative.
        """
        n = int(self.values(layout.COMMITTED))
        if n < 0:
            raise ValueError(f"{n} frames are marked as complete")
        if n > self.n:
            hdf5.look_again(self.data)
        if len(self.data) < n:
            raise DataError(f"{self.path} has {len(self.data)} frames; expected {n}.")
        self.n = n
        return n

    @property
    def finished(self) -> bool:
        """True if no more frames will come."""
        return bool(self.values(layout.FINISHED))

    def values(self, path: str, part: Any = ()) -> Any:
        """The present values of a dataset: all values, or a part such as a row or a slice of rows. Raises KeyError if
        the dataset does not exist.
        """
        item = self.file[path]
        hdf5.look_again(item)
        return item[part]

    def close(self) -> None:
        with suppress(RuntimeError, OSError, ValueError):
            self.file.close()


def opened(path: Path, follow: bool = False) -> ScanFile | None:
    """Open a scan file of this program; None if another program wrote the file.

    Any file may state that this program wrote it, so it is opened with the checks of `hdf5.open_hdf5`.

    Args:
        follow: the file may still be growing.

    Raises:
        DataError: the file cannot be read.
        NotReadyError: the file is missing or just being created (only with `follow`).
    """
    if path.is_dir() or not (follow or path.is_file()) or not hdf5.is_hdf5(path, follow):
        return None
    file = hdf5.open_hdf5(path, follow)
    with hdf5.closed_on_error(file), hdf5.readable(path):
        if layout.COMMITTED in file:
            return ScanFile(path, file)
    file.close()
    return None
