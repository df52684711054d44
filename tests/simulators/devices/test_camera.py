"""Simulated ORCA-Quest: the laws of every camera, its own timing, true angles, remade noise, and faults on demand."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from drivers.base.clock import Clock, SystemClock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraFrame, TriggerSource
from drivers.testing.camera import CameraBench, CameraConformance
from simulators.devices.camera import OrcaQuestBuild, SimulatedOrcaQuest
from simulators.devices.clock import VirtualClock
from simulators.devices.in_beam import SimulatedSampleMover, SimulatedShutter
from simulators.devices.trigger_line import Pulse, TriggerLine
from simulators.frame.sensor import CONVERSION
from simulators.scenes.scene import load_scene
from tests.drivers.orca_bench import SETTINGS, orca_bench, says_what_an_orca_says
from tests.messages import refused
from tests.simulators import chance

FLUX = 4e5
FULL = round(FLUX * SETTINGS.exposure / CONVERSION["standard"])  # counts without sample and effects
BALL = {"kind": "ellipsoid", "semi_axes": [0.03, 0.03, 0.03], "attenuation": 20.0, "centre": [0.08, 0.02, 0.01]}


class _Bench:
    """A camera over one small ball, its trigger line, clock, shutter (open) and sample mover."""

    def __init__(
        self, *effects: Any, clock: Clock | None = None, axis_offset_px: float = 0.0, flux: float = FLUX, **options: Any
    ) -> None:
        self.clock = clock or VirtualClock()
        self.line = TriggerLine(self.clock)
        self.shutter, self.sample = SimulatedShutter(), SimulatedSampleMover()
        self.shutter.open()
        self.scene = load_scene(
            {
                "phantom": {"kind": "solids", "solids": [BALL]},
                "beam": {"photons_per_s": flux},
                "effects": list(effects),
                "axis_offset_px": axis_offset_px,
            }
        )
        self.camera = SimulatedOrcaQuest(
            self.scene, self.line, self.clock, 5, self.shutter.is_open, self.sample.place, OrcaQuestBuild(**options)
        )
        self.camera.configure(SETTINGS)

    def fire(self, n: int, *, angle: float = 0.0, period: float = 0.05) -> list[float]:
        times = [self.clock.now() + (k + 1) * period for k in range(n)]
        self.line.schedule(Pulse(t, angle) for t in times)
        return times

    def take(self, n: int) -> list[CameraFrame]:
        return [self.camera.next_frame(1.0) for _ in range(n)]

    def one(self, trigger: TriggerSource = TriggerSource.INTERNAL, **changes: Any) -> CameraFrame:
        """One frame under other settings, the camera disarmed before and after."""
        self.camera.disarm()
        self.camera.configure(replace(SETTINGS, trigger=trigger, **changes))
        self.camera.arm(1)
        frame = self.camera.next_frame(5.0)
        self.camera.disarm()
        return frame


class TestConformance(CameraConformance):
    @pytest.fixture
    def bench(self) -> CameraBench:
        made = _Bench()
        return orca_bench(made.camera, made.clock, lambda times: made.line.schedule(Pulse(t, 0.0) for t in times))

    def test_its_conversion_is_that_of_an_orca(self, bench: CameraBench) -> None:
        says_what_an_orca_says(bench)


def test_dark_flat_and_projection_follow_shutter_and_sample() -> None:
    """The shutter is closed and the sample in the beam before anybody moves them."""
    assert not SimulatedShutter().is_open()
    assert SimulatedSampleMover().place() == 0
    bench = _Bench()
    projection = bench.one().counts
    assert projection.min() < 0.6 * FULL
    assert projection.max() == FULL
    bench.sample.out()
    assert (bench.one().counts == FULL).all()
    bench.shutter.close()
    assert not bench.one().counts.any()
    bench.sample.back()
    bench.shutter.open()
    np.testing.assert_array_equal(bench.one().counts, projection)


def _column(frame: CameraFrame) -> float:
    """Centre of mass of what the beam lost, in columns."""
    lost = FULL - frame.counts.astype(float)
    return float((lost * np.arange(lost.shape[1])).sum() / lost.sum())


def test_a_frame_shows_the_true_angle_of_its_pulse_not_the_commanded_one() -> None:
    bench = _Bench()
    bench.camera.arm(4)
    angles = [0.0, 0.61, math.pi / 2, 3.3]
    now = bench.clock.now()
    bench.line.schedule(Pulse(now + 0.05 * (k + 1), angle) for k, angle in enumerate(angles))
    for angle, frame in zip(angles, bench.take(4), strict=True):
        u = 0.08 * math.cos(angle) + 0.02 * math.sin(angle)
        assert _column(frame) == pytest.approx(bench.camera.detector.axis_col + u / 4.6e-3, abs=0.1)


def test_other_triggers_ask_the_line_for_the_angle() -> None:
    bench = _Bench()
    bench.line.attach_angle(lambda time: 1.1)
    expected = bench.camera.detector.axis_col + (0.08 * math.cos(1.1) + 0.02 * math.sin(1.1)) / 4.6e-3
    assert _column(bench.one()) == pytest.approx(expected, abs=0.1)
    bench.camera.configure(replace(SETTINGS, trigger=TriggerSource.SOFTWARE))
    bench.camera.arm(1)
    bench.camera.software_trigger()
    assert _column(bench.camera.next_frame(1.0)) == pytest.approx(expected, abs=0.1)


def test_axis_and_pitch_follow_offset_roi_and_binning() -> None:
    bench = _Bench(axis_offset_px=3.5)
    assert bench.camera.detector.axis_col == pytest.approx(4095 / 2 + 3.5 - 2008)
    assert bench.camera.detector.axis_row == pytest.approx(2303 / 2 - 1120)
    wide = bench.one(roi=(1056, 1944, 176, 192))
    moved = bench.one(roi=(1060, 1952, 172, 184))
    np.testing.assert_array_equal(wide.counts[4:, 8:], moved.counts)
    u = 0.08 / 4.6e-3
    for binning in (1, 2, 4):
        frame = bench.one(roi=(1056, 1944, 176, 192), binning=binning, exposure=0.01 / 16)
        detector = bench.camera.detector
        assert frame.counts.shape == (176 // binning, 192 // binning)
        assert detector.pitch == pytest.approx(4.6e-3 * binning)
        lost = frame.counts.max() - frame.counts.astype(float)
        column = (lost * np.arange(lost.shape[1])).sum() / lost.sum()
        # The same place on the sensor, whatever the binning: 1944 + (column + 1/2) * binning - 1/2.
        assert 1944 + (column + 0.5) * binning - 0.5 == pytest.approx(4095 / 2 + 3.5 + u, abs=0.2)
        assert frame.counts.max() == pytest.approx(FULL / 16 * binning**2, abs=1)
    assert _Bench(pixel_pitch=6.5e-4).camera.detector.pitch == pytest.approx(6.5e-4)


def test_photon_numbers_are_whole_electrons_without_offset() -> None:
    bench = _Bench("photon_noise", "read_noise", {"kind": "offset", "spread": 1.0}, flux=1000.0)
    bench.sample.out()
    counts = bench.one(readout="photon_number", roi=(1024, 1920, 200, 200)).counts
    described = bench.camera.describe()
    assert (described["conversion_factor"], described["conversion_offset"]) == (1.0, 0.0)
    # Ten photons, 0.27 electrons rms of the readout, and 1/12 of rounding (Janesick 2007).
    chance.mean_is(counts, 10.0, 10 + 0.27**2 + 1 / 12)
    chance.variance_is(counts, 10 + 0.27**2 + 1 / 12, 1 / 10)
    bench.shutter.close()
    # In the dark a pixel shows an electron where its noise exceeds one half.
    dark = bench.one(readout="photon_number", roi=(1024, 1920, 200, 200)).counts
    ones = 0.5 * math.erfc(0.5 / 0.27 / math.sqrt(2))
    chance.mean_is(dark > 0, ones, ones * (1 - ones))
    standard = bench.one(readout="standard").counts
    assert 195 < standard.mean() < 205


def test_photon_numbers_end_at_two_hundred_a_pixel() -> None:
    bench = _Bench()  # 4000 photons
    bench.sample.out()
    assert (bench.one(readout="photon_number").counts == 200).all()
    assert (bench.one(readout="photon_number", binning=2).counts == 800).all()
    assert (bench.one(readout="standard").counts == FULL).all()


@pytest.mark.parametrize(
    ("readout", "line_time"), [("standard", 7.2e-6), ("ultra_quiet", 172.8e-6), ("photon_number", 172.8e-6)]
)
def test_timing_is_the_orca_quest_s(readout: str, line_time: float) -> None:
    bench = _Bench()
    bench.camera.configure(replace(SETTINGS, readout=readout))
    timing = bench.camera.timing
    assert timing.readout == pytest.approx(24 * line_time)  # two rows a line
    assert timing.row_period == pytest.approx(line_time / 2)
    assert timing.min_period == pytest.approx(0.01 + 29 * line_time)
    # A pulse train just slower than this is taken whole; one a little faster loses every other frame.
    for factor, n in ((1.0001, 10), (0.99, 5)):
        bench.camera.arm(10)
        bench.fire(10, period=timing.min_period * factor)
        assert [frame.framestamp for frame in bench.take(n)] == list(range(n))
        with pytest.raises(DeviceTimeout):
            bench.camera.next_frame(0.5)
        bench.camera.disarm()


def test_the_second_model_has_its_own_times() -> None:
    bench = _Bench(model="C15550-22UP")
    bench.camera.configure(replace(SETTINGS, readout="ultra_quiet", exposure=1e-4))  # shorter than the first one takes
    assert bench.camera.timing.row_period == pytest.approx(17e-6)
    assert bench.camera.describe()["model"] == "C15550-22UP (simulated)"


def test_a_frame_is_there_once_it_is_exposed_and_read_out() -> None:
    bench = _Bench()
    bench.camera.configure(replace(SETTINGS, trigger=TriggerSource.SOFTWARE, readout="ultra_quiet"))
    bench.camera.arm(1)
    bench.camera.software_trigger()
    with pytest.raises(DeviceTimeout):
        bench.camera.next_frame(0.01 + 23 * 172.8e-6)
    assert bench.camera.next_frame(1.1 * 172.8e-6).framestamp == 0  # 24 lines after the exposure


def test_noise_belongs_to_seed_and_frame_number() -> None:
    noise = ("photon_noise", "read_noise", "offset")
    first, second = _Bench(*noise), _Bench(*noise)
    frames = [first.one().counts for _ in range(3)]
    for other in frames[1:]:
        assert (frames[0] != other).mean() > 0.9  # also where the framestamp starts anew
    second.camera.arm(3)
    second.fire(3, period=0.3)
    for mine, again in zip(frames, second.take(3), strict=True):
        np.testing.assert_array_equal(mine, again.counts)
    second.camera.rehearse()  # which is no frame: the next is as if it had not been
    np.testing.assert_array_equal(second.one().counts, first.one().counts)
    other_seed = SimulatedOrcaQuest(first.scene, first.line, first.clock, 6, first.shutter.is_open, first.sample.place)
    other_seed.configure(replace(SETTINGS, trigger=TriggerSource.INTERNAL))
    other_seed.arm(1)
    assert (other_seed.next_frame(1.0).counts != frames[0]).mean() > 0.9


def test_the_ring_current_falls_with_the_clock() -> None:
    bench = _Bench({"kind": "ring_current", "lifetime": 100.0})
    bench.sample.out()
    bench.clock.sleep(100 * math.log(2))
    assert bench.one().counts[0, 0] == pytest.approx(FULL / 2, abs=1)


@pytest.mark.parametrize(("fault", "framestamps"), [("lost", [0, 2, 3, 5]), ("ignored", [0, 1, 2, 3])])
def test_lost_frames_leave_a_gap_in_the_framestamps_and_ignored_triggers_in_the_times_only(
    fault: str, framestamps: list[int]
) -> None:
    bench = _Bench(**cast(Any, {fault: {2, 5}}))  # numbered over the camera's life: the frame below is number 0
    bench.one()
    bench.camera.configure(SETTINGS)
    bench.camera.arm(6)
    times = bench.fire(6)
    frames = bench.take(4)
    assert [frame.framestamp for frame in frames] == framestamps
    assert [frame.time for frame in frames] == [times[k] for k in (0, 2, 3, 5)]


def test_an_unplugged_camera_is_gone_but_disarms() -> None:
    bench = _Bench(unplug_at=3)
    bench.camera.arm(6)
    bench.fire(6)
    bench.clock.sleep(1.0)
    assert [frame.framestamp for frame in bench.take(3)] == [0, 1, 2]
    for call in (lambda: bench.camera.next_frame(1.0), lambda: bench.camera.configure(SETTINGS)):
        with refused(DeviceError):
            call()
    bench.camera.disarm()
    with refused(DeviceError):
        bench.camera.arm(1)
    bench.camera.close()
    free = _Bench(unplug_at=0)
    with refused(DeviceError):
        free.one()


def test_a_ring_that_is_overrun_names_the_lost_frames_and_goes_on() -> None:
    bench = _Bench(ring_frames=4)
    bench.camera.arm(10)
    bench.fire(7)
    bench.clock.sleep(1.0)  # a reader that looked away
    with refused(DeviceError):
        bench.camera.next_frame(1.0)
    assert [frame.framestamp for frame in bench.take(4)] == [3, 4, 5, 6]
    bench.fire(1)
    assert bench.camera.next_frame(1.0).framestamp == 7


def test_cancelled_pulses_expose_nothing() -> None:
    bench = _Bench()
    bench.camera.arm(5)
    times = bench.fire(5)
    bench.take(2)
    bench.line.cancel_after(times[1] + 0.001)
    with refused(DeviceTimeout):
        bench.camera.next_frame(1.0)


def test_software_triggers_faster_than_the_camera_are_refused() -> None:
    bench = _Bench()
    bench.camera.configure(replace(SETTINGS, trigger=TriggerSource.SOFTWARE))
    bench.camera.arm(2)
    bench.camera.software_trigger()
    with refused(DeviceRefused):
        bench.camera.software_trigger()
    assert bench.camera.next_frame(1.0).framestamp == 0


def test_a_reader_on_the_wall_clock_sees_pulses_scheduled_meanwhile() -> None:
    bench = _Bench(clock=SystemClock())
    bench.camera.arm(3)
    frames: list[CameraFrame] = []
    reader = threading.Thread(target=lambda: frames.extend(bench.take(3)))
    reader.start()
    bench.fire(3, period=0.02)
    reader.join(timeout=5.0)
    assert [frame.framestamp for frame in frames] == [0, 1, 2]


def test_disarm_ends_another_thread_s_wait() -> None:
    bench = _Bench(clock=SystemClock())
    bench.camera.arm(1)
    caught: list[Exception] = []

    def wait() -> None:
        try:
            bench.camera.next_frame(60.0)
        except DeviceError as error:
            caught.append(error)

    reader = threading.Thread(target=wait)
    reader.start()
    bench.camera.disarm()
    reader.join(timeout=5.0)
    assert "not armed" in str(caught[0])


def test_a_beam_lost_in_view_two_is_lost_in_the_third_projection_whatever_was_taken_between() -> None:
    """And in the flat that is taken just before it: a flat counts to the view that is exposed next."""
    bench = _Bench({"kind": "lost_beam", "views": [2, 3]})
    light = ""
    for kind in "dfpfpdfppf":  # dark, flat, projection
        (bench.shutter.close if kind == "d" else bench.shutter.open)()
        (bench.sample.back if kind == "p" else bench.sample.out)()
        light += ".*"[int(np.median(bench.one().counts) > 0)]
    assert light == ".****...**"


def test_exposure_is_rounded_to_ten_nanoseconds() -> None:
    accepted = _Bench().camera.configure(replace(SETTINGS, exposure=0.0123456789))
    assert accepted.exposure == pytest.approx(0.01234568, abs=1e-12)
