"""FrameTable: selecting and reordering keeps every fact with its frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beamline.storage.flag_legend import TODAY, FrameFlags
from beamline.storage.frame_table import FrameTable, kinds_of
from drivers.base.frame import FrameKind

N = 12
KINDS = [2, 1, 0, 0, 3, 0, 1, 0, -1, 0, -2, 0]


@pytest.fixture
def table(rng: np.random.Generator) -> FrameTable:
    replaces = np.full(N, -1)
    replaces[9] = 4
    blank = np.full((N, len(TODAY)), np.nan, np.float32), np.full((N, len(TODAY), 4), -1, np.int32)
    return FrameTable.of(
        KINDS,
        rng.normal(size=N),
        rng.uniform(size=N),
        times=np.arange(N) * 0.5,
        replaces=replaces,
        numbers=np.arange(N) + 7,
        shifts=rng.normal(size=(N, 2)),
        currents=rng.normal(size=N),
        flags=FrameFlags(rng.integers(0, 9, N).astype(np.uint64), TODAY, *blank),
        part_starts=np.array([0, 6]),
        pass_ends=np.array([5, 12]),
    )


def assert_same(one: FrameTable, other: FrameTable, but: tuple[str, ...] = ("flags",)) -> None:
    for name in {*vars(FrameTable)["__dataclass_fields__"]} - {*but}:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.flags is not None and other.flags is not None
    np.testing.assert_array_equal(one.flags.bits, other.flags.bits)


def test_kinds_are_asked_by_name(table: FrameTable) -> None:
    assert (table.darks.tolist(), table.flats.tolist(), table.offset_views.tolist()) == ([0], [1, 6], [10])
    assert table.views.tolist() == np.flatnonzero(table.are_views).tolist() == [2, 3, 5, 7, 9, 11]
    assert table.views_of(3, 9).tolist() == [3, 5, 7]
    assert table.of_kind(FrameKind.DARK, FrameKind.FLAT).tolist() == [0, 1, 6]
    assert table.has(FrameKind.DARK, FrameKind.ALIGNMENT) and not replace(table, kinds=table.kinds[1:]).has(2)
    assert table.without(table.flats).flats.size == 0 and table.flats.size == 2
    assert table.replaced.tolist() == [4]
    unknown = table.angles.copy()
    unknown[3] = np.nan
    assert replace(table, angles=unknown).views_with_angles.tolist() == [2, 5, 7, 9, 11]


def test_triggers_count_in_their_block_where_nothing_says_them() -> None:
    assert FrameTable.of([2, 2, 1, 0, 0, 0, 1]).triggers.tolist() == [0, 1, 0, 0, 1, 2, 0]


def test_parts_joined_are_the_whole(table: FrameTable) -> None:
    halves = [table.take(np.arange(6)), table.take(np.arange(6, N))]
    # The view that row 9 repeats is in the other half, and numbers of files do not go on.
    whole = replace(table, replaces=np.full(N, -1), numbers=None)
    joined = FrameTable.concat(
        [replace(halves[0], pass_ends=np.array([5])), replace(halves[1], pass_ends=np.array([6]))]
    )
    assert_same(joined, whole)


def test_an_order_and_its_inverse_are_the_table(table: FrameTable, rng: np.random.Generator) -> None:
    order = rng.permutation(N)
    moved = table.take(order)
    assert moved.replaces is not None and order[moved.replaces[np.flatnonzero(order == 9)]].tolist() == [4]
    np.testing.assert_array_equal(moved.angles, table.angles[order])
    assert_same(moved.take(np.argsort(order)), table, ("flags", "part_starts", "pass_ends"))


def test_a_selection_has_the_parts_and_passes_of_its_frames(table: FrameTable) -> None:
    some = table.take(np.array([2, 4, 7, 9, 11]))
    assert (some.part_starts.tolist(), some.pass_ends.tolist()) == ([0, 2], [2, 5])
    assert some.replaces is not None and some.replaces.tolist() == [-1, -1, -1, 1, -1]
    assert table.take(np.array([0, 2])).part_starts.tolist() == [0]  # no frame of the second part


def test_what_one_table_lacks_is_unknown_in_a_join(table: FrameTable) -> None:
    joined = FrameTable.concat([FrameTable.of([0, 0]), table])
    assert joined.currents is not None and np.isnan(joined.currents[:2]).all()
    assert joined.replaces is not None and (joined.replaces[:2].tolist(), joined.replaces[11]) == ([-1, -1], 6)
    assert (joined.part_starts.tolist(), joined.pass_ends.tolist()) == ([0, 2, 8], [7, 14])


def test_a_view_that_was_taken_again_has_the_number_of_the_first() -> None:
    table = FrameTable.of([2, 3, 0, 0], triggers=np.array([0, 0, 1, 2]), replaces=np.array([-1, -1, -1, 1]))
    assert (table.numbers_taken(), table.numbers_taken(3)) == ({0, 1}, {0})
    frame = table.frame(3, np.zeros((2, 2), np.uint16))
    assert (frame.kind, frame.index, frame.replaces, frame.aside) == (FrameKind.PROJECTION, 3, 1, 0.0)


def test_image_keys_that_nobody_defined_are_invalid_frames() -> None:
    """A wide view has the key of a projection, in a file: -2 says nothing."""
    kinds = kinds_of(np.array([0, 1, 2, 3, -1, -2, 4, 255], np.int16))
    assert kinds.tolist() == [0, 1, 2, 3, -1, 3, 3, 3] and kinds.dtype == np.int32
