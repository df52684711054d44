"""Waiting until the camera is cold: the cooler is ready or, if it does not report that, the temperature is steady."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.dcam.camera import DcamCamera
from drivers.dcam.codes import Cooler, Property
from tests.drivers.dcam.fake import World
from tests.messages import refused

TARGET = -20.0


def cool(world: World, status: Callable[[float], Cooler], rate: float = 0.5) -> Callable[[float, str], None]:
    """A sensor that cools from 0 °C at `rate` °C/s; it is updated whenever the driver reports its progress."""
    begin = world.clock.now()

    def play(celsius: float, text: str) -> None:
        now = max(TARGET, -rate * (world.clock.now() + 1.0 - begin))  # as it will be at the next look
        world.override(Property.SENSORTEMPERATURE, now)
        world.override(Property.SENSORCOOLERSTATUS, status(now))

    play(0.0, "")
    return play


def test_it_waits_until_the_cooler_is_ready_and_reports_how_far_it_is(camera: DcamCamera, world: World) -> None:
    play = cool(world, lambda celsius: Cooler.READY if celsius <= TARGET else Cooler.BUSY)
    reports: list[tuple[float, str]] = []
    began = world.clock.now()
    reached = camera.wait_until_cold(
        120.0, lambda celsius, status: (reports.append((celsius, status)), play(celsius, ""))[1]
    )
    assert reached == TARGET
    assert world.clock.now() - began == pytest.approx(39, abs=1.5)
    assert reports[-1] == (TARGET, "ready")
    assert [status for _, status in reports[:-1]] == ["busy"] * (len(reports) - 1)
    assert [celsius for celsius, _ in reports] == sorted((celsius for celsius, _ in reports), reverse=True)


@pytest.mark.parametrize("status", [Cooler.ALWAYS, Cooler.NONE, None])
def test_a_cooler_that_does_not_say_so_is_done_when_the_temperature_is_steady(
    camera: DcamCamera, world: World, status: Cooler | None
) -> None:
    play = cool(world, lambda celsius: status or Cooler.NONE)
    if status is None:
        world.fault("unsupported", Property.SENSORCOOLERSTATUS)

        def play(celsius: float, text: str, begin: float = world.clock.now()) -> None:
            world.override(Property.SENSORTEMPERATURE, max(TARGET, -0.5 * (world.clock.now() + 1.0 - begin)))

    began = world.clock.now()
    assert camera.wait_until_cold(300.0, play) == TARGET
    assert world.clock.now() - began == pytest.approx(40 + 60, abs=3)


@pytest.mark.parametrize(("number", "name"), [(7, "none"), (-9, "error1")])
def test_a_cooler_s_status_that_is_not_known_is_no_defect(
    camera: DcamCamera, world: World, number: int, name: str
) -> None:
    world.override(Property.SENSORCOOLERSTATUS, number)
    assert camera.describe()["cooler"] == name


def test_a_sensor_that_does_not_get_cold_is_a_timeout(camera: DcamCamera, world: World) -> None:
    play = cool(world, lambda celsius: Cooler.BUSY, rate=0.01)
    began = world.clock.now()
    with refused(DeviceTimeout):
        camera.wait_until_cold(30.0, play)
    assert world.clock.now() - began == pytest.approx(30, abs=0.01)


def test_a_cooler_that_is_off_is_refused(camera: DcamCamera, world: World) -> None:
    world.override(Property.SENSORCOOLERSTATUS, Cooler.OFF)
    with refused(DeviceRefused):
        camera.wait_until_cold(30.0)


def test_a_cooler_in_trouble_is_an_error(camera: DcamCamera, world: World) -> None:
    world.override(Property.SENSORCOOLERSTATUS, Cooler.ERROR2)
    with refused(DeviceError):
        camera.wait_until_cold(30.0)
