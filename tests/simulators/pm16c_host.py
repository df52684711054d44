"""A host that sends raw PM16C commands to the simulated controller, on a virtual clock."""

from __future__ import annotations

import math

from drivers.testing.stages.bench import EmittedPulse, emitted
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pm16c.wire import PM16CBuild
from tests.drivers.stages.flat_settings import flat

TURN = 360_000
SPEED = 10_000
ACCELERATION = 10_000.0
"""pps²: code 24, 100 ms per 1000 pps."""


class Wire:
    """A controller in REMOTE with speed and acceleration set, and the cable in TP0."""

    def __init__(self, **faults: object) -> None:
        self.clock = VirtualClock(start=0.0)
        self.line = TriggerLine(self.clock)
        self.box = flat(PM16CBuild, counts_per_turn=TURN, **faults).controller(self.clock, self.line)
        self.tell("REM", f"SPDH0{SPEED}", "RTE0024", "TMGM02")

    def tell(self, *commands: str) -> None:
        for command in commands:
            self.box.receive(command.encode() + b"\r\n")

    def ask(self, *commands: str) -> str:
        """The whole reply to the last command, without its CR LF, which must be there."""
        self.tell(*commands)
        reply = self.box.transmit()
        assert reply.endswith(b"\r\n")
        assert reply.count(b"\r\n") == 1
        return reply[:-2].decode()

    def train(self, start: int | str, end: int | str, interval: int | str) -> None:
        self.tell("TMGC0", f"TMGS0{int(start):+d}", f"TMGE0{int(end):+d}", f"TMGI0{interval}", "TMGR0")

    def rest(self) -> None:
        self.clock.sleep(3600.0)

    def run(self, *commands: str) -> None:
        """Give commands and let an hour pass."""
        self.tell(*commands)
        self.rest()

    def pulses(self) -> list[EmittedPulse]:
        return emitted(self.line, self.clock)

    def at(self, time: float) -> float:
        """Counts."""
        return self.line.angle_at(time) * TURN / (2 * math.pi)

    def places(self) -> list[int]:
        """Where the pulses were, in counts."""
        return [round(pulse.angle * TURN / (2 * math.pi)) for pulse in self.pulses()]
