"""NXtomo scan files: those of this program, also while they grow, and those of other programs (`nexus_source`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.core.process import json_object
from beamline.monitor.digest import has_checksum
from beamline.plan.passes import ended_by
from beamline.storage import datasets, hdf5
from beamline.storage.flag_legend import read_flags
from beamline.storage.parts import gaps_in, require_joined
from beamline.storage.readers.base import WHOLE, Opening, ScanFormat, frame_indices
from beamline.storage.readers.nexus import Places, find
from beamline.storage.readers.nexus_source import NexusSource, guarded
from beamline.storage.recorded_frames import decisions_in, frames_in, pass_ends_in
from beamline.storage.writers import layout
from beamline.storage.writers.rows import RUNNING, ScanEnding, ending_in


class OwnScan(NexusSource):
    """A scan file of this program: the frames that its writer has marked as complete, with their log, checksums and
    flags.
    """

    def _read_stated(self, found: list[Places]) -> None:
        self._damaged: set[int] = set()
        self.pixel_size_mm = datasets.scalar(self._places.detector, "x_pixel_size", datasets.LENGTH_UNITS)
        self.cone = self._cone()
        self.plan = json_object(datasets.text_at(self._file, "/entry/record/plan")) or {}
        self.refresh()
        devices = (self._file.get("/entry/instrument/devices") or {}).values()
        periods = (float(device["row_period"][()]) for device in devices if "row_period" in device)
        self.row_period = next(periods, None)

    def _cone(self) -> tuple[float, float] | None:
        sod = datasets.scalar(self._file, layout.SOURCE_DISTANCE, datasets.LENGTH_UNITS)
        beyond = datasets.scalar(self._places.detector, "distance", datasets.LENGTH_UNITS)
        if sod is None or beyond is None:
            return None
        if sod <= 0 or beyond < 0:
            raise DataError(
                f"{self.path}: the source is {sod:g} mm in front of the sample and the detector "
                f"{beyond:g} mm behind it; expected a source distance above 0. Correct it in a copy of "
                "the file."
            )
        return sod, sod + beyond

    def _check(self) -> None:
        require_joined(self._file)
        super()._check()

    @guarded
    def refresh(self) -> int:
        if (n := self._committed()) > self.n or not n or self.finished:
            self.n, flags = n, read_flags(self._file, n)
            known = self.plan or flags.flagged.any()  # a copy has none to say
            self.table = replace(frames_in(self._file, n), flags=flags if known else None)
        else:  # of frames that were there nothing else is used before the end
            self.table = replace(self.table, pass_ends=pass_ends_in(self._file))
        self.decisions, self._checksums = decisions_in(self._file), self._column("digest/checksum")
        return n

    def _committed(self) -> int:
        """The number of frames that the writer of the file has marked as complete; if it has grown, their pixels are
        read again.
        """
        committed = self._file[layout.COMMITTED]
        hdf5.look_again(committed)
        n = int(committed[()])
        if n < 0:
            raise ValueError(f"{n} frames are marked as complete")
        if n > self.n:  # those that are open here: HDF5 2.0 reads wrong values if another handle refreshes them
            for item in {self._places.data, self._places.image_key, self._places.angle} - {None}:
                hdf5.look_again(item)
        if len(self._places.data) < n:
            raise DataError(f"{self.path} has {len(self._places.data)} frames; expected {n}.")
        return n

    @property
    @guarded
    def finished(self) -> bool:
        flag = self._file[layout.FINISHED]
        hdf5.look_again(flag)
        return bool(flag[()])

    @property
    @guarded
    def attributes(self) -> dict[str, str | float | int]:
        """Further metadata: sample, title, times, status, missing triggers, why the scan ended early."""
        ending, reason = ending_in(self._file), self.ending.reason
        facts = super().attributes | {"status": ending.status, "missing_triggers": len(ending.missing)}
        return facts | ({"ended": reason} if reason else {})

    @property
    @guarded
    def ending(self) -> ScanEnding:
        ending = ending_in(self._file)
        own = {"reason": ending.reason or ended_by(self.decisions)}
        return replace(ending, **({"missing": gaps_in(self.path, self._file)} if ending.status == RUNNING else own))

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices, height = frame_indices(frames, self.n), len(range(self.shape[0])[rows])
        if 2 * height < self.shape[0] or not self.checksummed:
            return super().read(indices, rows)
        out = np.empty((indices.size, height, self.shape[1]), self.dtype)
        for view, row in zip(out, indices, strict=True):
            view[:] = self._compared(row)[rows]
        return out

    def _compared(self, row: int) -> NDArray[Any]:
        whole = super().read([row])
        if self._checksums is not None and not has_checksum(whole[0], int(self._checksums[row])):
            self._damaged.add(int(row))
        return whole[0]

    @property
    def checksummed(self) -> bool:
        return self._checksums is not None and self.n > 0

    @property
    def damaged(self) -> frozenset[int]:
        return frozenset(self._damaged)

    def _item(self, group: h5py.Group, path: str) -> h5py.Dataset | None:
        item = datasets.dataset(group, path)
        if item is not None:
            hdf5.look_again(item)
        return item


def open_nxtomo(path: Path, *, follow: bool = False, own_angles: bool = True, data: str | None = None) -> NexusSource:
    """The scan in an open file; arguments as for `NexusSource`."""
    file = hdf5.open_hdf5(path, follow)
    with hdf5.closed_on_error(file):
        return (OwnScan if layout.COMMITTED in file else NexusSource)(path, file, own_angles, data)


def _recognises(path: Path, opening: Opening) -> bool:
    if not path.is_file() or not hdf5.is_hdf5(path, opening.follow):
        return False
    with hdf5.open_hdf5(path, opening.follow) as file:
        return bool(find(file))


FORMAT = ScanFormat(
    "an NXdetector with frames and an image_key (NXtomo)",
    _recognises,
    lambda path, opening: open_nxtomo(path, follow=opening.follow, own_angles=opening.own_angles),
)
