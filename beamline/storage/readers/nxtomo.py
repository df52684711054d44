"""Scans as NXtomo lays them out: ours, also while they grow, and those of other programs (`nexus_source`)."""

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
from beamline.storage.flag_legend import FrameFlags, read_flags
from beamline.storage.frame_table import FrameTable
from beamline.storage.parts import decisions_in, gaps_in, pass_ends_in, require_joined
from beamline.storage.readers.base import WHOLE, Opening, ScanFormat, frame_indices
from beamline.storage.readers.nexus import Places, find
from beamline.storage.readers.nexus_source import NexusSource, guarded
from beamline.storage.writers import layout
from beamline.storage.writers.rows import RUNNING, ScanEnding, altered_rows, ending_in, require_earlier
from drivers.base.frame import FrameKind


class OwnScan(NexusSource):
    """A scan file of ours: the frames that its writer has counted, with their log, checksums and flags."""

    def _read_stated(self, found: list[Places]) -> None:
        self._damaged: set[int] = set()
        self._altered = np.zeros(0, np.bool_)
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
                f"{self.path}: the source is {sod:g} mm before the sample and the detector {beyond:g} mm behind it; "
                "expected a positive distance of the source. Correct it in a copy of the file."
            )
        return sod, sod + beyond

    def _check(self) -> None:
        require_joined(self._file)
        super()._check()

    @guarded
    def refresh(self) -> int:
        kinds = datasets.dataset(self._places.entry, "frame_log/kind")
        key = self._places.image_key if kinds is None else kinds
        if (n := self._committed(key)) > self.n or not n or self.finished:
            self.table = self._read_table(key, n, np.inf)
        else:  # of frames that were there nothing else is used before the end
            self.table = replace(self.table, pass_ends=pass_ends_in(self._file))
        self.decisions, self._checksums = decisions_in(self._file), self._column("digest/checksum")
        return self.n

    def _committed(self, key: h5py.Dataset) -> int:
        """The frames that the writer of our file counts; where they are more than before, their datasets are read
        anew."""
        places, committed = self._places, self._file[layout.COMMITTED]
        hdf5.look_again(committed)
        n = int(committed[()])
        if n < 0:
            raise ValueError(f"{n} frames are committed")
        if n > self.n:
            for item in {places.data, key, places.angle, places.image_key} - {None}:
                hdf5.look_again(item)
        return n

    def _read_table(self, key: h5py.Dataset, n: int, most: float) -> FrameTable:
        """With what our log says: alignment frames aside are wide views, frames whose record is altered are invalid."""
        known, table = self._altered.size, super()._read_table(key, n, most)
        if n > known:
            self._altered = np.pad(self._altered, (0, n - known))
            self._altered[known + altered_rows(self._file, known, n)] = True
        kinds, aside, replaces = table.kinds, None, self._column("frame_log/replaces")
        if (moved := self._item(self._places.entry, "sample/x_translation")) is not None:
            aside = datasets.values_of(moved)[:n]
            kinds[(kinds == FrameKind.ALIGNMENT) & (aside != 0)] = FrameKind.WIDE_VIEW
        kinds[self._altered[:n]] = FrameKind.INVALID
        for column in (table.triggers, table.framestamps, replaces):
            if column is not None:
                column[self._altered[:n]] = -1
        if replaces is not None:
            require_earlier(replaces)
        if table.times is not None:
            table.times[self._altered[:n]] = np.nan
        return replace(
            table,
            altered=self._altered[:n],
            aside=aside,
            replaces=replaces if replaces is not None and (replaces >= 0).any() else None,
            part_starts=self._part_starts(),
            pass_ends=pass_ends_in(self._file),
            flags=self._flags(),
        )

    def _flags(self) -> FrameFlags | None:
        flags = read_flags(self._file, self.n)
        return flags if self.plan or flags.flagged.any() else None  # a copy has none to say

    def _part_starts(self) -> NDArray[np.int64]:
        item = datasets.dataset(self._file, layout.PART_STARTS)
        starts = np.zeros(1, np.int64) if item is None else np.ravel(datasets.values_of(item))
        if starts.dtype.kind not in "iu" or not starts.size or starts[0] != 0 or (starts[1:] <= starts[:-1]).any():
            raise DataError(f"{self.path}: {layout.PART_STARTS} is {starts}; expected ascending rows, the first 0.")
        return starts.astype(np.int64)

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
    """The scan in an open file; arguments as of `NexusSource`."""
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
