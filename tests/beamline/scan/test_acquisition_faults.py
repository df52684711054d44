"""What goes wrong in a scan: it ends in its own words with what was taken, and the instrument ends up safe."""

from __future__ import annotations

from beamline.core.errors import InstrumentError
from beamline.plan.plan import Place
from drivers.base.errors import DeviceError, DeviceTimeout
from tests.beamline.acquired import Run, assert_safe
from tests.beamline.fakes import HOME, FakeInstrument, Faults


def test_a_camera_error_once_is_survived_twice_is_not() -> None:
    once = FakeInstrument(Faults(errors={10: 1}))
    run = Run(once, once.timeline())
    assert run.error is None
    assert [data["message"] for event, data in run.events if event == "warning"] == ["camera: ring overrun."]
    for_good = FakeInstrument(Faults(errors={10: 99}))
    run = Run(for_good, for_good.timeline())
    assert isinstance(run.error, DeviceError)
    assert len(run.frames) == 10
    assert run.scan.missing == []  # what was never reached is not missing
    assert_safe(for_good, home=False)
    assert f"move {HOME}" not in for_good.log  # with a device that failed nothing moves that need not


def test_a_camera_without_triggers_is_an_instrument_error_that_says_what_to_check() -> None:
    instrument = FakeInstrument(Faults(ignored=set(range(5, 99))))
    run = Run(instrument, instrument.timeline())
    assert isinstance(run.error, InstrumentError)
    assert "trigger cable" in str(run.error)
    assert len(run.frames) == 5
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


def test_a_stage_that_stops_short_fails_with_its_own_words() -> None:
    instrument = FakeInstrument(Faults(stall_at=8700))
    run = Run(instrument, instrument.timeline(n=12))
    assert isinstance(run.error, DeviceError)
    assert "stopped short" in str(run.error)
    assert run.views == list(range(6))
    assert run.scan.missing == []
    assert_safe(instrument, home=False)


def test_an_error_of_a_device_does_not_hide_what_was_lost_before_it() -> None:
    instrument = FakeInstrument(Faults(lost={5 + 2}, extra_after={5 + 3}, stall_at=8700))
    run = Run(instrument, instrument.timeline(n=12))
    assert isinstance(run.error, DeviceError) and "stopped short" in str(run.error)
    (told,) = [data["message"] for event, data in run.events if event == "warning"]
    assert told.startswith("1 of 12 projections are missing: 2 (from 30° to 30°). 1 were exposed but never delivered")
    assert "1 frames came without a trigger" in told


def test_a_shutter_that_does_not_open_is_noticed_before_a_frame_is_taken() -> None:
    instrument = FakeInstrument(Faults(stuck_shutter=True))
    run = Run(instrument, instrument.timeline())
    assert isinstance(run.error, InstrumentError)
    assert "shutter: it is closed, flats need it open" in str(run.error)
    assert len(run.frames) == 3
    assert_safe(instrument, home=False)


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
    assert [data["message"] for event, data in run.events if event == "warning"] == ["shutter: does not answer."]
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
    assert [data["message"] for event, data in run.events if event == "warning"][1:] == ["stage: no reply."] * 2
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
    assert "ZeroDivisionError: defect" in [data["message"] for event, data in run.events if event == "warning"]
    assert not instrument.is_open
    assert not instrument.camera.armed
