"""Ground truth: puts the true volume on the grid of a reconstruction, and compares volume files with it."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.storage import hdf5
from beamline.storage.volumes.files import opened_volume, whole_volume
from recon.assess import metrics
from recon.base.volume import Grid, Volume
from recon.judgement import by_truth

_VOLUME_PATHS = ("entry/data/data", "volume", "data")


def read_truth(spec: str) -> NDArray[np.float32]:
    """Read the reference volume [z, y, x] named by `spec`: FILE or FILE:first:end (slices), where FILE is any volume
    file (.npz, .npy, HDF5, TIFF, NIfTI, Zarr).

    Raises:
        ConfigError: no such file, or slices outside it.
        DataError: the file does not contain a volume.
    """
    match = re.fullmatch(r"(?P<path>.+?)(:(?P<first>\d*):(?P<end>\d*))?", spec)
    if match is None or not Path(match["path"]).exists():
        raise ConfigError(f"--truth {spec}: the file does not exist. Expected FILE or FILE:first:end.")
    path = Path(match["path"])
    try:
        data, _ = whole_volume(path, _volume_in(path))
    except DataError as error:
        raise DataError(f"--truth {path} contains no readable volume: {error}") from error
    if data.ndim != 3:
        raise DataError(f"--truth {path} is an array of shape {data.shape}; expected a volume [z, y, x].")
    first, end = int(match["first"] or 0), int(match["end"] or data.shape[0])
    if not 0 <= first < end <= data.shape[0]:
        raise ConfigError(f"--truth {spec}: slices {first}:{end} are outside 0:{data.shape[0]}.")
    return np.asarray(data[first:end], dtype=np.float32)


def _volume_in(path: Path) -> str | None:
    """The path of the volume in an HDF5 file; None for other files. Raises DataError if there is no volume at a known
    path.
    """
    if not (path.is_file() and h5py.is_hdf5(path)):
        return None
    with hdf5.open_hdf5(path) as file:
        dataset = next((p for p in _VOLUME_PATHS if getattr(file.get(p), "ndim", 0) == 3), None)
    if dataset is None:
        places = ", ".join(_VOLUME_PATHS)
        raise DataError(f"expected a 3-D dataset at one of {places}")
    return dataset


def fit_truth(truth: NDArray[np.float32], grid: Grid, binning: int) -> Volume:
    """The reference volume on `grid`. If the voxels of the reference are `binning` times finer, they are averaged.

    Raises:
        ConfigError: the shapes do not fit.
    """
    shape = grid.shape
    if truth.shape != shape:
        if tuple(t // binning for t in truth.shape) != shape:
            coarser = [n for n in range(2, max(shape) + 1) if tuple(s // n for s in shape) == truth.shape]
            advice = (
                f"Give --bin {coarser[0] * binning}"
                if coarser
                else "Choose slices of the ground truth with FILE:first:end"
            )
            raise ConfigError(
                f"--truth has the shape {truth.shape}, but the volume has {shape} [z, y, x] with --bin {binning}. "
                f"{advice}."
            )
        z, y, x = shape
        n = binning
        truth = truth[: z * n, : y * n, : x * n].reshape(z, n, y, n, x, n).mean(axis=(1, 3, 5), dtype=np.float32)
    if not np.isfinite(truth).all() or np.ptp(truth) == 0:
        raise ConfigError(
            "Give another --truth, because this ground truth has the same value in all voxels, or has values that "
            "are not finite."
        )
    return Volume(truth, grid)


def measured_file(path: Path, truth: str | None, masks: Path | None) -> dict[str, float]:
    """Figures of merit of a volume file, compared with a reference volume and in regions that the user has drawn.

    Args:
        truth: the reference volume, see `read_truth`.
        masks: labels [z, y, x] of the volume's shape: 1 dense, 2 empty, 0 not used.

    Raises:
        DataError, ConfigError: a file contains no volume, or a volume of another shape.
    """
    with opened_volume(path) as record:
        volume = np.asarray(record.volume.data[:], np.float32)
    values: dict[str, float] = {}
    try:
        if truth is not None:
            true = read_truth(truth)
            values = {**by_truth(true, volume), "ssim_slices": metrics.ssim_of_whole_slices(true, volume)}
        if masks is not None:
            labels, _ = whole_volume(masks)
            if not np.isin(labels, (0, 1, 2)).all():
                raise ValueError(f"{masks} has labels other than 0 (not used), 1 (dense) and 2 (empty)")
            regions = np.array([-1, 1, 0], np.int8)[labels.astype(np.intp)]
            values["snr"], values["cnr"] = metrics.snr_cnr(volume, regions)
    except ValueError as error:
        raise DataError(f"{path} cannot be measured: {error}.") from error
    return {name: float(value) for name, value in values.items()}
