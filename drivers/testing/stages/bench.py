"""A stage and its trigger cable for tests that do not depend on a protocol: moves, trains and pulses in degrees."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from drivers.base.clock import Clock
from drivers.base.protocols import RotationStage, TriggerTrain

SPEED = math.radians(10)
LONG = 60.0


class EmittedPulse(Protocol):
    """A pulse on the cable: the time of its rising edge in s, and the true position of the stage in rad."""

    @property
    def time(self) -> float: ...

    @property
    def angle(self) -> float: ...


class Cable(Protocol):
    """The trigger cable, with a measurement of the true angle: a simulated line, or a counter card."""

    def next_after(self, time: float) -> EmittedPulse | None:
        """The first pulse strictly later than `time`, also if it is still in the future; None if there is none."""

    def angle_at(self, time: float) -> float:
        """The true angle in rad."""


@dataclass(frozen=True, kw_only=True)
class StageKind:
    """Facts about a stage that the suite needs.

    Attributes:
        width: a pulse width (s) of the output, at most 1 ms; None if the width is fixed.
        no_width: a width that the output does not have, or that excludes other settings. inverts: True if the pulses
            may be active low. homes: True if the stage has a reference within its limits. turning_back_ends: True if a
            train ends when the stage turns back inside it. If False, the remaining pulses come later. disarms_moving:
            True if a train can be ended while the stage moves. triggers: True if the stage has a trigger output. For a
            stage without one, the suite is `StepStageConformance`.
    """

    width: float | None = 100e-6
    no_width: float = 0.0
    inverts: bool = False
    homes: bool = True
    turning_back_ends: bool = True
    disarms_moving: bool = True
    triggers: bool = True


@dataclass
class StageBench:
    """A stage at angle 0 that can move from -5 to 100 degrees at 10 degrees/s or faster, and its trigger cable."""

    stage: RotationStage
    clock: Clock
    line: Cable

    def pulses(self) -> list[EmittedPulse]:
        """The number of pulses emitted so far."""
        return emitted(self.line, self.clock)

    def pulse_counts(self) -> list[int]:
        """The positions of the pulses in counts."""
        return [self.stage.to_counts(pulse.angle) for pulse in self.pulses()]

    def go(self, degrees: float) -> float:
        """Move and wait; returns the position in degrees."""
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
"""Function that opens the stage again, with settings of its driver that differ from the usual ones."""


def emitted(line: Cable, clock: Clock) -> list[EmittedPulse]:
    """The pulses on a cable so far, in their order."""
    pulses: list[EmittedPulse] = []
    after = -math.inf
    while (pulse := line.next_after(after)) is not None and pulse.time <= clock.now():
        pulses.append(pulse)
        after = pulse.time
    return pulses
