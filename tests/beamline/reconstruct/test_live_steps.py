"""Each state of the live fit on its own: what new frames make of it, and what is reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event
from beamline.core.sinks import Warnings
from beamline.projections.axis import LocatedAxis
from beamline.projections.correction import apply, survey
from beamline.projections.selection import Selection
from beamline.projections.usable_views import UsableViews
from beamline.projections.views import checked_views, select
from beamline.reconstruct import followed_views
from beamline.reconstruct.followed_views import AxisSearch, FollowedViews
from beamline.reconstruct.live_end import ended, final_fit
from beamline.reconstruct.live_states import Cursor, Feeds, LiveScan, WaitsForAxis, WaitsForReferences
from beamline.reconstruct.live_steps import (
    after_progress,
    corrected_again,
    fed,
    first_state,
    joined,
    new_correction,
    next_state,
    settled,
    with_axis,
    with_better_axis,
    with_references,
)
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import open_scan
from drivers.base.frame import Frame, FrameKind
from recon.base.method import Progress
from recon.prep.align import AxisEstimate
from tests.beamline.reconstruct.growing_scan import BRIEF, INTERLACED, SCAN
from tests.beamline.scans import frames_of, write_flagged
from tests.clock import SteppedClock

pytestmark = pytest.mark.usefixtures("one_thread")

FRAMES = frames_of(INTERLACED)  # four references, then 30 projections
ROWS = np.arange(4, 34)
UNKNOWN = Selection()
KNOWN = Selection(axis_col=SCAN.axis_col)
NO_FLATS = [replace(frame, index=i) for i, frame in enumerate(f for f in FRAMES if f.kind is not FrameKind.FLAT)]


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Callable[..., tuple[LiveScan, list[Event]]]]:
    """Makes a scan to follow of a file with these frames, and the list of its events."""
    opened: list[ScanSource] = []

    def make(frames: Sequence[Frame] = FRAMES, selection: Selection = KNOWN) -> tuple[LiveScan, list[Event]]:
        events, clock = list[Event](), SteppedClock(tick=0.01)
        opened.append(open_scan(write_flagged(tmp_path / "scan.h5", list(frames), {})))
        views = FollowedViews(select(opened[-1], selection))
        warn = Warnings(events.append, clock)
        return LiveScan(BRIEF, 0, views, events.append, clock, warn, clock.now()), events

    yield make
    for source in opened:
        source.close()


@pytest.fixture
def axis_at(monkeypatch: pytest.MonkeyPatch) -> Callable[[float, bool], None]:
    """Makes each search find this column, clearly or not."""

    def answer(column: float, clear: bool) -> None:
        estimate = AxisEstimate(column, np.arange(3.0), np.arange(3.0), clear, "pair")
        monkeypatch.setattr(followed_views, "locate_axis", lambda *_, **__: LocatedAxis(column, estimate))

    return answer


def _states(events: list[Event]) -> list[Any]:
    return [event.data.get("state", event.event) for event in events]


def _file(n: int = 30, *, ended: bool = False, taken: int = 0) -> Cursor:
    """The file with the first n projections."""
    return Cursor(4 + n, ROWS[:n], ended, taken)


def _feeds(scan: LiveScan, n: int = 0, last: bool = False) -> Feeds:
    """A live fit with n projections."""
    state = with_references(scan, first_state(scan), ended=False)
    assert isinstance(state, Feeds)
    return fed(scan, state, _file(n, ended=last))[0] if n else state


class TestWaitsForReferences:
    def test_missing_flats_are_reported_once_and_waited_for_to_the_end(self, live: Callable[..., Any]) -> None:
        scan, events = live(NO_FLATS)
        told = with_references(scan, first_state(scan), ended=False)
        assert isinstance(told, WaitsForReferences) and told.come_last
        assert isinstance(with_references(scan, told, ended=False), WaitsForReferences)
        assert _states(events) == ["waiting"]
        with pytest.raises(DataError, match="flats are missing"):
            with_references(scan, told, ended=True)

    def test_references_that_come_last_are_not_used_before_the_end(self, live: Callable[..., Any]) -> None:
        scan, _ = live()
        state = replace(first_state(scan), come_last=True)
        assert isinstance(with_references(scan, state, ended=False), WaitsForReferences)
        assert isinstance(with_references(scan, state, ended=True), Feeds)

    def test_the_axis_is_searched_unless_it_is_stated(self, live: Callable[..., Any]) -> None:
        scan, events = live(selection=UNKNOWN)
        state = with_references(scan, first_state(scan), ended=False)
        assert isinstance(state, WaitsForAxis) and state.search == AxisSearch()
        assert "recon_started" not in [event.event for event in events]

    def test_a_stated_axis_begins_the_fit_with_no_projection(self, live: Callable[..., Any]) -> None:
        scan, events = live()
        state = _feeds(scan)
        assert (state.axis_col, state.search.settled, state.n_views, state.fit.n_views) == (SCAN.axis_col, True, 0, 0)
        assert [event.data["again"] for event in events if event.event == "recon_started"] == [False]

    def test_an_axis_outside_the_detector_is_refused(self, live: Callable[..., Any]) -> None:
        scan, _ = live(selection=Selection(axis_col=400.0))
        with pytest.raises(ConfigError, match="axis"):
            _feeds(scan)


class TestWaitsForAxis:
    @pytest.fixture
    def waits(self, live: Callable[..., Any]) -> tuple[LiveScan, WaitsForAxis]:
        scan, _ = live(selection=UNKNOWN)
        return scan, WaitsForAxis(new_correction(scan, scan.views.scan), AxisSearch())

    def test_an_unclear_axis_is_searched_again_with_half_as_many_projections_again(
        self, waits: tuple[LiveScan, WaitsForAxis], axis_at: Callable[[float, bool], None]
    ) -> None:
        scan, state = waits
        axis_at(20.7, False)
        after = with_axis(scan, state, _file(12))
        assert isinstance(after, WaitsForAxis) and after.correction is state.correction
        assert (state.search.next_views, after.search.next_views, after.search.settled) == (12, 18, False)

    def test_a_clear_axis_begins_the_fit_and_may_still_be_improved(
        self, waits: tuple[LiveScan, WaitsForAxis], axis_at: Callable[[float, bool], None]
    ) -> None:
        scan, state = waits
        axis_at(20.7, True)
        after = with_axis(scan, state, _file(12))
        assert isinstance(after, Feeds) and (after.axis_col, after.search.settled) == (20.7, False)
        assert after.search.estimate is not None and after.n_views == 0

    def test_at_the_end_the_best_axis_is_taken(
        self, waits: tuple[LiveScan, WaitsForAxis], axis_at: Callable[[float, bool], None]
    ) -> None:
        scan, state = waits
        axis_at(19.5, False)
        after = with_axis(scan, state, _file(5, ended=True))
        assert isinstance(after, Feeds) and (after.axis_col, after.search.settled) == (19.5, True)


class TestFeeds:
    @pytest.mark.parametrize("sizes", [[30], [1, 28, 1], [7] * 4 + [2]], ids=str)
    def test_batches_of_any_size_give_the_line_integrals_of_the_whole_scan(
        self, live: Callable[..., Any], sizes: list[int]
    ) -> None:
        scan, _ = live(frames_of(SCAN))
        state, file = _feeds(scan), Cursor()
        for n in np.cumsum(sizes):
            state, file = fed(scan, state, _file(n, ended=n == 30, taken=file.taken))
            assert (state.n_views, state.fit.n_views, file.behind) == (n, n, False)
        assert state.newest is None
        whole = apply(survey(scan.views.scan), ROWS)
        np.testing.assert_array_equal(joined(state).data, whole.data)
        assert len(state.batches) == 1

    def test_the_newest_projection_is_used_but_waits_for_the_next(self, live: Callable[..., Any]) -> None:
        scan, _ = live()
        state = _feeds(scan, 12)
        assert state.newest is not None and state.newest.view_ids.tolist() == [15]
        assert [ids.tolist() for ids in (part.view_ids for part in state.corrected)] == [list(range(4, 15)), [15]]
        final = settled(scan, state)
        assert (final.newest, final.n_views, final.fit.n_views) == (None, 12, 12)
        assert settled(scan, final) is final

    def test_a_batch_leaves_the_rest_for_the_next_reading(
        self, live: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("beamline.reconstruct.live_steps.BATCH_VIEWS", 8)
        scan, _ = live()
        state, file = fed(scan, _feeds(scan), _file(20))
        assert (state.n_views, file.taken, file.new.tolist()) == (8, 12, list(range(12, 24)))

    def test_a_small_move_of_the_axis_keeps_the_fit(
        self, live: Callable[..., Any], axis_at: Callable[[float, bool], None]
    ) -> None:
        scan, events = live()
        state = replace(_feeds(scan, 20), search=AxisSearch())
        axis_at(SCAN.axis_col + 0.4, True)
        after = with_better_axis(scan, state, _file(20))
        assert after.fit is state.fit and after.axis_col == SCAN.axis_col + 0.4
        assert (after.newest, after.n_views) == (state.newest, 20)
        assert _states(events).count("recon_started") == 1

    def test_a_large_move_begins_the_fit_again_with_the_projections_that_it_had(
        self, live: Callable[..., Any], axis_at: Callable[[float, bool], None]
    ) -> None:
        scan, events = live()
        state = replace(_feeds(scan, 20), search=AxisSearch(), history=(Progress(3, 0, 1.0, 0.1, 0.1, 100, 20),))
        axis_at(SCAN.axis_col - 1.5, True)
        after = with_better_axis(scan, state, _file(20))
        assert (after.axis_col, after.newest, after.fit.n_views, state.fit.n_views) == (
            SCAN.axis_col - 1.5,
            None,
            19,
            0,
        )
        assert after.history == state.history and events[-1].data["again"]
        more, _ = fed(scan, after, _file(25, taken=24))  # the newest view comes again with the next ones
        assert more.fit.n_views == more.n_views == 25

    def test_what_has_not_changed_is_not_corrected_again(self, live: Callable[..., Any]) -> None:
        scan, events = live(frames_of(SCAN))
        state = _feeds(scan, 30, last=True)
        n = len(events)
        assert corrected_again(scan, state, scan.views.usable(), "no reason") is state and len(events) == n

    def test_projections_that_may_not_be_used_any_more_leave_the_fit(self, live: Callable[..., Any]) -> None:
        scan, events = live()
        state = _feeds(scan, 30, last=True)
        usable: UsableViews = scan.views.usable().only(np.delete(ROWS, [3, 8]))
        after = corrected_again(scan, state, usable, "no reason")
        assert (after.n_views, after.fit.n_views) == (28, 28)
        assert "continues without 2 projections" in events[-1].data["message"]
        np.testing.assert_array_equal(joined(after).view_ids, np.delete(ROWS, [3, 8]))

    def test_a_fit_that_is_slower_than_the_scan_is_reported_once(self, live: Callable[..., Any]) -> None:
        scan, events = live()
        state, n = _feeds(scan), len(events)
        for step, views in ((1, 32), (20, 40), (19, 40), (18, 41)):
            state = after_progress(scan, state, Progress(step, 0, 0.0, 0.1, 0.1, 100, views), waiting=7)
        assert _states(events[n:]) == ["behind"] and "19 fitting steps for 40 projections" in events[-1].data["message"]
        assert [progress.step for progress in state.history] == [1, 20, 19, 18]


def test_one_reading_may_pass_two_states_and_take_a_batch(
    live: Callable[..., Any], axis_at: Callable[[float, bool], None]
) -> None:
    scan, _ = live(selection=UNKNOWN)
    axis_at(SCAN.axis_col, True)
    state, file = next_state(scan, first_state(scan), _file(20))
    assert isinstance(state, Feeds) and (state.n_views, file.taken) == (20, 24)


def test_the_last_fit_has_all_projections_and_knows_what_the_live_fit_reported(live: Callable[..., Any]) -> None:
    scan, events = live()
    before = Progress(3, 0, 1.0, 0.1, 0.1, 100, 20)
    state = replace(_feeds(scan, 20), history=(before,))
    last = ended(scan, state, scan.views.scan, checked_views(scan.views.scan, scan.warn))
    assert (last.fit, last.axis_col, last.history) == (state.fit, SCAN.axis_col, (before,))
    assert last.fit.n_views == last.prepared.geometry.n_views == 20
    written: list[float] = []
    fit = final_fit(scan, last, 5.0, 0.0, lambda: written.append(1.0))
    assert events[-1].data["state"] == "finishing" and (fit.fit, fit.before, fit.began) == (
        last.fit,
        (before,),
        scan.begin,
    )
    fit.on_progress(before)
    assert written == [1.0]
