"""Reads as many slices of a volume as fit into the memory, finds the box to measure, and reconstructs volumes from
halves of the projections.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

import recon
from beamline.api import Selection
from beamline.core.errors import DataError
from beamline.core.text import rounded, size
from beamline.projections.prepare import prepare_projections
from beamline.projections.views import select
from beamline.storage.readers.open import open_scan, scan_format
from beamline.storage.volumes.files import opened_volume
from recon import Grid, Volume
from recon.post import clusters
from splatline_structure.materials import F32, Spacing

Box = tuple[slice, slice, slice]
_BESIDE = 16  # additional slices on both sides of the measured slices, because the prior of a method extends over them
BYTES_OF_ALL, BYTES_OF_SQUARE, BYTES_BESIDE = 150, 75, 40 * 2 * _BESIDE
"""Peak memory in bytes a voxel of the measured slices, with both halves: if the box is the whole slice (measured: 145
for percolating particles, 105 for grains), and if it is the square in a circle, at most 41 % of the slice. The third is
for each voxel of one slice: FISTA-TV also reconstructs `_BESIDE` slices on both sides, at 40 bytes a voxel."""
_LEAST = 8  # fewest voxels along a side of the box
_MARGIN = 0.05  # fraction of the square's side left out at each end, so that the wall of a can is outside
_GOES_ON = 0.5  # if the rim of the field has this fraction of the inner mean, the sample is wider than the field


@dataclass(frozen=True, eq=False)
class ReadSlices:
    """The slices of a volume that were read.

    Attributes:
        record: the record of these slices, with lengths in mm.
        slices: their indices in the volume.
        asked: slices that were requested; `slices` are fewer if not all of them fit into the memory.
        n_slices: number of slices of the whole volume.
        limit_sentence: message that not all slices fit into the memory; empty if all fit.
    """

    record: Any
    slices: slice
    asked: slice
    n_slices: int
    limit_sentence: str = ""


Crop = Literal["square", "finite", "none"]


def read_volume(
    path: Path,
    dataset: str | None,
    voxel_um: Spacing | None,
    slices: tuple[int, int] | None,
    memory: int,
    crop: Crop,
    whole: bool = False,
    warn: Callable[[str], None] = lambda sentence: None,
) -> ReadSlices:
    """Read the slices of a volume, or as many of them in the middle as fit the memory.

    Args:
        voxel_um: edges of a voxel (z, y, x) in µm; None: the edges that the file states.
        crop: the crop for `box_in`; with "finite", values outside its circle may be anything.
        whole: True: read all requested slices, or raise an error.
        warn: function that gets a warning if the file states other edges.

    Raises:
        DataError: the file is not a volume of finite numbers, does not state the voxel size or has no such slices; or
            fewer than 8 slices fit the memory (with `whole`: fewer than all that were asked for).
    """
    _require_volume(path, dataset, memory)
    with opened_volume(path, dataset) as record:
        grid = _grid_in_mm(path, record, voxel_um, warn)
        n_slices = grid.shape[0]
        first, end = slices or (0, n_slices)
        if not 0 <= first < end <= n_slices:
            raise DataError(f"--slices {first} {end}: {path} has slices 0 to {n_slices}. Nothing was written.")
        most = _most_slices(path, grid, end - first, memory, crop, whole)
        excess = max(end - first - most, 0)
        fitting = slice(first + excess // 2, end - (excess - excess // 2))
        limit_sentence = (
            f"Only {most} of {end - first} slices fit into {size(memory)} of memory, so the numbers are measured in "
            f"the middle, in the slices {fitting.start}:{fitting.stop}. Numbers whose names end in _all are "
            f"measured in the slices {first}:{end}, but with the intervals of the middle slices. To measure more "
            "slices, free memory or give more --memory."
            if excess
            else ""
        )
        grid = grid.part(fitting, slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        values = np.ascontiguousarray(record.volume.data[fitting], np.float32)
        if min(values.shape) < _LEAST:
            raise DataError(
                f"{path} has {values.shape} voxels; expected {_LEAST} or more along each side. Nothing was written."
            )
        if crop != "finite" and (share := 1 - np.isfinite(values).mean()):
            raise DataError(
                f"{share:.2%} of the voxels of {path} are not finite. If these voxels are outside the circle of the "
                "field of view, use --crop finite, which measures the square inside the circle. Nothing was written."
            )
        record = replace(record, volume=Volume(values, grid), length_unit="mm", deviation=None, series=None)
        return ReadSlices(record, fitting, slice(first, end), n_slices, limit_sentence)


def _require_volume(path: Path, dataset: str | None, memory: int) -> None:
    """Raise DataError if the file is a scan, or a packed volume that would not fit the memory."""
    if dataset is None and path.is_file() and h5py.is_hdf5(path) and (scan := scan_format(path)) is not None:
        raise DataError(
            f"Reconstruct {path} with `beamline recon` first: it is a scan ({scan}). If the file does contain a "
            "volume, give --dataset. Nothing was written."
        )
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as packed:
            unpacked = sum(each.file_size for each in packed.infolist())
        if unpacked > memory:
            raise DataError(
                f"{path}: not enough memory. The unpacked volume has {size(unpacked)}, and {size(memory)} are "
                "allowed. Give more --memory, or save the volume as .npy (numpy.save), which is read slice by slice. "
                "Nothing was written."
            )


def _grid_in_mm(path: Path, record: Any, voxel_um: Spacing | None, warn: Callable[[str], None]) -> Grid:
    """The grid of a volume with spacings in mm: those of `voxel_um`, otherwise those that the file states."""
    grid = record.volume.grid
    if voxel_um is None:
        if record.length_unit != "mm":
            raise DataError(
                f"Give --voxel-um EDGE, or Z:Y:X if voxels are not cubes: {path} does not state the voxel size. "
                "Nothing was written."
            )
        return grid
    if record.length_unit == "mm" and not np.allclose(voxel_um, stated := 1e3 * np.array(grid.spacing), 0.01):
        warn(
            f"{path} states voxels with edges (z, y, x) of {_edges(stated)} µm, but the edges of --voxel-um "
            f"are used: {_edges(voxel_um)} µm. Leave out --voxel-um to use the edges that the file states."
        )
    return Grid(grid.shape, voxel_um[2] * 1e-3, slice_pitch=voxel_um[0] * 1e-3)


def _most_slices(path: Path, grid: Grid, wanted: int, memory: int, crop: Crop, whole: bool) -> int:
    """The largest number of slices that can be measured within the memory. The arguments are those of `read_volume`.

    Raises:
        DataError: fewer than 8 slices fit (with `whole`: fewer than `wanted`).
    """
    bytes_a_voxel = BYTES_OF_ALL if crop == "none" else BYTES_OF_SQUARE
    most = (memory // math.prod(grid.shape[1:]) - BYTES_BESIDE) // bytes_a_voxel
    least = wanted if whole else min(wanted, _LEAST)
    if most < least:
        needed = rounded((bytes_a_voxel * least + BYTES_BESIDE) * math.prod(grid.shape[1:]), up=True)
        raise DataError(
            f"{path}: not enough memory. {least} slices of {grid.shape[1]} x {grid.shape[2]} voxels need "
            f"{size(needed)}, and {size(memory)} are allowed{' for each of several volumes' if whole else ''}. "
            "Free memory, give more "
            f"--memory{', fewer --slices' if whole else ''}{', --crop square' if crop == 'none' else ''}, or "
            "measure a part of the volume (`recon --roi`, then --parts or --quick). Nothing was written."
        )
    return most


def _edges(spacing: ArrayLike) -> str:
    return " x ".join(f"{edge:.4g}" for edge in np.asarray(spacing))


def slabs_of(
    path: Path, dataset: str | None, read: ReadSlices, box: Box, tell: Callable[[int, int], None]
) -> Iterator[F32]:
    """Yields the box in all requested slices, in slabs of at most as many slices as were read. Each slab begins with
    the last slice of the slab before.

    Args:
        tell: function that is called with the number of slabs read and the number of all slabs.

    Raises:
        DataError: some values are not finite.
    """
    requested = np.arange(read.asked.start, read.asked.stop)
    slabs = [
        slice(max(block[0] - 1, requested[0]), block[-1] + 1)
        for block in np.array_split(requested, math.ceil(requested.size / read.record.grid.shape[0]))
    ]
    with opened_volume(path, dataset) as record:
        for taken, slab_slices in enumerate(slabs, 1):
            slab = np.asarray(record.volume.data[slab_slices], np.float32)[:, *box[1:]]
            if not np.isfinite(slab).all():
                raise DataError(f"{path} has values that are not finite; measure other --slices. Nothing was written.")
            yield slab
            tell(taken, len(slabs))


def box_in(volume: F32, crop: Crop) -> Box:
    """The part of a volume that is measured.

    Args:
        crop: "square": the square inside the sample, or inside the field of view if the sample is wider. "finite": the
            square inside the circle of finite values. "none": everything.

    Raises:
        ValueError: the volume has the same value everywhere, or some values in the square are not finite.
    """
    nz, ny, nx = volume.shape
    if crop == "none":
        return slice(0, nz), slice(0, ny), slice(0, nx)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(volume).all(axis=0))
    if crop == "finite" and not known.all():
        box = inscribed_box((nz, ny, nx), sample_circle(known[None].astype(np.float32)), 0.0)
        if not known[box[1:]].all():
            raise ValueError(
                "repair the volume: some values inside the square of --crop finite are not finite (a masked volume has "
                "such values only outside a circle)"
            )
        return box
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

    The mean over z, minus its least value, is divided into two classes with k-means. Its square root is used, so that a
    pin of metal is not a class of its own. The circle has the extent of the largest connected part.

    Args:
        volume: [z, y, x], finite.

    Raises:
        ValueError: the mean has the same value everywhere.
    """
    mean = volume.mean(axis=0, dtype=np.float64)
    mean = np.sqrt(mean - mean.min())
    parts, _ = ndimage.label(ndimage.binary_fill_holes(mean > clusters(mean.ravel(), 2).centres.mean()))
    largest = np.bincount(parts.ravel())[1:].argmax() + 1
    rows, cols = np.nonzero(parts == largest)
    radius = (np.ptp(rows) + np.ptp(cols) + 2) / 4
    return float(rows.min() + rows.max()) / 2, float(cols.min() + cols.max()) / 2, float(radius)


def inscribed_box(shape: tuple[int, int, int], circle: tuple[float, float, float], margin: float = 0.05) -> Box:
    """All slices of the square inside a circle, of side 2 r cos 45° minus a margin, cut to the volume.

    Args:
        shape: (nz, ny, nx).
        circle: centre (y, x) and radius in voxels.
        margin: fraction of the side left out at each end, below 0.5.

    Raises:
        ValueError: the box is empty.
    """
    *centre, radius = circle
    half = radius * math.cos(math.pi / 4) * (1 - 2 * margin)
    y, x = (
        slice(max(0, math.ceil(c - half)), min(n, math.floor(c + half) + 1))
        for c, n in zip(centre, shape[1:], strict=True)
    )
    if y.start >= y.stop or x.start >= x.stop:
        raise ValueError(
            f"no voxel of the volume {shape} lies in the square inside the sample's circle (radius {radius:.3g} "
            f"voxels, centre {centre}); give --crop none"
        )
    return slice(0, shape[0]), y, x


def parts_of(
    read: ReadSlices, scan: Path, count: int, warn: Callable[[str], None], tell: Callable[[int, int], None]
) -> list[F32]:
    """Reconstruct the slices of a volume from each of `count` interleaved parts of the projections, with its own
    method.

    The projections are sorted by angle and dealt out in turn, as for error bars. Corrections are the defaults of
    `recon`. For a parallel beam only the rows of these slices, and some next to them, are read.

    Raises:
        DataError, ConfigError: the scan cannot be read or prepared.
        ValueError: the method cannot use these projections, the volume does not have the slices that the rows of the
            scan give, or the volume does not state the rotation axis.
    """
    record, facts, slices = read.record, read.record.parameters, read.slices
    if math.isnan(record.axis_col):
        raise ValueError(
            "give --parts or --quick, because the volume does not state the rotation axis. The axis is needed to "
            "reconstruct the volume again from each half of the projections"
        )
    rows: Any = None if facts.get("rows", "all") == "all" else tuple(map(int, str(facts["rows"]).split(":")))
    selection = Selection(
        views=str(facts.get("views", "all")), rows=rows, binning=int(facts.get("binning", 1)), axis_col=record.axis_col,
    )  # fmt: skip
    with open_scan(scan) as source:
        picked = select(source, selection)
        selected = picked.selection
        first, end, side = selected.detector_rows.start, selected.detector_rows.stop, selected.binning
        if selected.cone is None:
            if (end - first) // side != read.n_slices:
                raise ValueError(
                    f"give --parts or --quick, because the volume and the scan do not fit together: the volume has "
                    f"{read.n_slices} slices, but rows {first}:{end} of the scan give {(end - first) // side} slices"
                )
            low, high = max(slices.start - _BESIDE, 0), min(slices.stop + _BESIDE, read.n_slices)
            picked = picked.selecting(replace(selection, rows=(first + low * side, first + high * side)))
            slices = slice(slices.start - low, slices.stop - low)
        elif read.limit_sentence:
            raise ValueError(
                "give --quick or --parts, because volumes from halves of cone-beam projections must be reconstructed "
                "with all slices, which do not fit into the memory"
            )
        prepared = prepare_projections(picked, warn)
    views, geometry = prepared.views.seen, prepared.geometry
    order = np.argsort(np.mod(geometry.angles, geometry.period), kind="stable")
    in_pixels = facts.get("pixel_pitch_unit") == "px"
    scale = 1.0 if in_pixels else prepared.geometry.sample_pitch / record.grid.voxel_size  # to the volume's unit
    volumes = []
    for n in range(count):
        tell(n, count)
        chosen = np.sort(order[n::count])
        result = recon.reconstruct(views.select(chosen), method=record.method)
        volumes.append(result.volume.data[slices] * np.float32(scale))
    tell(count, count)
    return volumes
