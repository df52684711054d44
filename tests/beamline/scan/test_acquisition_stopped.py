"""A scan that is stopped or aborted, at any moment: what was exposed is kept with its angles, and it ends up safe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beamline.core.errors import ScanStopped
from beamline.core.stop import ScanAborted, StopRequest
from beamline.plan.plan import Mode, Place
from beamline.scan.acquisition import Acquisition
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraSettings, TriggerSource
from tests.beamline.acquired import Run, assert_safe, assert_true_angles
from tests.beamline.fakes import COUNT, HOME, FakeInstrument, Faults


@pytest.mark.parametrize("abort", [False, True])
def test_a_scan_cut_short_says_that_its_first_frame_came_a_trigger_late(abort: bool) -> None:
    """The start is as vague as above, and nothing but that frame's time tells that the first trigger was ignored."""
    stop = StopRequest()
    wish = stop.abort if abort else stop.stop
    instrument = FakeInstrument(Faults(ignored={5}), on_frame=lambda number: wish() if number == 40 else None)
    instrument.stage.limits = replace(instrument.stage.limits, acceleration=np.radians(60).item())
    run = Run(instrument, instrument.timeline(n=140, speed=55), stop)
    assert type(run.error) is (ScanAborted if abort else ScanStopped)
    assert "may all be wrong by up to 1 steps" in str(run.error)


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
@pytest.mark.parametrize("at", [Place.START, Place.END])
def test_a_stop_keeps_what_was_exposed_and_takes_the_references_still_owed(mode: Mode, at: Place) -> None:
    stop = StopRequest()
    first = 5 if at is Place.START else 0
    instrument = FakeInstrument(on_frame=lambda number: stop.stop("enough") if number == first + 6 else None)
    run = Run(instrument, instrument.timeline(n=24, mode=mode, at=at), stop)
    assert type(run.error) is ScanStopped
    assert "of 24 projections: enough" in str(run.error)
    assert run.views == list(range(len(run.views)))
    assert 7 <= len(run.views) < 12
    assert [f.kind for f in run.frames].count(FrameKind.FLAT) == 2
    assert [f.kind for f in run.frames].count(FrameKind.DARK) == 3
    assert_true_angles(run)
    assert_safe(instrument)
    assert run.scan.missing == []


def test_frames_taken_while_the_stage_brakes_keep_their_angles_though_they_come_ever_later() -> None:
    stop = StopRequest()
    lost = 33
    instrument = FakeInstrument(Faults(lost={5 + lost}), on_frame=lambda number: stop.stop() if number == 35 else None)
    run = Run(instrument, instrument.timeline(n=140, speed=55), stop)
    assert type(run.error) is ScanStopped
    assert run.views == [i for i in range(len(run.views) + 1) if i != lost]
    assert len(run.views) > 36  # some came while it braked, one of which was lost
    assert np.diff([f.time for f in run.of(FrameKind.PROJECTION)])[-1] > 1.5 * instrument.period
    assert run.of(FrameKind.INVALID) == []
    assert_true_angles(run)
    assert run.scan.missing == [5 + lost]


def test_a_stop_in_the_owed_references_ends_the_scan() -> None:
    stop = StopRequest()
    instrument = FakeInstrument(on_frame=lambda number: stop.stop() if number == 12 else None)
    run = Run(instrument, instrument.timeline(n=12, at=Place.END), stop)
    assert type(run.error) is ScanStopped
    assert [f.kind for f in run.frames[12:]] == [FrameKind.FLAT] + [FrameKind.DARK] * 3  # darks were still owed
    assert_safe(instrument)


def test_a_stop_during_the_darks_takes_no_views() -> None:
    stop = StopRequest()
    instrument = FakeInstrument(on_frame=lambda number: stop.stop() if number == 1 else None)
    run = Run(instrument, instrument.timeline(at=Place.BOTH), stop)
    assert type(run.error) is ScanStopped
    assert len(run.frames) == 2
    assert_safe(instrument)


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
def test_an_abort_leaves_everything_where_it_is_but_safe(mode: Mode) -> None:
    stop = StopRequest()
    instrument = FakeInstrument(on_frame=lambda number: stop.abort() if number == 11 else None)
    run = Run(instrument, instrument.timeline(n=24, mode=mode, at=Place.BOTH), stop)
    assert type(run.error) is ScanAborted
    assert run.error.exit_code == 130
    assert len(run.frames) == 12
    assert "abort stage" in instrument.log
    assert f"move {HOME}" not in instrument.log
    assert_safe(instrument, home=False)
    assert instrument.stage.position() != pytest.approx(HOME * COUNT)


@pytest.mark.parametrize("abort", [False, True])
def test_a_request_that_came_before_the_start_is_heeded(abort: bool) -> None:
    stop = StopRequest()
    stop.abort() if abort else stop.stop()
    instrument = FakeInstrument()
    run = Run(instrument, instrument.timeline(), stop)
    assert type(run.error) is ScanAborted
    assert run.error.exit_code == 130
    assert run.frames == []
    assert not any(entry.startswith(("move", "arm")) for entry in instrument.log if entry != f"move {HOME}")
    assert_safe(instrument)


def test_an_abort_on_the_way_home_stands_at_once() -> None:
    stop = StopRequest()
    instrument = FakeInstrument()
    sleep = instrument.clock.sleep

    def on_the_way(seconds: float) -> None:
        sleep(seconds)
        if instrument.log[-1] == f"move {HOME}":
            stop.abort()

    instrument.clock.sleep = on_the_way  # type: ignore[method-assign]
    run = Run(instrument, instrument.timeline(), stop)
    assert type(run.error) is ScanAborted
    assert len(run.frames) == 17
    assert instrument.log[-1] == "abort stage"
    assert_safe(instrument, home=False)


def test_a_caller_that_gives_up_leaves_a_safe_instrument_at_home() -> None:
    instrument = FakeInstrument()
    scan = Acquisition(
        instrument.devices,
        instrument.timeline(),
        CameraSettings(1.0, TriggerSource.INTERNAL),
        0.0,
        instrument.clock,
        StopRequest(),
    )
    frames = scan.frames()
    for _ in range(8):
        next(frames)
    frames.close()
    assert_safe(instrument)
