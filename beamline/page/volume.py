"""The volume on the page: the newest of a run, finished or so far, and its slices."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.page.tiles import TileRegion, bin_mean
from beamline.storage import hdf5

_DATA = "/entry/data/data"
_HELD = 2**29
"""Bytes of a volume that is read into memory as a whole: slices across its chunks take their time otherwise."""


@dataclass(frozen=True)
class VolumeFile:
    """A volume file at a certain time: the next snapshot replaces it."""

    path: Path
    changed_ns: int


def newest(candidates: tuple[Path, ...]) -> VolumeFile | None:
    """The first existing one of these files."""
    for path in candidates:
        with suppress(OSError):
            return VolumeFile(path, path.stat().st_mtime_ns)
    return None


class ShownVolume:
    """An open volume file; z, y or x slices of it. All calls come from one thread (HDF5).

    Raises:
        DataError: no volume of this program, or one that cannot be read.
    """

    def __init__(self, file: VolumeFile) -> None:
        self.file = file
        self._file = hdf5.open_hdf5(file.path)
        with hdf5.readable(file.path):
            data = hdf5.dataset(self._file, _DATA)
            if data is None or data.ndim != 3 or data.dtype.kind != "f":
                raise DataError(f"{file.path} holds no volume at {_DATA}.")
            self.shape: tuple[int, int, int] = data.shape
            self._values: h5py.Dataset | NDArray[np.float32] = data[()] if data.nbytes <= _HELD else data
            self.facts = self._facts()

    def close(self) -> None:
        self._file.close()

    def cut(self, axis: int, index: int) -> tuple[NDArray[np.float32], int]:
        """A slice across an axis (0 z, 1 y, 2 x), binned to at most 1024 pixels a side, and its binning."""
        if not (0 <= axis < 3 and 0 <= index < self.shape[axis]):
            raise DataError(f"Slice {index} across axis {axis} is not in a volume of {self.shape}.")
        place: list[slice | int] = [slice(None)] * 3
        place[axis] = index
        with hdf5.readable(self.file.path):
            values = np.asarray(self._values[tuple(place)], np.float32)
        factor = TileRegion(0, values.shape[0], 0, values.shape[1]).binning()
        return bin_mean(values, (factor, factor)), factor

    def _facts(self) -> dict[str, Any]:
        """Shape, mm of a voxel (null: unknown), unit of the values, views, method, and a grey window."""
        parameters = "/entry/reconstruction/parameters"
        z = hdf5.dataset(self._file, "/entry/data/z")
        unit = "" if z is None else hdf5.attribute(z, "units")
        x = hdf5.dataset(self._file, "/entry/data/x")
        step = float(x[1] - x[0]) if x is not None and x.size > 1 else None
        views = hdf5.dataset(self._file, f"{parameters}/n_views")
        method = hdf5.dataset(self._file, f"{parameters}/method")
        middle = np.asarray(self._values[self.shape[0] // 2], np.float32)
        low, high = np.percentile(middle[np.isfinite(middle)], (0.5, 99.8)) if np.isfinite(middle).any() else (0, 1)
        return {
            "name": self.file.path.name,
            "changed": self.file.changed_ns / 1e9,
            "shape": self.shape,
            "voxel": step,
            "length_unit": unit,
            "unit": hdf5.attribute(self._file[_DATA], "units"),
            "views": None if views is None else int(views[()]),
            "method": "" if method is None else hdf5.text(method[()]),
            "window": [float(low), float(max(high, low + 1e-9))],
        }
