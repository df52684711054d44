"""NXtomoproc: the format that holds everything a volume was made with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.volumes.base import Slices
from beamline.storage.volumes.registry import REGISTRY
from beamline.storage.writers.recon_file import DEFINITION, ReconRecord, opened_reconstruction, write_record


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
