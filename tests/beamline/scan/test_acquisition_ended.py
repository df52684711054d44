"""A scan that is stopped, aborted or ended by a device: exposed frames keep their angles; the end is safe."""

import numpy as np
import pytest

from beamline.core.errors import InstrumentError, ScanStopped
from beamline.core.stop import ScanAborted, StopRequest
from beamline.plan.plan import Mode, Place
from beamline.scan.acquisition import Acquisition
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraSettings, TriggerSource
from tests.beamline.acquired import Run, assert_safe
from tests.beamline.fakes import COUNT, HOME, FakeInstrument, Faults, assert_true


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
@pytest.mark.parametrize("at", [Place.START, Place.END])
def test_a_stop_keeps_what_was_exposed_and_takes_the_references_still_owed(mode: Mode, at: Place) -> None:
    stop = StopRequest()
    first = 5 if at is Place.START else 0
    instrument = FakeInstrument(at={first + 6: lambda: stop.stop("enough")})
    run = Run(instrument, instrument.timeline(n=24, mode=mode, at=at), stop)
    assert type(run.error) is ScanStopped
    assert "of 24 projections: enough" in str(run.error)
    assert run.views == list(range(len(run.views)))
    assert 7 <= len(run.views) < 12
    assert [f.kind for f in run.frames].count(FrameKind.FLAT) == 2
    assert [f.kind for f in run.frames].count(FrameKind.DARK) == 3
    assert_true(run.frames, COUNT / 2)
    assert_safe(instrument)
    assert run.scan.missing == []


def test_frames_taken_while_the_stage_brakes_keep_their_angles_though_they_come_ever_later() -> None:
    stop = StopRequest()
    lost = 33
    instrument = FakeInstrument(Faults(lost={5 + lost}), at={35: stop.stop})
    run = Run(instrument, instrument.timeline(n=140, speed=55), stop)
    assert type(run.error) is ScanStopped
    assert run.views == [i for i in range(len(run.views) + 1) if i != lost]
    assert len(run.views) > 36  # some came while it braked, one of which was lost
    assert np.diff([f.time for f in run.of(FrameKind.PROJECTION)])[-1] > 1.5 * instrument.period
    assert run.of(FrameKind.INVALID) == []
    assert_true(run.frames, COUNT / 2)
    assert run.scan.missing == [5 + lost]


@pytest.mark.parametrize(
    ("at", "number", "taken"),
    [(Place.END, 12, "P" * 12 + "F" + "DDD"), (Place.BOTH, 1, "DD")],  # darks of the end alone are still owed
)
def test_a_stop_in_references_ends_the_scan(at: Place, number: int, taken: str) -> None:
    stop = StopRequest()
    instrument = FakeInstrument(at={number: stop.stop})
    run = Run(instrument, instrument.timeline(n=12, at=at), stop)
    assert type(run.error) is ScanStopped
    assert "".join(frame.kind.name[0] for frame in run.frames) == taken
    assert_safe(instrument)


@pytest.mark.parametrize("mode", [Mode.FLY, Mode.STEP])
def test_an_abort_leaves_everything_where_it_is_but_safe(mode: Mode) -> None:
    stop = StopRequest()
    instrument = FakeInstrument(at={11: stop.abort})
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


def test_a_camera_error_once_is_survived_twice_is_not() -> None:
    once = FakeInstrument(Faults(errors={10: 1}))
    run = Run(once, once.timeline())
    assert run.error is None
    assert run.warnings == ["camera: ring overrun."]
    for_good = FakeInstrument(Faults(errors={10: 99}))
    run = Run(for_good, for_good.timeline())
    assert isinstance(run.error, DeviceError)
    assert len(run.frames) == 10
    assert run.scan.missing == []  # what was never reached is not missing
    assert_safe(for_good, home=False)
    assert f"move {HOME}" not in for_good.log  # with a device that failed nothing moves that need not


@pytest.mark.parametrize(
    ("faults", "error", "said", "frames"),
    [
        (Faults(ignored=set(range(5, 99))), InstrumentError, "trigger cable", 5),
        (Faults(stall_at=8700), DeviceError, "stopped short", 5 + 6),
        (
            Faults(stuck_shutter=True),
            InstrumentError,
            "shutter: the device is closed, but for flats it must be open",
            3,
        ),
    ],
)
def test_a_device_that_does_not_do_its_part_ends_the_scan_in_its_own_words(
    faults: Faults, error: type[Exception], said: str, frames: int
) -> None:
    run = Run(instrument := FakeInstrument(faults), instrument.timeline())
    assert isinstance(run.error, error) and said in str(run.error)
    assert (len(run.frames), run.scan.missing) == (frames, [])
    assert_safe(instrument, home=False)


def test_a_camera_that_falls_silent_is_noticed_while_the_stage_still_turns() -> None:
    instrument = FakeInstrument(Faults(ignored=set(range(20, 999))))
    start = instrument.clock.now()
    run = Run(instrument, instrument.timeline(n=600, speed=3))
    assert isinstance(run.error, InstrumentError)
    assert "while the stage turned" in str(run.error)
    assert len(run.frames) == 20
    assert instrument.clock.now() - start < 15  # of the 60 s that the scan would take
    assert_safe(instrument, home=False)


def test_an_error_of_a_device_does_not_hide_what_was_lost_before_it() -> None:
    instrument = FakeInstrument(Faults(lost={5 + 2}, extra_after={5 + 3}, stall_at=8700))
    run = Run(instrument, instrument.timeline(n=12))
    assert isinstance(run.error, DeviceError) and "stopped short" in str(run.error)
    (told,) = run.warnings
    assert told.startswith(
        "1 of 12 projections is missing: 2 (at 30°). Exposed, but never delivered by the camera: 1 frame"
    )
    assert "1 frame came without a trigger" in told


def test_a_stage_that_cannot_be_made_safe_is_said_though_the_data_are_good() -> None:
    instrument = FakeInstrument()

    def fail() -> None:
        raise DeviceError("shutter", "does not answer")

    instrument.devices.shutter.close = fail  # type: ignore[method-assign]
    run = Run(instrument, instrument.timeline(at=Place.NONE))
    assert isinstance(run.error, DeviceError)  # the device's own, with its parts
    assert run.error.device == "shutter"
    assert [data for event, data in run.events if event == "warning"] == []  # it is told once
    assert run.scan.unsafe
    assert len(run.frames) == 12
    assert not instrument.camera.armed
    assert f"move {HOME}" not in instrument.log


def test_a_shutter_that_closes_at_the_second_try_is_told_and_the_scan_is_good() -> None:
    instrument = FakeInstrument()
    tries: list[int] = []
    close = instrument.devices.shutter.close

    def at_the_second_try() -> None:
        tries.append(len(tries))
        if len(tries) == 1:
            raise DeviceError("shutter", "does not answer")
        close()

    instrument.devices.shutter.close = at_the_second_try  # type: ignore[method-assign]
    instrument.is_open = True
    run = Run(instrument, instrument.timeline(at=Place.NONE))
    assert run.error is None
    assert run.warnings == ["shutter: does not answer."]
    assert not run.scan.unsafe
    assert_safe(instrument)


def test_a_stage_that_does_not_obey_a_stop_is_aborted() -> None:
    instrument = FakeInstrument(Faults(errors={10: 99}))

    def deaf() -> None:
        raise DeviceTimeout("stage", "no reply")

    instrument.devices.stage.stop = deaf  # type: ignore[method-assign]
    run = Run(instrument, instrument.timeline())
    assert isinstance(run.error, DeviceError)
    assert run.error.device == "camera"
    assert run.warnings[1:] == ["stage: no reply."] * 2
    assert instrument.log.count("abort stage") == 1
    assert_safe(instrument, home=False)


def test_a_way_home_that_fails_leaves_a_stage_that_stands() -> None:
    instrument = FakeInstrument()
    moving = instrument.devices.stage.moving

    def dies_on_the_way_home() -> bool:
        if instrument.log[-1] == f"move {HOME}":
            raise DeviceTimeout("stage", "no reply")
        return moving()

    instrument.devices.stage.moving = dies_on_the_way_home  # type: ignore[method-assign]
    run = Run(instrument, instrument.timeline())
    assert isinstance(run.error, DeviceTimeout)
    assert not run.scan.unsafe
    assert len(run.frames) == 17
    assert instrument.log[-1] == "stop stage"
    assert not moving()
    assert not instrument.is_open


def test_a_defect_in_one_driver_does_not_leave_the_other_devices_unsafe() -> None:
    instrument = FakeInstrument(Faults(errors={10: 99}))

    def fail() -> None:
        raise ZeroDivisionError("defect")

    instrument.devices.stage.stop = fail  # type: ignore[method-assign]
    run = Run(instrument, instrument.timeline())
    assert isinstance(run.error, DeviceError)  # what went wrong first
    assert "ZeroDivisionError: defect" in run.warnings
    assert not instrument.is_open
    assert not instrument.camera.armed
