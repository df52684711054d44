"""Durations: the remaining time of work, progress through the rows of a table, and the phases of long work."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from beamline.core.events import PhaseReached, Sink, TrialReached
from drivers.base.clock import Clock, SystemClock


def seconds_left(done: float, total: float, spent: float) -> float | None:
    """Remaining seconds, if the work continues at the present speed; None as long as nothing is done.

    Args:
        done, total: amount of work that is done, and of all work, in any unit in which the work proceeds evenly, such
            as predicted seconds.
        spent: time in s that the finished work took.
    """
    return max(total - done, 0.0) * spent / done if done > 0 and spent > 0 else None


_Row = TypeVar("_Row")


def in_turn(stage: str, rows: Sequence[_Row], label: Callable[[_Row], str], sink: Sink, clock: Clock) -> Iterator[_Row]:
    """Yields the rows of a table that remain to be done. Before each row, an event `progress` of this stage gives its
    label, the rate so far and the remaining seconds."""
    begin = clock.now()
    for n, row in enumerate(rows):
        spent = clock.now() - begin
        eta, rate = seconds_left(n, len(rows), spent), 60 * n / max(spent, 1e-9)
        sink(TrialReached(stage, n, len(rows), label(row), eta, rate, time=clock.now()))
        yield row


_SAY_EVERY = 0.2  # s between events on the progress of a phase


class Phases:
    """Consecutive phases of a piece of work. They have no gaps, so that their seconds add up to the time since the
    start.

    Args:
        sink: gets an event `progress` of the stage "phase" when a phase begins, and further events on its progress.
            clock: gives the times of the events.

    Attributes:
        seconds: duration of each phase that has ended. If a phase is repeated, the sum of its durations.
    """

    def __init__(self, sink: Sink = lambda event: None, clock: Clock | None = None) -> None:
        self._sink, self._clock = sink, clock or SystemClock()
        self._name, self._counted, self._begun, self._reported = "", "", self._clock.now(), -math.inf
        self.seconds: dict[str, float] = {}

    def enter(self, name: str, counted: str = "views") -> None:
        """End the last phase and begin this one. `counted` names the items that its progress counts."""
        self.end()
        self._name, self._counted, self._reported = name, counted, -math.inf
        self._say(0, 0, None, None)

    def progress(self, n: int, total: int) -> None:
        """Report that n of `total` are done; n = 0 is not reported."""
        now = self._clock.now()
        if n and (now - self._reported >= _SAY_EVERY or n == total):
            self._reported = now
            spent = max(now - self._begun, 1e-9)
            self._say(n, total, n / spent, seconds_left(n, total, spent))

    def end(self) -> None:
        """End the present phase now."""
        now = self._clock.now()
        if self._name:
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + now - self._begun
            self._begun = now
        self._name = ""

    def _say(self, n: int, total: int, per_s: float | None, eta_s: float | None) -> None:
        self._sink(PhaseReached("phase", self._counted, self._name, n, total, per_s, eta_s, time=self._clock.now()))
