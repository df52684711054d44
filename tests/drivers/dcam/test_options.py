"""Options for trigger and counts: each one reaches the camera, is read back, and has its effect."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.dcam.camera import DcamCamera
from drivers.dcam.codes import Error, Property
from drivers.orca_quest import DcamOptions, GlobalExposure, HotPixelMode, TriggerActive, TriggerMode, TriggerPolarity
from tests.drivers.dcam.fake import World
from tests.messages import refused

EXTERNAL = CameraSettings(0.001, TriggerSource.EXTERNAL)
PULSE_WIDTH = 1e-3
"""s; of the fake's pulses."""
LINES = 48 / 2 + 5
"""Line times that a frame of the fake's sensor takes."""


@contextmanager
def connected(world: World, **options: Any) -> Iterator[DcamCamera]:
    camera = world.connect(DcamOptions(**options))
    try:
        camera.configure(EXTERNAL)
        yield camera
    finally:
        camera.close()
    assert world.live == 0


@pytest.mark.parametrize(
    ("option", "prop", "value"),
    [
        ({"trigger_active": TriggerActive.LEVEL}, Property.TRIGGERACTIVE, 2),
        ({"trigger_active": TriggerActive.SYNC_READOUT}, Property.TRIGGERACTIVE, 3),
        ({"trigger_mode": TriggerMode.START}, Property.TRIGGER_MODE, 6),
        ({"trigger_polarity": TriggerPolarity.NEGATIVE}, Property.TRIGGERPOLARITY, 1),
        ({"global_exposure": GlobalExposure.GLOBAL_RESET}, Property.TRIGGER_GLOBALEXPOSURE, 5),
        ({"trigger_times": 3}, Property.TRIGGERTIMES, 3),
        ({"trigger_delay": 0.25}, Property.TRIGGERDELAY, 0.25),
        ({"hot_pixels": HotPixelMode.AGGRESSIVE}, Property.HOTPIXELCORRECT_LEVEL, 3),
        ({"hot_pixels": HotPixelMode.MINIMUM}, Property.DEFECTCORRECT_MODE, 2),
    ],
)
def test_an_option_reaches_the_camera_and_one_that_it_ignores_is_noticed(
    world: World, option: dict[str, Any], prop: Property, value: float
) -> None:
    with connected(world, **option) as camera:
        assert world.value(prop) == value
        if prop not in (Property.DEFECTCORRECT_MODE, Property.HOTPIXELCORRECT_LEVEL):
            ((name, chosen),) = option.items()
            assert camera.describe()[name] == chosen
    world.reset()
    stuck = world.value(prop) if world.value(prop) != value else value + 1
    world.override(prop, stuck)
    with (
        pytest.raises(DeviceRefused, match=f"{prop.name} = {stuck:g}"),
        connected(world, **option),
    ):
        pass
    assert world.live == 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"trigger_times": 0},
        {"trigger_times": 10_001},
        {"trigger_delay": -1e-6},
        {"trigger_delay": 10.1},
        {"trigger_delay": float("nan")},
        {"exposure_tolerance": -0.1},
        {"ring": 0},
    ],
)
def test_numbers_that_no_camera_takes_are_refused_at_once(wrong: dict[str, Any]) -> None:
    (name,) = wrong
    with pytest.raises(ValueError, match=name):
        DcamOptions(**wrong)


def test_negative_polarity_takes_the_end_of_a_pulse(world: World) -> None:
    with connected(world, trigger_polarity=TriggerPolarity.NEGATIVE) as camera:
        camera.arm(1)
        rise = world.clock.now() + 0.5
        world.schedule([rise])
        assert camera.next_frame(1.0).time == pytest.approx(rise + PULSE_WIDTH, abs=3e-6)


def test_a_delay_moves_the_exposure_but_not_the_time_of_the_trigger(world: World) -> None:
    with connected(world, trigger_delay=0.25) as camera:
        camera.arm(2)
        times = world.clock.now() + np.array([0.5, 1.5])
        world.schedule(times.tolist())
        assert [camera.next_frame(2.0).time for _ in times] == pytest.approx(times, abs=3e-6)
        readout = camera.timing.readout
        assert world.clock.now() == pytest.approx(times[-1] + 0.25 + 0.001 + readout, abs=1e-5)


def test_every_third_pulse_is_a_frame_and_pulses_may_be_three_times_as_close(world: World) -> None:
    with connected(world) as camera:
        usual = camera.timing.min_period
    world.reset()
    with connected(world, trigger_times=3) as camera:
        assert camera.timing.min_period == pytest.approx(usual / 3)
        camera.arm(3)
        times = world.clock.now() + 1.05 * camera.timing.min_period * np.arange(1, 10)
        world.schedule(times.tolist())
        assert [camera.next_frame(1.0).time for _ in range(3)] == pytest.approx(times[2::3], abs=3e-6)


def test_level_exposes_while_the_pulse_lasts(world: World) -> None:
    with connected(world, trigger_active=TriggerActive.LEVEL) as camera:
        camera.configure(replace(EXTERNAL, exposure=PULSE_WIDTH))
        assert camera.timing.min_period == pytest.approx(LINES * 7.2e-6)
        camera.arm(2)
        times = world.clock.now() + np.array([0.5, 0.6])
        world.schedule(times.tolist())
        assert [camera.next_frame(1.0).time for _ in times] == pytest.approx(times, abs=3e-6)


def test_sync_readout_has_no_dead_time_and_one_frame_less_than_pulses(world: World) -> None:
    with connected(world, trigger_active=TriggerActive.SYNC_READOUT) as camera:
        period = 1.05 * camera.timing.min_period
        camera.configure(replace(EXTERNAL, exposure=period))
        assert period < 0.001  # shorter than an edge trigger could have it with that exposure
        camera.arm(5)
        times = world.clock.now() + 0.1 + period * np.arange(5)
        world.schedule(times.tolist())
        assert [camera.next_frame(1.0).time for _ in range(4)] == pytest.approx(times[:4], abs=3e-6)
        with pytest.raises(DeviceTimeout):
            camera.next_frame(0.05)


def test_start_runs_freely_from_the_first_pulse_and_can_be_armed_again(world: World) -> None:
    """The camera itself turns its trigger source to internal with the first pulse."""
    with connected(world, trigger_mode=TriggerMode.START) as camera:
        for _ in range(2):
            camera.arm(3)
            with pytest.raises(DeviceTimeout):
                camera.next_frame(0.1)
            pulse = world.clock.now() + 0.5
            world.schedule([pulse])
            frames = [camera.next_frame(1.0) for _ in range(3)]
            interval = world.value(Property.INTERNAL_FRAMEINTERVAL)
            assert [frame.framestamp for frame in frames] == [0, 1, 2]
            assert [frame.time for frame in frames] == pytest.approx(pulse + interval * np.arange(3), abs=3e-6)
            assert world.value(Property.TRIGGERSOURCE) == 1
            camera.disarm()


@pytest.mark.parametrize(
    "option",
    [
        {"trigger_active": TriggerActive.LEVEL},
        {"trigger_active": TriggerActive.SYNC_READOUT},
        {"trigger_mode": TriggerMode.START},
        {"trigger_times": 3},
        {"trigger_delay": 0.25},
    ],
)
def test_how_pulses_are_taken_does_not_reach_software_triggers(world: World, option: dict[str, Any]) -> None:
    """Darks, flats and step scans: one frame of the set exposure a trigger, whatever the pulses of a fly scan do."""
    with connected(world, **option) as camera:
        camera.configure(CameraSettings(0.001, TriggerSource.SOFTWARE))
        plain = (Property.TRIGGERACTIVE, Property.TRIGGER_MODE, Property.TRIGGERTIMES, Property.TRIGGERDELAY)
        assert [world.value(prop) for prop in plain] == [1, 1, 1, 0]
        camera.arm(3)
        for stamp in range(3):
            camera.software_trigger()
            assert camera.next_frame(1.0).framestamp == stamp


def test_photon_number_resolving_is_a_readout(world: World) -> None:
    with connected(world) as camera:
        asked = replace(EXTERNAL, readout="photon_number", binning=2)
        assert camera.configure(asked) == asked
        assert world.value(Property.SENSORMODE) == 18
        # Timing as ultra quiet; what counts mean, the camera says itself.
        assert camera.timing.min_period == pytest.approx(0.001 + LINES * 172.8e-6)
        described = camera.describe()
        assert (described["readout"], described["conversion_factor"]) == ("photon_number", 1)
        with refused(DeviceRefused):
            camera.configure(replace(asked, exposure=100e-6))
        assert camera.configure(EXTERNAL) == EXTERNAL  # and back


def test_repairs_are_refused_where_photons_are_counted(world: World) -> None:
    with connected(world, hot_pixels=HotPixelMode.STANDARD) as camera:
        assert camera.describe()["hot_pixels"] == "standard"
        with pytest.raises(DeviceRefused, match="DEFECTCORRECT_MODE"):
            camera.configure(replace(EXTERNAL, readout="photon_number"))
        assert camera.configure(EXTERNAL) == EXTERNAL


@pytest.mark.parametrize(("accepted", "rejected"), [(0.00100900, False), (0.00101701, False), (0.00101721, True)])
def test_an_exposure_may_be_rounded_but_not_ignored(world: World, accepted: float, rejected: bool) -> None:
    """By a hundredth and one line time of 7.2 us."""
    with connected(world) as camera:
        world.override(Property.EXPOSURETIME, accepted)
        if rejected:
            with refused(DeviceRefused):
                camera.configure(EXTERNAL)
        else:
            assert camera.configure(EXTERNAL).exposure == accepted


@pytest.mark.parametrize(
    "absent",
    [
        Property.BITSPERCHANNEL,
        Property.DEFECTCORRECT_MODE,
        Property.FRAMEBUNDLE_MODE,
        Property.SENSORCOOLERSTATUS,
        Property.TIMESTAMP_PRODUCER,
        Property.SENSORTEMPERATURE,
        Property.CONVERSIONFACTOR_COEFF,
        Property.CONVERSIONFACTOR_OFFSET,
        Property.INTERNAL_FRAMEINTERVAL,
        0x04000105,  # the text CAMERAVERSION
    ],
)
def test_what_a_model_does_not_have_is_not_missed(world: World, absent: int) -> None:
    world.fault("unsupported", absent)
    with connected(world) as camera:
        assert camera.timing.bits == 16
        assert "model" in camera.describe()
        camera.arm(1)
        world.pulse()
        np.testing.assert_array_equal(camera.next_frame(1.0).counts, world.pattern(0))


def test_a_library_without_capabilities_of_stamps_is_still_described(world: World) -> None:
    with connected(world) as camera:
        world.fail("dcamdev_getcapability", Error.NOTSUPPORT)
        assert camera.describe()["capabilities"] == "not reported"


def test_what_it_must_have_is_missed_by_name(world: World) -> None:
    world.fault("unsupported", Property.TRIGGERPOLARITY)
    with refused(DeviceRefused):
        world.connect()
    assert world.live == 0


def test_a_camera_that_does_not_count_its_frames_is_refused(world: World) -> None:
    world.fault("no_stamps")
    with refused(DeviceError):
        world.connect()
    assert world.live == 0


def test_the_description_says_who_makes_stamps(world: World) -> None:
    with connected(world) as camera:
        described = camera.describe()
        assert described["capabilities"] == "framestamp|timestamp"
        assert described["framestamps_by"] == described["timestamps_by"] == "the camera"
        assert described["hot_pixels"] == "as measured"
