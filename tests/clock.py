"""The clock of tests: the same number of steps on any machine."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class SteppedClock:
    """Time (s) that passes when somebody sleeps, and by a tick with each look at it.

    It is a `drivers.base.clock.Clock`, and is called as `time.perf_counter` is.
    """

    time: float = 0.0
    tick: float = 0.0

    def now(self) -> float:
        self.time += self.tick
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds

    __call__ = now
