"""Frames in a scan file of this program: their table, and rows that no longer match their checksum."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.process import json_object
from beamline.storage import datasets, hdf5
from beamline.storage.frame_table import FrameTable, kinds_of
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind
from recon.base.arrays import I64, Mask

_RECORD = np.dtype([(path, layout.COLUMNS[path][0]) for path in layout.RECORDED])
"""56 bytes, little-endian, without gaps."""


def frames_in(file: h5py.File, n: int | None = None) -> FrameTable:
    """The table of the first n frames, as the log in the file records them, without flags.

    Alignment frames aside are offset projections; frames whose record differs from its checksum are INVALID.

    Args:
        n: number of frames; None: all committed frames.

    Raises:
        ValueError: a column is not as `create` made it, or a row claims to replace a later one.
    """
    n = int(file[layout.COMMITTED][()]) if n is None else n
    columns, aside = _record(file, n), None
    altered, kinds = _altered(columns), kinds_of(columns[layout.KIND])
    if layout.X_TRANSLATION in file:
        aside = _column(file, layout.X_TRANSLATION, n)
        kinds[(kinds == FrameKind.ALIGNMENT) & (aside != 0)] = FrameKind.OFFSET_VIEW
    kinds[altered] = FrameKind.INVALID
    for path in (layout.TRIGGER, layout.FRAMESTAMP, layout.REPLACES):
        columns[path][altered] = -1
    columns[layout.TIME][altered] = np.nan
    require_earlier(replaces := columns[layout.REPLACES])
    seconds, times = columns[layout.COUNT_TIME], columns[layout.TIME]
    return FrameTable.of(
        kinds,
        datasets.radians(file[layout.ANGLE])[:n] + 0.0,  # no -0
        np.where(seconds > 0, seconds, np.nan),  # some write 0 for what they do not know
        triggers=columns[layout.TRIGGER],
        framestamps=columns[layout.FRAMESTAMP],
        times=times if np.isfinite(times).any() else None,
        replaces=replaces if (replaces >= 0).any() else None,
        aside=aside,
        altered=altered,
        part_starts=_part_starts(file),
        pass_ends=pass_ends_in(file),
    )


def _part_starts(file: h5py.File) -> I64:
    item = datasets.dataset(file, layout.PART_STARTS)
    starts = np.zeros(1, np.int64) if item is None else np.ravel(datasets.values_of(item))
    if starts.dtype.kind not in "iu" or not starts.size or starts[0] != 0 or (starts[1:] <= starts[:-1]).any():
        raise DataError(f"{file.filename}: {layout.PART_STARTS} is {starts}; expected ascending rows, the first 0.")
    return starts.astype(np.int64)


def pass_ends_in(file: h5py.File) -> I64:
    """Rows of a file at the end of each pass [pass], of those committed; empty if the scan chose nothing."""
    ends = np.asarray(_list_in(file, layout.PASS_ENDS), np.int64)
    return ends[ends <= int(file[layout.COMMITTED][()])] if ends.size else ends


def decisions_in(file: h5py.File) -> tuple[dict[str, Any], ...]:
    """What was chosen after each pass, oldest first: values of the event `next_chosen`; empty in the same way."""
    return tuple(json_object(datasets.text(line)) or {} for line in _list_in(file, layout.DECISIONS))


def _list_in(file: h5py.File, path: str) -> Sequence[Any]:
    """The values of a dataset, also of one that grows; none where the file does not have it."""
    if path not in file:
        return ()
    hdf5.look_again(file[path])
    return file[path][()]


def codes_of(kind: FrameKind) -> dict[str, int]:
    """The codes of a kind of frame, by their columns: NXtomo's image key, and the finer one of the log.

    NXtomo has no image key for alignment frames, so they get a key with which other programs do not use them. An offset
    projection is a projection of the translated sample; the log records it as an alignment frame.
    """
    key = {FrameKind.ALIGNMENT: FrameKind.INVALID, FrameKind.OFFSET_VIEW: FrameKind.PROJECTION}.get(kind, kind)
    return {layout.IMAGE_KEY: int(key), layout.KIND: max(int(kind), int(FrameKind.ALIGNMENT))}


def record_checksums(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint32]:
    """CRC-32 [row] of the `layout.RECORDED` columns [row], by their paths.

    The row of a repeated frame becomes an invalid one, but its checksum is still that of its first kind.
    """
    table = np.empty(len(columns[layout.KIND]), _RECORD)
    for path in layout.RECORDED:
        table[path] = columns[path]
    rows, size = table.tobytes(), _RECORD.itemsize
    return np.array([zlib.crc32(rows[i : i + size]) for i in range(0, len(rows), size)], np.uint32)


def altered_rows(file: h5py.File, n: int) -> I64:
    """Rows, of the first n, whose record differs from its checksum.

    Raises:
        ValueError: a column is not as `create` made it.
    """
    return np.flatnonzero(_altered(_record(file, n)))


def _record(file: h5py.File, n: int) -> dict[str, NDArray[Any]]:
    """The columns [row] that a checksum is over, and the checksums, by their paths."""
    return {path: _column(file, path, n) for path in (*layout.RECORDED, layout.RECORD_CHECKSUM)}


def _column(file: h5py.File, path: str, n: int) -> NDArray[Any]:
    column, dtype = file[path], layout.COLUMNS.get(path, ("<f8", ""))[0]
    datasets.require_real(column.dtype, f"{path} in {file.filename}")
    if len(column) < n:  # a reader has some of them open already, see look_again
        hdf5.look_again(column)
    values = np.asarray(column[:n])
    if values.shape != (n,) or column.dtype != dtype:
        raise ValueError(f"{path} is {column.dtype} {column.shape}, expected {dtype} of {n} rows")
    return values


def _altered(columns: Mapping[str, NDArray[Any]]) -> Mask:
    """True if each row differs from its checksum."""
    checksums = columns[layout.RECORD_CHECKSUM]
    good = np.asarray(record_checksums(columns) == checksums)
    marked = ~good & np.any([columns[path] == code for path, code in codes_of(FrameKind.INVALID).items()], axis=0)
    for kind in FrameKind if marked.any() else ():  # as of a repeated frame, whose checksum is that of its kind
        before = {path: np.full_like(columns[path], code) for path, code in codes_of(kind).items()}
        good[marked] |= (record_checksums({**columns, **before}) == checksums)[marked]
    return ~good


def require_earlier(replaces: NDArray[np.integer[Any]]) -> None:
    """Raise ValueError if a row claims to replace itself or a later one. replaces: [row]; -1: none."""
    wrong = np.flatnonzero(replaces >= np.arange(replaces.size))
    if wrong.size:
        row = int(wrong[0])
        raise ValueError(f"row {row} claims to replace row {replaces[row]}; only an earlier row can be replaced")
