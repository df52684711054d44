"""Simulated PI GCS 2.0, trigger output: the positions at which an output line in mode 0 (PositionDistance) fires.

One pulse for each step of travel. If the start threshold lies below the stop threshold, pulses begin only in the
positive direction; if it lies above, only in the negative one. Equal thresholds switch the window off. A move that
reverses inside the window goes on giving pulses at every step. They end beyond either threshold (C-863, E-727 manuals).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

SLACK = 1e-6
"""counts: largest error of a position by the decimals on the wire."""


class FirstPulse(StrEnum):
    """Where the first pulse comes. The manuals do not say, so the simulation offers each possibility."""

    AT_THRESHOLD = "at_threshold"
    STEP_AFTER = "step_after"
    GRID = "grid"
    """At whole steps from position 0; the window only selects."""


@dataclass(frozen=True)
class Window:
    """Settings of a line: step > 0 and thresholds in counts of the axis; `zero` is the count of its position 0."""

    step: float
    start: float
    stop: float
    zero: float = 0.0
    rule: FirstPulse = FirstPulse.AT_THRESHOLD

    @property
    def sign(self) -> int:
        """The direction in which pulses begin: +1, -1, or 0 if the window is off."""
        return (self.stop > self.start) - (self.stop < self.start)


@dataclass(frozen=True)
class TrainProgress:
    """How far a line is: inside its window or not, and the last pulse (or where it would have been): anchor + index
    steps."""

    inside: bool = False
    anchor: float = 0.0
    index: int = 0


@dataclass(frozen=True)
class Crossing:
    """A position at which the line changes, and its state after the change."""

    position: float
    pulse: bool
    after: TrainProgress


def switched_on(window: Window, position: float) -> TrainProgress:
    """What a line knows when TRO switches it on with the axis at `position` (counts)."""
    return TrainProgress() if window.sign else TrainProgress(True, position, 0)


def crossings(window: Window, progress: TrainProgress, begin: float, end: float) -> Iterator[Crossing]:
    """What happens on the straight way from `begin` (not included) to `end` (included), in order."""
    if begin == end:
        return
    sign, reach = (1 if end > begin else -1), abs(end - begin)

    def ahead(position: float) -> float:
        return sign * (position - begin)

    if not progress.inside:
        if sign != window.sign or ahead(window.stop) < 0 or ahead(window.start) > reach:
            return
        if ahead(window.start) > 0:
            progress = _entered(window, window.start, sign)
            if window.rule is FirstPulse.AT_THRESHOLD:
                yield Crossing(window.start, True, progress)
            else:
                yield Crossing(window.start, False, progress)
        else:  # it stood inside when it was switched on
            progress = _entered(window, begin, sign)
    edge = window.stop if sign == window.sign else window.start
    room = ahead(edge) if window.sign else math.inf
    while True:
        at = progress.anchor + (progress.index + sign) * window.step
        if ahead(at) > min(room, reach) + SLACK:
            break
        progress = replace(progress, index=progress.index + sign)
        yield Crossing(end if ahead(at) > reach else at, True, progress)
    if room < reach:
        yield Crossing(edge, False, TrainProgress())


def _entered(window: Window, position: float, sign: int) -> TrainProgress:
    if window.rule is not FirstPulse.GRID:
        return TrainProgress(True, position, 0)
    steps = (position - window.zero) / window.step
    nearest = math.ceil(sign * steps - SLACK / window.step)
    return TrainProgress(True, window.zero, sign * (nearest - 1))
