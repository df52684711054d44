"""Measures a volume: against a truth if there is one, and always against the data and its own background."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.projections.prepared import PreparedProjections
from beamline.storage import hdf5
from beamline.storage.volumes.files import opened_volume, whole_volume
from recon.assess import metrics
from recon.base.geometry import Geometry
from recon.base.masks import RayWeights
from recon.base.views import spread
from recon.base.volume import Grid, Volume
from recon.voxels.projector import project
from recon.voxels.resolution import ViewResolution, at_voxel_resolution

_RESIDUAL_VIEWS = 16
RESIDUAL_RAYS, _RESIDUAL_ROWS = 2**17, 16  # of a view; rows of a band: bands of rows stand for a large detector
_VOLUME_PATHS = ("entry/data/data", "volume", "data")


def read_truth(spec: str) -> NDArray[np.float32]:
    """Read the reference volume [z, y, x] named by `spec`: FILE or FILE:first:end (slices), where FILE is any volume
    file (.npz, .npy, HDF5, TIFF, NIfTI, Zarr).

    Raises:
        ConfigError: no such file, or slices outside it.
        DataError: the file holds no volume.
    """
    match = re.fullmatch(r"(?P<path>.+?)(:(?P<first>\d*):(?P<end>\d*))?", spec)
    if match is None or not Path(match["path"]).exists():
        raise ConfigError(f"--truth {spec}: the file does not exist. Expected FILE or FILE:first:end.")
    path = Path(match["path"])
    try:
        data, _ = whole_volume(path, _volume_in(path))
    except DataError as error:
        raise DataError(f"--truth {path} contains no readable volume: {error}") from error
    first, end = int(match["first"] or 0), int(match["end"] or data.shape[0])
    if not 0 <= first < end <= data.shape[0]:
        raise ConfigError(f"--truth {spec}: slices {first}:{end} do not lie in 0:{data.shape[0]}.")
    return np.asarray(data[first:end], dtype=np.float32)


def _volume_in(path: Path) -> str | None:
    """Where an HDF5 file has its volume; None for other files. Raises DataError: no volume at a known place."""
    if not (path.is_file() and h5py.is_hdf5(path)):
        return None
    with hdf5.open_hdf5(path) as file:
        dataset = next((p for p in _VOLUME_PATHS if getattr(file.get(p), "ndim", 0) == 3), None)
    if dataset is None:
        raise DataError(f"expected a 3-D dataset at one of {', '.join(_VOLUME_PATHS)}")
    return dataset


def fit_truth(truth: NDArray[np.float32], grid: Grid, binning: int) -> Volume:
    """The reference volume on `grid`; a reference that is `binning` times finer is averaged.

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
    """Dense and empty regions of a reference, without their rims, to assess volumes of the same sample; None if it has
    no such regions.

    They are those of `metrics.sampled` of the volume.
    """
    return metrics.interior_regions(metrics.sampled(volume.data), seed)


def contrast_by(mask: NDArray[np.int8] | None, volume: Volume) -> dict[str, float]:
    """SNR and CNR of a volume in `regions`; empty without regions."""
    if mask is None:
        return {}
    snr, cnr = metrics.snr_cnr(metrics.sampled(volume.data), mask)
    return {"snr": snr, "cnr": cnr}


def residual_share(geometry: Geometry, grid: Grid, held_out: tuple[NDArray[np.float32], Geometry] | None) -> float:
    """Approximate share of all rays used for the residual in `measure`."""
    views = min(geometry.n_views, _RESIDUAL_VIEWS) + (0 if held_out is None else held_out[1].n_views)
    rows, cols = geometry.detector_shape
    in_bands = geometry.rows_show_slices and grid == Grid.matching(geometry)
    return views / geometry.n_views * (min(1.0, RESIDUAL_RAYS / (rows * cols)) if in_bands else 1.0)


def measure(
    volume: Volume,
    prepared: PreparedProjections | None,
    truth: Volume | None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> dict[str, float]:
    """Figures of merit by the names of beamline.report.metrics.METRICS.

    With a truth: PSNR, SSIM 3D, NRMSE. With views: the residual in up to 16 of
    the views used, and in the views held out where there are any. Of a detector with more than 2^17 pixels only bands
    of rows with so many pixels are used. `progress` hears how many of these views were compared.
    """
    values = {} if truth is None else _against(truth.data, volume.data)
    if prepared is None:
        return {name: float(value) for name, value in values.items()}
    some, weights = spread(np.arange(prepared.geometry.n_views), _RESIDUAL_VIEWS), prepared.ray_factors()
    values["residual"] = _residual(volume, prepared.projections.data, prepared.geometry, some, weights, progress)
    if prepared.held_out is not None:
        data, unseen = prepared.held_out
        weights = prepared.ray_factors(unseen.n_views)
        later = (
            None
            if weights is None
            else RayWeights(tuple(factor[prepared.geometry.n_views :] for factor in weights.factors))
        )
        values["residual_held_out"] = _residual(volume, data, unseen, np.arange(unseen.n_views), later, progress)
    return {name: float(value) for name, value in values.items()}


def _against(truth: NDArray[np.float32], volume: NDArray[np.float32]) -> dict[str, float]:
    """The figures of a volume by the true one, [z, y, x] each."""
    of = {"psnr": metrics.psnr, "ssim3d": metrics.ssim3d, "nrmse": metrics.nrmse}
    return {name: figure(truth, volume) for name, figure in of.items()}


def residuals_along_rows(volume: Volume, prepared: PreparedProjections) -> tuple[float, float]:
    """The residual, in the differences of rays from the mean of their row, of a volume, and the lesser one of two
    uniform volumes with the density of least residual: a box and a cylinder that fill the slices.

    A volume that leaves more shows nothing of the sample yet. The means tell nothing: they hold matter beyond the
    field, too, which a right volume lacks. Both are 0 where views have no such differences.
    """
    grid = volume.grid
    _, y, x = grid.coordinates()
    inside = np.hypot(y[:, None], x) < grid.spacing[1] * min(grid.shape[1:]) / 2
    uniform = (Volume(np.broadcast_to(np.float32(at), grid.shape), grid) for at in (inside, True))
    some, weights = spread(np.arange(prepared.geometry.n_views), _RESIDUAL_VIEWS), prepared.ray_factors()
    products, total = np.zeros((4, 4)), 0.0  # of the views, the volume and the two uniform ones
    volumes, data = (volume, *uniform), prepared.projections.data
    # What is not looked at in bands of rows takes less memory so.
    for views in [some] if prepared.geometry.rows_show_slices else np.array_split(some, min(len(some), 4)):
        for lines, measured, _ in _in_bands(volumes, data, prepared.geometry, views, weights):
            known, own, seen = _at_voxel_resolution(*measured)
            images = [_without_means(image, known) for image in (seen, *lines)]
            products += [[np.vdot(one, other) for other in images] for one in images]
            total += float(np.square(_without_means(own, known)).sum())
    if total == 0:
        return 0.0, 0.0
    squares = products[0, 0] - 2 * products[0, 1] + products[1, 1]
    norms = np.diag(products)[2:]
    least = products[0, 0] - np.divide(products[0, 2:] ** 2, norms, out=np.zeros(2), where=norms > 0).max()
    return math.sqrt(max(squares, 0.0) / total), math.sqrt(max(least, 0.0) / total)


def _without_means(image: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The differences of known rays [view, row, col] from the mean of their row; 0 of the others."""
    values, n = np.where(known, image, np.float64(0)), np.maximum(known.sum(axis=2, keepdims=True), 1)
    return np.where(known, values - values.sum(axis=2, keepdims=True) / n, 0)


def measured_file(path: Path, truth: str | None, masks: Path | None) -> dict[str, float]:
    """Figures of merit of a volume file: against a reference volume, and in regions drawn by the user.

    Args:
        truth: as of `read_truth`.
        masks: labels [z, y, x] of the volume's shape: 1 dense, 2 empty, 0 not used.

    Raises:
        DataError, ConfigError: files that hold no volumes, or of another shape.
    """
    with opened_volume(path) as record:
        volume = np.asarray(record.volume.data[:], np.float32)
    values: dict[str, float] = {}
    try:
        if truth is not None:
            true = read_truth(truth)
            values = {**_against(true, volume), "ssim_slices": metrics.ssim_of_whole_slices(true, volume)}
        if masks is not None:
            labels, _ = whole_volume(masks)
            if not np.isin(labels, (0, 1, 2)).all():
                raise ValueError(f"{masks} has other labels than 0 (not used), 1 (dense) and 2 (empty)")
            regions = np.array([-1, 1, 0], np.int8)[labels.astype(np.intp)]
            values["snr"], values["cnr"] = metrics.snr_cnr(volume, regions)
    except ValueError as error:
        raise DataError(f"{path} cannot be measured: {error}.") from error
    return {name: float(value) for name, value in values.items()}


def squares_left(
    projected: NDArray[np.float32],
    views: NDArray[np.float32],
    resolution: ViewResolution,
    measured: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[view] sums of squares of A x - G p, at voxel resolution, and of p, over the measured rays.

    The data residual is the root of the sum of the first over that of the second, for every command that states one.

    Args:
        projected: [view, row, col] line integrals of the volume by a `Projector` of this resolution.
        views: those measured, where NaN does not count.
        measured: [view, row, col]; None: all rays.
    """
    known, own, seen = _at_voxel_resolution(views, resolution, measured)
    left = np.where(known, projected - seen, 0)
    sums = [np.square(each, dtype=np.float64).sum(axis=(1, 2)) for each in (left, own)]
    return sums[0], sums[1]


def _at_voxel_resolution(
    views: NDArray[np.float32], resolution: ViewResolution, measured: NDArray[np.bool_] | None
) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
    """Which rays are known, p of these, and G p, [view, row, col] each; see `squares_left`."""
    known = np.isfinite(views) if measured is None else np.isfinite(views) & measured
    own = np.where(known, views, np.float32(0))
    return known, own, at_voxel_resolution(own.swapaxes(1, 2), resolution, known.swapaxes(1, 2)).swapaxes(1, 2)


def _residual(
    volume: Volume,
    data: NDArray[np.float32],
    geometry: Geometry,
    views: NDArray[np.int64],
    weights: RayWeights | None,
    progress: Callable[[int, int], None],
) -> float:
    """The residual of the volume in these views, without unmeasured rays."""
    squared = total = 0.0
    for (lines,), measured, done in _in_bands([volume], data, geometry, views, weights):
        left, own = squares_left(lines, *measured)
        squared, total = squared + left.sum(), total + own.sum()
        progress(done, len(views))
    if total == 0:
        raise ValueError("all projections are zero, so no residual can be computed")
    return float(np.sqrt(squared / total))


_Measured = tuple[NDArray[np.float32], ViewResolution, NDArray[np.bool_] | None]
"""Views [view, row, col], the resolution of voxels in them, and which rays were measured; None: all."""


def _in_bands(
    volumes: Sequence[Volume],
    data: NDArray[np.float32],
    geometry: Geometry,
    views: NDArray[np.int64],
    weights: RayWeights | None,
) -> Iterator[tuple[list[NDArray[np.float32]], _Measured, int]]:
    """Line integrals of each volume in each band of rows of these views, those measured, and the
    number of views that this and earlier bands are worth."""
    some, grid = geometry.select(views), volumes[0].grid
    matter = np.maximum(sum(np.nansum(data[view], axis=1, dtype=np.float64) for view in views), 0)
    bands = residual_bands(grid, some, matter)
    for n, rows in enumerate(bands):
        part, slices = some, slice(None)
        if rows != slice(0, some.detector_shape[0]):
            part, slices = some.rows(rows.start, rows.stop), rows
            height = (part.middle_height, *grid.centre[1:])
            grid = replace(grid, shape=(part.detector_shape[0], *grid.shape[1:]), centre=height)
        lines = [project(Volume(np.ascontiguousarray(each.data[slices]), grid), part) for each in volumes]
        measured = None if weights is None else np.asarray(weights[views, rows] > 0)
        yield lines, (data[views, rows], ViewResolution.of(part, grid), measured), (n + 1) * len(views) // len(bands)


def residual_bands(grid: Grid, geometry: Geometry, matter: NDArray[np.float64]) -> list[slice]:
    """Bands of rows that represent the detector: all rows, unless it is large; one band if rows are not slices.

    Args:
        matter: that the rows show [row]; bands lie at equal shares of it.
    """
    rows, cols = geometry.detector_shape
    bands = max(1, RESIDUAL_RAYS // (_RESIDUAL_ROWS * cols))
    if not geometry.rows_show_slices or grid != Grid.matching(geometry):
        return [slice(0, rows)]
    if rows <= bands * _RESIDUAL_ROWS:
        return [slice(first, min(first + _RESIDUAL_ROWS, rows)) for first in range(0, rows, _RESIDUAL_ROWS)]
    reached = np.cumsum(matter if matter.any() else np.ones(rows))
    middles = np.searchsorted(reached, (np.arange(bands) + 0.5) / bands * reached[-1])
    starts = np.unique(np.clip(middles - _RESIDUAL_ROWS // 2, 0, rows - _RESIDUAL_ROWS))
    return [slice(first, first + _RESIDUAL_ROWS) for first in starts.tolist()]
