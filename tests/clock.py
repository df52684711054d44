"""A clock for tests: it counts steps, so that it is the same on any machine."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass
class SteppedClock:
    """A time in s that advances with each sleep, and by a tick each time it is read; events that are `due` then happen.

    It is a `drivers.base.clock.Clock`, and is called as `time.perf_counter` is.
    """

    time: float = 0.0
    tick: float = 0.0
    due: list[tuple[float, Callable[[], None]]] = field(default_factory=list)

    def now(self) -> float:
        self._pass(self.tick)
        return self.time

    def sleep(self, seconds: float) -> None:
        self._pass(seconds)

    def _pass(self, seconds: float) -> None:
        self.time += seconds
        while self.due and self.due[0][0] <= self.time:
            self.due.pop(0)[1]()

    __call__ = now


def wait_until(done: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait in real time for another thread or process; fails if it takes longer than `seconds`."""
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)
