"""An instrument that fails on request: real drivers, a real configuration, one virtual clock.

The configuration names a serial port and a DCAM library; the port is a simulated controller behind a cable that can be
disturbed or pulled out, the library is the fake one. A scan opens, runs and closes all of it, as at an instrument.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any
from uuid import uuid4

import h5py
import pytest
import serial

from beamline.config.load import Config, config_folder, load
from beamline.core.events import Event
from beamline.core.run_result import RunResult
from beamline.core.stop import Cause, PauseRequest, StopRequest
from beamline.instrument.connect import ConnectedDevices, connect
from beamline.scan import measurement
from beamline.scan import run as run_module
from beamline.scan.control import commands_taken
from beamline.scan.recorder import Recorder
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from drivers.base.clock import Clock
from drivers.base.frame import Frame, FrameKind
from simulators.devices.trigger_line import Pulse, TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsBuild, PiGcsController
from simulators.wires.pm16c.wire import PM16CBuild, PM16CController
from simulators.wires.wire import register
from tests.drivers.dcam.fake import World
from tests.drivers.stages.flat_settings import flat
from tests.simulators.wires.zaber.wire import ZaberBuild, ZaberController

COUNTS = 360_000
SENSOR = (16, 16)
PORT = "/dev/rig"
VIEWS, DARKS, FLATS = 12, 2, 1
FIRST, STEP = 10.0, 2.0
"""Degrees of the first view, and between views."""
SHUTTER = 2
"""Output of the controller that the shutter is on, where it has outputs."""
SMALL = (
    f"scan.angles={{scheme: fixed, views: {VIEWS}, start_deg: {FIRST}, span_deg: {STEP * VIEWS}}}",
    "scan.period_s=0.1",
    "scan.exposure_s=0.005",
    "references.on_fault=log",  # the camera's pictures show its counters, not the beam
    f"scan.darks.count={DARKS}",
    f"scan.flats={{count: {FLATS}, at: start, exposure_s: null}}",
    "storage.flush_every=100",
    "recon.live=false",
)


class Phase(IntEnum):
    """What a scan is doing, as its controller sees it: turning is the move that gives the pulses."""

    OPENING = 0
    TAXI = 1
    ARMING = 2
    TURNING = 3
    DISARMING = 4
    GOING_BACK = 5


@dataclass(frozen=True)
class Kind:
    """A controller: how it is configured and built, and what can be seen of it from outside.

    Attributes:
        arming, disarming: requests by which the phases are distinguished.
        line_end: of what it sends.
        unasked: a line that it (or noise that looks like one) may send without being asked.
        stop: how another program tells it to stop.
        block: puts what stalls it, and a limit switch, in its way at counts; None clears the way.
    """

    stage: str
    build: Callable[..., Any]
    moving: Callable[[Any], bool]
    levels: Callable[[Any, int], bool] | None
    arming: bytes
    disarming: bytes
    line_end: bytes
    unasked: Callable[[Any], bytes]
    stop: bytes
    block: Callable[[Any, int | None, int | None], None]


def _block_pm16c(box: PM16CController, stall_at: int | None, switch_at: int | None) -> None:
    box.box.sample.stall_at, box.box.sample.switch_at = stall_at, switch_at


def _block_pi(box: PiGcsController, stall_at: int | None, switch_at: int | None) -> None:
    box.box.axis.build = replace(box.box.axis.build, stall_at=stall_at, switch_at=switch_at)


def _block_zaber(box: ZaberController, stall_at: int | None, switch_at: int | None) -> None:
    box.device.axis.stall_at, box.device.axis.switch_at = stall_at, switch_at


def _alert(controller: ZaberController) -> bytes:
    controller.alert()
    return controller.transmit()


KINDS = {
    "pm16c": Kind(
        stage="kind: pm16c",
        build=flat(PM16CBuild, counts_per_turn=COUNTS).controller,
        moving=lambda box: box.box.sample.moving(),
        levels=None,
        arming=rb"TMGI\?0",
        disarming=rb"TMGC0",
        line_end=b"\r\n",
        unasked=lambda box: b"STOP0\r\n",
        stop=b"SSTP0\r\n",
        block=_block_pm16c,
    ),
    "pi_gcs": Kind(
        stage='kind: pi_gcs, axis: "1", trigger_line: 1',
        build=flat(PiGcsBuild, counts_per_turn=COUNTS).controller,
        moving=lambda box: box.box.axis.moving(),
        levels=lambda box, output: box.box.levels.get(output, False),
        arming=rb"CTO\? 1 8",
        disarming=rb"TRO 1 0",
        line_end=b"\n",
        unasked=lambda box: b"1=77.000000\n",
        stop=b"HLT 1\n",
        block=_block_pi,
    ),
    "zaber": Kind(
        stage="kind: zaber, output: 1",
        build=flat(ZaberBuild, counts_per_turn=COUNTS).controller,
        moving=lambda box: box.device.axis.moving(box.clock.now()),
        levels=lambda box, output: bool(box.device.triggers.outputs[output - 1]),
        arming=rb"/1 0 \d\d trigger 2 when",
        disarming=rb"/1 0 \d\d trigger 1 disable",
        line_end=b"\r\n",
        unasked=_alert,
        stop=b"/1 1 stop\n",
        block=_block_zaber,
    ),
}

Spoil = Callable[[bytes], bytes]


class Cable:
    """The serial cable to a controller. Safe from one thread at a time, as the port is.

    Attributes:
        spoilt: a reply was spoilt, or the cable came out.
        last_request: what the host sent last.
        at_request: number of a request, from 0 -> what happens just before it.
        dead: the cable is out.
    """

    def __init__(self, kind: Kind, controller: Any) -> None:
        self.clock: Clock = controller.clock
        self.last_request = b""
        self._kind, self.controller = kind, controller
        self.repair()

    def repair(self) -> None:
        self.phase, self.spoilt = Phase.OPENING, False
        self.at_request: dict[int, Callable[[], object]] = {}
        self._requests = 0
        self._at: Phase | None = None
        self._spoil: Spoil | None = None
        self._due = self._out_of_socket = False

    def spoil(self, at: Phase, spoil: Spoil) -> None:
        """The first reply of a phase that `spoil` changes comes so."""
        self._at, self._spoil = at, spoil

    def unplug(self, at: Phase) -> None:
        """It comes out with the first request of a phase, and stays out."""
        self._at = at

    def pull(self) -> None:
        """It comes out now."""
        self._out_of_socket = True

    @property
    def dead(self) -> bool:
        return self._out_of_socket

    def plug(self) -> None:
        """It is put in again."""
        self._out_of_socket = False

    def receive(self, data: bytes) -> None:
        self._watch(data)
        self.at_request.get(self._requests, lambda: None)()
        self._requests += 1
        if self._at is self.phase:
            self._at = None
            self._due = self._spoil is not None
            self._out_of_socket = self._spoil is None
        if self._out_of_socket:
            raise serial.SerialException("device disconnected")
        self.controller.receive(data)

    def transmit(self) -> bytes:
        if self._out_of_socket:
            raise serial.SerialException("device disconnected")
        reply = self.controller.transmit()
        if reply and self._due and self._spoil is not None:
            sound, reply = reply, self._spoil(reply)
            self.spoilt = reply != sound
            self._due = not self.spoilt
        return reply

    def _watch(self, data: bytes) -> None:
        self.last_request = data
        moving = self._kind.moving(self.controller)
        match self.phase:
            case Phase.OPENING if moving:
                self.phase = Phase.TAXI
            case Phase.TAXI if not moving and re.match(self._kind.arming, data):
                self.phase = Phase.ARMING
            case Phase.ARMING if moving:
                self.phase = Phase.TURNING
            case Phase.TURNING if not moving and re.match(self._kind.disarming, data):
                self.phase = Phase.DISARMING
            case Phase.DISARMING if moving:
                self.phase = Phase.GOING_BACK


class TriggerCable:
    """The cable from trigger output to camera: pulses get lost on it, and others are picked up halfway to the next.

    Pulses are counted from 0 over all scans. `noise` comes at times on the clock.
    """

    def __init__(self, line: TriggerLine) -> None:
        self.lost: Set[int] = frozenset()
        self.picked_up_after: Set[int] = frozenset()
        self.noise: Sequence[float] = ()
        self.line = line

    def next_after(self, time: float) -> Pulse | None:
        heard = (Pulse(at, self.line.angle_at(at)) for at in self.noise if at > time)
        return min((pulse for pulse in (self._sent_after(time), *heard) if pulse is not None), default=None)

    def _sent_after(self, time: float) -> Pulse | None:
        if not (self.lost or self.picked_up_after):
            return self.line.next_after(time)
        sent, at = [], 0.0
        while (pulse := self.line.next_after(at)) is not None:
            sent.append(pulse)
            at = pulse.time
        halfway = {k: Pulse((a.time + b.time) / 2, (a.angle + b.angle) / 2) for k, (a, b) in enumerate(pairwise(sent))}
        arrive = [pulse for k, pulse in enumerate(sent) if k not in self.lost]
        arrive += [pulse for k, pulse in halfway.items() if k in self.picked_up_after]
        return min((pulse for pulse in arrive if pulse.time > time), default=None)


@dataclass
class Scanned:
    """A scan, how it ended and what it left."""

    folder: Path | None
    shape: tuple[int, int]
    error: BaseException | None = None
    result: RunResult | None = None
    events: list[Event] = field(default_factory=list)

    @property
    def warnings(self) -> list[str]:
        """Without those on darks and flats, which show no beam here."""
        said = [event.data["message"] for event in self.events if event.event == "warning"]
        return [
            message
            for message in said
            if not re.match(r"(Darks|Flats) in frame|The scan did not take the \d+ (darks|flats)", message)
        ]

    def of(self, name: str) -> list[Event]:
        return [event for event in self.events if event.event == name]

    def rows(self) -> dict[FrameKind, list[int]]:
        """Triggers in the file by kind of frame; every frame was read, and every trigger has its own angle."""
        assert self.folder is not None
        found: dict[FrameKind, list[int]] = {kind: [] for kind in FrameKind}
        with open_scan(self.folder / "scan.h5") as source, h5py.File(self.folder / "scan.h5") as file:
            assert source.finished
            triggers = [int(trigger) for trigger in file["entry/frame_log/trigger"][()]]
            for frame, trigger in zip(source.frames(), triggers, strict=True):
                found[frame.kind].append(trigger)
                assert frame.counts.shape == self.shape
                if frame.kind is FrameKind.PROJECTION:
                    assert math.degrees(frame.angle) == pytest.approx(FIRST + STEP * trigger, abs=1e-6)
        return found

    def status(self) -> str:
        assert self.folder is not None
        with h5py.File(self.folder / "scan.h5") as file:
            return str(file["entry/progress/status"][()].decode())


class _Recorder(Recorder):
    """After a frame was handed over, and before the next is taken, things happen."""

    def __init__(self, at_frame: dict[int, Callable[[], object]], *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._at_frame = at_frame

    def put(self, frame: Frame) -> None:
        super().put(frame)
        self._at_frame.get(frame.index, lambda: None)()


@cache
def _instrument(*overrides: str) -> Config:
    """A value, read once: a scan takes less time than reading it."""
    return load(config_folder() / "instrument.yaml", overrides, environment={})


class Rig:
    """One controller and one camera, for any number of scans.

    Args:
        sensor: rows and columns of the camera.

    Attributes:
        at_frame: row of the file -> what happens when that frame has been taken.
        after_connecting: what happens once all devices are open.
        pause: the request that pauses the scan begun last.
        in_pause: what happens at each look at a paused scan, one after the other; after the last one it goes on.
        asked: what the operator was asked to do.
    """

    def __init__(
        self, world: World, monkeypatch: pytest.MonkeyPatch, kind: str, sensor: tuple[int, int] = SENSOR
    ) -> None:
        self.world, self.kind, self._sensor = world, KINDS[kind], sensor
        world.reset(*sensor)
        self.clock = world.clock
        line = TriggerLine(self.clock)
        self.controller = self.kind.build(self.clock, line)
        self.cable, self.trigger_cable = Cable(self.kind, self.controller), TriggerCable(line)
        world.plug(self.trigger_cable)
        self.asked: list[str] = []
        self.after_connecting: Callable[[], None] = lambda: None
        self.at_frame: dict[int, Callable[[], object]] = {}
        self.pause, self.in_pause = PauseRequest(), list[Callable[[], object]]()
        simulated, opens = register(f"rig-{uuid4().hex}", self.cable), serial.serial_for_url
        monkeypatch.setattr(
            serial, "serial_for_url", lambda url, **how: opens(simulated if url == PORT else url, **how)
        )
        monkeypatch.setattr(run_module, "connect", self._connect)
        monkeypatch.setattr(run_module, "commands_taken", self._verbs_taken)
        monkeypatch.setattr(measurement, "wait_in_pause", self._wait_in_pause)
        monkeypatch.setattr(run_module, "watched", lambda *how: nullcontext())  # a process a scan
        monkeypatch.setattr(measurement, "Recorder", partial(_Recorder, self.at_frame))

    def config(self, *overrides: str) -> Config:
        stage = (
            f"{self.kind.stage}, port: {PORT}, counts_per_turn: {COUNTS}, max_speed_deg_s: 30, "
            "acceleration_deg_s2: 60, low_deg: -5, high_deg: 365"
        )
        shutter = "manual" if self.kind.levels is None else f"stage_output, output: {SHUTTER}, settle_s: 0"
        camera = f"kind: dcam, library: {self.world.path}, ring_mb: 1"
        devices = f"devices.stage={{{stage}}}", f"devices.shutter={{kind: {shutter}}}", f"devices.camera={{{camera}}}"
        return _instrument(*devices, *SMALL, *overrides)

    def scan(self, runs: Path, *overrides: str, stop: StopRequest | None = None) -> Scanned:
        """A whole scan: devices opened, run, closed."""
        runs.mkdir(exist_ok=True)
        before = set(runs.iterdir())
        scanned = Scanned(None, self._sensor)
        try:
            sinks = [scanned.events.append]
            scanned.result = run_scan(self.config(*overrides), runs, sinks, stop, ask=self.asked.append)
        except Exception as error:
            scanned.error = error
        scanned.folder = next(iter(set(runs.iterdir()) - before), None)
        return scanned

    def block(self, stall_at: int | None = None, switch_at: int | None = None) -> None:
        """Put something in the stage's way, in counts."""
        self.kind.block(self.controller, stall_at, switch_at)

    def stop_from_elsewhere(self) -> None:
        """Another program, or a person at the panel, stops the stage."""
        self.controller.receive(self.kind.stop)
        self.controller.transmit()  # the reply goes there, too

    def repair(self) -> None:
        """Everything is as it should be again."""
        self.cable.repair()
        self.trigger_cable.lost = self.trigger_cable.picked_up_after = frozenset()
        self.trigger_cable.noise = ()
        self.block()
        self.after_connecting = lambda: None
        self.at_frame.clear()
        self.in_pause.clear()
        for fault in ("no_camera", "unplugged", "unplug_at", "refuse"):
            self.world.fault(fault, 0)

    @property
    def moving(self) -> bool:
        """As the controller itself knows it."""
        return self.kind.moving(self.controller)

    @property
    def shutter_open(self) -> bool:
        """As the shutter's cable has it, or as the operator was last asked to have it."""
        if self.kind.levels is not None:
            return self.kind.levels(self.controller, SHUTTER)
        wishes = [wish for wish in self.asked if "shutter" in wish]
        return bool(wishes) and wishes[-1].startswith("Open")

    def go_on(self) -> None:
        """Nothing holds the scan any more."""
        self.pause.resume()
        for cause in Cause:
            self.pause.release(cause)

    @contextmanager
    def _verbs_taken(self, folder: Path, stop: StopRequest, pause: PauseRequest, *choose: Any) -> Iterator[None]:
        self.pause = pause
        with commands_taken(folder, stop, pause, *choose):
            yield

    def _wait_in_pause(self, recorder: Recorder) -> bool:
        recorder.check()
        (self.in_pause.pop(0) if self.in_pause else self.go_on)()
        return False

    def _connect(self, config: Config, **how: Any) -> ConnectedDevices:
        bench = connect(config, **{**how, "clock": self.clock})
        self.after_connecting()
        return bench
