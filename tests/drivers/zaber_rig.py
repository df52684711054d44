"""A simulated Zaber stage on a virtual clock, for the driver's tests."""

from __future__ import annotations

import itertools
import math
from typing import Any

from drivers.base.clock import Clock
from drivers.stages.zaber.settings import ZaberSettings
from drivers.stages.zaber.stage import ZaberStage
from drivers.testing.stages.bench import StageBench
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.serial_url import register
from simulators.wires.zaber.wire import ZaberBuild
from tests.drivers.stages.flat_settings import flat

NAMES = (f"zaber-test-{number}" for number in itertools.count())
COUNTS = 360_000
REPLIES_TO_OPEN = 16
"""get and set comm.checksum, device.id, serial, version, pos, three kept settings, cycle, two limits, set accel,
two triggers and the output: faults count replies from power-on."""


USUAL: dict[str, Any] = {
    "counts_per_turn": COUNTS,
    "max_speed": math.radians(30),
    "acceleration": math.radians(60),
    "low": math.radians(-5),
    "high": math.radians(100),
}
"""Of the driver's settings."""


class Rig:
    """A simulated device on a virtual clock, its cable, and the driver's settings."""

    def __init__(self, **settings: Any) -> None:
        self.clock = VirtualClock()
        self.line = TriggerLine(self.clock)
        self.sent: list[str] = []
        build = flat(ZaberBuild, **({"counts_per_turn": COUNTS} | settings))
        self.controller = build.controller(self.clock, self.line)
        self.url = register(next(NAMES), self)
        self._lost = b"nothing"

    def receive(self, data: bytes) -> None:
        self.sent.append(data.decode().strip())
        if self._lost not in data:
            self.controller.receive(data)

    def transmit(self) -> bytes:
        return self.controller.transmit()

    def open(self, clock: Clock | None = None, **settings: Any) -> ZaberStage:
        return ZaberStage(self.url, flat(ZaberSettings, **(USUAL | settings)), clock or self.clock)

    def bench(self, **settings: Any) -> StageBench:
        return StageBench(self.open(**settings), self.clock, self.line)

    def lose(self, part: str) -> None:
        """From now on packets with this text do not reach the device."""
        self._lost = part.encode()

    def say(self, *packets: str) -> str:
        """Another program; the data of the last reply, without its checksum."""
        reply = b""
        for packet in packets:
            self.controller.receive(packet.encode() + b"\n")
            reply = self.controller.transmit()
        return reply.decode().strip().split(":")[0].split(maxsplit=5)[-1]
