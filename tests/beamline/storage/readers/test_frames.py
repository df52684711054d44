"""Frames: columns, rows and pixels of several files read as one scan."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from beamline.storage.flag_legend import TODAY, FrameFlags
from beamline.storage.readers.frames import Frames
from tests.beamline.array_source import ArraySource


def _of(n: int, first: int = 0) -> Any:
    frames = np.arange(first, first + 6 * n, dtype=np.uint16).reshape(n, 2, 3)
    return ArraySource(frames, [0] * n, np.arange(n, dtype=float))


def test_rows_count_from_the_first_frame_of_all() -> None:
    one, other = _of(2), _of(3, 12)
    one.damaged, other.damaged = frozenset({1}), frozenset({0})
    nothing = np.full((3, len(TODAY)), np.nan, np.float32), np.full((3, len(TODAY), 4), -1, np.int32)
    one.state(pass_ends=np.array([2]))
    other.state(
        replaces=np.array([-1, 0, -1]),
        part_starts=np.array([0, 1]),
        altered=np.array([False, False, True]),
        pass_ends=np.array([1, 3]),
        flags=FrameFlags(np.array([0, 1 << TODAY[0].bit, 0], np.uint64), TODAY, *nothing),
    )
    both = Frames(one, other)
    assert both.table.pass_ends.tolist() == [2, 3, 5] and both.table.pass_ends.dtype == np.int64
    assert (both.damaged, np.flatnonzero(both.table.altered).tolist()) == ({1, 2}, [4])
    assert both.table.replaces is not None and both.table.replaces.tolist() == [-1, -1, -1, 2, -1]
    assert both.table.part_starts.tolist() == [0, 2, 3]
    assert both.table.flags is not None and both.table.flags.flagged.tolist() == [False] * 3 + [True, False]
    np.testing.assert_array_equal(both.read([4, 0, 3], slice(1, 2)).ravel(), [27, 28, 29, 3, 4, 5, 21, 22, 23])


def test_what_differs_is_a_value_or_follows_the_source() -> None:
    base = _of(2)
    changed = Frames(
        base,
        pixels=lambda read, frames, rows: read(frames, rows) + 1,
        axis_col=3.5,
        attributes={"from": "a test"},
        table=lambda known: replace(known, kinds=np.where(np.arange(len(known)) == 1, 1, known.kinds)),
    )
    assert (changed.axis_col, changed.attributes, changed.table.kinds.tolist()) == (3.5, {"from": "a test"}, [0, 1])
    grown = _of(4)
    base.table, base.read = grown.table, grown.read
    assert len(changed.table) == 2 and changed.refresh() == 4
    frame = next(changed.frames(3))
    assert (frame.index, frame.trigger, frame.framestamp, int(frame.counts[0, 0])) == (3, 3, 7, 19)
