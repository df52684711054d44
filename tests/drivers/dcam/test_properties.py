"""Settings: applied, read back, or rejected without a change; timing as the camera reports it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from drivers import orca_quest
from drivers.base.errors import DeviceRefused
from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.dcam.camera import DcamCamera
from drivers.dcam.codes import Property
from tests.drivers.dcam.fake import World

EXTERNAL = CameraSettings(0.001, TriggerSource.EXTERNAL)


def test_exposure_is_the_value_that_the_camera_accepted(camera: DcamCamera) -> None:
    """Steps of 10 ns, upwards."""
    accepted = camera.configure(replace(EXTERNAL, exposure=0.0010000123))
    assert accepted.exposure == pytest.approx(0.00100002, abs=1e-12)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"exposure": 1e-6}, r"EXPOSURETIME = 1e-06 is out of range\..* legal: 7\.2e-06 to 1800 s"),
        ({"exposure": 100e-6, "readout": "ultra_quiet"}, r"legal: 0\.0001728 to 1800 s"),
        ({"exposure": 2000.0}, "out of range"),
        (
            {"binning": 3},
            r"rejects BINNING = 3\..* 'INVALIDVALUE \(0x80000821\)'.* legal: 1, 2, 4",
        ),
        ({"roi": (0, 0, 30, 40)}, r"set SUBARRAYVSIZE = 32 instead of 30\..* legal: 4 to 48 in steps of 4"),
        (
            {"roi": (32, 0, 32, 40)},
            r"region \(32, 0, 32, 40\) .* extends beyond the sensor\. Expected a region within 48 x 72",
        ),
        ({"roi": (0, 0, 96, 40)}, "extends beyond the sensor"),
        ({"readout": "fast"}, r"no readout 'fast'\..* legal: standard, ultra_quiet"),
    ],
)
def test_a_refusal_says_why_and_leaves_the_settings(camera: DcamCamera, wrong: dict[str, Any], message: str) -> None:
    before = camera.configure(CameraSettings(0.003, TriggerSource.EXTERNAL, roi=(4, 8, 20, 24), binning=2))
    timing = camera.timing
    with pytest.raises(DeviceRefused, match=message):
        camera.configure(replace(EXTERNAL, **wrong))
    assert camera.timing == timing
    assert camera.configure(before) == before


@pytest.mark.parametrize(
    ("prop", "left", "needed"),
    [
        (Property.TRIGGERPOLARITY, 1, 2),  # positive
        (Property.TRIGGERTIMES, 3, 1),
        (Property.TRIGGERDELAY, 0.5, 0),
        (Property.TRIGGER_MODE, 6, 1),  # normal
        (Property.TRIGGERACTIVE, 2, 1),  # edge
        (Property.TRIGGER_GLOBALEXPOSURE, 5, 3),  # delayed
        (Property.SENSORMODE, 12, 1),  # area
        (Property.IMAGE_PIXELTYPE, 1, 2),  # MONO16
        (Property.BITSPERCHANNEL, 12, 16),
        (Property.DEFECTCORRECT_MODE, 2, 1),  # off
    ],
)
def test_what_another_program_left_is_undone(
    camera: DcamCamera, world: World, prop: Property, left: float, needed: float
) -> None:
    world.preset(prop, left)
    camera.configure(EXTERNAL)
    assert world.value(prop) == needed


def test_bundled_frames_are_refused(camera: DcamCamera, world: World) -> None:
    world.override(Property.FRAMEBUNDLE_MODE, 2)
    with pytest.raises(DeviceRefused, match=r"combines several frames.*larger region"):
        camera.configure(EXTERNAL)


@pytest.mark.parametrize("readout", orca_quest.LINE_TIME)
@pytest.mark.parametrize("trigger", [TriggerSource.EXTERNAL, TriggerSource.SOFTWARE])
def test_full_frame_timing_is_that_of_the_data_sheet(world: World, readout: str, trigger: TriggerSource) -> None:
    """The fake computes times in C from the property table; the planner's figures were typed from the data sheet."""
    world.reset(*orca_quest.SENSOR_SHAPE)
    camera = world.connect()
    settings = CameraSettings(0.02, trigger, readout=readout)
    camera.configure(settings)
    reported, planned = camera.timing, orca_quest.timing(settings, link="coaxpress")
    camera.close()
    assert (reported.shape, reported.bits) == (planned.shape, planned.bits)
    assert (reported.min_period, reported.readout) == pytest.approx((planned.min_period, planned.readout), rel=1e-9)
    assert reported.row_period == pytest.approx(planned.row_period, rel=1e-9)


def test_rows_of_a_binned_region_start_two_line_times_apart(camera: DcamCamera) -> None:
    """Two sensor rows in 7.2 us; four summed rows therefore follow each other in 14.4 us."""
    camera.configure(replace(EXTERNAL, roi=(0, 0, 32, 40), binning=4))
    assert camera.timing.row_period == pytest.approx(14.4e-6)


@pytest.mark.parametrize(
    "slowest",
    [
        Property.TIMING_MINTRIGGERINTERVAL,
        Property.TIMING_CYCLICTRIGGERPERIOD,
        Property.TIMING_MINTRIGGERBLANKING,
        Property.INTERNAL_FRAMEINTERVAL,  # over USB it is the link's, which is slower than the sensor
    ],
)
def test_the_strictest_trigger_rule_sets_the_least_period(camera: DcamCamera, world: World, slowest: Property) -> None:
    world.override(slowest, 0.5)
    expected = 0.501 if slowest is Property.TIMING_MINTRIGGERBLANKING else 0.5
    assert camera.timing.min_period == pytest.approx(expected)


def test_free_run_overlaps_readout_and_exposure(camera: DcamCamera) -> None:
    """Internal trigger: 1 / max(exposure, readout), not 1 / (exposure + readout)."""
    camera.configure(replace(EXTERNAL, trigger=TriggerSource.INTERNAL, exposure=0.01))
    assert camera.timing.min_period == pytest.approx(0.01)
