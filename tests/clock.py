"""A clock for tests: it counts steps, so that it is the same on any machine."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass
class SteppedClock:
    """Time (s) that passes when somebody sleeps, and by a tick with each look at it; what is `due` by then happens.

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
    """Wait in real time for another thread or process; it must be done within so many s."""
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)
