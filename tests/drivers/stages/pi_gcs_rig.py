"""A simulated PI GCS 2.0 controller on a virtual clock, for the driver's tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drivers.base.clock import Clock
from drivers.stages.pi_gcs.settings import PiGcsSettings
from drivers.stages.pi_gcs.stage import PiGcsStage
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.wire import PiGcsBuild, PiGcsController
from tests.drivers.stages.flat_settings import flat
from tests.drivers.stages.rig import FIGURES, StageRig

COUNTS = 90_000
USUAL: dict[str, Any] = FIGURES | {"axis": "1", "trigger_line": 2, "counts_per_turn": COUNTS}
"""Of the driver's settings."""
LATENCY = 0.002
CABLE = {"output": 2, "latency": LATENCY, "counts_per_turn": COUNTS}
"""Of the controller: its cable is in output 2."""


def controller(clock: Clock, line: TriggerLine, **build: Any) -> PiGcsController:
    return flat(PiGcsBuild, **(CABLE | build)).controller(clock, line)


class Rig(StageRig):
    """`heard` is every byte that the driver sent; `spoil` what becomes of a reply."""

    latency = LATENCY

    def __init__(self, *, wire: dict[str, Any] | None = None, **build: Any) -> None:
        self.spoil: Callable[[bytes], bytes] = lambda reply: reply
        spoil = {"spoil": lambda number, reply: self.spoil(reply)}
        super().__init__(PiGcsBuild, CABLE | spoil | (wire or {}) | build)
        self.heard = bytearray()
        self._lost: list[tuple[bytes, bytes]] = []

    def receive(self, data: bytes) -> None:
        self.heard += data
        for prefix, instead in self._lost:
            if data.startswith(prefix) and b"?" not in data:
                data = instead
        self.controller.receive(data)

    def open(self, clock: Clock | None = None, **settings: Any) -> PiGcsStage:
        return PiGcsStage(self.url, flat(PiGcsSettings, **(USUAL | settings)), clock or self.clock)

    def replace(self, prefix: str, instead: str = "") -> None:
        """From now on commands (not queries) that begin so arrive as another, or do not arrive."""
        self._lost.append((prefix.encode(), instead.encode() + b"\n"))

    def sent(self) -> list[str]:
        """What the driver has sent since this was last asked, control bytes on their own, ERR? left out."""
        text, self.heard = self.heard.decode(), bytearray()
        for byte in "\x04\x05\x07\x18":
            text = text.replace(byte, f"#{ord(byte)}\n")
        return [line for line in text.split("\n") if line and line != "ERR?"]
