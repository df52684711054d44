"""A host that talks raw PI GCS 2.0 to the simulated controller, on a virtual clock."""

from __future__ import annotations

import math
from typing import Any

from drivers.testing.stages.bench import emitted
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import Pulse, TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsBuild
from tests.drivers.stages.flat_settings import flat

TURN = 360_000
"""A thousand counts a degree."""
VELOCITY = 10.0
ACCELERATION = 20.0


class Wire:
    """A controller with servo, velocity and acceleration set, and the cable in output 1."""

    def __init__(self, *, settings: dict[str, Any] | None = None, **build: Any) -> None:
        self.clock = VirtualClock(start=0.0)
        self.line = TriggerLine(self.clock)
        built = flat(PiGcsBuild, **({"counts_per_turn": TURN} | (settings or {}) | build))
        self.box = built.controller(self.clock, self.line)
        self.tell("SVO 1 1", f"VEL 1 {VELOCITY}", f"ACC 1 {ACCELERATION}", f"DEC 1 {ACCELERATION}")

    def tell(self, *commands: str) -> None:
        for command in commands:
            self.box.receive(command.encode() + b"\n")

    def raw(self, data: bytes) -> bytes:
        self.box.receive(data)
        return self.box.transmit()

    def ask(self, *commands: str) -> str:
        """The whole reply to the last command, without its LF, which must be there."""
        self.tell(*commands)
        reply = self.box.transmit()
        assert reply.endswith(b"\n")
        assert not reply.endswith(b" \n")
        return reply[:-1].decode("cp1252")

    def complains(self, *commands: str) -> int:
        """The error register after the commands, which must not have been answered."""
        self.tell(*commands)
        assert self.box.transmit() == b""
        return int(self.ask("ERR?"))

    def window(self, step: str, start: str, stop: str) -> None:
        """Degrees; and switched on."""
        self.tell("TRO 1 0", "CTO 1 2 1", "CTO 1 3 0", f"CTO 1 1 {step}", f"CTO 1 8 {start}", f"CTO 1 9 {stop}")
        assert self.complains("TRO 1 1") == 0

    def run(self, *commands: str) -> None:
        """Give commands and let an hour pass; none of them may be refused."""
        self.tell(*commands)
        self.clock.sleep(3600.0)
        assert self.ask("ERR?") in ("0", "10")

    def pulses(self) -> list[Pulse]:
        return emitted(self.line, self.clock)

    def degrees(self) -> list[float]:
        """Where the pulses were."""
        return [round(math.degrees(pulse.angle), 6) for pulse in self.pulses()]
