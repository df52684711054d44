"""Reads the table of the frames in a scan file of this program, and finds rows that no longer match their checksum."""

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
"""The record of a frame for its checksum: 56 bytes, little-endian, without gaps."""


def frames_in(file: h5py.File, n: int | None = None) -> FrameTable:
    """The table of the first n frames, from the log in the file. Flags are not included.

    Alignment frames with the sample moved sideways become offset projections. Frames whose record differs from its
    checksum become INVALID.

    Args:
        n: number of frames; None: all committed frames.

    Raises:
        ValueError: a column does not have the form that `create` gave it, or a row claims to replace a later row.
    """
    n = int(file[layout.COMMITTED][()]) if n is None else n
    columns, translations = _record(file, n), None
    altered, kinds = _altered(columns), kinds_of(columns[layout.KIND])
    if layout.X_TRANSLATION in file:
        translations = _column(file, layout.X_TRANSLATION, n)
        kinds[(kinds == FrameKind.ALIGNMENT) & (translations != 0)] = FrameKind.OFFSET_VIEW
    kinds[altered] = FrameKind.INVALID
    for path in (layout.TRIGGER, layout.FRAMESTAMP, layout.REPLACES):
        columns[path][altered] = -1
    columns[layout.TIME][altered] = np.nan
    require_earlier(replaces := columns[layout.REPLACES])
    seconds, times = columns[layout.COUNT_TIME], columns[layout.TIME]
    return FrameTable.of(
        kinds,
        datasets.radians(file[layout.ANGLE])[:n] + 0.0,  # avoids -0
        np.where(seconds > 0, seconds, np.nan),  # some programs write 0 for an unknown value
        triggers=columns[layout.TRIGGER],
        framestamps=columns[layout.FRAMESTAMP],
        times=times if np.isfinite(times).any() else None,
        replaces=replaces if (replaces >= 0).any() else None,
        aside=translations,
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
    """[pass] row at which each pass ends, among the committed rows. Empty if the scan does not choose between
    passes.
    """
    ends = np.asarray(_list_in(file, layout.PASS_ENDS), np.int64)
    return ends[ends <= int(file[layout.COMMITTED][()])] if ends.size else ends


def decisions_in(file: h5py.File) -> tuple[dict[str, Any], ...]:
    """The choice after each pass, oldest first, as values of the event `next_chosen`. Empty if the scan does not choose
    between passes.
    """
    return tuple(json_object(datasets.text(line)) or {} for line in _list_in(file, layout.DECISIONS))


def _list_in(file: h5py.File, path: str) -> Sequence[Any]:
    """The present values of a dataset, which may be growing. Empty if the file does not have the dataset."""
    if path not in file:
        return ()
    hdf5.look_again(file[path])
    return file[path][()]


def codes_of(kind: FrameKind) -> dict[str, int]:
    """The codes of a kind of frame, by column: the image key of NXtomo, and the code in the log, which distinguishes
    more kinds.

    NXtomo has no image key for alignment frames. They get a key with which other programs ignore them. The log records
    an offset projection, for which the sample is translated, as an alignment frame.
    """
    key = {FrameKind.ALIGNMENT: FrameKind.INVALID, FrameKind.OFFSET_VIEW: FrameKind.PROJECTION}.get(kind, kind)
    return {layout.IMAGE_KEY: int(key), layout.KIND: max(int(kind), int(FrameKind.ALIGNMENT))}


def record_checksums(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint32]:
    """CRC-32 [row] of the `layout.RECORDED` columns [row], by their paths.

    If a frame is repeated, its first row becomes invalid, but the checksum of this row is still computed with the
    original kind.
    """
    table = np.empty(len(columns[layout.KIND]), _RECORD)
    for path in layout.RECORDED:
        table[path] = columns[path]
    rows, size = table.tobytes(), _RECORD.itemsize
    return np.array([zlib.crc32(rows[i : i + size]) for i in range(0, len(rows), size)], np.uint32)


def altered_rows(file: h5py.File, n: int) -> I64:
    """The rows among the first n whose record differs from its checksum.

    Raises:
        ValueError: a column does not have the form that `create` gave it.
    """
    return np.flatnonzero(_altered(_record(file, n)))


def _record(file: h5py.File, n: int) -> dict[str, NDArray[Any]]:
    """The columns [row] from which a checksum is computed, and the checksums, by path."""
    return {path: _column(file, path, n) for path in (*layout.RECORDED, layout.RECORD_CHECKSUM)}


def _column(file: h5py.File, path: str, n: int) -> NDArray[Any]:
    column, dtype = file[path], layout.COLUMNS.get(path, ("<f8", ""))[0]
    datasets.require_real(column.dtype, f"{path} in {file.filename}")
    if len(column) < n:  # a reader may have opened some of these datasets already, see look_again
        hdf5.look_again(column)
    values = np.asarray(column[:n])
    if values.shape != (n,) or column.dtype != dtype:
        raise ValueError(
            f"{path} has the type {column.dtype} and the shape {column.shape}; expected {dtype} with {n} rows"
        )
    return values


def _altered(columns: Mapping[str, NDArray[Any]]) -> Mask:
    """bool [row], True if the row differs from its checksum."""
    checksums = columns[layout.RECORD_CHECKSUM]
    good = np.asarray(record_checksums(columns) == checksums)
    marked = ~good & np.any([columns[path] == code for path, code in codes_of(FrameKind.INVALID).items()], axis=0)
    # for a repeated frame, the checksum was computed with its original kind
    for kind in FrameKind if marked.any() else ():
        before = {path: np.full_like(columns[path], code) for path, code in codes_of(kind).items()}
        good[marked] |= (record_checksums({**columns, **before}) == checksums)[marked]
    return ~good


def require_earlier(replaces: NDArray[np.integer[Any]]) -> None:
    """Raise ValueError if a row claims to replace itself or a later one. replaces: [row]; -1: none."""
    wrong = np.flatnonzero(replaces >= np.arange(replaces.size))
    if wrong.size:
        row = int(wrong[0])
        replaced_row = replaces[row]
        raise ValueError(f"row {row} claims to replace row {replaced_row}; only an earlier row can be replaced")
