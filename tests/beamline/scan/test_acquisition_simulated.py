"""Acquisition over the real stage driver and the simulated camera: what they lose is what is found missing."""

import math
from uuid import uuid4

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from beamline.core.stop import ScanStopped, StopRequest
from beamline.plan.plan import FieldPlan, Mode, Place, ScanPlan
from beamline.plan.timeline import work_out
from beamline.scan.acquisition import Acquisition
from beamline.scan.ledger import LedgerError
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraSettings, Devices, TriggerSource
from drivers.stages.pm16c.settings import PM16CSettings
from drivers.stages.pm16c.stage import PM16CStage
from simulators.devices.camera import OrcaQuestBuild, SimulatedOrcaQuest
from simulators.devices.clock import VirtualClock
from simulators.devices.in_beam import SimulatedSampleMover, SimulatedShutter
from simulators.devices.trigger_line import TriggerLine
from simulators.scenes.scene import load_scene
from simulators.wires.pm16c.box import BoxBuild
from simulators.wires.pm16c.wire import PM16CBuild
from simulators.wires.wire import register

N = 24
SETTINGS = CameraSettings(0.02, TriggerSource.EXTERNAL, roi=(1148, 2044, 8, 8))
SCENE = {
    "phantom": {"kind": "solids", "solids": [{"kind": "cylinder", "radius": 0.01, "height": 0.1, "attenuation": 5.0}]},
    "beam": {"photons_per_s": 1e5},
}
PULSES = st.sets(st.integers(0, N - 1), max_size=4)


class FaultyInstrument:
    """The simulated instrument with faults; what happens when frames are taken can be scheduled."""

    def __init__(self, pulses_lost: set[int], ignored: set[int], lost: set[int]) -> None:
        self.clock = VirtualClock()
        self.line = TriggerLine(self.clock)
        box = PM16CBuild(BoxBuild(counts_per_turn=36000, lost=pulses_lost)).controller(self.clock, self.line)
        settings = PM16CSettings(
            counts_per_turn=36000, max_speed=math.radians(60), acceleration=math.radians(60), low=math.radians(-90),
            high=math.radians(270),
        )  # fmt: skip
        self.stage = PM16CStage(register(f"acquire-{uuid4().hex}", box), settings, self.clock)
        self.shutter, self.sample = SimulatedShutter(), SimulatedSampleMover()
        self.camera = SimulatedOrcaQuest(
            load_scene(SCENE),
            self.line,
            self.clock,
            0,
            self.shutter.is_open,
            self.sample.place,
            OrcaQuestBuild(lost=lost, ignored=ignored),
        )

    def scan(self, stop: StopRequest, stop_after: int = 10**9) -> tuple[Acquisition, list[Frame], BaseException | None]:
        none = FieldPlan(0, Place.NONE, 0.02)
        angles = np.linspace(0, math.pi, N, endpoint=False)
        plan = ScanPlan(angles, Mode.FLY, 0.02, 0.15, 0.0, none, none, "fixed")
        self.camera.configure(SETTINGS)
        timeline = work_out(plan, self.stage.limits, self.stage.to_counts, self.camera.timing)
        assert timeline.violations == ()
        devices = Devices(self.stage, self.camera, self.shutter, self.sample)
        acquisition = Acquisition(devices, timeline, SETTINGS, 0.0, self.clock, stop)
        frames: list[Frame] = []
        try:
            for frame in acquisition.frames():
                frames.append(frame)
                if len(frames) == stop_after:
                    stop.stop()
        except Exception as error:
            return acquisition, frames, error
        return acquisition, frames, None

    def assert_true_angles(self, frames: list[Frame]) -> None:
        """Against where the simulated axis really was when the trigger rose."""
        for frame in frames:
            assert frame.angle == pytest.approx(self.line.angle_at(frame.time), abs=2 * math.pi / 36000)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(PULSES, PULSES, PULSES)
@example(set(), {0, 17, 18, 19}, {16, 17, 18, 19})
def test_lost_pulses_ignored_triggers_and_lost_frames_are_all_named(
    pulses_lost: set[int], ignored: set[int], lost: set[int]
) -> None:
    instrument = FaultyInstrument(pulses_lost, ignored, lost)
    arrive = [i for i in range(N) if i not in pulses_lost]
    accepted = [i for number, i in enumerate(arrive) if number not in ignored]
    kept = [i for number, i in enumerate(accepted) if number not in lost]
    acquisition, frames, error = instrument.scan(StopRequest())
    assert [frame.trigger for frame in frames] == kept
    instrument.assert_true_angles(frames)
    assert acquisition.missing == [i for i in range(N) if i not in kept]
    assert isinstance(error, LedgerError) if acquisition.missing else error is None
    assert instrument.stage.position() == 0.0
    assert not instrument.shutter.is_open()
    instrument.stage.close()


@pytest.mark.parametrize("silent", [12, 20])
def test_a_camera_that_is_silent_at_the_end_of_a_pass_has_its_missing_frames_named(silent: int) -> None:
    """Up to the patience for a frame (2 s, 13 periods); a camera that is silent for longer ends the scan."""
    last = set(range(N - silent, N))
    instrument = FaultyInstrument(set(), set(), last)
    acquisition, frames, error = instrument.scan(StopRequest())
    assert len(frames) == N - silent
    if silent == 20:
        assert "no frame for 2" in str(error)
    else:
        assert acquisition.missing == sorted(last)
        assert isinstance(error, LedgerError)
    assert not instrument.shutter.is_open()
    instrument.stage.close()


@pytest.mark.parametrize("after", [1, 12])
def test_frames_after_a_stop_while_turning_are_kept_and_those_exposed_while_it_brakes_are_invalid(after: int) -> None:
    instrument = FaultyInstrument(set(), set(), set())
    acquisition, frames, error = instrument.scan(StopRequest(), stop_after=after)
    assert isinstance(error, ScanStopped)
    assert after < len(frames) < N
    views = [frame for frame in frames if frame.kind is FrameKind.PROJECTION]
    assert [frame.trigger for frame in frames] == [*range(len(views)), *[-1] * (len(frames) - len(views))]
    assert {frame.kind for frame in frames[len(views) :]} == {FrameKind.INVALID} and len(views) >= after
    instrument.assert_true_angles(views)
    assert acquisition.missing == []
    assert instrument.stage.position() == 0.0
    instrument.stage.close()
