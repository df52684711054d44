"""Simulated scans with a sample moved by a motor, and with a stage behind an EPICS motor record."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.config.load import Config
from beamline.core.events import Event
from beamline.core.stop import ScanAborted, StopRequest
from beamline.instrument import connect as devices
from beamline.scan.acquisition import Acquisition
from beamline.scan.dry_run import dry_run
from beamline.scan.preflight import preflight
from beamline.scan.run import run_scan
from drivers.base.errors import DeviceTimeout
from drivers.base.frame import Frame, FrameKind
from drivers.stages.epics.stage import EpicsStage
from simulators.devices.trigger_line import TriggerLine
from tests.beamline.ball_scan import COMMON, small
from tests.drivers.soft_ioc import PREFIX, TickingClock, record_of, serve_pva

EPICS = f"{{kind: epics, port: 'sim://epics', {COMMON}}}"
MOVERS = {
    "epics, linear": "{kind: epics, port: 'sim://epics', unit: mm",
    "pm16c": "{kind: pm16c, port: 'sim://pm16c', channel: 7",
    "pi_gcs": "{kind: pi_gcs, port: 'sim://pi_gcs'",
}
SHORT = ("scan.angles={scheme: fixed, views: 6}", "scan.flats={count: 2, at: both}", "scan.darks={count: 2}")


def _frames(settings: Config) -> list[Frame]:
    with devices.connect(settings) as instrument:
        ready = preflight(settings, instrument, Path())
        scan = Acquisition(instrument.devices, ready.timeline, ready.settings, 0.1, instrument.clock, StopRequest())
        return list(scan.frames())


@pytest.mark.parametrize("mover", MOVERS.values(), ids=MOVERS)
def test_flats_are_taken_with_the_sample_out_and_views_with_it_in(mover: str) -> None:
    words = f"devices.sample_mover={{kind: stage, in_deg: 1, out_deg: 12, speed_deg_s: 10, stage: {mover}, {COMMON}}}}}"
    frames = _frames(small(words, *SHORT, "scan.mode=step"))
    kinds = [frame.kind for frame in frames]
    assert kinds == [FrameKind.DARK] * 2 + [FrameKind.FLAT] * 2 + [FrameKind.PROJECTION] * 6 + [FrameKind.FLAT] * 2
    light = np.mean([frame.counts for frame in frames if frame.kind is FrameKind.FLAT], axis=0)
    for frame in frames:
        if frame.kind is FrameKind.PROJECTION:
            assert (frame.counts.astype(float) < 0.8 * light).any()  # the ball
        elif frame.kind is FrameKind.FLAT:
            assert (frame.counts.astype(float) > 0.9 * light).all()
    time = [frame.time for frame in frames]
    assert all(later - before > 1.1 for before, later in ((time[3], time[4]), (time[9], time[10])))  # it takes its time


def test_a_step_scan_by_a_motor_record_and_no_fly_scan() -> None:
    settings = small(f"devices.stage={EPICS}", *SHORT)
    said = dry_run(settings).timeline.violations
    assert "a fly scan needs a stage with a trigger output, but this stage has none. Use scan.mode: step" in said
    frames = _frames(small(f"devices.stage={EPICS}", *SHORT, "scan.mode=step"))
    views = [frame.angle for frame in frames if frame.kind is FrameKind.PROJECTION]
    assert np.degrees(views) == pytest.approx([0, 30, 60, 90, 120, 150], abs=1e-3)


def test_an_ioc_that_dies_in_a_scan_ends_it_and_leaves_what_obeys_safe(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("p4p")
    settings = small(f"devices.stage={EPICS}", *SHORT, "scan.mode=step", "devices.stage.timeout_s=0.5")
    clock = TickingClock()
    with (
        serve_pva(record_of(clock, TriggerLine(clock)), clock, monkeypatch) as ioc,
        devices.connect(settings, clock) as instrument,
    ):
        behind: Any = settings.devices.stage.settings
        stage = EpicsStage(f"pva://{PREFIX}", behind, clock)
        used = replace(instrument.devices, stage=stage)
        ready = preflight(settings, instrument, Path())
        scan = Acquisition(used, ready.timeline, ready.settings, 0.1, clock, StopRequest())
        frames = []
        with pytest.raises(DeviceTimeout, match=r"no answer within 0.5 s.*IOC"):
            for frame in scan.frames():
                frames.append(frame)
                if len(frames) == 7:
                    ioc.stop()
        assert len(frames) == 7 and scan.unsafe
        assert not used.shutter.is_open()
        stage.close()


def test_an_abort_stops_the_motor_that_moves_the_sample(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mover = f"{{kind: epics, port: 'sim://epics', {COMMON}}}"
    words = f"devices.sample_mover={{kind: stage, in_deg: 0, out_deg: 300, speed_deg_s: 1, stage: {mover}}}"
    settings, stop = (
        small(words, *SHORT, "scan.mode=step", "recon.live=false", "simulation.clock={speed: 20}"),
        StopRequest(),
    )
    motors: list[EpicsStage] = []
    start = EpicsStage.start_move

    def noted(motor: EpicsStage, angle: float, speed: float) -> None:
        motors.append(motor)
        start(motor, angle, speed)

    monkeypatch.setattr(EpicsStage, "start_move", noted)
    with devices.connect(settings) as instrument:

        def hear(event: Event) -> None:
            if event.event == "block_started" and event.data["kind"] == "flat":
                stop.abort("a person saw it")

        with pytest.raises(ScanAborted, match="a person saw it"):
            run_scan(settings, tmp_path, [hear], stop, instrument=instrument)
        motor = motors[0]
        place = motor.position()
        instrument.clock.sleep(5)
        assert motor.position() == place < np.radians(290)
