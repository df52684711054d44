"""A simulated PI GCS 2.0 controller on a virtual clock, for the driver's tests."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

from drivers.base.clock import Clock
from drivers.stages.pi_gcs.settings import PiGcsSettings
from drivers.stages.pi_gcs.stage import PiGcsStage
from drivers.testing.stages.bench import StageBench
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsBuild, PiGcsController
from simulators.wires.serial_url import register
from tests.drivers.stages.flat_settings import flat

NAMES = (f"pi-gcs-test-{number}" for number in itertools.count())
COUNTS = 90_000
LATENCY = 0.002
USUAL: dict[str, Any] = {
    "axis": "1",
    "trigger_line": 2,
    "counts_per_turn": COUNTS,
    "max_speed": math.radians(30),
    "acceleration": math.radians(60),
    "low": math.radians(-5),
    "high": math.radians(100),
}
"""Of the driver's settings."""


def controller(clock: Any, line: TriggerLine, *, wire: dict[str, Any] | None = None, **build: Any) -> PiGcsController:
    """With the cable in output 2."""
    usual = {"output": 2, "latency": LATENCY, "counts_per_turn": COUNTS}
    return flat(PiGcsBuild, **(usual | (wire or {}) | build)).controller(clock, line)


class Rig:
    """A simulated controller, its trigger cable, and the driver's usual settings. `heard` is every byte that the
    driver sent."""

    def __init__(self, *, wire: dict[str, Any] | None = None, **build: Any) -> None:
        self.clock = VirtualClock()
        self.line = TriggerLine(self.clock)
        self.spoil: Callable[[bytes], bytes] = lambda reply: reply
        spoil = {"spoil": lambda number, reply: self.spoil(reply)}
        self.controller = controller(self.clock, self.line, wire=spoil | (wire or {}), **build)
        self.url = register(next(NAMES), self)
        self.heard = bytearray()
        self.unasked = bytearray()
        self._lost: list[tuple[bytes, bytes]] = []

    def receive(self, data: bytes) -> None:
        self.heard += data
        for prefix, instead in self._lost:
            if data.startswith(prefix) and b"?" not in data:
                data = instead
        self.controller.receive(data)

    def transmit(self) -> bytes:
        unasked, self.unasked = bytes(self.unasked), bytearray()
        return unasked + self.controller.transmit()

    def open(self, clock: Clock | None = None, **settings: Any) -> PiGcsStage:
        return PiGcsStage(self.url, flat(PiGcsSettings, **(USUAL | settings)), clock or self.clock)

    def bench(self, **settings: Any) -> StageBench:
        return StageBench(self.open(**settings), self.clock, self.line)

    def replace(self, prefix: str, instead: str = "") -> None:
        """From now on commands (not queries) that begin so arrive as another, or do not arrive."""
        self._lost.append((prefix.encode(), instead.encode() + b"\n"))

    def say(self, *commands: str | bytes) -> str:
        """Another program, or a person at a joystick; the reply to the last command."""
        reply = b""
        for command in commands:
            self.controller.receive(command if isinstance(command, bytes) else command.encode() + b"\n")
            self.clock.sleep(LATENCY)
            reply = self.controller.transmit()
        return reply.decode().strip()

    def sent(self) -> list[str]:
        """What the driver has sent since this was last asked, control bytes on their own, ERR? left out."""
        text, self.heard = self.heard.decode(), bytearray()
        for byte in "\x04\x05\x07\x18":
            text = text.replace(byte, f"#{ord(byte)}\n")
        return [line for line in text.split("\n") if line and line != "ERR?"]
