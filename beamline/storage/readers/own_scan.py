"""OwnScan: a scan file of this program as a ScanSource, with its log, checksums and flags, also while it grows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.core.process import json_object
from beamline.core.text import count
from beamline.monitor.digest import has_checksum
from beamline.plan.passes import ended_by
from beamline.storage import datasets, hdf5, scan_file
from beamline.storage.datasets import require_real
from beamline.storage.flag_legend import read_flags
from beamline.storage.frame_table import FrameTable
from beamline.storage.parts import gaps_in, require_joined
from beamline.storage.readers.base import WHOLE, ScanSource, frame_indices
from beamline.storage.readers.nexus import read_energy
from beamline.storage.readers.nxtomo import format_of, quantity_of, stated_facts
from beamline.storage.recorded_frames import decisions_in, frames_in, pass_ends_in
from beamline.storage.scan_file import ScanFile
from beamline.storage.structure import drawn_on
from beamline.storage.writers import layout
from beamline.storage.writers.rows import RUNNING, ScanEnding, ending_in


class OwnScan(ScanSource):
    """The frames of a scan file of this program. Only frames that the writer has marked as complete are read. See
    ScanSource.
    """

    def __init__(self, scan: ScanFile) -> None:
        """Read an open file, which this object closes later. Raises DataError if something is missing that a writer
        always stores.
        """
        file, entry = scan.file, scan.file[layout.ENTRY]
        self.path, self._scan, self._damaged = scan.path, scan, set[int]()
        self._checksums: NDArray[np.int64] | None = None
        self._check()
        self.shape, self.dtype, self.format = scan.shape, scan.dtype, format_of(entry)
        self.quantity = quantity_of(datasets.text_at(entry, "record/quantity"), scan.data.id.dtype)
        self.energy_kev = read_energy(entry)
        self.axis_col = datasets.scalar(file, layout.AXIS_COL, {"pixel": 1.0})
        self.pixel_size_mm = datasets.scalar(file, f"{layout.DETECTOR}/x_pixel_size", datasets.LENGTH_UNITS)
        self.cone = self._cone()
        self.plan = json_object(datasets.text_at(entry, "record/plan")) or {}
        self.table = FrameTable.of(np.zeros(0))
        self.refresh()
        devices = (file.get("/entry/instrument/devices") or {}).values()
        periods = (float(device["row_period"][()]) for device in devices if "row_period" in device)
        self.row_period = next(periods, None)

    def _check(self) -> None:
        data, keys = self._scan.data, self._scan.file[layout.KIND]
        require_joined(self._scan.file)
        for item in (data, keys):
            require_real(item.dtype, f"{item.name} in {self.path}")
        self.unpack_bytes = datasets.require_possible(data)
        if lost := datasets.missing_links(data):
            raise DataError(
                f"{self.path} refers to frames in {lost[0]}, which does not exist or has another shape "
                f"({count(len(lost), 'such link')})."
            )

    def _cone(self) -> tuple[float, float] | None:
        places = layout.SOURCE_DISTANCE, f"{layout.DETECTOR}/distance"
        sod, detector_distance = (datasets.scalar(self._scan.file, each, datasets.LENGTH_UNITS) for each in places)
        if sod is None or detector_distance is None:
            return None
        if sod <= 0 or detector_distance < 0:
            raise DataError(
                f"{self.path}: the source is {sod:g} mm in front of the sample and the detector {detector_distance:g} "
                "mm behind it; expected a source distance above 0. Correct the distances in a copy of the file."
            )
        return sod, sod + detector_distance

    @hdf5.guarded
    def refresh(self) -> int:
        scan, known = self._scan, len(self.table)
        if (n := scan.committed()) > known or not n or self.finished:
            flags = read_flags(scan.file, n)
            stated = self.plan or flags.flagged.any()  # a copy has neither
            self.table = replace(frames_in(scan.file, n), flags=flags if stated else None)
        else:  # no new frames: before the end, only pass ends can have changed
            self.table = replace(self.table, pass_ends=pass_ends_in(scan.file))
        self.decisions, self._checksums = decisions_in(scan.file), self._stored_checksums(n)
        return n

    def _stored_checksums(self, n: int) -> NDArray[np.int64] | None:
        """The checksums of the pixels of n frames; None if the file has no checksums."""
        values = np.asarray(self._scan.values(PIXEL_CHECKSUM)) if PIXEL_CHECKSUM in self._scan.file else np.zeros(0)
        listed = values.ndim == 1 and values.size >= n and values.dtype.kind in "ui"
        return values[:n].astype(np.int64) if listed else None

    @property
    @hdf5.guarded
    def finished(self) -> bool:
        return self._scan.finished

    @property
    @hdf5.guarded
    def attributes(self) -> dict[str, str | float | int]:
        """Further metadata: sample, title, times, status, missing triggers, why the scan ended early."""
        ending, reason = ending_in(self._scan.file), self.ending.reason
        facts = stated_facts(self._scan.file[layout.ENTRY], self.table.exposures)
        if self._scan.data.is_virtual:
            facts["parts"] = ", ".join(name for name, _ in drawn_on(self._scan.data.id.get_create_plist()))
        facts |= {"status": ending.status, "missing_triggers": len(ending.missing)}
        return facts | ({"ended": reason} if reason else {})

    @property
    @hdf5.guarded
    def ending(self) -> ScanEnding:
        ending = ending_in(self._scan.file)
        own = {"reason": ending.reason or ended_by(self.decisions)}
        return replace(
            ending, **({"missing": gaps_in(self.path, self._scan.file)} if ending.status == RUNNING else own)
        )

    @property
    def frame_bytes(self) -> int:
        return datasets.bytes_unpacked(self._scan.data)

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices, height = frame_indices(frames, len(self.table)), len(range(self.shape[0])[rows])
        out = np.empty((indices.size, height, self.shape[1]), self.dtype)
        if 2 * height < self.shape[0] or not self.checksummed:
            datasets.read_frames(self._scan.data, indices, rows, out)
            return out
        whole = np.empty((1, *self.shape), self.dtype)
        for view, row in zip(out, indices, strict=True):
            datasets.read_frames(self._scan.data, np.array([row]), WHOLE, whole)
            if self._checksums is not None and not has_checksum(whole[0], int(self._checksums[row])):
                self._damaged.add(int(row))
            view[:] = whole[0, rows]
        return out

    @property
    def checksummed(self) -> bool:
        return self._checksums is not None and len(self.table) > 0

    @property
    def damaged(self) -> frozenset[int]:
        return frozenset(self._damaged)

    def holds(self, path: str) -> bool:
        """True if the dataset at this path contains the frames."""
        return bool(datasets.resolve(self._scan.file, path) == self._scan.data)

    def close(self) -> None:
        self._scan.close()


PIXEL_CHECKSUM = "/entry/digest/checksum"


def open_own(path: Path, follow: bool = False) -> OwnScan | None:
    """The scan in a file of this program; None if another program wrote the file. Raises the same errors as
    `scan_file.opened`.
    """
    scan = scan_file.opened(path, follow)
    if scan is None:
        return None
    with hdf5.closed_on_error(scan), hdf5.readable(path):
        return OwnScan(scan)
