"""Volumes: what is read of a file, the box that is looked at, and the same volume from parts of its views."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy import ndimage

import recon
from beamline.api import Selection
from beamline.core.errors import DataError
from beamline.core.machine import free_memory
from beamline.core.text import size
from beamline.projections.prepare import prepare_projections
from beamline.storage.readers.open import open_scan
from beamline.storage.volumes.files import opened_volume
from recon import Grid, Volume
from recon.post import clusters
from splatline_structure.materials import F32

Box = tuple[slice, slice, slice]
BYTES_A_VOXEL = 110  # peak memory: 92 as measured of one structure, and the volumes of the halves
_LEAST = 8  # voxels of a side
_MARGIN = 0.05  # of the square in the sample's circle, at each end: the wall of a can stays out
_GOES_ON = 0.5  # of the mean inside, at the rim of the field: there the sample is wider than the field


def read_volume(path: Path, dataset: str | None, voxel_um: float | None, slices: tuple[int, int] | None) -> Any:
    """The record of a volume, its lengths in mm, with these slices.

    Raises:
        DataError: no volume of finite numbers, no size of a voxel, or more voxels than the memory takes.
    """
    if dataset is None and path.is_file() and h5py.is_hdf5(path) and _is_scan(path):
        raise DataError(f"{path} is a scan: reconstruct it with `beamline recon`. Nothing was written.")
    with opened_volume(path, dataset) as record:
        grid = record.volume.grid
        if voxel_um is not None:
            grid = Grid(grid.shape, voxel_um * 1e-3)
        elif record.length_unit != "mm":
            raise DataError(f"{path} does not state the size of a voxel: give --voxel-um. Nothing was written.")
        first, end = slices or (0, grid.shape[0])
        if not 0 <= first < end <= grid.shape[0]:
            raise DataError(f"--slices {first} {end}: {path} has slices 0 to {grid.shape[0]}. Nothing was written.")
        grid = grid.part(slice(first, end), slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        needed = BYTES_A_VOXEL * math.prod(grid.shape)
        if needed > free_memory():
            raise DataError(
                f"{path}: {' x '.join(map(str, grid.shape))} voxels take {size(needed)}, and {size(free_memory())} are "
                "free; take some --slices. Nothing was written."
            )
        values = np.ascontiguousarray(record.volume.data[first:end], np.float32)
        if min(values.shape) < _LEAST:
            raise DataError(
                f"{path} holds {values.shape}; expected {_LEAST} or more voxels a side. Nothing was written."
            )
        if not np.isfinite(values).all():
            raise DataError(f"{path} has values that are not finite. Nothing was written.")
        return replace(record, volume=Volume(values, grid), length_unit="mm", deviation=None, series=None)


def _is_scan(path: Path) -> bool:
    with suppress(DataError), open_scan(path):
        return True
    return False


def box_in(volume: F32, crop: bool) -> Box:
    """The square inside the circle of the sample, or of the field where the sample is wider; or all.

    Raises:
        ValueError: the volume is the same everywhere.
    """
    nz, ny, nx = volume.shape
    if not crop:
        return slice(0, nz), slice(0, ny), slice(0, nx)
    y, x = (np.arange(n) - (n - 1) / 2 for n in (ny, nx))
    away, field = np.hypot(y[:, None], x), min(ny, nx) / 2
    mean = volume.mean(axis=0)
    rim, middle = (
        float(mean[part].mean()) for part in ((away > 0.94 * field) & (away < 0.99 * field), away < field / 2)
    )
    circle = (float(ny - 1) / 2, float(nx - 1) / 2, field) if rim > _GOES_ON * middle else sample_circle(volume)
    return inscribed_box((nz, ny, nx), circle, _MARGIN)


def sample_circle(volume: F32) -> tuple[float, float, float]:
    """Centre (y, x) and radius of the sample seen along z, in voxels.

    K-means divides the root of the mean over z above its least value into two classes, so that a pin of metal is not
    one of them; the circle has the extent of the largest connected part.

    Args:
        volume: [z, y, x], finite.

    Raises:
        ValueError: the mean is the same everywhere.
    """
    mean = volume.mean(axis=0, dtype=np.float64)
    mean = np.sqrt(mean - mean.min())
    parts, _ = ndimage.label(ndimage.binary_fill_holes(mean > clusters(mean.ravel(), 2).centres.mean()))
    largest = np.bincount(parts.ravel())[1:].argmax() + 1
    rows, cols = np.nonzero(parts == largest)
    radius = (np.ptp(rows) + np.ptp(cols) + 2) / 4
    return float(rows.min() + rows.max()) / 2, float(cols.min() + cols.max()) / 2, float(radius)


def inscribed_box(shape: tuple[int, int, int], circle: tuple[float, float, float], margin: float = 0.05) -> Box:
    """All slices of the square inside a circle, of side 2 r cos 45° less a margin, cut to the volume.

    Args:
        shape: (nz, ny, nx).
        circle: centre (y, x) and radius in voxels.
        margin: share of the side taken off at each of its ends, 0 to 0.5.

    Raises:
        ValueError: for another margin, or a box that is empty.
    """
    if not 0 <= margin < 0.5:
        raise ValueError(f"the margin is a share of the side, 0 to 0.5, got {margin}")
    *centre, radius = circle
    half = radius * math.cos(math.pi / 4) * (1 - 2 * margin)
    y, x = (
        slice(max(0, math.ceil(c - half)), min(n, math.floor(c + half) + 1))
        for c, n in zip(centre, shape[1:], strict=True)
    )
    if y.start >= y.stop or x.start >= x.stop:
        raise ValueError(f"the square in a circle of radius {radius:.3g} voxels at {centre} holds no voxel of {shape}")
    return slice(0, shape[0]), y, x


def parts_of(
    record: Any, scan: Path, count: int, warn: Callable[[str], None], tell: Callable[[int, int], None]
) -> list[F32]:
    """The volume from each of `count` interleaved parts of the views of its scan, by its method.

    The views, in the order of their angles, are dealt out as by error bars; corrections are the defaults of `recon`.

    Raises:
        DataError, ConfigError: the scan cannot be read or prepared. ValueError: the method takes no such views.
    """
    facts = record.parameters
    rows: Any = None if facts.get("rows", "all") == "all" else tuple(map(int, str(facts["rows"]).split(":")))
    selection = Selection(
        views=str(facts.get("views", "all")), rows=rows, binning=int(facts.get("binning", 1)), axis_col=record.axis_col,
    )  # fmt: skip
    with open_scan(scan) as source:
        prepared = prepare_projections(source, selection, warn)
    views, order = prepared.views, np.argsort(np.mod(prepared.geometry.angles, prepared.geometry.period), kind="stable")
    in_pixels = facts.get("pixel_pitch_unit") == "px"
    scale = 1.0 if in_pixels else prepared.geometry.sample_pitch / record.grid.voxel_size  # to the volume's unit
    volumes = []
    for first in range(count):
        tell(first, count)
        chosen = np.sort(order[first::count])
        weights = None if views.weights is None else np.asarray(views.weights[chosen], np.float32)
        use = recon.DataUse(weights=weights, sample_radius=prepared.sample_radius)
        made = recon.reconstruct(views.data[chosen], prepared.geometry.select(chosen), record.method, use=use)
        volumes.append(made.volume.data * np.float32(scale))
    tell(count, count)
    return volumes
