"""A simulated controller of a stage on a virtual clock, for tests of its driver."""

from __future__ import annotations

import itertools
import math
from typing import Any

from drivers.base.clock import Clock
from drivers.testing.stages.bench import StageBench
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import register
from tests.drivers.stages.flat_settings import flat

NAMES = (f"stage-test-{number}" for number in itertools.count())
FIGURES: dict[str, Any] = {
    "max_speed": math.radians(30),
    "acceleration": math.radians(60),
    "low": math.radians(-5),
    "high": math.radians(100),
}
"""Usual ones, of the settings of any stage."""


class StageRig:
    """The controller of a `build`, its trigger cable, and its wire, which is this; `url` is where that is plugged in.

    Attributes:
        end: of a command on the wire.
        latency: s until its reply is there.
    """

    end = b"\n"
    latency = 0.0

    def __init__(self, build: type, figures: dict[str, Any]) -> None:
        self.clock = VirtualClock()
        self.line = TriggerLine(self.clock)
        self.controller: Any = flat(build, **figures).controller(self.clock, self.line)
        self.url = register(next(NAMES), self)

    def receive(self, data: bytes) -> None:
        self.controller.receive(data)

    def transmit(self) -> bytes:
        return bytes(self.controller.transmit())

    def open(self, clock: Clock | None = None, **settings: Any) -> Any:
        """The driver's stage, with settings that differ from the usual ones."""
        raise NotImplementedError

    def bench(self, **settings: Any) -> StageBench:
        return StageBench(self.open(**settings), self.clock, self.line)

    def say(self, *commands: str | bytes) -> str:
        """Another program, or a person at a panel or joystick; the reply to the last command."""
        reply = b""
        for command in commands:
            self.controller.receive(command if isinstance(command, bytes) else command.encode() + self.end)
            self.clock.sleep(self.latency)
            reply = self.controller.transmit()
        return reply.decode().strip()
