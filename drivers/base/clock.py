"""Clock: the time for devices and waits. Every driver takes the clock as an argument, so that a simulation can use its
own clock.
"""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    def now(self) -> float:
        """Time in seconds since the Unix epoch. It never decreases."""

    def sleep(self, seconds: float) -> None: ...


class SystemClock:
    """Wall-clock time that never decreases: the epoch time at the start plus a monotonic counter.

    The counter is time.perf_counter: Windows advances time.monotonic in steps of 16 ms.
    """

    def __init__(self) -> None:
        self._epoch = time.time() - time.perf_counter()

    def now(self) -> float:
        return self._epoch + time.perf_counter()

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)
