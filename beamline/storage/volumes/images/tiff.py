"""TIFF volumes: all slices in one file, or a folder with one file per slice."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import tifffile
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import json_of
from beamline.storage.readers.tiff import UNREADABLE, VOLUME, Complaints
from beamline.storage.recon_record import ReconRecord
from beamline.storage.structure import dtype_of, shape_of
from beamline.storage.volumes import REGISTRY
from beamline.storage.volumes.base import Slices, facts_of, marked, record_of

# most bytes of voxels in a TIFF with offsets of 32 bits; larger volumes need a BigTIFF
CLASSIC_TIFF_BYTES = 4_000_000_000
_UNITS = {"mm": "mm", "px": "pixel"}  # names of the axes in ImageJ and OME


@dataclass(frozen=True)
class TiffVolume:
    """One TIFF as an ImageJ hyperstack. From 4 GB on, which is the limit of this format, it is a BigTIFF with OME
    metadata.

    Both state the edges of a voxel in x, y and z. The metadata are JSON in ImageJ's `Info` or OME's `Description`.
    """

    name: str = "TIFF"
    suffixes: tuple[str, ...] = REGISTRY["tiff"].suffixes
    greys: bool = True

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        dtype = slices.pixels.dtype
        big = int(np.prod(slices.shape, dtype=np.int64)) * dtype.itemsize >= CLASSIC_TIFF_BYTES
        facts = json_of(facts_of(record, slices.pixels) | {"shape": slices.shape})
        ome = big or slices.shape[2] == 1  # tifffile takes a single column of an ImageJ file for the samples of a pixel
        tags = _ome(record, facts) if ome else _imagej(record, facts)
        with tifffile.TiffWriter(path, bigtiff=big, ome=ome, imagej=not ome, byteorder="<") as tif:
            tif.write(iter(slices), shape=slices.shape, dtype=dtype, photometric="minisblack", **tags)

    def holds(self, path: Path) -> bool:
        return path.is_file() and path.name.lower().endswith(self.suffixes) and facts_of_imagej(path) is not None

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        facts = facts_of_imagej(path)
        assert facts is not None
        try:
            with Complaints() as complaints, tifffile.TiffFile(path) as tif:
                pages = len(tif.pages)
                shape = shape_of(facts.get("shape"))
                values: NDArray[Any] = tifffile.memmap(path, mode="r").reshape(shape)
                dtype_of(values.dtype.str)
            if complaints.messages or pages != shape[0]:
                raise ValueError(f"{pages} of {shape[0]} slices, {'; '.join(complaints.messages)}")
        except UNREADABLE as error:
            raise DataError(f"{path} cannot be read as a volume ({error}): it is cut off or was changed.") from error
        yield record_of(path, facts, values)


@dataclass(frozen=True)
class TiffFolderVolume:
    """A folder with `slice_00000.tif` and so on. Every file contains the metadata, its own number and the number of
    slices.
    """

    name: str = "folder of TIFFs"
    suffixes: tuple[str, ...] = REGISTRY["tiff_folder"].suffixes
    greys: bool = True

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        path.mkdir()
        tags = _tags(record, json.loads(json_of(facts_of(record, slices.pixels))))
        for z, values in enumerate(slices):
            tags["metadata"] |= {"slice": z, "slices": slices.shape[0]}
            tifffile.imwrite(_slice(path, z), values, **tags)

    def holds(self, path: Path) -> bool:
        return path.is_dir() and _slice(path, 0).is_file() and facts_of_imagej(_slice(path, 0)) is not None

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        facts = facts_of_imagej(_slice(path, 0))
        assert facts is not None
        try:
            stated_shape = facts.get("shape")
            shape = shape_of([facts.get("slices"), *(stated_shape[-2:] if isinstance(stated_shape, list) else ())])
        except ValueError as error:
            raise DataError(
                f"{path} cannot be read as a volume ({error}), because its files were changed after the export."
            ) from error
        names = {item.name for item in path.iterdir()}
        first = next((z for z in range(shape[0]) if _slice(path, z).name not in names), None)
        if first is not None:
            missing = shape[0] - sum(_slice(path, z).name in names for z in range(min(shape[0], first + len(names))))
            n_slices = shape[0]
            raise DataError(
                f"{missing} of {n_slices} slices are missing in {path} (first: {_slice(path, first).name})."
            )
        yield record_of(path, facts, _Stack(path, shape))


@dataclass(frozen=True)
class _Stack:
    """A folder of slices that can be sliced along z like an array."""

    folder: Path
    shape: tuple[int, int, int]

    @property
    def dtype(self) -> np.dtype[Any]:
        return self[0:1].dtype

    def __getitem__(self, part: slice) -> NDArray[Any]:
        return np.stack([self._read(z) for z in range(*part.indices(self.shape[0]))])

    def _read(self, z: int) -> NDArray[Any]:
        path = _slice(self.folder, z)
        try:
            values = tifffile.imread(path)
        except UNREADABLE as error:
            raise DataError(f"{path} cannot be read ({error}).") from error
        if values.shape != self.shape[1:]:
            first_shape = self.shape[1:]
            raise DataError(f"{path} has shape {values.shape}, but slice 0 has {first_shape}.")
        return values


def _slice(folder: Path, z: int) -> Path:
    return folder / f"slice_{z:05d}.tif"


def facts_of_imagej(path: Path) -> dict[str, Any] | None:
    try:
        with Complaints(), tifffile.TiffFile(path) as tif:
            return marked(_note(tif))
    except (*UNREADABLE, ElementTree.ParseError):
        return None


def _note(tif: tifffile.TiffFile) -> str:
    """The text that contains our metadata: ImageJ's information, OME's description, or the description of a slice."""
    if tif.is_imagej:
        return str((tif.imagej_metadata or {}).get("Info", ""))
    if tif.ome_metadata:
        return ElementTree.fromstring(tif.ome_metadata).findtext("{*}Image/{*}Description") or ""
    return str(tif.pages.first.description)


def _imagej(record: ReconRecord, facts: str) -> dict[str, Any]:
    """Pixels per unit, and the distance of slices in this unit, as ImageJ stores them."""
    z, _, x = record.volume.grid.spacing
    metadata = {"axes": "ZYX", "spacing": z, "unit": _UNITS[record.length_unit], "format": VOLUME, "Info": facts}
    return {"resolution": (1 / x, 1 / x), "resolutionunit": "NONE", "metadata": metadata}


def _ome(record: ReconRecord, facts: str) -> dict[str, Any]:
    """The edges of a voxel, as OME stores them."""
    metadata: dict[str, Any] = {"axes": "ZYX", "Description": facts}
    for axis, edge in zip("ZYX", record.volume.grid.spacing, strict=True):
        metadata |= {f"PhysicalSize{axis}": edge, f"PhysicalSize{axis}Unit": _UNITS[record.length_unit]}
    return {"metadata": metadata}


def _tags(record: ReconRecord, facts: dict[str, Any]) -> dict[str, Any]:
    """Values that other programs show: pixels per cm, and the metadata."""
    tags: dict[str, Any] = {"photometric": "minisblack", "metadata": facts}
    if record.length_unit == "mm":
        tags |= {"resolution": (10 / record.volume.grid.voxel_size,) * 2, "resolutionunit": "CENTIMETER"}
    return tags
