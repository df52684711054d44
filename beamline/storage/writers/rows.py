"""Writes the rows of a scan file, one for each frame, and the final entries of the file.

The final entries state how the scan ended, and which triggers gave no frame and why. They also contain the view
/exchange of the frames. Its layout is that of De Carlo et al. (2014), "Scientific data exchange: a schema for
HDF5-based storage of raw and analyzed data", J. Synchrotron Rad. 21, 1224: data, data_white and data_dark [frame, row,
col], and theta in degrees. They are virtual datasets, so no pixels are copied.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.text import size
from beamline.monitor.checks import ALARMS
from beamline.monitor.digest import FrameDigest
from beamline.storage import datasets, hdf5
from beamline.storage.flag_legend import FLAGS, REGIONS, SCORES, UNMARKED, VALID, Mark
from beamline.storage.recorded_frames import codes_of, frames_in, record_checksums
from beamline.storage.writers import layout
from drivers.base.frame import Frame, FrameKind
from recon.base.arrays import I64

ROOM = 2**24  # bytes on the disk, far more than the /exchange view needs
PER_FLUSH = 64  # rows written before a flush if nobody is reading yet


class Rows:
    """Writes rows into a file that create() made. It only accesses existing datasets, and cannot create or delete any.

    Pixels are written at once, metadata at `flush`: writing the columns of several rows takes as long as writing those
    of one row.
    """

    def __init__(self, file: h5py.File) -> None:
        self._data: h5py.Dataset = file[layout.DATA]
        self._preview: h5py.Dataset = file[layout.PREVIEW]
        self._columns: dict[str, h5py.Dataset] = {path: file[path] for path in layout.growing(file)}
        self._types = {path: column.dtype for path, column in self._columns.items()}
        self._first, self._pending = 0, list[dict[str, Any]]()

    def write(self, frame: Frame, digest: FrameDigest, mark: Mark = UNMARKED) -> None:
        """Write the row `frame.index`, which exists or is the next one. Pixels are written at once, metadata at the
        next `flush`.

        If the frame replaces a projection, that projection becomes an invalid frame, so that no program uses both.
        """
        row = frame.index
        if row != self._first + len(self._pending):
            self.flush()
            self._first = row
        values = {
            **codes_of(frame.kind),
            layout.X_TRANSLATION: frame.aside,
            layout.COUNT_TIME: frame.exposure,
            layout.ANGLE: math.degrees(frame.angle),
            layout.TRIGGER: frame.trigger,
            layout.FRAMESTAMP: frame.framestamp,
            layout.TIME: frame.time,
            layout.REPLACES: frame.replaces,
            FLAGS: mark.bits,
            VALID: mark.valid,
            SCORES: mark.scores,
            REGIONS: mark.regions,
            layout.RECORD_CHECKSUM: 0,  # computed when the rows are written
        } | {f"/entry/digest/{name}": value for name, value in vars(digest).items()}
        for dataset, pixels in ((self._data, frame.counts), (self._preview, digest.preview)):
            self._grow(dataset, row + 1)
            dataset.id.write_direct_chunk((row, 0, 0), np.ascontiguousarray(pixels, dataset.dtype))
        self._pending.append({path: values[path] for path in self._columns})
        if frame.replaces >= 0:
            self.flush()
            for path, code in codes_of(FrameKind.INVALID).items():
                self._columns[path][frame.replaces] = code

    def flush(self) -> None:
        """Write the metadata of the rows since the last call. The caller then flushes the file."""
        if not self._pending:
            return
        n, record = len(self._pending), dict[str, NDArray[Any]]()
        for path, column in self._columns.items():  # the checksum of the record is the last column
            if path == layout.RECORD_CHECKSUM:
                values = record_checksums(record)
            else:
                values = np.array([row[path] for row in self._pending], self._types[path])
            if path in layout.RECORDED:
                record[path] = values
            self._grow(column, self._first + n)
            place = column.id.get_space()  # for twenty columns this takes a quarter of the time of h5py's usual way
            place.select_hyperslab((self._first, *(0,) * (values.ndim - 1)), values.shape)
            column.id.write(h5py.h5s.create_simple(values.shape), place, values)
        self._first, self._pending = self._first + n, []

    def add_flags(self, rows: range, bits: int) -> None:
        """Flag existing rows, if a check found a fault in them only after it saw later frames."""
        self.flush()
        flags = self._columns[FLAGS][rows.start : rows.stop]
        marked = flags | np.uint64(bits)
        if (marked != flags).any():
            self._columns[FLAGS][rows.start : rows.stop] = marked
            self._columns[VALID][rows.start : rows.stop] = marked & np.uint64(ALARMS) == 0

    def add_place(self, check: int, frame: int, score: float, regions: Mapping[int, Sequence[int]]) -> None:
        """Store the score of a flag in the row of its frame, and its regions in existing rows. `check` is the index of
        the check in the legend.
        """
        self._columns[SCORES][frame, check] = score
        for row, box in regions.items():
            self._columns[REGIONS][row, check] = box

    @staticmethod
    def _grow(dataset: h5py.Dataset, n: int) -> None:
        shape = dataset.id.shape
        if shape[0] < n:  # never shrinks, because a reader may still use the rows at the end
            dataset.id.set_extent((n, *shape[1:]))


NAMES = {FrameKind.PROJECTION: "data", FrameKind.FLAT: "data_white", FrameKind.DARK: "data_dark"}
THETA = {"data": "theta", "data_white": "theta_white", "data_dark": "theta_dark"}


def add_exchange_view(file: h5py.File) -> None:
    """Add the rows so far to /exchange. A kind without frames gets no dataset. Invalid frames are omitted."""
    source, angles, group = file[layout.DATA], file[layout.ANGLE][()], file.require_group(layout.EXCHANGE)
    units = file["/entry/record/quantity"].asstr()[()]
    for name, rows in _rows(file).items():
        virtual = h5py.VirtualLayout((rows.size, *source.shape[1:]), source.dtype)
        filled = 0
        for first, last in datasets.runs(rows):
            virtual[filled : filled + last - first] = h5py.VirtualSource(source)[first:last]
            filled += last - first
        dataset = group.create_virtual_dataset(name, virtual)
        dataset.attrs["axes"] = f"{THETA[name]}:y:x"
        dataset.attrs["units"] = units
        theta = group.create_dataset(THETA[name], data=angles[rows])
        theta.attrs["units"] = "deg"


def has_exchange_view(file: h5py.File) -> bool:
    """True if /exchange is complete."""
    return layout.EXCHANGE in file and set(_rows(file)) <= set(file[layout.EXCHANGE])


def put_exchange_view(path: Path) -> None:
    """Add the /exchange view to a closed scan file. The part of the file that contains the frames is not changed.

    Raises:
        DataError: the disk failed, or has less than ROOM bytes free.
    """
    if (free := shutil.disk_usage(path.parent).free) < ROOM:
        raise DataError(
            f"{path}: its disk has {size(free)} free, but {size(ROOM)} are needed to add the /exchange view (links "
            "under which other programs find the frames). Nothing was changed."
        )
    try:
        with hdf5.changed(path, layout.LIBVER) as file:
            add_exchange_view(file)
    except hdf5.ALTERED as error:
        raise DataError(f"{path} does not accept the /exchange view ({hdf5.reason(error)}).") from error


def _rows(file: h5py.File) -> dict[str, I64]:
    """Rows of each dataset of the /exchange view."""
    table = frames_in(file)
    rows = {name: table.of_kind(kind) for kind, name in NAMES.items()}
    return {name: rows_of_kind for name, rows_of_kind in rows.items() if rows_of_kind.size}


STATUSES = ("complete", "stopped", "failed")
RUNNING = "running"  # for a scan that continues, or whose program was killed
DIED = "The process that took the scan was killed."


@dataclass(frozen=True)
class ScanEnding:
    """How a scan ended.

    Attributes:
        status: "complete", "stopped" (by the operator, an alarm, or darks or flats that cannot be used), "failed", or
            RUNNING if nothing was stated.
        missing: triggers that gave no frame, counted over the whole scan from 0.
        reason: why it did not take all its frames, in words; "" if it did, or if it is not stated.
    """

    status: str = "complete"
    missing: tuple[int, ...] = ()
    reason: str = ""


def ending_in(file: h5py.File) -> ScanEnding:
    """The ending stated by a scan file of this program."""
    for path in (layout.STATUS, layout.MISSING):
        hdf5.look_again(file[path])
    status = datasets.text_of(file[layout.STATUS]) or RUNNING
    return ScanEnding(status, tuple(file[layout.MISSING][()].tolist()), datasets.text_at(file, layout.REASON))


def state_ending(fields: Mapping[str, h5py.Dataset] | h5py.File, ending: ScanEnding) -> None:
    """Write the ending into a file created by `layout.create`, or into its open datasets, by path.

    Files of older versions have no place for the reason.
    """
    missing = np.asarray(ending.missing, np.int64)
    fields[layout.MISSING].resize(missing.size, 0)
    fields[layout.MISSING][...] = missing
    state_words(fields, ending)


def state_words(fields: Mapping[str, h5py.Dataset] | h5py.File, ending: ScanEnding) -> None:
    """Write only status and reason, which needs no further space on the disk."""
    if layout.REASON in fields:
        fields[layout.REASON][()] = ending.reason.encode()[: layout.REASON_BYTES].decode(errors="ignore").encode()
    fields[layout.STATUS][()] = ending.status.encode()


def complete(file: hdf5.NewFile, ending: ScanEnding) -> None:
    """State that a file created by `layout.create` has all frames of its scan, and how the scan ended; add
    /exchange."""
    file[layout.COMMITTED][()] = len(file[layout.DATA])
    state_ending(file, ending)
    file[layout.FINISHED][()] = 1
    layout.state_field_of_view(file)
    add_exchange_view(file)
