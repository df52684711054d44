"""Every library call fails in turn, or the cable is pulled there: one named error, and a new camera works."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.dcam.abi import ARGUMENTS, DcamError
from drivers.dcam.camera import DcamCamera
from drivers.dcam.codes import Error
from tests.drivers.dcam.fake import World

EXTERNAL = CameraSettings(0.001, TriggerSource.EXTERNAL, roi=(8, 12, 16, 20))


def use(camera: DcamCamera, world: World) -> None:
    """Everything that a camera is asked in its life, but its end."""
    camera.configure(EXTERNAL)
    with pytest.raises(DeviceRefused):
        camera.configure(replace(EXTERNAL, binning=3))  # legal values are looked up
    camera.wait_until_cold(1.0)
    camera.arm(2)
    world.pulses(2)
    assert [camera.next_frame(1.0).framestamp for _ in range(2)] == [0, 1]
    with pytest.raises(DeviceTimeout):
        camera.next_frame(0.01)
    camera.disarm()
    camera.configure(replace(EXTERNAL, trigger=TriggerSource.SOFTWARE))
    camera.arm(1)
    camera.software_trigger()
    assert camera.next_frame(1.0).framestamp == 0
    assert camera.timing.shape == (16, 20)
    camera.describe()
    camera.disarm()


def whole_life(world: World) -> list[DeviceError]:
    """What went wrong, in order; the camera is closed whatever happens."""
    try:
        camera = world.connect()
    except DeviceError as error:
        return [error]
    errors = []
    for step in (lambda: use(camera, world), camera.close, camera.close):
        try:
            step()
        except DeviceError as error:
            errors.append(error)
    return errors


def calls_of_a_life(library: Path, call: str) -> int:
    world = World(library)
    assert whole_life(world) == []
    return world.calls(call)


@pytest.mark.parametrize("call", ARGUMENTS)
def test_an_error_at_any_call_is_one_error_with_its_name(fake_library: Path, call: str) -> None:
    n = calls_of_a_life(fake_library, call)
    assert n > 0, f"{call} is never called"
    for nth in range(1, n + 1):
        world = World(fake_library)
        world.fail(call, Error.FAILREADCAMERA, nth)
        (error,) = whole_life(world)
        assert isinstance(error, DcamError), nth
        assert error.code == Error.FAILREADCAMERA
        assert error.request.split()[0] == call
        assert world.live == 0, f"something stays open after call {nth}"
        assert whole_life(world) == [], "a new camera in the same process"


@pytest.mark.parametrize("call", ARGUMENTS)
def test_a_cable_that_comes_out_at_any_call_is_said_at_most_once(fake_library: Path, call: str) -> None:
    """At the end of its life nobody has to know."""
    for nth in range(1, calls_of_a_life(fake_library, call) + 1):
        world = World(fake_library)
        world.fail(call, Error.NOCONNECTION, nth)
        errors = whole_life(world)
        assert [error.reply for error in errors] in ([], ["NOCONNECTION (0x80000F07)"])
        assert errors or call in ("dcamapi_uninit", "dcamdev_close", "dcamwait_close", *STOPPING)
        assert world.live == 0
        world.fault("unplugged", 0)
        assert whole_life(world) == []


STOPPING = ("dcamwait_abort", "dcamcap_stop", "dcambuf_release")


@pytest.mark.parametrize("code", [Error.TOOFREQUENTTRIGGER, Error.TEMPERATURE_TROUBLE, Error.COOLINGTROUBLE])
def test_troubles_that_end_a_wait_say_what_to_do(camera: DcamCamera, world: World, code: Error) -> None:
    camera.configure(EXTERNAL)
    camera.arm(1)
    world.fail("dcamwait_start", code)
    with pytest.raises(DcamError, match=rf"{code.name}.*(Turn the stage more slowly|fan and cooling water)"):
        camera.next_frame(1.0)


@pytest.mark.parametrize("code", [Error.LOSTFRAME, Error.MISSINGFRAME_TROUBLE])
def test_a_reported_loss_does_not_end_the_capture(camera: DcamCamera, world: World, code: Error) -> None:
    camera.configure(EXTERNAL)
    camera.arm(2)
    world.schedule([world.clock.now() + 0.5])
    world.fail("dcamwait_start", code)
    assert camera.next_frame(1.0).framestamp == 0
    assert camera.describe()["transport_losses"] == 1


def test_a_ring_that_cannot_be_freed_is_freed_before_the_next_run(camera: DcamCamera, world: World) -> None:
    camera.arm(1)
    world.fail("dcamcap_stop", Error.FAILWRITECAMERA)
    with pytest.raises(DcamError, match=r"dcamcap_stop.*FAILWRITECAMERA"):
        camera.disarm()
    camera.arm(1)
    world.pulse()
    assert camera.next_frame(1.0).framestamp == 0


def test_a_second_session_in_one_process_is_refused_and_the_first_lives(camera: DcamCamera, world: World) -> None:
    with pytest.raises(DcamError, match=r"dcamapi_init.*BUSY"):
        world.connect()
    camera.arm(1)
    world.pulse()
    assert camera.next_frame(1.0).framestamp == 0
