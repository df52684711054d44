"""A simulated PM16C on a virtual clock, for the driver's tests."""

from __future__ import annotations

import itertools
import math
from typing import Any

from drivers.base.clock import Clock
from drivers.stages.pm16c.settings import PM16CSettings
from drivers.stages.pm16c.stage import PM16CStage
from drivers.testing.stages.bench import StageBench
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pm16c.wire import PM16CBuild
from simulators.wires.serial_url import register
from tests.drivers.stages.flat_settings import flat

NAMES = (f"pm16c-test-{number}" for number in itertools.count())
COUNTS = 90_000
QUERIES_TO_OPEN = 13
"""VER? STS? STS? STS? ERRF? SETCH? RTE? SPDH? SPD? SETCH? TMGR? RTE? SETLS?: faults count queries from power-on."""


class Rig:
    """A simulated controller (sample on channel 11, hex B) on a virtual clock, its cable, and the driver's settings."""

    def __init__(self, **faults: Any) -> None:
        self.clock = VirtualClock()
        self.line = TriggerLine(self.clock)
        settings = {"channel": 11, "counts_per_turn": COUNTS} | faults
        self.controller = flat(PM16CBuild, **settings).controller(self.clock, self.line)
        self.url = register(next(NAMES), self)
        self._lost = b"nothing"

    def receive(self, data: bytes) -> None:
        if not data.startswith(self._lost) or b"?" in data:
            self.controller.receive(data)

    def transmit(self) -> bytes:
        return self.controller.transmit()

    def open(self, clock: Clock | None = None, **settings: Any) -> PM16CStage:
        usual: dict[str, Any] = {
            "channel": 11,
            "counts_per_turn": COUNTS,
            "max_speed": math.radians(30),
            "acceleration": math.radians(60),
            "low": math.radians(-5),
            "high": math.radians(100),
            "home": 0.0,
            "home_speed": min(math.radians(15), settings.get("max_speed", 1.0)),
        }
        return PM16CStage(self.url, flat(PM16CSettings, **(usual | settings)), clock or self.clock)

    def bench(self, **settings: Any) -> StageBench:
        return StageBench(self.open(**settings), self.clock, self.line)

    def lose(self, prefix: str) -> None:
        """From now on commands (not queries) that begin so do not reach the controller."""
        self._lost = prefix.encode()

    def say(self, *commands: str) -> str:
        """Another program, or a person at the panel; the reply to the last command."""
        reply = b""
        for command in commands:
            self.controller.receive(command.encode() + b"\r\n")
            reply = self.controller.transmit()
        return reply.decode().strip()


class Slow:
    """A controller whose settings and moves take effect `seconds` after they came: it is writing its memory, for which
    KEK's driver waits 40 ms. Stops act, and queries are answered, at once, from what holds by then."""

    def __init__(self, rig: Rig, seconds: float) -> None:
        self.clock, self._rig, self._seconds = rig.clock, rig, seconds
        self._coming: list[tuple[float, bytes]] = []

    def receive(self, data: bytes) -> None:
        self._settle()
        if b"?" in data or b"STP" in data:
            self._rig.receive(data)
        else:
            self._coming.append((self.clock.now() + self._seconds, data))

    def transmit(self) -> bytes:
        self._settle()
        return self._rig.transmit()

    def _settle(self) -> None:
        while self._coming and self._coming[0][0] <= self.clock.now():
            self._rig.receive(self._coming.pop(0)[1])
