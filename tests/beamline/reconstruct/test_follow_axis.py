"""The rotation axis of a scan that is followed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from beamline.core.events import Event
from beamline.core.sinks import Warnings
from beamline.projections.axis import LocatedAxis
from beamline.projections.selection import Selection
from beamline.reconstruct import followed_views
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.clock import SystemClock
from drivers.base.frame import FrameKind
from recon.prep.align import AxisEstimate
from tests.beamline.reconstruct.growing_scan import BRIEF, FIT, INTERLACED, SCAN, ScanClock, options, schedule
from tests.beamline.scans import DARK, TwoCylinders, frames_of

pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_file_s_axis_is_taken_and_a_finished_scan_followed(tmp_path: Path) -> None:
    clock = ScanClock()
    schedule(clock, tmp_path / "scan.h5", frames_of(SCAN), begin=0.0, period=0.0, axis_col=20.25)
    clock.sleep(1.0)
    events: list[Event] = []
    reconstruct_file(options(tmp_path, selection=Selection(), method=BRIEF), events.append, clock)
    assert events[-1].data["axis_col"] == 20.25


@pytest.mark.slow
def test_the_axis_is_found_while_the_views_come(tmp_path: Path) -> None:
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    reconstruct_file(options(tmp_path, selection=Selection(), method=BRIEF), events.append, clock)
    started = [event.data for event in events if event.event == "recon_started"]
    assert started[0]["n_views"] < 30
    assert events[-1].data["axis_col"] == pytest.approx(SCAN.axis_col, abs=0.3)


@pytest.mark.slow
def test_a_post_that_shows_itself_at_the_end_does_not_draw_the_axis_away(tmp_path: Path) -> None:
    """That it comes and goes is known when all views are there; they are corrected again, and the axis with them."""
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 3.0)), shape=(6, 64), pixel_size_mm=0.5)
    frames = frames_of(scan)
    views = [at for at, frame in enumerate(frames) if frame.kind is FrameKind.PROJECTION]
    for at, middle in zip(views, scan.axis_col + 34 * np.cos(scan.angles + 0.3), strict=True):
        frames[at].counts[:, np.abs(np.arange(64) - middle) < 6] = DARK
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", frames)
    reconstruct_file(options(tmp_path, selection=Selection(), method=BRIEF), events.append, clock)
    states = [event.data["state"] for event in events if event.event == "state"]
    assert "correcting" in states and events[-1].data["axis_col"] == pytest.approx(scan.axis_col, abs=0.2)


@pytest.mark.slow
def test_a_better_axis_begins_the_fit_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def locate(corrector: object, frames: np.ndarray, *_: object, **__: object) -> Any:
        value = 18.0 if frames.size < 20 else 20.7
        return LocatedAxis(value, AxisEstimate(value, np.arange(3.0), np.arange(3.0), True, "pair"))

    monkeypatch.setattr(followed_views, "locate_axis", locate)
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    wanted = options(tmp_path, selection=Selection(), method=replace(FIT, seconds=4.0))
    metrics = reconstruct_file(wanted, events.append, clock).metrics
    begun = [event.data for event in events if event.event == "recon_started"]
    assert [(each["axis_col"], each["again"]) for each in begun] == [(18.0, False), (20.7, True)]
    assert events[-1].data["axis_col"] == 20.7
    history = read_reconstruction(tmp_path / "recon.h5").history
    assert history["n_views"][-1] == 30
    assert np.all(np.diff(history["seconds"]) > 0)  # one time, though the second fit began later
    assert metrics["residual"] < 0.1


def test_the_axis_is_looked_for_at_half_a_turn_and_what_is_unknown_till_then_is_told_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A full turn, that other looks would reach at 90 and 135 views; a quarter is there at 50, the half turn at 100."""
    looks, told = list[int](), list[str]()
    warn = Warnings(lambda event: told.append(event.data["message"]), SystemClock())
    correction: Any = None
    source: Any = SimpleNamespace(
        table=SimpleNamespace(angles=np.radians(np.arange(0, 360, 1.8))), axis_col=None, cone=None
    )

    def locate(correction: object, frames: np.ndarray, *_: object, **__: object) -> Any:
        looks.append(frames.size)
        sure = source.table.angles[frames[-1]] > np.radians(175)
        return LocatedAxis(20.7, AxisEstimate(20.7, np.arange(3.0), np.arange(3.0), sure, "ends of half a turn"))

    monkeypatch.setattr(followed_views, "locate_axis", locate)
    scan: Any = SimpleNamespace(source=source, selection=Selection())
    followed = followed_views.FollowedViews(scan)
    search, col = followed_views.AxisSearch(), None
    for n in range(1, 101):
        search, col = search.look(followed, correction, np.arange(n), col, ended=False, warn=warn)
        assert (col is None) == (n < looks[-1] if looks and looks[-1] > 95 else True)
    assert 50 in looks and looks[-1] == 100 and col == 20.7
    assert len(set(told)) == 1 and "--axis COLUMN" in told[0] and "optics.axis_col" in told[0]
    assert warn.messages == []  # the report does not say that the axis is unknown, which was found
