"""A stage and a camera on one virtual clock: real drivers over a simulated controller and the fake library.

The clock is the fake library's, for it is in C that waits for frames jump. The stage's pulses go over a TriggerLine
into the fake camera's trigger input.
"""

from __future__ import annotations

import math
from types import TracebackType
from typing import Self
from uuid import uuid4

from beamline.instrument.connect import ConnectedDevices
from drivers.base.protocols import Devices
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
