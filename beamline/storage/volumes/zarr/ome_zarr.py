"""OME-Zarr 0.5: a folder with the volume at several scales, each in uncompressed chunks, for viewers that load only
what they show.

The axes and scales are those of ngff.openmicroscopy.org/0.5; zarr, the format's library, writes and reads the
arrays.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import json_of
from beamline.core.files import SETTINGS, bytes_below
from beamline.storage.array_file import zarr_library
from beamline.storage.foreign_zarr import open_zarr
from beamline.storage.readers.tiff import VOLUME
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volumes import REGISTRY
from beamline.storage.volumes.base import Slices, facts_of, marked, record_of

_CHUNK = 16, 256, 256  # voxels along each side of a chunk
_SMALLEST = 256  # voxels along a side; no scale is made below this size
_KEY = "splatline"


@dataclass(frozen=True)
class OmeZarr:
    """OME-Zarr. Each scale averages 2 x 2 x 2 voxels of the scale before. The metadata are JSON in `splatline`."""

    name: str = "OME-Zarr"
    suffixes: tuple[str, ...] = REGISTRY["ome_zarr"].suffixes
    greys: bool = True

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        zarr, levels = zarr_library(path), _levels(slices.shape)
        path.mkdir()  # raises an error if the folder exists
        group = zarr.create_group(str(path), zarr_format=3)
        scales = [
            group.create_array(
                str(n),
                shape=shape,
                chunks=tuple(min(pair) for pair in zip(shape, _CHUNK, strict=True)),
                dtype=slices.pixels.dtype,
                compressors=None,
                dimension_names=["z", "y", "x"],
                config={"write_empty_chunks": True},
            )
            for n, shape in enumerate(levels)
        ]
        values = iter(slices)
        for z in range(0, slices.shape[0], _CHUNK[0]):
            block = np.stack([*itertools.islice(values, _CHUNK[0])])
            scales[0][z : z + len(block)] = block
        for finer, coarser in itertools.pairwise(scales):
            for z in range(0, coarser.shape[0], _CHUNK[0]):
                end = min(z + _CHUNK[0], coarser.shape[0])
                coarser[z:end] = _means(finer, coarser, z, end)
        group.attrs.update({"ome": _ome(record, levels), _KEY: json_of(facts_of(record, slices.pixels))})

    def holds(self, path: Path) -> bool:
        return path.is_dir() and _facts(path) is not None

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        facts, (finest, _) = _facts(path), open_zarr(path)
        assert facts is not None
        for scale in (finest, *finest.coarser):
            if lost := scale.array.nchunks - scale.array.nchunks_initialized:
                raise DataError(
                    f"{path} is cut off or was changed: {lost} of {scale.array.nchunks} chunks of the "
                    f"scale {scale.array.basename} are missing."
                )
        yield record_of(path, facts, finest)


def _means(finer: Any, coarser: Any, z: int, end: int) -> NDArray[Any]:
    """The slices from `z` to `end` of a scale, computed from the finer scale."""
    fz, fy, fx = (2 if n > m else 1 for n, m in zip(finer.shape, coarser.shape, strict=True))
    _, rows, cols = coarser.shape
    part = finer[z * fz : end * fz, : rows * fy, : cols * fx].reshape(end - z, fz, rows, fy, cols, fx)
    means = part.mean(axis=(1, 3, 5), dtype=np.float32)
    return (np.rint(means) if coarser.dtype.kind == "u" else means).astype(coarser.dtype)


def _levels(shape: tuple[int, int, int]) -> list[tuple[int, int, int]]:
    """Shapes of the scales. Each scale is half as large as the scale before along the sides that are longer than one
    voxel.
    """
    levels = [shape]
    while max(levels[-1]) > _SMALLEST:
        z, y, x = (max(1, n // 2) for n in levels[-1])
        levels.append((z, y, x))
    return levels


def _ome(record: ReconRecord, levels: list[tuple[int, int, int]]) -> dict[str, Any]:
    """The axes, and for each scale the edge of a voxel and the centre of the first voxel."""
    grid, unit = record.volume.grid, {"unit": "millimeter"} if record.length_unit == "mm" else {}
    datasets = []
    first, edge = [float(centres[0]) for centres in grid.coordinates()], [float(size) for size in grid.spacing]
    for n, shape in enumerate(levels):
        if n:
            halved = [2 if a > b else 1 for a, b in zip(levels[n - 1], shape, strict=True)]
            first = [centre + size * (by - 1) / 2 for centre, size, by in zip(first, edge, halved, strict=True)]
            edge = [size * by for size, by in zip(edge, halved, strict=True)]
        steps = [{"type": "scale", "scale": edge}, {"type": "translation", "translation": first}]
        datasets.append({"path": str(n), "coordinateTransformations": steps})
    axes = [{"name": name, "type": "space", **unit} for name in "zyx"]
    image = {"name": record.title, "axes": axes, "datasets": datasets, "type": "mean"}
    return {"version": "0.5", "multiscales": [image]}


def _facts(path: Path) -> dict[str, Any] | None:
    try:
        text = bytes_below(path, "zarr.json", SETTINGS).decode()
        return marked(json.loads(text)["attributes"][_KEY]) if VOLUME in text else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
