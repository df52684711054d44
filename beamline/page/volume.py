"""Volumes on the page: slices, histograms and profiles of volume files of any size. If a file has several resolutions,
they are used; otherwise a coarse copy in memory is used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from beamline.core.errors import DataError
from beamline.page.tiles import TileRegion, bin_mean
from beamline.storage import hdf5
from beamline.storage.foreign_zarr import ZarrScale
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volumes.files import opened_volume, times_of
from beamline.storage.writers.recon_file import CHANGE, opened_reconstruction
from recon.base.arrays import some_values
from recon.base.greys import apart, grey_windows

F32 = NDArray[np.float32]
HELD = 2**29
"""Largest number of bytes of the copy of a volume. The copy has all voxels, or every n-th slice, binned by n."""
FIRST_READ_BYTES = 2**26  # bytes of a volume that are read before the first picture
SLICE_READ_BYTES = 2**28  # bytes of a file with scales that are read for one slice, at most
_SAMPLE = 2_000_000  # number of values whose histogram is as good as that of all values
_Piece = tuple[NDArray[Any], TileRegion, int]


def slices_of(path: Path, values: Any, held: int) -> ScaledSlices | CopiedSlices:
    """Open the slices of the voxels in a file."""
    if isinstance(values, ZarrScale) and 4 * math.prod((values, *values.coarser)[-1].shape) <= held:
        return ScaledSlices(values)
    return CopiedSlices(path, values, held)


class ScaledSlices:
    """Slices of a file with several resolutions. The resolution is that of the tile; if this would read more than
    `SLICE_READ_BYTES`, a coarser one is used.

    The methods are those of CopiedSlices. All calls must come from one thread (HDF5).
    """

    bin, ready = 1, 1.0

    def __init__(self, finest: ZarrScale) -> None:
        self._scales = [(scale, _steps(finest.shape, scale.shape)) for scale in (finest, *finest.coarser)]

    def read_more(self) -> bool:
        return False

    def part(self, axis: int, index: int, region: TileRegion) -> _Piece:
        sides = [i for i in range(3) if i != axis]
        n_rows, n_cols = (self._scales[0][0].shape[i] for i in sides)
        shown = region.inside((n_rows, n_cols))
        square = [(scale, steps) for scale, steps in self._scales if steps[sides[0]] == steps[sides[1]]]
        fine = sum(steps[sides[0]] <= shown.binning() for _, steps in square)
        for scale, steps in square[fine - 1 :]:
            bin_, slice_ = steps[sides[0]], min(index // steps[axis], scale.shape[axis] - 1)
            first, end = [slice_] * 3, [slice_ + 1] * 3
            for i, edges in zip(sides, shown.slices, strict=True):
                first[i] = min(edges.start // bin_, scale.shape[i] - 1)
                end[i] = min(-(-edges.stop // bin_), scale.shape[i])
            if _bytes_read(scale, first, end) <= SLICE_READ_BYTES:
                break
        rows, cols = ((first[i] * bin_, end[i] * bin_) for i in sides)
        return scale.box(_place(first), _place(end)).squeeze(axis), TileRegion(*rows, *cols), bin_

    def sample(self) -> NDArray[Any]:
        coarsest, _ = self._scales[-1]
        return some_values(coarsest.box((0, 0, 0), coarsest.shape), _SAMPLE)


class CopiedSlices:
    """Slices of a file in which slices across y and x are spread over the whole file. Slices across z come from the
    file, and slices across y and x from a copy in memory.

    The copy is read slice by slice: first a few slices from the whole volume, then the slices between them.

    Attributes:
        bin: binning of slices across y and x, at any zoom.
    """

    def __init__(self, path: Path, values: Any, held: int) -> None:
        self._path, self._values = path, values
        self.bin = math.ceil((4 * math.prod(values.shape) / held) ** (1 / 3))
        shape = [-(-n // self.bin) for n in values.shape]
        self._copy = np.empty(shape, np.float32)
        self._filled = np.zeros(shape[0], bool)
        spread = sorted(range(shape[0]), key=lambda z: -(z & -z or 2 * shape[0]))  # 0, the halves, the quarters ...
        self._waiting = iter(spread)
        for _ in range(max(1, FIRST_READ_BYTES // (4 * math.prod(values.shape[1:])))):
            self.read_more()

    @property
    def ready(self) -> float:
        """The share of the copy that has been read."""
        return float(self._filled.mean())

    def read_more(self) -> bool:
        """Read one more slice of the copy; False if all slices are read."""
        z = next(self._waiting, None)
        if z is None:
            return False
        self._copy[z] = bin_mean(self._read(z * self.bin), (self.bin, self.bin))
        self._filled[z] = True
        return True

    def part(self, axis: int, index: int, region: TileRegion) -> _Piece:
        """A part of a slice that contains the given region, the region of this part, and its binning."""
        rows, cols = (n for i, n in enumerate(self._values.shape) if i != axis)
        shown, whole = region.inside((rows, cols)), TileRegion(0, rows, 0, cols)
        if axis == 0:
            return self._read(index)[shown.slices], shown, 1
        known = np.flatnonzero(self._filled)
        nearest = known[np.searchsorted((known[1:] + known[:-1]) / 2, np.arange(self._filled.size))]
        values = self._copy.take(index // self.bin, axis)[nearest]
        return (values[shown.slices], shown, 1) if self.bin == 1 else (values, whole, self.bin)

    def sample(self) -> NDArray[Any]:
        """A representative sample of the values as a one-dimensional array; all values if there are few."""
        step = max(1, math.isqrt(int(self._filled.sum()) * self._copy[0].size // _SAMPLE))
        return self._copy[:, ::step, ::step][self._filled].reshape(-1)

    def _read(self, z: int) -> F32:
        with hdf5.readable(self._path):
            return np.asarray(self._values[z : z + 1][0], np.float32)


def _place(index: list[int]) -> tuple[int, int, int]:
    z, y, x = index
    return z, y, x


def _steps(finest: tuple[int, ...], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Number of voxels of the finest resolution in one voxel, along each axis: powers of two, as `OmeZarr` writes
    them."""
    return tuple(2 ** round(math.log2(n / m)) for n, m in zip(finest, shape, strict=True))


def _bytes_read(scale: ZarrScale, first: list[int], end: list[int]) -> int:
    """Number of bytes that are read for a box, because whole chunks are read."""
    chunks = [-(-b // n) - a // n for a, b, n in zip(first, end, scale.chunk, strict=True)]
    return math.prod(chunks) * scale.dtype.itemsize * math.prod(scale.chunk)


BINS = 256


@dataclass(frozen=True)
class VolumeFile:
    """A volume file at a certain time. The next snapshot replaces the file."""

    path: Path
    changed_ns: int


def newest(candidates: tuple[Path, ...]) -> VolumeFile | None:
    """The most recently written of these files; None if none exists."""
    files = []
    for path in candidates:
        with suppress(OSError):
            files.append(VolumeFile(path, path.stat().st_mtime_ns))
    return max(files, key=lambda file: file.changed_ns, default=None)


@dataclass(frozen=True, eq=False)
class VolumeTile:
    """Values, the region of the slice that they show, their binning, and the fraction of the voxels of the slice that
    has been read."""

    values: F32
    region: TileRegion
    bin: int
    ready: float


class ShownVolume:
    """A volume file of any readable kind. All calls come from one thread (HDF5).

    Args:
        held: largest number of bytes of the copy of a file with a single resolution, see `slices_of`. dataset: name of
            an array in a file with several arrays; None: the volume. record: object to show instead of a volume of the
            file; its voxels are sliced along z.

    Raises: DataError: the file cannot be read, or does not contain a volume.
    """

    def __init__(
        self,
        path: Path,
        held: int = HELD,
        dataset: str | None = None,
        record: ReconRecord | None = None,
    ) -> None:
        with ExitStack() as opened:
            seconds = () if dataset is not None or record is not None else times_of(path)
            if record is None:
                record = opened.enter_context(
                    opened_reconstruction(path, 0) if seconds else opened_volume(path, dataset)
                )
            self.path, self._grid = path, record.volume.grid
            values: Any = record.volume.data
            self._name = path.name if dataset is None else f"{path.name}::{dataset}"
            self.shape: tuple[int, int, int] = values.shape
            each = [values] if record.series is None else record.series.each()
            self._seconds = seconds
            self._slices = [slices_of(path, one, held // len(each)) for one in each]
            self._length_unit, self._unit, self._parameters = record.length_unit, record.unit, record.parameters
            window: Any = record.parameters.get("window") if values.dtype.kind == "u" else None
            self._grey = None if window is None else (window[0], (window[1] - window[0]) / np.iinfo(values.dtype).max)
            self._changed = path.stat().st_mtime
            self._closed, self._file = False, opened.pop_all()

    def close(self) -> None:
        self._closed = True
        self._file.close()

    def read_more(self) -> bool:
        """Read one more slice of the copy for slices across y and x; False if all slices are read."""
        return not self._closed and any(one.read_more() for one in self._slices)

    def facts(self) -> dict[str, Any]:
        """Facts about the volume: name; shape; voxel size along z, y, x with unit; unit of the values; method, and why
        it is shown; number of projections; angles of the projections, if slices are projections (empty: it is a
        volume); angles that no projection has; grey windows over all times."""
        windows = grey_windows(np.concatenate([self._sample(time) for time in range(len(self._slices))]))
        unit = self._length_unit
        return {
            "name": self._name,
            "changed": self._changed,
            "shape": self.shape,
            "voxel": [float(step) for step in self._grid.spacing],
            "length_unit": unit,
            "unit": "" if unit == "px" else self._unit,
            "method": str(self._parameters.get("method", "")),
            "because": str(self._parameters.get("chosen_because", "")),
            "angles": [None if np.isnan(each) else each for each in self._numbers("angles_deg")],
            "unseen_deg": self._numbers("unseen_deg"),
            "views": None if (views := self._parameters.get("n_views")) is None else int(views),
            "seconds": self._seconds,
            "coarse_bin": self._slices[0].bin,
            "window": windows["matter"],
            "windows": windows,
        }

    def cut(self, axis: int, index: int, region: TileRegion, time: int = 0) -> VolumeTile:
        """Part of a slice across an axis (0: z, 1: y, 2: x), binned to a tile. For a time series, at one of its times.

        Raises:
            DataError: there is no such slice.
        """
        values, shown, bin_ = self._part(axis, index, region, time)
        factor = TileRegion(0, values.shape[0], 0, values.shape[1]).binning()
        tile = self._meant(bin_mean(values, (factor, factor)))
        return VolumeTile(tile, shown, factor * bin_, 1.0 if axis == 0 else self._volume_at(time).ready)

    def histogram(self, time: int = 0) -> dict[str, list[float]]:
        """Centres of 256 bins over the values, and the number of voxels in each bin (of a sample, if there are many
        voxels)."""
        sample = self._sample(time).astype(np.float64)  # in float32 a wide range would overflow
        ends = (float(sample.min()), float(sample.max())) if sample.size else (0.0, 1.0)
        counts, edges = np.histogram(sample, BINS, apart(*ends))
        return {"values": ((edges[1:] + edges[:-1]) / 2).tolist(), "voxels": counts.tolist()}

    def profile(self, axis: int, index: int, line: Sequence[float], time: int = 0) -> dict[str, list[float]]:
        """Distances and values along a line in a slice, linear between voxels, in steps of at most a voxel.

        Args:
            line: first row, first column, last row, last column; the first voxel's middle is at 0.5, 0.5.
        """
        r0, c0, r1, c1 = line
        edges = (min(r0, r1) - 9, max(r0, r1) + 9, min(c0, c1) - 9, max(c0, c1) + 9)
        values, shown, bin_ = self._part(axis, index, TileRegion(*(max(0, int(edge)) for edge in edges)), time)
        down, across = (step for i, step in enumerate(self._grid.spacing) if i != axis)
        n = int(np.clip(math.ceil(max(abs(r1 - r0), abs(c1 - c0))), 1, 10_000)) + 1
        rows, cols = np.linspace(r0, r1, n), np.linspace(c0, c1, n)
        positions = ((rows - shown.first_row) / bin_ - 0.5, (cols - shown.first_col) / bin_ - 0.5)
        sampled = map_coordinates(self._meant(values), positions, order=1, mode="nearest")
        length = math.hypot((r1 - r0) * down, (c1 - c0) * across)
        return {"distance": np.linspace(0, length, n).tolist(), "values": np.nan_to_num(sampled).tolist()}

    def _numbers(self, name: str) -> list[float]:
        return list(np.asarray(self._parameters.get(name, ()), np.float64).tolist())

    def _volume_at(self, time: int) -> ScaledSlices | CopiedSlices:
        """The volume at one of the times. A volume that is not a time series is the same at all times."""
        return self._slices[min(time, len(self._slices) - 1)]

    def _part(self, axis: int, index: int, region: TileRegion, time: int) -> tuple[NDArray[Any], TileRegion, int]:
        if not (0 <= axis < 3 and 0 <= index < self.shape[axis]):
            raise DataError(f"Slice {index} across axis {axis} is outside the volume of {self.shape}.")
        return self._volume_at(time).part(axis, index, region)

    def _sample(self, time: int) -> F32:
        values = self._meant(self._volume_at(time).sample())
        return values[np.isfinite(values)]

    def _meant(self, values: NDArray[Any]) -> F32:
        """The values that the grey values of a file stand for."""
        if self._grey is None:
            return np.asarray(values, np.float32)
        low, step = self._grey
        return np.float32(low) + np.float32(step) * np.asarray(values, np.float32)


def moved_reference(path: Path, opened: ExitStack) -> ShownVolume | None:
    """The moved reference of a state: its volume minus its change; None: the file has no change. `opened` keeps
    the file open."""
    if not hdf5.is_hdf5(path):
        return None
    with hdf5.open_hdf5(path) as file:
        if not isinstance(file.get(_CHANGE), h5py.Dataset):
            return None
    record, file = opened.enter_context(opened_volume(path)), opened.enter_context(hdf5.open_hdf5(path))
    data: Any = _Before(record.volume.data, file[_CHANGE])
    shown = replace(record, volume=replace(record.volume, data=data))
    return ShownVolume(path, dataset="moved reference", record=shown)


_CHANGE = f"entry/data/{CHANGE}"


class _Before:
    """The voxels of a volume minus their change, slice by slice."""

    def __init__(self, volume: Any, change: h5py.Dataset) -> None:
        self._volume, self._change = volume, change
        self.shape, self.dtype, self.ndim = volume.shape, volume.dtype, 3

    def __getitem__(self, key: slice) -> F32:
        return np.asarray(self._volume[key] - self._change[key], np.float32)
