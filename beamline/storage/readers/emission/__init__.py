"""Emission: counts of lines of response with what their mean holds, in the group /emission of an HDF5 file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets, hdf5
from beamline.storage.readers.base import WHOLE, EmissionCounts, Opening, ScanFormat, frame_indices
from beamline.storage.readers.stacks import FrameStack, StacksSource, dataset_at
from drivers.base.frame import FrameKind

FORMATS = {"emission": __name__}

F32 = NDArray[np.float32]
GROUP = "emission"
SETS = ("attenuation", "normalisation", "randoms", "scatter")
"""Beside the counts [view, row, col]: line integrals of the attenuation, efficiency, mean randoms, mean scatter."""


class EmissionSource(StacksSource):
    """An emission scan. Its pixels are line integrals of the activity; `emission` has the counts."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        views = dataset_at(file, f"{GROUP}/counts")
        super().__init__(
            path, file, [FrameStack(FrameKind.PROJECTION, views.name, views)], format="emission",
            facts={"title": f"Emission counts of {path.stem}"},
        )  # fmt: skip
        self._counts = views
        self.dtype, self.quantity = np.dtype(np.float32), "line_integrals"
        self._sets = {
            name: dataset for name in SETS if (dataset := datasets.dataset(file, f"{GROUP}/{name}")) is not None
        }
        for name, dataset in self._sets.items():
            datasets.require_real(dataset.dtype, f"{dataset.name} in {path}")
            if dataset.shape != views.shape:
                raise DataError(f"{path}: {name} has shape {dataset.shape}, the counts {views.shape} [view, row, col].")
        angles = datasets.radians(dataset_at(file, f"{GROUP}/angles"))
        if angles.shape != self.angles.shape:
            raise DataError(f"{path}: {angles.size} angles for {self.angles.size} views; expected one for each.")
        self.angles = angles
        self.pixel_size_mm = datasets.scalar(file, f"{GROUP}/pixel_size", {"mm": 1.0})
        self.axis_col, self.emission = (self.shape[1] - 1) / 2, self._counted

    @property
    def checksummed(self) -> bool:
        return all(item.fletcher32 for item in (self._counts, *self._sets.values()))

    def _counted(self, frames: NDArray[np.int64], rows: slice) -> EmissionCounts:
        counts = super().read(frames, rows)
        sets = dict.fromkeys(SETS, np.zeros_like(counts)) | {"normalisation": np.ones_like(counts)}
        for name, item in self._sets.items():
            sets[name] = np.empty_like(counts)
            datasets.read_frames(item, frames, rows, sets[name])
        survival = sets["normalisation"] * np.exp(-sets["attenuation"])
        return EmissionCounts(counts, survival, sets["randoms"] + sets["scatter"])

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        """Line integrals of the activity [frame, row, col], in counts; NaN where nothing survives."""
        counted = self._counted(frame_indices(frames, self.image_key.size), rows)
        lines = np.full_like(counted.counts, np.nan)
        return np.divide(counted.counts - counted.background, counted.survival, out=lines, where=counted.survival > 0)


def _recognises(path: Path, opening: Opening) -> bool:
    if not path.is_file() or not hdf5.is_hdf5(path, opening.follow):
        return False
    with hdf5.open_hdf5(path, opening.follow) as file:
        return datasets.dataset(file, f"{GROUP}/counts") is not None


def _open(path: Path, opening: Opening) -> EmissionSource:
    if opening.follow:
        raise DataError(f"{path} is an emission scan, which cannot be followed. Leave out --follow.")
    file = hdf5.open_hdf5(path)
    with hdf5.closed_on_error(file):
        return EmissionSource(path, file)


FORMAT = ScanFormat("/emission/counts (emission)", _recognises, _open)
