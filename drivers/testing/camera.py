"""Conformance tests for every camera, real or simulated; the tests of a camera derive from them.

A subclass defines the fixture `bench`, which makes a new CameraBench for each test. Frames are small and exposures
short.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import Camera, CameraFrame, CameraSettings, TriggerSource

CLOCK_ERROR = 2e-4  # s


@dataclass(frozen=True)
class CameraBench:
    """A camera with the tools to test it.

    Attributes:
        pulse: function that puts rising edges on the camera's trigger input at these times of the clock.
        settings: accepted settings: externally triggered, a small region, about 10 ms.
        refused: changes of the settings that the camera rejects, each with a pattern of the message.
        binnings: its binnings in addition to 1.
        time_error: s by which the time of a frame may differ from its trigger; larger if another computer gives the
            time.
    """

    camera: Camera
    clock: Clock
    pulse: Callable[[Sequence[float]], None]
    settings: CameraSettings
    refused: Sequence[tuple[Mapping[str, Any], str]]
    binnings: Sequence[int] = ()
    time_error: float = CLOCK_ERROR

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        assert self.settings.roi is not None
        return self.settings.roi[2:]


class CameraConformance:
    """Laws of drivers.base.protocols.Camera."""

    @pytest.fixture
    def bench(self) -> CameraBench:
        pytest.fail("Define the fixture `bench` in the subclass: a new CameraBench with the camera for each test.")

    def _pulses(self, bench: CameraBench, n: int, period: float | None = None, delay: float = 0.05) -> list[float]:
        step = 1.05 * bench.camera.timing.min_period if period is None else period
        times = [bench.clock.now() + delay + k * step for k in range(n)]
        bench.pulse(times)
        return times

    def _arm(self, bench: CameraBench, n: int, **changes: Any) -> None:
        bench.camera.configure(replace(bench.settings, **changes))
        bench.camera.arm(n)

    def _take(self, bench: CameraBench, n: int) -> list[CameraFrame]:
        return [bench.camera.next_frame(timeout=5.0) for _ in range(n)]

    def test_configure_reads_back_and_timing_follows(self, bench: CameraBench) -> None:
        accepted = bench.camera.configure(bench.settings)
        assert accepted.exposure == pytest.approx(bench.settings.exposure, rel=0.01)
        assert (accepted.trigger, accepted.roi, accepted.binning) == (bench.settings.trigger, bench.settings.roi, 1)
        timing = bench.camera.timing
        assert timing.shape == bench.shape
        assert timing.min_period >= accepted.exposure
        assert timing.readout > 0
        assert timing.row_period * bench.shape[0] <= timing.readout * 1.01
        longer = bench.camera.configure(replace(bench.settings, exposure=2 * bench.settings.exposure))
        assert bench.camera.timing.min_period - timing.min_period == pytest.approx(longer.exposure - accepted.exposure)
        for binning in bench.binnings:
            bench.camera.configure(replace(bench.settings, binning=binning))
            assert bench.camera.timing.shape == (bench.shape[0] // binning, bench.shape[1] // binning)

    def test_refuses_what_it_cannot_and_stays_as_it_was(self, bench: CameraBench) -> None:
        assert bench.refused
        bench.camera.configure(bench.settings)
        before = bench.camera.timing
        for changes, words in bench.refused:
            with pytest.raises(DeviceRefused, match=words):
                bench.camera.configure(replace(bench.settings, **changes))
            assert bench.camera.timing == before

    def test_every_pulse_is_a_frame_in_order(self, bench: CameraBench) -> None:
        self._arm(bench, 6)
        times = self._pulses(bench, 6)
        frames = self._take(bench, 6)
        assert [frame.framestamp for frame in frames] == list(range(6))
        assert [frame.time for frame in frames] == pytest.approx(times, abs=bench.time_error)
        assert {(frame.counts.shape, frame.counts.dtype) for frame in frames} == {(bench.shape, np.dtype(np.uint16))}
        # A frame cannot arrive before it is exposed and read out.
        assert bench.clock.now() >= times[-1] + bench.settings.exposure + bench.camera.timing.readout - 1e-6

    def test_pulses_that_come_too_early_are_ignored(self, bench: CameraBench) -> None:
        self._arm(bench, 6)
        times = self._pulses(bench, 9, period=0.6 * bench.camera.timing.min_period)
        frames = self._take(bench, 5)  # every other pulse
        assert [frame.framestamp for frame in frames] == list(range(5))
        assert [frame.time for frame in frames] == pytest.approx(times[::2], abs=bench.time_error)
        with pytest.raises(DeviceTimeout):
            bench.camera.next_frame(timeout=0.2)

    def test_an_overrun_ring_is_one_error_and_the_rest_can_be_taken(self, bench: CameraBench) -> None:
        self._arm(bench, 1)
        times = self._pulses(bench, 200)
        bench.clock.sleep(times[-1] - bench.clock.now() + 1.0)
        with pytest.raises(DeviceError, match=r"ring (?:buffer )?of \d+ frames was overrun and \d+ frames are lost"):
            bench.camera.next_frame(timeout=1.0)
        rest = [bench.camera.next_frame(timeout=1.0)]
        while rest[-1].framestamp < 199:
            rest.append(bench.camera.next_frame(timeout=1.0))
        assert [frame.framestamp for frame in rest] == list(range(200 - len(rest), 200))
        assert [frame.time - rest[0].time for frame in rest] == pytest.approx(
            [time - times[-len(rest)] for time in times[-len(rest) :]], abs=bench.time_error
        )

    def test_pulses_before_arm_are_lost(self, bench: CameraBench) -> None:
        bench.camera.configure(bench.settings)
        self._pulses(bench, 2, delay=0.0)
        bench.clock.sleep(1.0)
        bench.camera.arm(1)
        with pytest.raises(DeviceTimeout):
            bench.camera.next_frame(timeout=0.1)

    def test_a_frame_that_does_not_come_is_a_timeout_in_time(self, bench: CameraBench) -> None:
        self._arm(bench, 1)
        start = bench.clock.now()
        with pytest.raises(DeviceTimeout, match=r"0\.3 s"):
            bench.camera.next_frame(timeout=0.3)
        assert bench.clock.now() - start == pytest.approx(0.3, abs=0.1)
        self._pulses(bench, 1)  # and the camera still works
        assert bench.camera.next_frame(timeout=1.0).framestamp == 0

    def test_software_triggers(self, bench: CameraBench) -> None:
        self._arm(bench, 3, trigger=TriggerSource.SOFTWARE)
        for k in range(3):
            triggered = bench.clock.now()
            bench.camera.software_trigger()
            frame = bench.camera.next_frame(timeout=1.0)
            assert frame.framestamp == k
            assert frame.time == pytest.approx(triggered, abs=0.05)
            bench.clock.sleep(bench.camera.timing.min_period)

    def test_software_trigger_is_refused_where_it_means_nothing(self, bench: CameraBench) -> None:
        bench.camera.configure(bench.settings)
        with pytest.raises(DeviceRefused, match="not armed"):
            bench.camera.software_trigger()
        bench.camera.arm(1)
        with pytest.raises(DeviceRefused, match="external"):
            bench.camera.software_trigger()

    def test_free_run_gives_the_frames_asked_for(self, bench: CameraBench) -> None:
        self._arm(bench, 4, trigger=TriggerSource.INTERNAL)
        frames = self._take(bench, 4)
        assert [frame.framestamp for frame in frames] == [0, 1, 2, 3]
        gaps = np.diff([frame.time for frame in frames])
        beyond_clock = bench.time_error - CLOCK_ERROR
        # the resolution of its clock may be microseconds
        assert (gaps >= bench.settings.exposure - beyond_clock - 2e-6).all()
        assert gaps == pytest.approx(gaps[0], abs=bench.time_error)

    def test_framestamps_start_anew_with_every_arm(self, bench: CameraBench) -> None:
        bench.camera.configure(replace(bench.settings, trigger=TriggerSource.INTERNAL))
        for _ in range(2):
            bench.camera.arm(2)
            assert [frame.framestamp for frame in self._take(bench, 2)] == [0, 1]
            bench.camera.disarm()

    def test_frames_own_their_memory(self, bench: CameraBench) -> None:
        self._arm(bench, 2, trigger=TriggerSource.INTERNAL)
        first, second = self._take(bench, 2)
        assert not np.shares_memory(first.counts, second.counts)
        copy = first.counts.copy()
        second.counts[:] = 0
        np.testing.assert_array_equal(first.counts, copy)

    def test_disarm_is_legal_in_every_state(self, bench: CameraBench) -> None:
        bench.camera.disarm()
        bench.camera.configure(bench.settings)
        bench.camera.disarm()
        bench.camera.arm(3)
        self._pulses(bench, 3)
        bench.camera.next_frame(timeout=1.0)
        bench.camera.disarm()
        bench.camera.disarm()
        with pytest.raises(DeviceRefused, match="not armed"):
            bench.camera.next_frame(timeout=0.1)
        bench.camera.configure(bench.settings)

    def test_an_armed_camera_takes_no_settings_and_no_second_arm(self, bench: CameraBench) -> None:
        self._arm(bench, 2)
        with pytest.raises(DeviceRefused, match="disarm"):
            bench.camera.configure(replace(bench.settings, exposure=2 * bench.settings.exposure))
        with pytest.raises(DeviceRefused, match="disarm"):
            bench.camera.arm(2)
        bench.camera.disarm()
        with pytest.raises(DeviceRefused, match="less than one frame"):
            bench.camera.arm(0)

    def test_describes_itself_for_the_file(self, bench: CameraBench) -> None:
        bench.camera.configure(bench.settings)
        text = bench.camera.describe()
        assert {type(value) for value in text.values()} <= {str, int, float}
        assert text["model"]
        assert float(text["conversion_factor"]) > 0  # electrons per count
        assert float(text["conversion_offset"]) >= 0  # counts

    def test_a_closed_camera_says_so(self, bench: CameraBench) -> None:
        self._arm(bench, 1)
        bench.camera.close()
        bench.camera.close()
        bench.camera.disarm()
        with pytest.raises(DeviceError, match="closed"):
            bench.camera.configure(bench.settings)
        with pytest.raises(DeviceError, match="closed"):
            bench.camera.arm(1)
