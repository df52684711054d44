"""Phases: the parts of a long work, reported as they begin, with the seconds of each; they add up to the whole."""

from __future__ import annotations

import math

from beamline.core.events import PhaseReached, Sink
from beamline.core.machine_speed import seconds_left
from drivers.base.clock import Clock, SystemClock

_SAY_EVERY = 0.2  # s between events on the progress of a phase


class Phases:
    """Consecutive phases without gaps, so that their seconds add up to the time since the start.

    Args:
        sink: gets an event `progress` of the stage "phase" as each begins, and some on its progress.
        clock: for their times.

    Attributes:
        seconds: of each phase that has ended; the sum for a repeated phase.
    """

    def __init__(self, sink: Sink = lambda event: None, clock: Clock | None = None) -> None:
        self._sink, self._clock = sink, clock or SystemClock()
        self._name, self._counted, self._begun, self._said = "", "", self._clock.now(), -math.inf
        self.seconds: dict[str, float] = {}

    def enter(self, name: str, counted: str = "views") -> None:
        """End the last phase and begin this one; its progress counts up to `counted`."""
        self.end()
        self._name, self._counted, self._said = name, counted, -math.inf
        self._say(0, 0, None, None)

    def progress(self, n: int, total: int) -> None:
        """Report that n of `total` are done; n = 0 is not reported."""
        now = self._clock.now()
        if not n:
            return
        if now - self._said >= _SAY_EVERY or n == total:
            self._said = now
            spent = max(now - self._begun, 1e-9)
            self._say(n, total, n / spent, seconds_left(n, total, spent))

    def end(self) -> None:
        """End the last phase now."""
        now = self._clock.now()
        if self._name:
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + now - self._begun
            self._begun = now
        self._name = ""

    def _say(self, n: int, of: int, per_s: float | None, eta_s: float | None) -> None:
        self._sink(PhaseReached("phase", self._counted, self._name, n, of, per_s, eta_s, time=self._clock.now()))
