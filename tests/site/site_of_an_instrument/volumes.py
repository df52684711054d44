"""A format of volumes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamline.storage.recon_record import ReconRecord
from beamline.storage.volumes.base import Slices, bare_record


@dataclass(frozen=True)
class Raw:
    """Float32 voxels after a line with their shape."""

    name: str = "raw voxels"
    suffixes: tuple[str, ...] = (".raw",)
    greys: bool = False

    def write(self, path: Path, record: ReconRecord, slices: Slices) -> None:
        with path.open("xb") as file:
            file.write((" ".join(map(str, slices.shape)) + "\n").encode())
            for values in slices:
                file.write(values.tobytes())

    def holds(self, path: Path) -> bool:
        return path.is_file() and path.suffix == ".raw"

    @contextmanager
    def open(self, path: Path) -> Iterator[ReconRecord]:
        line = path.open("rb").readline()
        shape = tuple(map(int, line.split()))
        yield bare_record(path, np.memmap(path, np.float32, "r", len(line), shape))
