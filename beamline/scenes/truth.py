"""Truth: attenuation and labels of a simulated sample, on the grid of a reconstruction of its scan."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.files import whole_file
from beamline.core.voxel_kind import VoxelKind
from beamline.storage import hdf5
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.samples.sample import Sample

LARGEST = 256  # Voxels across by default: 256³ take 84 MB with the labels
BYTES_A_VOXEL = 16  # Peak memory as measured: 12 for solids (float64 and float32), 16 for volumes


@dataclass(frozen=True, eq=False)
class Truth:
    """True voxels and labels of a sample.

    Attributes:
        values: float32 [z, y, x]; lengths are in mm.
        labels: uint8 [z, y, x]; 0 is air, k the k-th of `names`.
    """

    grid: Grid
    values: NDArray[np.float32]
    labels: NDArray[np.uint8]
    names: tuple[str, ...]
    kind: VoxelKind = VoxelKind.ATTENUATION


def geometry_of(detector: Detector, angles: NDArray[np.float64]) -> Geometry:
    """The simulated rays as a reconstruction's geometry; a cone's detector is placed at the sample."""
    if np.isfinite(detector.sod):
        at, row = detector.sod, detector.axis_row
        return Geometry.cone(angles, detector.shape, detector.pitch, at, at, axis_col=detector.axis_col, axis_row=row)
    return Geometry.parallel(
        angles, detector.shape, pixel_pitch=detector.pitch, axis_col=detector.axis_col, axis_row=detector.axis_row
    )


def binning_of(detector: Detector) -> int:
    """The least binning for a volume of LARGEST voxels across at most, limited by the frame's rows and columns."""
    return max(1, min(-(-max(detector.shape) // LARGEST), *detector.shape))


def memory_of(detector: Detector, binning: int) -> int:
    """Peak memory of `truth_of` in bytes. ValueError: the binning does not fit into the frame."""
    return BYTES_A_VOXEL * math.prod(grid_of(detector, binning).shape)


def truth_of(sample: Sample, detector: Detector, binning: int) -> Truth:
    """The truth in voxels of `binning` pixels. ValueError: the binning does not fit into the frame."""
    grid = grid_of(detector, binning)
    z, y, x = grid.centre
    shifted = replace(grid, centre=(z + _above(detector, binning), y, x))
    return Truth(grid, sample.attenuation(shifted), sample.labels(shifted), sample.names)


def grid_of(detector: Detector, binning: int) -> Grid:
    """The grid of a reconstruction in voxels of `binning` pixels."""
    return Grid.matching(geometry_of(detector, np.zeros(1)).binned(binning))


def _above(detector: Detector, binning: int) -> float:
    """z of a reconstruction's origin in the scene, mm: in a parallel beam the middle of the rows in whole bins, see
    Geometry.binned."""
    if np.isfinite(detector.sod):
        return 0.0
    rows = detector.shape[0] // binning * binning
    return ((rows - 1) / 2 - detector.axis_row) * detector.pitch


def write_truth(path: Path, truth: Truth) -> None:
    """Write an HDF5 file with entry/data/data (read by `beamline recon --truth`) and entry/data/labels, complete or not
    at all.

    Raises:
        DataError: `path` exists or cannot be written.
    """
    with whole_file(path) as partial, hdf5.created(partial) as file:
        file.attrs["default"] = "entry"
        entry = file.create_group("entry")
        entry.attrs["NX_class"], entry.attrs["default"] = "NXentry", "data"
        data = entry.create_group("data")
        data.attrs["NX_class"], data.attrs["signal"], data.attrs["axes"] = "NXdata", "data", ["z", "y", "x"]
        chunks = (1, *truth.grid.shape[1:])
        data.create_dataset("data", data=truth.values, chunks=chunks)
        data["data"].attrs["units"] = truth.kind.unit("mm")
        data.create_dataset("labels", data=truth.labels, chunks=chunks, compression="gzip", compression_opts=1)
        data["labels"].attrs["names"] = ["air", *truth.names]
        for name, centres in zip(("z", "y", "x"), truth.grid.coordinates(), strict=True):
            data[name] = centres
            data[name].attrs["units"] = "mm"
