"""OME-Zarr 0.5: a folder with the volume in several scales, each in raw chunks, for viewers that load what they show.

A Zarr 3 array without a compressor is a zarr.json and a file for each chunk with its voxels in order (Zarr core 3.0,
zarr-specs.readthedocs.io). It is written here; the axes and scales are those of ngff.openmicroscopy.org/0.5.
"""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import SETTINGS, bytes_below, open_below
from beamline.storage.foreign_zarr import is_halved
from beamline.storage.readers.tiff import VOLUME
from beamline.storage.recon_record import ReconRecord
from beamline.storage.structure import dtype_of, require_held, shape_of
from beamline.storage.volumes.base import Slices, facts_of, marked, record_of
from beamline.storage.volumes.registry import REGISTRY

_CHUNK = 16, 256, 256  # voxels
_SMALLEST = 256  # voxels along a side, below which no further scale is made
_SCALES = 32  # at most: each halves the one before
_META = "zarr.json"
_KEY = "splatline"


@dataclass(frozen=True)
class OmeZarr:
    """OME-Zarr; every scale averages 2 x 2 x 2 voxels of the one before; the metadata are JSON in `splatline`."""

    name: str = "OME-Zarr"
    suffixes: tuple[str, ...] = REGISTRY["ome_zarr"].suffixes
    greys: bool = True

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        path.mkdir()
        dtype, levels = slices.pixels.dtype, _levels(slices.shape)
        scales = [_Scale(path / str(n), shape, dtype) for n, shape in enumerate(levels)]
        for finer, coarser in itertools.pairwise(scales):
            finer.coarser = coarser
        for values in slices:
            scales[0].add(values)
        attributes = {"ome": _ome(record, levels), _KEY: json.dumps(facts_of(record, slices.pixels))}
        _write_json(path / _META, {"zarr_format": 3, "node_type": "group", "attributes": attributes})

    def holds(self, path: Path) -> bool:
        return path.is_dir() and _facts(path) is not None

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        facts = _facts(path)
        assert facts is not None
        try:
            scales = [_opened(path, "0")]
            with suppress(FileNotFoundError):
                for n in range(1, _SCALES):
                    scales.append(_opened(path, str(n)))
            if not all(is_halved(scales[0].shape, scale) for scale in scales):
                raise ValueError(f"its scales have the shapes {[scale.shape for scale in scales]}")
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise DataError(f"{path} cannot be read as a volume ({error}): it is cut off, or was changed.") from error
        yield record_of(path, facts, replace(scales[0], coarser=tuple(scales[1:])))


class _Scale:
    """A scale that takes slices one after another, and passes halved ones to the next scale."""

    def __init__(self, folder: Path, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> None:
        self._folder, self._shape, self._dtype = folder, shape, dtype
        self._chunk = tuple(min(size, most) for size, most in zip(shape, _CHUNK, strict=True))
        self._waiting: list[NDArray[Any]] = []  # for a row of chunks
        self._odd: NDArray[np.float32] | None = None  # the first of two slices that become one
        self._added = 0
        self.coarser: _Scale | None = None
        folder.mkdir()
        _write_json(folder / _META, _array(shape, self._chunk, dtype))

    def add(self, values: NDArray[Any]) -> None:
        self._waiting.append(values)
        self._added += 1
        if len(self._waiting) == self._chunk[0] or self._added == self._shape[0]:
            self._flush()
        if self.coarser is not None:
            self._hand_on(self.coarser, values)

    def _hand_on(self, coarser: _Scale, values: NDArray[Any]) -> None:
        rows, cols = coarser._shape[1:]
        fy, fx = (2 if n > m else 1 for n, m in zip(self._shape[1:], (rows, cols), strict=True))
        part = values[: rows * fy, : cols * fx].astype(np.float32)
        half = part.reshape(rows, fy, cols, fx).mean(axis=(1, 3), dtype=np.float32)
        if self._shape[0] > coarser._shape[0]:
            if self._odd is None:
                self._odd = half
                return
            half, self._odd = (self._odd + half) / 2, None
        if coarser._added < coarser._shape[0]:
            coarser.add((np.rint(half) if self._dtype.kind == "u" else half).astype(self._dtype))

    def _flush(self) -> None:
        block, (deep, high, wide) = np.stack(self._waiting), self._chunk
        n = (self._added - 1) // deep
        self._waiting = []
        for i in range(-(-self._shape[1] // high)):
            row = self._folder / "c" / str(n) / str(i)
            row.mkdir(parents=True)
            for j in range(-(-self._shape[2] // wide)):
                part = block[:, i * high : (i + 1) * high, j * wide : (j + 1) * wide]
                whole = np.zeros(self._chunk, self._dtype)
                whole[: part.shape[0], : part.shape[1], : part.shape[2]] = part
                (row / str(j)).write_bytes(whole.data)


def _opened(path: Path, name: str) -> _Chunks:
    metadata = json.loads(bytes_below(path, f"{name}/{_META}", SETTINGS))
    if (codecs := [str(each["name"]) for each in metadata["codecs"]]) != ["bytes"]:
        raise ValueError(f"its chunks are encoded by {', '.join(codecs)}, but only raw ones are read")
    chunk = shape_of(metadata["chunk_grid"]["configuration"]["chunk_shape"], "chunk")
    return _Chunks(path, name, shape_of(metadata["shape"]), chunk, dtype_of(metadata["data_type"]))


@dataclass(frozen=True)
class _Chunks:
    """A scale, sliced along z as an array is; the finest one has the others in `coarser` (`base.VolumeScale`)."""

    path: Path  # of the whole volume
    name: str
    shape: tuple[int, int, int]
    chunk: tuple[int, int, int]
    dtype: np.dtype[Any]
    coarser: tuple[_Chunks, ...] = ()
    whole_chunks = False

    def __getitem__(self, part: slice) -> NDArray[Any]:
        first, end, step = part.indices(self.shape[0])
        out = np.empty((len(range(first, end, step)), *self.shape[1:]), self.dtype)
        at = np.arange(first, end, step)
        for n in np.unique(at // self.chunk[0]):
            mine = at // self.chunk[0] == n
            out[mine] = self._row(int(n))[at[mine] % self.chunk[0]]
        return out

    def box(self, first: tuple[int, int, int], end: tuple[int, int, int]) -> NDArray[Any]:
        """The voxels of a box, from the pages of the files that hold them."""
        out = np.empty([b - a for a, b in zip(first, end, strict=True)], self.dtype)
        chunks = [range(a // n, -(-b // n)) for a, b, n in zip(first, end, self.chunk, strict=True)]
        for at in itertools.product(*chunks):
            here, there = [], []
            for i, n, a, b in zip(at, self.chunk, first, end, strict=True):
                low, high = max(a, i * n), min(b, (i + 1) * n)
                here.append(slice(low - i * n, high - i * n))
                there.append(slice(low - a, high - a))
            out[tuple(there)] = self._read(*at, mapped=True)[tuple(here)]
        return out

    def _row(self, n: int) -> NDArray[Any]:
        (_, high, wide), (_, rows, cols) = self.chunk, self.shape
        across, down = range(-(-cols // wide)), range(-(-rows // high))
        lines = [np.concatenate([self._read(n, i, j) for j in across], axis=2) for i in down]
        return np.concatenate(lines, axis=1)[:, :rows, :cols]

    def _read(self, *at: int, mapped: bool = False) -> NDArray[Any]:
        name, n_bytes = "/".join((self.name, "c", *map(str, at))), math.prod(self.chunk) * self.dtype.itemsize
        try:
            with open_below(self.path, name, n_bytes) as file:
                require_held(self.chunk, self.dtype, 0, os.fstat(file.fileno()).st_size)
                if mapped:
                    return np.memmap(file, self.dtype, "r", shape=self.chunk)
                return np.fromfile(file, self.dtype, math.prod(self.chunk)).reshape(self.chunk)
        except (OSError, ValueError) as error:
            raise DataError(
                f"{self.path / name} cannot be read ({error}): the volume is cut off, or was changed."
            ) from error


def _levels(shape: tuple[int, int, int]) -> list[tuple[int, int, int]]:
    """Shapes of the scales, each half of the one before along the sides that are longer than one voxel."""
    levels = [shape]
    while max(levels[-1]) > _SMALLEST:
        z, y, x = (max(1, n // 2) for n in levels[-1])
        levels.append((z, y, x))
    return levels


def _array(shape: tuple[int, ...], chunk: tuple[int, ...], dtype: np.dtype[Any]) -> dict[str, Any]:
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0,
        "codecs": [{"name": "bytes", **({"configuration": {"endian": "little"}} if dtype.itemsize > 1 else {})}],
        "attributes": {},
        "dimension_names": ["z", "y", "x"],
    }


def _ome(record: ReconRecord, levels: list[tuple[int, int, int]]) -> dict[str, Any]:
    """Axes, and of each scale the edge of a voxel and the centre of the first one."""
    grid, unit = record.volume.grid, {"unit": "millimeter"} if record.length_unit == "mm" else {}
    datasets = []
    first, edge = [float(centres[0]) for centres in grid.coordinates()], [float(size) for size in grid.spacing]
    for n, shape in enumerate(levels):
        if n:
            halved = [2 if a > b else 1 for a, b in zip(levels[n - 1], shape, strict=True)]
            first = [at + size * (by - 1) / 2 for at, size, by in zip(first, edge, halved, strict=True)]
            edge = [size * by for size, by in zip(edge, halved, strict=True)]
        steps = [{"type": "scale", "scale": edge}, {"type": "translation", "translation": first}]
        datasets.append({"path": str(n), "coordinateTransformations": steps})
    axes = [{"name": name, "type": "space", **unit} for name in "zyx"]
    image = {"name": record.title, "axes": axes, "datasets": datasets, "type": "mean"}
    return {"version": "0.5", "multiscales": [image]}


def _facts(path: Path) -> dict[str, Any] | None:
    try:
        text = bytes_below(path, _META).decode()
        return marked(json.loads(text)["attributes"][_KEY]) if VOLUME in text else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _write_json(path: Path, said: dict[str, Any]) -> None:
    path.write_text(json.dumps(said, indent=1), encoding="utf-8")
