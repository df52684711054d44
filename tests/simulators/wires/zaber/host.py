"""A host that exchanges raw Zaber ASCII with the simulated stage, on a virtual clock, with its own checksum
arithmetic."""

from __future__ import annotations

import math
from typing import Any

from drivers.testing.stages.bench import EmittedPulse, emitted
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from tests.drivers.stages.flat_settings import flat
from tests.simulators.wires.zaber.wire import ZaberBuild

TURN = 360_000
SPEED = 10_000
ACCELERATION = 50_000
"""Microsteps/s, microsteps/s²; the native values below are near them and give them exactly in the closed forms."""
NATIVE_SPEED, NATIVE_ACCELERATION = 16384, 8


class Wire:
    """A homed stage with a speed of 10 000 microsteps/s, and the cable in output 1."""

    def __init__(self, **settings: Any) -> None:
        self.clock = VirtualClock(start=0.0)
        self.line = TriggerLine(self.clock)
        self.box = flat(ZaberBuild, **({"counts_per_turn": TURN} | settings)).controller(self.clock, self.line)
        self.tell(f"/1 1 set maxspeed {NATIVE_SPEED}", f"/1 1 set accel {NATIVE_ACCELERATION}")

    @property
    def acceleration(self) -> float:
        """Microsteps/s²: native units are 1.6384 / 10 000 of them."""
        return NATIVE_ACCELERATION * 10_000 / 1.6384

    def tell(self, *packets: str) -> str:
        """Send packets; everything that came back."""
        for packet in packets:
            self.box.receive(packet.encode() + b"\n")
        return self.box.transmit().decode("ascii", errors="backslashreplace")

    def ask(self, packet: str) -> str:
        """The one line that answers a packet, without its CR LF, which must be there."""
        self.box.transmit()
        reply = self.tell(packet)
        assert reply.endswith("\r\n")
        assert reply.count("\r\n") == 1
        return reply[:-2]

    def data(self, words: str, axis: int = 0) -> str:
        """The data of an accepted command."""
        reply = self.ask(f"/1 {axis} {words}").split(maxsplit=5)
        assert reply[2] == "OK", reply
        return reply[5]

    def do(self, *words: str) -> None:
        for text in words:
            self.data(text, axis=int(text.split()[0] in ("move", "home", "stop", "estop")))

    def run(self, *words: str) -> None:
        """Give commands and let an hour pass."""
        self.do(*words)
        self.clock.sleep(3600.0)

    def pulses(self) -> list[EmittedPulse]:
        return emitted(self.line, self.clock)

    def counts(self) -> list[int]:
        """Where the pulses were, in microsteps."""
        return [round(pulse.angle * TURN / (2 * math.pi)) for pulse in self.pulses()]
