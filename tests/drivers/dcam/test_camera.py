"""Acquisition with the fake library: every frame once, right pixels, every loss reported, everything closed."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import Camera, CameraFrame, CameraSettings, TriggerSource
from drivers.dcam.abi import DcamError
from drivers.dcam.camera import DcamCamera
from drivers.dcam.codes import Error
from drivers.orca_quest import SENSOR_SHAPE, DcamOptions
from drivers.testing.camera import CameraBench, CameraConformance
from tests.drivers.dcam.fake import World
from tests.drivers.orca_bench import orca_bench, says_what_an_orca_says
from tests.messages import refused


class TestDcamCamera(CameraConformance):
    @pytest.fixture
    def bench(self, world: World) -> Iterator[CameraBench]:
        world.reset(*SENSOR_SHAPE)
        camera = world.connect()
        yield orca_bench(camera, world.clock, world.schedule)
        camera.close()
        assert world.live == 0

    def test_its_conversion_is_that_of_an_orca(self, bench: CameraBench) -> None:
        says_what_an_orca_says(bench)


EXTERNAL = CameraSettings(0.001, TriggerSource.EXTERNAL)
FRAME_BYTES = 48 * 72 * 2


Waiting: TypeAlias = tuple[DcamCamera, Future[CameraFrame]]


@pytest.fixture
def small_ring(world: World) -> Iterator[DcamCamera]:
    """A camera whose ring has 4 slots, of which 3 are safe to read while it runs."""
    camera = world.connect(DcamOptions(ring=4 * FRAME_BYTES))
    camera.configure(EXTERNAL)
    yield camera
    camera.close()


def take(camera: Camera, n: int) -> list[int]:
    return [camera.next_frame(1.0).framestamp for _ in range(n)]


def test_every_pulse_is_a_frame_with_its_own_pixels_and_time(camera: DcamCamera, world: World) -> None:
    camera.arm(5)
    times = world.clock.now() + np.array([0.1, 0.3, 0.4, 0.5, 0.55])
    world.schedule(times.tolist())
    for stamp, time in enumerate(times):
        frame = camera.next_frame(1.0)
        assert frame.framestamp == stamp
        assert frame.time == pytest.approx(time, abs=3e-6)  # the camera's clock ticks in us and starts anywhere
        assert frame.counts.dtype == np.uint16
        np.testing.assert_array_equal(frame.counts, world.pattern(stamp))


@pytest.mark.parametrize("pad", [0, 6, 1024])
@pytest.mark.parametrize(("roi", "binning"), [((8, 12, 32, 40), 1), ((4, 16, 40, 24), 2)])
def test_rows_of_the_ring_may_be_padded(camera: DcamCamera, world: World, pad: int, roi: Any, binning: int) -> None:
    world.fault("pad", pad)
    camera.configure(replace(EXTERNAL, roi=roi, binning=binning))
    camera.arm(1)
    world.pulse()
    np.testing.assert_array_equal(camera.next_frame(1.0).counts, world.pattern(0, roi, binning))


def test_an_overrun_ring_is_an_error_that_leaves_a_gap_and_a_count(small_ring: DcamCamera, world: World) -> None:
    """10 frames into 4 slots: 6 are gone and the oldest of the 4 may go at any moment."""
    small_ring.arm(100)
    world.pulses(10)
    with refused(DeviceError):
        small_ring.next_frame(1.0)
    assert take(small_ring, 3) == [7, 8, 9]
    assert small_ring.describe()["frames_overwritten"] == 7
    world.pulses(8)
    with refused(DeviceError):
        small_ring.next_frame(1.0)
    world.pulses(2)  # another overrun before anything could be taken is no second error: taking must go on
    assert take(small_ring, 3) == [17, 18, 19]
    assert small_ring.describe()["frames_overwritten"] == 14


def test_a_frame_lost_on_the_way_leaves_a_gap(camera: DcamCamera, world: World) -> None:
    camera.arm(5)
    world.pulses(2)
    world.fault("drop", 1)
    world.fault("report_loss", 1)
    world.pulses(3)
    assert take(camera, 4) == [0, 1, 3, 4]
    with pytest.raises(DeviceTimeout):
        camera.next_frame(0.01)
    assert camera.describe()["transport_losses"] == 1


@pytest.mark.parametrize("origin", [0, 1])
def test_a_lost_first_frame_shows_whatever_number_the_camera_begins_with(world: World, origin: int) -> None:
    world.fault("first_stamp", origin)
    camera = world.connect()
    camera.configure(EXTERNAL)
    camera.arm(3)
    world.fault("drop", 1)
    world.pulses(3)
    assert take(camera, 2) == [1, 2]
    camera.close()


def test_framestamps_that_go_on_over_captures_count_from_a_run_s_first_frame(world: World) -> None:
    """The fact sheet has it from memory that they begin anew; else every frame of a run would seem to be lost."""
    world.fault("stamps_go_on")
    camera = world.connect()
    camera.configure(EXTERNAL)
    for _ in range(2):
        camera.arm(4)
        world.pulses(2)
        world.fault("drop", 1)
        world.pulses(2)
        assert take(camera, 3) == [0, 1, 3]
        camera.disarm()
    assert camera.describe()["framestamps_begin_anew"] == "no"
    camera.close()


def test_a_count_of_frames_that_goes_back_is_said_and_not_waited_out(camera: DcamCamera, world: World) -> None:
    camera.arm(5)
    world.pulses(3)
    assert take(camera, 3) == [0, 1, 2]
    world.fault("count_back", 2)
    with refused(DeviceError):
        camera.next_frame(1.0)


def test_a_state_that_the_interface_does_not_have_is_an_error_of_the_device(camera: DcamCamera, world: World) -> None:
    camera.arm(1)
    world.fault("odd_status", 9)
    with refused(DeviceError):
        camera.next_frame(1.0)


def test_arm_returns_only_when_triggers_are_taken(camera: DcamCamera, world: World) -> None:
    world.fault("start_polls", 3)
    camera.arm(1)
    assert world.pulse()
    assert take(camera, 1) == [0]


@pytest.fixture
def waiting(world: World, request: pytest.FixtureRequest) -> Iterator[Waiting]:
    """A camera in real time with a thread that waits for its first frame, and that frame's future.

    Its parameter is a fault that the camera has from the beginning.
    """
    world.reset(real_time=True)
    if fault := getattr(request, "param", None):
        world.fault(fault)
    camera = world.connect()
    camera.configure(EXTERNAL)
    camera.arm(1)
    with ThreadPoolExecutor() as pool:
        frame = pool.submit(camera.next_frame, 30.0)
        while not world.waiters:
            pass
        yield camera, frame
    camera.close()


def test_an_event_that_never_comes_delays_but_does_not_lose_a_frame(waiting: Waiting, world: World) -> None:
    _, frame = waiting
    world.fault("swallow_events", 1)
    world.schedule([world.clock.now()])
    assert frame.result(timeout=5.0).framestamp == 0


@pytest.mark.parametrize("waiting", [None, "no_stopped_event"], indirect=True)
def test_disarm_ends_a_wait_in_another_thread(waiting: Waiting, world: World) -> None:
    """Also where the camera cannot signal that it stopped: the wait itself is aborted."""
    camera, frame = waiting
    aborted = world.calls("dcamwait_abort")
    camera.disarm()
    with refused(DeviceRefused):
        frame.result(timeout=5.0)
    assert world.calls("dcamwait_abort") == aborted + 1


def test_close_waits_for_the_thread_that_is_in_the_library(waiting: Waiting, world: World) -> None:
    camera, frame = waiting
    world.fault("slow_to_wake", 50)  # ms; the fake refuses to close a wait handle that somebody waits with
    camera.close()
    with refused(DeviceError):
        frame.result(timeout=5.0)
    assert (world.live, world.waiters) == (0, 0)


def test_a_capture_that_ends_by_itself_gives_its_frames_first(camera: DcamCamera, world: World) -> None:
    camera.arm(3)
    world.pulses(2)
    world.stop()
    assert take(camera, 2) == [0, 1]
    with refused(DeviceError):
        camera.next_frame(1.0)
    camera.disarm()  # the library answers "nothing to do", which is no failure


def test_a_ring_is_freed_though_the_stop_fails(camera: DcamCamera, world: World) -> None:
    camera.arm(1)
    world.stop()  # by itself, so that the ring can be freed
    world.fail("dcamcap_stop", Error.FAILWRITECAMERA)
    with pytest.raises(DcamError, match="dcamcap_stop"):
        camera.disarm()
    assert world.live == 3  # session, camera, wait


def test_no_memory_for_the_ring_leaves_it_disarmed(camera: DcamCamera, world: World) -> None:
    world.fault("no_memory")
    with pytest.raises(DcamError, match=r"NOMEMORY.*fewer bytes"):
        camera.arm(1)
    world.fault("no_memory", 0)
    camera.arm(1)


def test_an_index_too_high_is_said(world: World) -> None:
    with refused(DeviceError):
        DcamCamera(world.path, index=1)
    assert world.live == 0


def test_a_camera_that_refuses_its_first_setting_is_let_go(world: World) -> None:
    world.fault("refuse", 0x00100110)
    with pytest.raises(DeviceRefused, match="rejects TRIGGERSOURCE"):
        world.connect()
    assert world.live == 0


def test_description_names_the_camera_and_what_counts_mean(camera: DcamCamera) -> None:
    description = camera.describe()
    assert description["row_period"] == pytest.approx(camera.timing.row_period)
    assert (description["vendor"], description["model"]) == ("Hamamatsu", "C15550-20UP")
    assert description["cameraid"] == "S/N: 000123"
    assert (description["conversion_factor"], description["conversion_offset"]) == (0.107, 200)
    assert description["defect_correction"] == "off"
