"""A simulated Zaber stage on a virtual clock, for the driver's tests."""

from __future__ import annotations

from typing import Any

from drivers.base.clock import Clock
from drivers.stages.zaber.settings import ZaberSettings
from drivers.stages.zaber.stage import ZaberStage
from tests.drivers.stages.flat_settings import flat
from tests.drivers.stages.rig import FIGURES, StageRig
from tests.simulators.wires.zaber.wire import ZaberBuild

COUNTS = 360_000
REPLIES_TO_OPEN = 16
"""get and set comm.checksum, device.id, serial, version, pos, three kept settings, cycle, two limits, set accel,
two triggers and the output: faults count replies from power-on."""
USUAL: dict[str, Any] = FIGURES | {"counts_per_turn": COUNTS}
"""Of the driver's settings."""


class Rig(StageRig):
    """`sent` is every packet that the driver sent."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(ZaberBuild, {"counts_per_turn": COUNTS} | settings)
        self.sent: list[str] = []
        self._lost = b"nothing"

    def receive(self, data: bytes) -> None:
        self.sent.append(data.decode().strip())
        if self._lost not in data:
            self.controller.receive(data)

    def open(self, clock: Clock | None = None, **settings: Any) -> ZaberStage:
        return ZaberStage(self.url, flat(ZaberSettings, **(USUAL | settings)), clock or self.clock)

    def lose(self, part: str) -> None:
        """From now on packets with this text do not reach the device."""
        self._lost = part.encode()

    def say(self, *packets: str | bytes) -> str:
        """Another program; the data of the last reply, without its checksum."""
        return super().say(*packets).split(":")[0].split(maxsplit=5)[-1]
