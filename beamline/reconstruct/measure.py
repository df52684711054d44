"""Measuring a volume: against a truth where there is one, and always against the data and its own background."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.projections.prepare import PreparedProjections
from beamline.storage import hdf5
from beamline.storage.volume_file import read_volume
from recon.assess import metrics
from recon.base.volume import Grid, Volume
from recon.voxels.projector import data_residual

_RESIDUAL_VIEWS = 16
_VOLUME_PATHS = ("entry/data/data", "volume", "data")


def read_truth(spec: str) -> NDArray[np.float32]:
    """The volume [z, y, x] that `spec` names: FILE or FILE:first:end (slices), where FILE is any volume file
    (.npz, .npy, HDF5, TIFF, NIfTI).

    Raises:
        ConfigError: no such file, or slices outside it.
        DataError: the file holds no volume.
    """
    match = re.fullmatch(r"(?P<path>.+?)(:(?P<first>\d*):(?P<end>\d*))?", spec)
    if match is None or not Path(match["path"]).is_file():
        raise ConfigError(f"--truth {spec}: there is no such file. Expected FILE or FILE:first:end.")
    path = Path(match["path"])
    try:
        data, _ = read_volume(path, _volume_in(path))
    except DataError as error:
        raise DataError(f"--truth {path} holds no volume that can be read: {error}") from error
    first, end = int(match["first"] or 0), int(match["end"] or data.shape[0])
    if not 0 <= first < end <= data.shape[0]:
        raise ConfigError(f"--truth {spec}: slices {first}:{end} do not lie in 0:{data.shape[0]}.")
    return np.asarray(data[first:end], dtype=np.float32)


def _volume_in(path: Path) -> str | None:
    """Where an HDF5 file has its volume; None for other files. Raises DataError: none at a place that is known."""
    if not h5py.is_hdf5(path):
        return None
    with hdf5.open_hdf5(path) as file:
        found = next((p for p in _VOLUME_PATHS if getattr(file.get(p), "ndim", 0) == 3), None)
    if found is None:
        raise DataError(f"expected a 3-D dataset at one of {', '.join(_VOLUME_PATHS)}")
    return found


def fit_truth(truth: NDArray[np.float32], grid: Grid, binning: int) -> Volume:
    """The truth on the volume's `grid`; a truth that is `binning` times finer is averaged.

    Raises:
        ConfigError: the shapes do not fit.
    """
    shape = grid.shape
    if truth.shape != shape:
        if tuple(t // binning for t in truth.shape) != shape:
            coarser = [n for n in range(2, max(shape) + 1) if tuple(s // n for s in shape) == truth.shape]
            advice = f"Give --bin {coarser[0] * binning}" if coarser else "Choose its slices with FILE:first:end"
            raise ConfigError(
                f"--truth has shape {truth.shape}, the volume {shape} [z, y, x] with --bin {binning}. {advice}."
            )
        z, y, x = shape
        n = binning
        truth = truth[: z * n, : y * n, : x * n].reshape(z, n, y, n, x, n).mean(axis=(1, 3, 5), dtype=np.float32)
    if not np.isfinite(truth).all() or np.ptp(truth) == 0:
        raise ConfigError("--truth is constant, or not finite everywhere; there is nothing to compare with.")
    return Volume(truth, grid)


def regions(volume: Volume, seed: int) -> NDArray[np.int8] | None:
    """Dense and empty regions of a good volume (k-means), to judge others of the same sample by; None without two."""
    try:
        return metrics.kmeans_mask(volume.data, seed)
    except ValueError:
        return None


def measure(
    volume: Volume, prepared: PreparedProjections, truth: Volume | None, mask: NDArray[np.int8] | None
) -> dict[str, float]:
    """Figures of merit by the names of beamline.report.metrics.METRICS.

    With a truth: PSNR, SSIM 3D, NRMSE. With a mask of the dense and empty regions: SNR and CNR. Always: the residual
    in up to 16 of the views used, and in the views held out where there are any.
    """
    values: dict[str, float] = {}
    if truth is not None:
        values["psnr"] = metrics.psnr(truth.data, volume.data)
        values["ssim3d"] = metrics.ssim3d(truth.data, volume.data)
        values["nrmse"] = metrics.nrmse(truth.data, volume.data)
    if mask is not None and {0, 1} <= set(np.unique(mask).tolist()):
        values["snr"], values["cnr"] = metrics.snr_cnr(volume.data, mask)
    n = prepared.geometry.n_views
    some = np.unique(np.linspace(0, n - 1, min(n, _RESIDUAL_VIEWS)).round().astype(np.int64))
    weights = prepared.ray_weights()
    values["residual"] = data_residual(
        volume, prepared.projections.data[some], prepared.geometry.select(some), _known(weights, some)
    )
    if prepared.held_out is not None:
        data, unseen = prepared.held_out
        weights = prepared.ray_weights(unseen.n_views)
        values["residual_held_out"] = data_residual(volume, data, unseen, _known(weights, slice(n, None)))
    return {name: float(value) for name, value in values.items()}


def _known(weights: NDArray[np.float32] | None, views: NDArray[np.int64] | slice) -> NDArray[np.float32] | None:
    """1 for rays of these views that weigh anything, 0 for those that were not measured; None: all were."""
    return None if weights is None else (weights[views] > 0).astype(np.float32)
