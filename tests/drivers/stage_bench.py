"""A stage and its trigger cable on a bench, for tests that know no protocol: moves, trains, pulses in degrees."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from drivers.clock import Clock
from drivers.protocols import RotationStage, TriggerTrain
from simulators.devices.trigger_line import Pulse, TriggerLine
from tests.simulators.cable import emitted

SPEED = math.radians(10)
LONG = 60.0


@dataclass
class StageBench:
    """A stage at angle 0 that can go from -5 to 100 degrees at 10 degrees/s or faster, and its trigger cable."""

    stage: RotationStage
    clock: Clock
    line: TriggerLine

    def pulses(self) -> list[Pulse]:
        """Those that have been emitted by now."""
        return emitted(self.line, self.clock)

    def go(self, degrees: float) -> float:
        """Move and wait; where it stands, in degrees."""
        self.stage.start_move(math.radians(degrees), SPEED)
        return math.degrees(self.stage.wait(LONG))

    def counts(self, degrees: float) -> int:
        return self.stage.to_counts(math.radians(degrees))

    def train(self, first: float, step: float, n: int) -> TriggerTrain:
        """A train in degrees."""
        return TriggerTrain(self.counts(first), self.counts(step), n)

    @property
    def count(self) -> float:
        """One count in degrees."""
        return 360.0 / self.stage.limits.counts_per_turn


Build = Callable[..., StageBench]
