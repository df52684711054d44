"""Volumes on the page: slices, histograms and profiles of volume files, also of files larger than the memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from beamline.core.errors import DataError
from beamline.page.tiles import TileRegion, bin_mean
from beamline.storage import hdf5
from beamline.storage.volumes.files import opened_volume
from beamline.storage.writers.recon_file import ReconRecord

F32 = NDArray[np.float32]
HELD = 2**29
"""Bytes of a volume that is held as a whole. Of a larger one this is a copy with every n-th slice, binned by n."""
BINS = 256
_SAMPLE = 2_000_000  # values that show the histogram as well as all do


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


def _fbp_of(path: Path, record: ReconRecord) -> Any:
    if record.fbp is None:
        raise DataError(f"{path} keeps no FBP beside its volume.")
    return record.fbp


class ShownVolume:
    """A volume file of any kind that is read here. All calls come from one thread (HDF5).

    Of a volume above `held` bytes, slices across z are read from the file. One across y or x would read all of the
    file, so it comes from the coarse copy.

    Args:
        progress: takes slices read and slices to read of the coarse copy.
        fbp: the FBP that is kept beside a volume (`has_fbp`), instead of the volume.

    Raises:
        DataError: it cannot be read, or holds no volume.
    """

    def __init__(
        self,
        path: Path,
        progress: Callable[[int, int], None] = lambda n, of: None,
        held: int = HELD,
        fbp: bool = False,
    ) -> None:
        with ExitStack() as opened:
            record = opened.enter_context(opened_volume(path))
            self.path, self._grid, self.has_fbp = path, record.volume.grid, record.fbp is not None
            self._values: Any = record.volume.data
            self._name = path.name
            if fbp:
                self._values, self._name = _fbp_of(path, record), f"{path.name}, FBP"
            self.shape: tuple[int, int, int] = self._values.shape
            self.coarse_bin = math.ceil((4 * math.prod(self.shape) / held) ** (1 / 3))
            self._coarse = self._copied(progress)
            self._sample = self._sampled()
            self._length_unit, self._parameters = record.length_unit, record.parameters
            self._changed = path.stat().st_mtime
            self._file = opened.pop_all()

    def close(self) -> None:
        self._file.close()

    def facts(self) -> dict[str, Any]:
        """Name, shape, length of a voxel along z, y, x and unit, unit of values, method, views, window."""
        low, high = np.percentile(self._sample, (0.5, 99.8)) if self._sample.size else (0.0, 1.0)
        unit = self._length_unit
        return {
            "name": self._name,
            "changed": self._changed,
            "shape": self.shape,
            "voxel": [float(step) for step in self._grid.spacing],
            "length_unit": unit,
            "unit": "" if unit == "px" else f"1/{unit}",
            "method": str(self._parameters.get("method", "")),
            "views": None if (views := self._parameters.get("n_views")) is None else int(views),
            "coarse_bin": self.coarse_bin,
            "window": [float(low), float(max(high, low + 1e-9))],
        }

    def cut(self, axis: int, index: int, region: TileRegion) -> tuple[F32, TileRegion, int]:
        """Part of a slice across an axis (0 z, 1 y, 2 x), binned to a tile; the part that it shows, and its binning.

        Raises:
            DataError: there is no such slice.
        """
        values, bin_ = self._slice(axis, index)
        rows, cols = (n for i, n in enumerate(self.shape) if i != axis)
        shown = region.inside((rows, cols))
        if bin_ == 1:
            values = values[shown.first_row : shown.last_row, shown.first_col : shown.last_col]
        else:
            shown = TileRegion(0, rows, 0, cols)
        factor = TileRegion(0, values.shape[0], 0, values.shape[1]).binning()
        return bin_mean(values, (factor, factor)), shown, factor * bin_

    def histogram(self) -> dict[str, list[float]]:
        """Centres of 256 bins over the values, and voxels in each (of a sample, where there are many)."""
        counts, edges = np.histogram(self._sample, BINS)
        return {"values": ((edges[1:] + edges[:-1]) / 2).tolist(), "voxels": counts.tolist()}

    def profile(self, axis: int, index: int, line: Sequence[float]) -> dict[str, list[float]]:
        """Distances and values along a line in a slice, linear between voxels, in steps of at most a voxel.

        Args:
            line: first row, first column, last row, last column; the first voxel's middle is at 0.5, 0.5.
        """
        values, bin_ = self._slice(axis, index)
        r0, c0, r1, c1 = line
        down, across = (step for i, step in enumerate(self._grid.spacing) if i != axis)
        n = int(np.clip(math.ceil(max(abs(r1 - r0), abs(c1 - c0))), 1, 10_000)) + 1
        rows, cols = np.linspace(r0, r1, n), np.linspace(c0, c1, n)
        found = map_coordinates(values, (rows / bin_ - 0.5, cols / bin_ - 0.5), order=1, mode="nearest")
        length = math.hypot((r1 - r0) * down, (c1 - c0) * across)
        return {"distance": np.linspace(0, length, n).tolist(), "values": np.nan_to_num(found).tolist()}

    def _slice(self, axis: int, index: int) -> tuple[F32, int]:
        """A slice, and its binning."""
        if not (0 <= axis < 3 and 0 <= index < self.shape[axis]):
            raise DataError(f"Slice {index} across axis {axis} is not in a volume of {self.shape}.")
        from_file = axis == 0 and self.coarse_bin > 1
        source, bin_ = (self._values, 1) if from_file else (self._coarse, self.coarse_bin)
        place: list[slice | int] = [slice(None)] * 3
        place[axis] = min(index // bin_, source.shape[axis] - 1)
        with hdf5.readable(self.path):
            return np.asarray(source[tuple(place)], np.float32), bin_

    def _copied(self, progress: Callable[[int, int], None]) -> F32:
        chosen = range(0, self.shape[0], self.coarse_bin)
        copy = []
        for n, z in enumerate(chosen, 1):
            with hdf5.readable(self.path):
                values = np.asarray(self._values[z], np.float32)
            copy.append(bin_mean(values, (self.coarse_bin, self.coarse_bin)))
            progress(n, len(chosen))
        return np.stack(copy)

    def _sampled(self) -> F32:
        flat = self._coarse.reshape(-1)
        part = flat[:: max(1, flat.size // _SAMPLE)]
        return part[np.isfinite(part)]
