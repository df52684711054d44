"""A stage's pulses into the camera driver: one frame each, none invented, and what is missing is named."""

from __future__ import annotations

import math
import time
from pathlib import Path
from types import TracebackType
from typing import Self
from uuid import uuid4

import h5py
import numpy as np
import pytest

from beamline.config.load import Config, config_folder, load
from beamline.core.run_result import RunResult
from beamline.instrument.connect import ConnectedDevices
from beamline.scan import recorder
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from drivers.base.errors import DeviceTimeout
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraFrame, CameraSettings, Devices, TriggerSource, TriggerTrain
from drivers.dcam.camera import DcamCamera
from drivers.orca_quest import DcamOptions
from drivers.stages.pm16c.settings import PM16CSettings
from drivers.stages.pm16c.stage import PM16CStage
from simulators.devices.in_beam import SimulatedSampleMover, SimulatedShutter
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pm16c.box import BoxBuild
from simulators.wires.pm16c.wire import PM16CBuild
from simulators.wires.wire import register
from tests.drivers.dcam.fake import World

SENSOR = (64, 64)
COUNTS = 360_000


class FlyRig:
    """Closes its devices at the end of a `with` block, and then nothing of the library may be left open."""

    def __init__(self, world: World, options: DcamOptions | None = None) -> None:
        world.reset(*SENSOR)
        self.world, self.clock = world, world.clock
        self.line = TriggerLine(self.clock)
        world.plug(self.line)
        build = PM16CBuild(BoxBuild(counts_per_turn=COUNTS))
        box = build.controller(self.clock, self.line)
        settings = PM16CSettings(counts_per_turn=COUNTS, max_speed=math.radians(30), acceleration=math.radians(60))
        self.stage = PM16CStage(register(f"fly-{uuid4().hex}", box), settings, self.clock)
        self.camera: DcamCamera = world.connect(options)

    def connected(self) -> ConnectedDevices:
        devices = Devices(self.stage, self.camera, SimulatedShutter(), SimulatedSampleMover())
        return ConnectedDevices(devices, self.clock, None, self.close)

    def close(self) -> None:
        self.stage.close()
        self.camera.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
        assert self.world.live == 0


EXTERNAL = CameraSettings(0.002, TriggerSource.EXTERNAL)
DARKS, FLATS = 3, 2
COUNT = 2 * math.pi / COUNTS


def small(views: int, *overrides: str) -> Config:
    usual = (
        f"scan.angles.views={views}",
        "scan.period_s=0.01",
        "scan.exposure_s=0.005",
        "references.on_fault=log",  # the camera's pictures show its counters, not the beam
        f"scan.darks.count={DARKS}",
        f"scan.flats.count={FLATS}",
        "scan.flats.at=start",
        "devices.camera.roi=null",
        "storage.flush_every=100",
        "recon.live=false",
    )
    return load(config_folder() / "simulated.yaml", [*usual, *overrides], environment={})


def fly(rig: FlyRig, interval: int, n: int, speed: float) -> list[CameraFrame]:
    """A train of n pulses from 0.1 turns on; every frame that came of it. `speed` in counts/s."""
    start = COUNTS // 10
    rig.stage.start_move(rig.stage.to_angle(start - 20_000), rig.stage.limits.max_speed)
    rig.stage.wait(60.0)
    rig.camera.configure(EXTERNAL)
    rig.camera.arm(n)
    rig.stage.arm(TriggerTrain(start, interval, n))
    rig.stage.start_move(rig.stage.to_angle(start + interval * n + 20_000), speed * COUNT)
    frames: list[CameraFrame] = []
    while rig.stage.moving() or len(frames) < rig.world.exposed:
        try:
            frames.append(rig.camera.next_frame(0.05))
        except DeviceTimeout:
            continue
    return frames


def test_pulses_that_a_stopped_stage_takes_back_never_come(world: World) -> None:
    with FlyRig(world) as rig:
        start = COUNTS // 10
        rig.camera.configure(EXTERNAL)
        rig.camera.arm(1000)
        rig.stage.arm(TriggerTrain(start, 100, 1000))
        rig.stage.start_move(rig.stage.to_angle(start + 120_000), 10_000 * COUNT)
        for stamp in range(5):
            assert rig.camera.next_frame(20.0).framestamp == stamp
        rig.stage.stop()
        rig.clock.sleep(60.0)
        passed = (rig.stage.to_counts(rig.stage.position()) - start) // 100 + 1
        assert 5 < passed < 200
        assert rig.world.exposed == passed


class Scanned:
    """A scan through acquisition, ledger and writer, and what it left."""

    def __init__(self, rig: FlyRig, config: Config, runs: Path) -> None:
        self.result: RunResult | None = None
        self.error: Exception | None = None
        began, busy = time.monotonic(), time.process_time()
        try:
            self.result = run_scan(config, runs, instrument=rig.connected())
        except Exception as error:
            self.error = error
        self.seconds, self.cpu_seconds = time.monotonic() - began, time.process_time() - busy
        folders = list(runs.iterdir())
        assert len(folders) == 1, self.error
        self.path = folders[0] / "scan.h5"

    def views(self) -> list[tuple[int, float, int]]:
        """(trigger, angle in counts, framestamp's four bits in the pixels) of each projection in the file."""
        with open_scan(self.path) as source, h5py.File(self.path) as file:
            triggers = file["entry/frame_log/trigger"][()]
            assert len(triggers) == len(source.table.kinds)
            return [
                (int(triggers[row]), frame.angle / COUNT, int(frame.counts[0, 0]) >> 12)
                for row, frame in enumerate(source.frames())
                if frame.kind is FrameKind.PROJECTION
            ]


@pytest.mark.slow
def test_three_thousand_views_are_three_thousand_pulses_frames_and_rows(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = 3000
    # On a virtual clock frames come faster than any disk takes them: they would be flown in pieces.
    monkeypatch.setattr(recorder, "hold_for_backlog", lambda *_: None)
    with FlyRig(world) as rig:
        scanned = Scanned(rig, small(views), tmp_path)
        assert scanned.error is None
        assert rig.world.exposed == views  # the last capture's
        pulses = 0
        after = 0.0
        while (pulse := rig.line.next_after(after)) is not None:
            pulses, after = pulses + 1, pulse.time
        assert pulses == views
    assert scanned.result is not None
    assert (scanned.result.n_frames, scanned.result.missing) == (DARKS + FLATS + views, ())
    rows = scanned.views()
    assert [trigger for trigger, _, _ in rows] == list(range(views))
    assert [bits for _, _, bits in rows] == [k % 16 for k in range(views)]
    np.testing.assert_allclose([angle for _, angle, _ in rows], np.arange(views) * COUNTS / 2 / views, atol=1e-6)
    print(f"\n{views} views in {scanned.seconds:.2f} s, {scanned.cpu_seconds:.2f} s of CPU time")
    assert scanned.cpu_seconds < 20  # the clock on the wall also counts what else the machine does


def test_the_camera_captures_before_the_stage_is_armed_and_until_it_is_disarmed(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pulse that comes before the camera is ready is lost without a word."""
    capturing: dict[str, list[bool]] = {}

    with FlyRig(world) as rig:

        def spied(call: str) -> None:
            real = getattr(rig.stage, call)

            def spy(*arguments: object) -> object:
                running = world.calls("dcamcap_start") - world.calls("dcamcap_stop")
                capturing.setdefault(call, []).append(running == 1)
                return real(*arguments)

            monkeypatch.setattr(rig.stage, call, spy)

        for call in ("arm", "disarm"):
            spied(call)
        passes = "scan.angles={scheme: interlaced, views: 24, passes: 3, start_deg: 60, span_deg: 24}"
        assert Scanned(rig, small(24, "scan.period_s=0.2", passes), tmp_path).error is None
    assert capturing["arm"] == [True] * 3
    assert capturing["disarm"][:3] == [True] * 3
