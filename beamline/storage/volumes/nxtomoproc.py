"""Volumes in NeXus files: NXtomoproc, which holds everything a volume was made with, and any other as it is plotted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import h5py

from beamline.core.errors import DataError
from beamline.core.voxel_kind import VoxelKind
from beamline.storage import hdf5
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volume_file import axes_of
from beamline.storage.volumes.base import Slices, bare_record
from beamline.storage.volumes.registry import REGISTRY
from beamline.storage.writers.recon_file import DEFINITION, opened_reconstruction, write_record
from recon.base.volume import Volume


@dataclass(frozen=True)
class NXtomoproc:
    """HDF5, float32, with all settings, figures of merit and the history."""

    name: str = "HDF5 (NXtomoproc)"
    suffixes: tuple[str, ...] = REGISTRY["hdf5"].suffixes
    greys: bool = False

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        write_record(path, record)

    def holds(self, path: Path) -> bool:
        if not path.is_file() or not hdf5.is_hdf5(path):
            return False
        try:
            with hdf5.open_hdf5(path) as file:
                return hdf5.text_at(file, "entry/definition") == DEFINITION
        except (DataError, OSError, TypeError):
            return False

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        with opened_reconstruction(path) as record:
            yield record


@dataclass(frozen=True)
class NexusVolume:
    """HDF5 whose default plot has the axes z, y, x: a truth of `simulate`, labels of `segment`; read, never written."""

    name: str = "HDF5 (NXdata)"
    suffixes: tuple[str, ...] = ()
    greys: bool = False

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        raise ValueError(f"{self.name} can only be read; write {NXtomoproc().name}.")

    def holds(self, path: Path) -> bool:
        if not path.is_file() or not hdf5.is_hdf5(path):
            return False
        try:
            with hdf5.open_hdf5(path) as file:
                return _plotted(file) is not None
        except (DataError, *hdf5.ALTERED):
            return False

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        with hdf5.open_hdf5(path) as file, hdf5.readable(path):
            values = _plotted(file)
            assert values is not None
            spacing, first = axes_of(file, str(values.name))
            record = bare_record(path, values, spacing)  # type: ignore[arg-type]
            if spacing is not None and first is not None:
                half = [(n - 1) / 2 * edge for n, edge in zip(values.shape, spacing, strict=True)]
                z, y, x = (low + middle for low, middle in zip(first, half, strict=True))
                grid = replace(record.volume.grid, centre=(z, y, x))
                record = replace(record, volume=Volume(values, grid))
            yield replace(record, kind=VoxelKind.of_unit(hdf5.attribute(values, "units")))


def _plotted(file: h5py.File) -> h5py.Dataset | None:
    """The volume [z, y, x] that the file's attributes `default` and `signal` name; None without one."""
    entry = hdf5.resolve(file, hdf5.attribute(file, "default") or "entry")
    data = hdf5.resolve(entry, hdf5.attribute(entry, "default") or "data") if isinstance(entry, h5py.Group) else None
    if not isinstance(data, h5py.Group) or [hdf5.text(name) for name in data.attrs.get("axes", ())] != ["z", "y", "x"]:
        return None
    values = hdf5.dataset(data, hdf5.attribute(data, "signal"))
    return values if values is not None and values.ndim == 3 and values.dtype.kind in "uif" else None
