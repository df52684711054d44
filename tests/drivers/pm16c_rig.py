"""A simulated PM16C on a virtual clock, for the driver's tests."""

from __future__ import annotations

import math
from typing import Any

from drivers.base.clock import Clock
from drivers.stages.pm16c.settings import PM16CSettings
from drivers.stages.pm16c.stage import PM16CStage
from simulators.wires.pm16c.wire import PM16CBuild
from tests.drivers.stages.flat_settings import flat
from tests.drivers.stages.rig import FIGURES, StageRig

COUNTS = 90_000
QUERIES_TO_OPEN = 13
"""VER? STS? STS? STS? ERRF? SETCH? RTE? SPDH? SPD? SETCH? TMGR? RTE? SETLS?: faults count queries from power-on."""


class Rig(StageRig):
    """The sample is on channel 11, hex B."""

    end = b"\r\n"

    def __init__(self, **faults: Any) -> None:
        super().__init__(PM16CBuild, {"channel": 11, "counts_per_turn": COUNTS} | faults)
        self._lost = b"nothing"

    def receive(self, data: bytes) -> None:
        if not data.startswith(self._lost) or b"?" in data:
            self.controller.receive(data)

    def open(self, clock: Clock | None = None, **settings: Any) -> PM16CStage:
        home_speed = min(math.radians(15), settings.get("max_speed", 1.0))
        usual = {"channel": 11, "counts_per_turn": COUNTS, "home": 0.0, "home_speed": home_speed}
        return PM16CStage(self.url, flat(PM16CSettings, **(FIGURES | usual | settings)), clock or self.clock)

    def lose(self, prefix: str) -> None:
        """From now on commands (not queries) that begin so do not reach the controller."""
        self._lost = prefix.encode()


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
