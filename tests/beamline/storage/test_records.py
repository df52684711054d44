"""Rows of the frame log have a checksum; a row that was changed is not used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import describe, validate
from beamline.projections.replay import replay
from beamline.storage.readers.open import open_scan
from beamline.storage.recorded_frames import frames_in, record_checksums
from beamline.storage.recover import recover
from beamline.storage.writers import layout
from drivers.base.frame import Frame, FrameKind

Write = Callable[[list[Frame]], Path]
ROW = 8


def _flip(path: Path, column: str, row: int, bit: int) -> None:
    with h5py.File(path, "r+") as file:
        values = file[column][()]
        values[row : row + 1].view(f"u{values.itemsize}")[0] ^= np.array(1 << bit, f"u{values.itemsize}")
        file[column][...] = values


def test_each_column_has_its_part_in_the_checksum_of_a_row(path: Path) -> None:
    with h5py.File(path) as file:
        columns = {column: file[column][()] for column in layout.RECORDED}
    before = record_checksums(columns)
    for column, values in columns.items():
        bits = values.copy()
        bits[ROW : ROW + 1].view(f"u{bits.itemsize}")[0] ^= np.array(1 << 8 * bits.itemsize - 3, f"u{bits.itemsize}")
        assert np.flatnonzero(record_checksums(columns | {column: bits}) != before).tolist() == [ROW], column


@pytest.mark.parametrize("column", [layout.ANGLE, layout.KIND, layout.RECORD_CHECKSUM])
def test_one_flipped_bit_is_found_and_its_frame_is_left_out(path: Path, frames: list[Frame], column: str) -> None:
    _flip(path, column, ROW, 8 * np.dtype(layout.COLUMNS[column][0]).itemsize - 3)
    with open_scan(path) as source:
        assert np.flatnonzero(source.table.altered).tolist() == [ROW]
        assert np.flatnonzero(source.table.kinds == FrameKind.INVALID).tolist() == [ROW]
        assert sum(1 for _ in replay(source)) == len(frames)  # and does not count to 2**61
    assert [f.severity for f in validate(path) if f.rule == "records"] == ["error"]
    assert any("Look for an intact copy" in said for said in describe(path)["findings"])
    with h5py.File(path) as file:
        assert len(frames_in(file).numbers_taken()) == sum(frame.kind is FrameKind.PROJECTION for frame in frames) - 1
    with pytest.raises(DataError, match=rf"stored with them: {ROW}\..* Nothing was written"):
        ingest(path, path.with_name("copy.h5"))


def test_recover_says_it(path: Path, frames: list[Frame]) -> None:
    _flip(path, layout.ANGLE, ROW, 3)
    before = path.read_bytes()
    done = recover(path)
    assert (done.changed, done.altered) == (False, (ROW,))
    assert (
        f"with {len(frames)} frames; records differ from the checksum stored with them: frame {ROW}." in done.in_words()
    )
    assert path.read_bytes() == before


def test_a_view_that_was_taken_again_keeps_its_checksum(write: Write, frames: list[Frame]) -> None:
    again = replace(frames[ROW], index=len(frames), time=frames[-1].time + 1, replaces=ROW)
    path = write([*frames, again])
    with open_scan(path) as source:
        assert not source.table.altered.any()
        assert source.table.kinds[ROW] == FrameKind.INVALID
    _flip(path, layout.TRIGGER, ROW, 1)
    with open_scan(path) as source:
        assert np.flatnonzero(source.table.altered).tolist() == [ROW]
