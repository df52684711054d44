"""Every frame carries the angle it was exposed at, every missing one is named, and the instrument ends up safe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.acquire import Acquisition
from beamline.errors import InstrumentError, ScanStopped
from beamline.ledger import LedgerError
from beamline.plan import Mode, Place, Timeline
from beamline.stop import ScanAborted, StopRequest
from drivers.errors import DeviceError, DeviceTimeout
from drivers.frame import Frame, FrameKind
from drivers.protocols import CameraSettings, CameraTiming, TriggerSource
from tests.beamline.fakes import COUNT, HOME, Camera, Faults, Instrument, seen

SETTLE = 0.05


class Run:
    """A scan run to its end, whatever that is."""

    def __init__(self, bench: Instrument, timeline: Timeline, stop: StopRequest | None = None) -> None:
        self.events: list[tuple[str, Mapping[str, Any]]] = []
        self.frames: list[Frame] = []
        self.error: BaseException | None = None
        self.scan = Acquisition(
            bench.devices,
            timeline,
            CameraSettings(1.0, TriggerSource.INTERNAL),
            SETTLE,
            bench.clock,
            stop or StopRequest(),
            lambda event, data: self.events.append((event, data)),
        )
        try:
            self.frames.extend(self.scan.frames())
        except BaseException as error:
            self.error = error

    def of(self, kind: FrameKind) -> list[Frame]:
        return [frame for frame in self.frames if frame.kind is kind]

    @property
    def views(self) -> list[int]:
        return [frame.trigger for frame in self.of(FrameKind.PROJECTION)]


def assert_true_angles(run: Run) -> None:
    """Against what the fake camera wrote into the pixels at the moment of the trigger."""
    for frame in run.frames:
        count, is_open, is_in, _ = seen(frame)
        assert is_open is (frame.kind is not FrameKind.DARK)
        assert is_in is (frame.kind is not FrameKind.FLAT)
        if frame.kind is not FrameKind.INVALID:
            assert frame.angle == pytest.approx(count * COUNT, abs=COUNT / 2)


def assert_safe(bench: Instrument, home: bool = True) -> None:
    assert not bench.is_open
    assert not bench.camera.armed
    assert not bench.stage.moving()
    assert (bench.stage.train, bench.stage.pulses) == (None, [])  # disarmed
    if home:
        assert bench.stage.position() == pytest.approx(HOME * COUNT)
        assert bench.is_in


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
@pytest.mark.parametrize("at", [Place.START, Place.BOTH])
def test_a_scan_is_its_plan_frame_by_frame(mode: Mode, at: Place) -> None:
    bench = Instrument()
    timeline = bench.timeline(n=12, mode=mode, at=at)
    run = Run(bench, timeline)
    assert run.error is None
    D, F, P = FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION
    after = [F] * 2 + [D] * 3 if at is Place.BOTH else []
    assert [f.kind for f in run.frames] == [D] * 3 + [F] * 2 + [P] * 12 + after
    assert [f.index for f in run.frames] == list(range(timeline.n_frames))
    assert [f.exposure for f in run.frames][:6] == [0.02] * 3 + [0.03] * 2 + [0.02]
    assert_true_angles(run)
    planned = timeline.views
    np.testing.assert_allclose([f.angle for f in run.of(P)], planned.angles, atol=COUNT / 2)
    assert run.views == list(range(12))
    assert np.all(np.diff([f.time for f in run.frames]) > 0)
    assert run.scan.missing == []
    assert_safe(bench)
    assert [e for e, _ in run.events] == ["block_started", "block_done"] * len(timeline.blocks)
    done = [data for event, data in run.events if event == "block_done"]
    assert [data["frames"] for data in done] == [block.n for block in timeline.blocks]
    assert {(data["lost"], data["ignored"], data["extra"], len(data["missing"])) for data in done} == {(0, 0, 0, 0)}


def test_the_frame_that_leaves_owns_its_memory() -> None:
    run = Run(bench := Instrument(), bench.timeline())
    for a, b in zip(run.frames, run.frames[1:], strict=False):
        assert not np.shares_memory(a.counts, b.counts)


def test_several_passes_keep_their_order_and_angles() -> None:
    bench = Instrument()
    timeline = bench.timeline(n=12, passes=3)
    run = Run(bench, timeline)
    assert run.error is None
    assert_true_angles(run)
    degrees = np.degrees([f.angle for f in run.of(FrameKind.PROJECTION)])
    np.testing.assert_allclose(degrees, [*range(0, 180, 45), *range(15, 180, 45), *range(30, 180, 45)], atol=0.01)
    assert run.views == list(range(12))


@settings(max_examples=40, deadline=None)
@given(st.sets(st.integers(0, 23), max_size=5), st.sets(st.integers(0, 23), max_size=4), st.sampled_from([1, 2, 3]))
def test_fly_any_lost_and_ignored_triggers_are_named(lost: set[int], ignored: set[int], passes: int) -> None:
    first = 5  # triggers before the views: 3 darks and 2 flats
    bench = Instrument(Faults(lost={first + i for i in lost}, ignored={first + i for i in ignored}))
    n = 24
    gone = sorted(lost | ignored)
    run = Run(bench, bench.timeline(n=n, passes=passes))
    assert_true_angles(run)
    if not gone:
        assert run.error is None
        return
    per_pass = n // passes
    silent = [p for p in range(passes) if set(range(p * per_pass, (p + 1) * per_pass)) <= set(gone)]
    if silent:  # not one frame of a whole pass: the instrument is at fault, and there is no point in going on
        assert isinstance(run.error, InstrumentError)
        assert_safe(bench, home=False)
        n = (silent[0] + 1) * per_pass
    else:
        assert isinstance(run.error, LedgerError)
        assert run.error.missing == tuple(run.scan.missing)
        assert f"{len(gone)} of 24 projections are missing" in str(run.error)
        assert_safe(bench)
    assert run.views == [i for i in range(n) if i not in gone]
    assert run.scan.missing == [first + i for i in gone if i < n]


@settings(max_examples=25, deadline=None)
@given(st.sets(st.integers(0, 16)))
def test_step_lost_frames_are_named_and_the_scan_goes_on(lost: set[int]) -> None:
    bench = Instrument(Faults(lost=lost))
    run = Run(bench, bench.timeline(n=12, mode=Mode.STEP))
    assert_true_angles(run)
    runs_of_three = [i for i in range(15) if {i, i + 1, i + 2} <= lost and not (i < 3 <= i + 2 or i < 5 <= i + 2)]
    if runs_of_three:
        assert isinstance(run.error, InstrumentError)
        assert "in a row" in str(run.error)
        taken = [
            f.trigger + (0, 3, 5)[[FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION].index(f.kind)]
            for f in run.frames
        ]
        assert taken == [i for i in range(min(runs_of_three) + 3) if i not in lost]
    else:
        assert run.scan.missing == sorted(lost)
        assert isinstance(run.error, LedgerError) or not lost
        assert len(run.frames) == 17 - len(lost)
    assert_safe(bench, home=not runs_of_three)


def test_where_the_start_is_too_vague_the_error_says_how_far_the_angles_may_be_off() -> None:
    """Pulses every 23 ms, and the first one expected to within 46 ms: an ignored first trigger cannot be told apart."""
    bench = Instrument(Faults(ignored={5}))
    bench.stage.limits = replace(bench.stage.limits, acceleration=np.radians(60).item())
    run = Run(bench, bench.timeline(n=140, speed=55))
    assert isinstance(run.error, LedgerError)
    assert "1 of 140 projections are missing" in str(run.error)
    assert "may all be wrong by up to 1 steps" in str(run.error)


@pytest.mark.parametrize("abort", [False, True])
def test_a_scan_cut_short_says_that_its_first_frame_came_a_trigger_late(abort: bool) -> None:
    """The start is as vague as above, and nothing but that frame's time tells that the first trigger was ignored."""
    stop = StopRequest()
    wish = stop.abort if abort else stop.stop
    bench = Instrument(Faults(ignored={5}), on_frame=lambda number: wish() if number == 40 else None)
    bench.stage.limits = replace(bench.stage.limits, acceleration=np.radians(60).item())
    run = Run(bench, bench.timeline(n=140, speed=55), stop)
    assert type(run.error) is (ScanAborted if abort else ScanStopped)
    assert "may all be wrong by up to 1 steps" in str(run.error)


def test_frames_that_no_trigger_made_become_invalid_rows() -> None:
    bench = Instrument(Faults(extra_after={9, 16}))
    run = Run(bench, bench.timeline(n=12))
    assert run.views == list(range(12))
    invalid = run.of(FrameKind.INVALID)
    assert [f.trigger for f in invalid] == [-1, -1]
    np.testing.assert_allclose(np.degrees([f.angle for f in invalid]), [4 * 15 + 7.5, 11 * 15], atol=0.3)
    assert [f.index for f in run.frames] == list(range(19))
    assert isinstance(run.error, LedgerError)
    assert "2 frames came without a trigger" in str(run.error)
    assert run.error.missing == ()
    assert_safe(bench)


def test_a_camera_error_once_is_survived_twice_is_not() -> None:
    once = Instrument(Faults(errors={10: 1}))
    run = Run(once, once.timeline())
    assert run.error is None
    assert [data["message"] for event, data in run.events if event == "warning"] == ["camera: ring overrun."]
    for_good = Instrument(Faults(errors={10: 99}))
    run = Run(for_good, for_good.timeline())
    assert isinstance(run.error, DeviceError)
    assert len(run.frames) == 10
    assert run.scan.missing == []  # what was never reached is not missing
    assert_safe(for_good, home=False)
    assert f"move {HOME}" not in for_good.log  # with a device that failed nothing moves that need not


def test_a_camera_without_triggers_is_an_instrument_error_that_says_what_to_check() -> None:
    bench = Instrument(Faults(ignored=set(range(5, 99))))
    run = Run(bench, bench.timeline())
    assert isinstance(run.error, InstrumentError)
    assert "trigger cable" in str(run.error)
    assert len(run.frames) == 5
    assert_safe(bench, home=False)


def test_a_camera_that_falls_silent_is_noticed_while_the_stage_still_turns() -> None:
    bench = Instrument(Faults(ignored=set(range(20, 999))))
    start = bench.clock.now()
    run = Run(bench, bench.timeline(n=600, speed=3))
    assert isinstance(run.error, InstrumentError)
    assert "while the stage turned" in str(run.error)
    assert len(run.frames) == 20
    assert bench.clock.now() - start < 15  # of the 60 s that the scan would take
    assert_safe(bench, home=False)


def test_a_stage_that_stops_short_fails_with_its_own_words() -> None:
    bench = Instrument(Faults(stall_at=8700))
    run = Run(bench, bench.timeline(n=12))
    assert isinstance(run.error, DeviceError)
    assert "stopped short" in str(run.error)
    assert run.views == list(range(6))
    assert run.scan.missing == []
    assert_safe(bench, home=False)


def test_a_shutter_that_does_not_open_is_noticed_before_a_frame_is_taken() -> None:
    bench = Instrument(Faults(stuck_shutter=True))
    run = Run(bench, bench.timeline())
    assert isinstance(run.error, InstrumentError)
    assert "shutter: it is closed, flats need it open" in str(run.error)
    assert len(run.frames) == 3
    assert_safe(bench, home=False)


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
@pytest.mark.parametrize("at", [Place.START, Place.END])
def test_a_stop_keeps_what_was_exposed_and_takes_the_references_still_owed(mode: Mode, at: Place) -> None:
    stop = StopRequest()
    first = 5 if at is Place.START else 0
    bench = Instrument(on_frame=lambda number: stop.stop("enough") if number == first + 6 else None)
    run = Run(bench, bench.timeline(n=24, mode=mode, at=at), stop)
    assert type(run.error) is ScanStopped
    assert "of 24 projections: enough" in str(run.error)
    assert run.views == list(range(len(run.views)))
    assert 7 <= len(run.views) < 12
    assert [f.kind for f in run.frames].count(FrameKind.FLAT) == 2
    assert [f.kind for f in run.frames].count(FrameKind.DARK) == 3
    assert_true_angles(run)
    assert_safe(bench)
    assert run.scan.missing == []


def test_frames_taken_while_the_stage_brakes_keep_their_angles_though_they_come_ever_later() -> None:
    stop = StopRequest()
    lost = 33
    bench = Instrument(Faults(lost={5 + lost}), on_frame=lambda number: stop.stop() if number == 35 else None)
    run = Run(bench, bench.timeline(n=140, speed=55), stop)
    assert type(run.error) is ScanStopped
    assert run.views == [i for i in range(len(run.views) + 1) if i != lost]
    assert len(run.views) > 36  # some came while it braked, one of which was lost
    assert np.diff([f.time for f in run.of(FrameKind.PROJECTION)])[-1] > 1.5 * bench.period
    assert run.of(FrameKind.INVALID) == []
    assert_true_angles(run)
    assert run.scan.missing == [5 + lost]


def test_a_stop_in_the_owed_references_ends_the_scan() -> None:
    stop = StopRequest()
    bench = Instrument(on_frame=lambda number: stop.stop() if number == 12 else None)
    run = Run(bench, bench.timeline(n=12, at=Place.END), stop)
    assert type(run.error) is ScanStopped
    assert [f.kind for f in run.frames[12:]] == [FrameKind.FLAT] + [FrameKind.DARK] * 3  # darks were still owed
    assert_safe(bench)


def test_a_stop_during_the_darks_takes_no_views() -> None:
    stop = StopRequest()
    bench = Instrument(on_frame=lambda number: stop.stop() if number == 1 else None)
    run = Run(bench, bench.timeline(at=Place.BOTH), stop)
    assert type(run.error) is ScanStopped
    assert len(run.frames) == 2
    assert_safe(bench)


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
def test_an_abort_leaves_everything_where_it_is_but_safe(mode: Mode) -> None:
    stop = StopRequest()
    bench = Instrument(on_frame=lambda number: stop.abort() if number == 11 else None)
    run = Run(bench, bench.timeline(n=24, mode=mode, at=Place.BOTH), stop)
    assert type(run.error) is ScanAborted
    assert run.error.exit_code == 130
    assert len(run.frames) == 12
    assert "abort stage" in bench.log
    assert f"move {HOME}" not in bench.log
    assert_safe(bench, home=False)
    assert bench.stage.position() != pytest.approx(HOME * COUNT)


@pytest.mark.parametrize("abort", [False, True])
def test_a_request_that_came_before_the_start_is_heeded(abort: bool) -> None:
    stop = StopRequest()
    stop.abort() if abort else stop.stop()
    bench = Instrument()
    run = Run(bench, bench.timeline(), stop)
    assert type(run.error) is ScanAborted
    assert run.error.exit_code == 130
    assert run.frames == []
    assert not any(entry.startswith(("move", "arm")) for entry in bench.log if entry != f"move {HOME}")
    assert_safe(bench)


def test_an_abort_on_the_way_home_stands_at_once() -> None:
    stop = StopRequest()
    bench = Instrument()
    sleep = bench.clock.sleep

    def on_the_way(seconds: float) -> None:
        sleep(seconds)
        if bench.log[-1] == f"move {HOME}":
            stop.abort()

    bench.clock.sleep = on_the_way  # type: ignore[method-assign]
    run = Run(bench, bench.timeline(), stop)
    assert type(run.error) is ScanAborted
    assert len(run.frames) == 17
    assert bench.log[-1] == "abort stage"
    assert_safe(bench, home=False)


class Dawdling(Camera):
    """Slow to be ready again, and every second trigger is fired only 10 ms after the call."""

    @property
    def timing(self) -> CameraTiming:
        return replace(super().timing, min_period=self.settings.exposure + 0.05)

    def software_trigger(self) -> None:
        self.bench.clock.sleep(0.01 * (1 - self.number % 2))
        super().software_trigger()


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
def test_software_triggers_leave_the_least_period_between_exposures_whenever_the_camera_fires(mode: Mode) -> None:
    bench = Instrument()
    bench.camera = Dawdling(bench)
    bench.devices = replace(bench.devices, camera=bench.camera)
    run = Run(bench, bench.timeline(n=8, mode=mode), None)
    assert run.error is None
    for kind, exposure in ((FrameKind.DARK, 0.02), (FrameKind.FLAT, 0.03), (FrameKind.PROJECTION, 0.02)):
        assert np.diff([frame.time for frame in run.of(kind)]).min() > exposure + 0.05 - 1e-6


def test_a_caller_that_gives_up_leaves_a_safe_instrument_at_home() -> None:
    bench = Instrument()
    scan = Acquisition(
        bench.devices, bench.timeline(), CameraSettings(1.0, TriggerSource.INTERNAL), 0.0, bench.clock, StopRequest()
    )
    frames = scan.frames()
    for _ in range(8):
        next(frames)
    frames.close()
    assert_safe(bench)


def test_a_stage_that_cannot_be_made_safe_is_said_though_the_data_are_good() -> None:
    bench = Instrument()

    def fail() -> None:
        raise DeviceError("shutter", "does not answer")

    bench.devices.shutter.close = fail  # type: ignore[method-assign]
    run = Run(bench, bench.timeline(at=Place.NONE))
    assert isinstance(run.error, DeviceError)  # the device's own, with its parts
    assert run.error.device == "shutter"
    assert [data for event, data in run.events if event == "warning"] == []  # it is told once
    assert run.scan.unsafe
    assert len(run.frames) == 12
    assert not bench.camera.armed
    assert f"move {HOME}" not in bench.log


def test_a_shutter_that_closes_at_the_second_try_is_told_and_the_scan_is_good() -> None:
    bench = Instrument()
    tries: list[int] = []
    close = bench.devices.shutter.close

    def at_the_second_try() -> None:
        tries.append(len(tries))
        if len(tries) == 1:
            raise DeviceError("shutter", "does not answer")
        close()

    bench.devices.shutter.close = at_the_second_try  # type: ignore[method-assign]
    bench.is_open = True
    run = Run(bench, bench.timeline(at=Place.NONE))
    assert run.error is None
    assert [data["message"] for event, data in run.events if event == "warning"] == ["shutter: does not answer."]
    assert not run.scan.unsafe
    assert_safe(bench)


def test_a_stage_that_does_not_obey_a_stop_is_aborted() -> None:
    bench = Instrument(Faults(errors={10: 99}))

    def deaf() -> None:
        raise DeviceTimeout("stage", "no reply")

    bench.devices.stage.stop = deaf  # type: ignore[method-assign]
    run = Run(bench, bench.timeline())
    assert isinstance(run.error, DeviceError)
    assert run.error.device == "camera"
    assert [data["message"] for event, data in run.events if event == "warning"][1:] == ["stage: no reply."] * 2
    assert bench.log.count("abort stage") == 1
    assert_safe(bench, home=False)


def test_a_way_home_that_fails_leaves_a_stage_that_stands() -> None:
    bench = Instrument()
    moving = bench.devices.stage.moving

    def dies_on_the_way_home() -> bool:
        if bench.log[-1] == f"move {HOME}":
            raise DeviceTimeout("stage", "no reply")
        return moving()

    bench.devices.stage.moving = dies_on_the_way_home  # type: ignore[method-assign]
    run = Run(bench, bench.timeline())
    assert isinstance(run.error, DeviceTimeout)
    assert not run.scan.unsafe
    assert len(run.frames) == 17
    assert bench.log[-1] == "stop stage"
    assert not moving()
    assert not bench.is_open


def test_a_defect_in_one_driver_does_not_leave_the_other_devices_unsafe() -> None:
    bench = Instrument(Faults(errors={10: 99}))

    def fail() -> None:
        raise ZeroDivisionError("defect")

    bench.devices.stage.stop = fail  # type: ignore[method-assign]
    run = Run(bench, bench.timeline())
    assert isinstance(run.error, DeviceError)  # what went wrong first
    assert "ZeroDivisionError: defect" in [data["message"] for event, data in run.events if event == "warning"]
    assert not bench.is_open
    assert not bench.camera.armed
