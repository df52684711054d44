"""Which trigger each number belongs to, and where a file ends."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from drivers.base.frame import FrameKind
from splatline_areadetector.plan import PlannedBlock
from splatline_areadetector.sorter import NO_SCAN, NewEpoch, Outside, Phase, Place, Sorter

DARK, FLAT, VIEW = FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION
BLOCKS = (PlannedBlock(DARK, 2), PlannedBlock(VIEW, 5), PlannedBlock(FLAT, 3))
DARKS, VIEWS, FLATS = (Phase(i, kind) for i, kind in enumerate((DARK, VIEW, FLAT), 1))


@given(st.sets(st.integers(0, 39), min_size=1), st.integers(0, 2**30))
def test_a_frame_has_the_trigger_of_its_number_whatever_is_lost(came: set[int], first: int) -> None:
    sorter = Sorter([PlannedBlock(VIEW, 40)], first)
    places = [sorter.take(first + i, Phase(1, VIEW)) for i in sorted(came)]
    assert [place.trigger for place in places if isinstance(place, Place)] == sorted(came)
    skipped = {trigger for place in places if isinstance(place, Place) for trigger in place.skipped}
    assert skipped == {*range(max(came))} - came
    assert sorter.missing(0) == sorted({*range(40)} - came) and sorter.complete is (max(came) == 39)


def test_blocks_and_what_belongs_to_none() -> None:
    sorter = Sorter(BLOCKS)
    assert sorter.take(3, NO_SCAN) == Outside()
    assert sorter.take(4, DARKS) == Place(0, DARK, 0)
    assert sorter.take(4, DARKS) == Outside(repeated=True) and sorter.repeats == 1
    assert sorter.take(5, DARKS) == Place(0, DARK, 1)
    assert sorter.take(6, DARKS) == Outside()  # beyond the block's plan: the camera runs free
    assert sorter.take(8, VIEWS) == Place(1, VIEW, 0)
    assert sorter.take(11, VIEWS) == Place(1, VIEW, 3, range(1, 3))
    assert sorter.take(12, VIEWS) == Place(1, VIEW, 4) and not sorter.complete
    assert sorter.take(1, FLATS) == Place(2, FLAT, 0)  # numbered anew in each block
    assert sorter.take(3, FLATS) == Place(2, FLAT, 2, range(1, 2)) and sorter.complete
    assert (sorter.missing(0), sorter.missing(1), sorter.missing(2)) == ([], [1, 2], [1])
    assert sorter.take(9, Phase(4, DARK)) == Place(3, DARK, 0)  # darks taken again


def test_a_number_that_falls_is_another_epoch() -> None:
    sorter = Sorter(BLOCKS)
    sorter.take(8, VIEWS)
    epoch = sorter.take(2, VIEWS)
    assert isinstance(epoch, NewEpoch) and "began anew at 2, after 8" in epoch.why
    sorter = Sorter(BLOCKS)
    sorter.take(8, DARKS)
    assert isinstance(sorter.take(2, VIEWS, reconnected=True), NewEpoch)  # the server restarted
    assert sorter.take(2, VIEWS) == Place(1, VIEW, 0)


def test_free_run_after_the_last_view_is_no_epoch() -> None:
    """A camera that counts from each start runs free before tomoscan says that its scan is complete."""
    sorter = Sorter([PlannedBlock(VIEW, 2)])
    assert [sorter.take(i, VIEWS) for i in (1, 2, 1, 2, 3)][2:] == [Outside()] * 3


def test_frames_that_are_missing_at_the_end_are_known_once_later_ones_come() -> None:
    """A ride by a plan would wait for them for ever."""
    sorter = Sorter(BLOCKS[1:2])
    assert sorter.take(1, VIEWS) == Place(0, VIEW, 0) and sorter.take(3, VIEWS) == Place(0, VIEW, 2, range(1, 2))
    assert not sorter.complete and sorter.take(9, VIEWS) == Outside(lost=range(4, 6))
    assert sorter.complete and sorter.missing(0) == [1, 3, 4] and sorter.take(10, VIEWS) == Outside()
    sorter = Sorter(BLOCKS)
    places = [sorter.take(i, phase) for i, phase in ((1, DARKS), (3, VIEWS), (8, FLATS), (12, NO_SCAN))]
    assert places[3] == Outside(lost=range(9, 11)) and sorter.complete  # the last dark and view did not come
    assert [sorter.missing(i) for i in range(3)] == [[1], [1, 2, 3, 4], [1, 2]]


def test_frames_that_are_missing_at_the_end_have_numbers_of_their_own_block() -> None:
    sorter = Sorter(BLOCKS[1:2])
    sorter.take(1, VIEWS)
    assert sorter.pass_over(3) == range(2, 4) and sorter.take(9, VIEWS) == Outside(lost=range(4, 6))
    sorter = Sorter(BLOCKS[1:2])
    assert sorter.take(3, VIEWS) == Place(0, VIEW, 0)
    assert [sorter.take(i, NO_SCAN) for i in (1, 8, 9)] == [Outside()] * 3  # a free run's own count: these came
    assert sorter.complete and sorter.missing(0) == [1, 2, 3, 4]


def test_the_first_projection_by_its_number_and_by_a_second_count() -> None:
    sorter = Sorter(BLOCKS, first_id=10)
    assert sorter.take(9, VIEWS) == Outside() and sorter.take(12, VIEWS) == Place(1, VIEW, 2, range(2))
    sorter = Sorter(BLOCKS)
    sorter.take(12, VIEWS)
    sorter.shift_first(2)
    assert sorter.take(13, VIEWS) == Place(1, VIEW, 3) and sorter.missing(1) == [0, 1, 4]


def test_frames_that_will_not_come() -> None:
    sorter = Sorter(BLOCKS[1:2])
    assert sorter.pass_over(3) == range(0)
    sorter.take(1, VIEWS)
    assert sorter.pass_over(3) == range(2, 4) and sorter.pass_over(9) == range(0)
    assert sorter.take(4, VIEWS) == Place(0, VIEW, 3)
    sorter.lose(Place(0, VIEW, 3))
    assert sorter.pass_over(5) == range(5, 6) and sorter.complete and sorter.missing(0) == [1, 2, 3, 4]
