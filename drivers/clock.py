"""Clock: the time that devices and waits run on; it comes in as an argument so that simulations can bend it."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    def now(self) -> float:
        """Seconds since the Unix epoch, never going back."""
        ...

    def sleep(self, seconds: float) -> None: ...


class SystemClock:
    """Wall-clock time that never goes back: epoch at start plus a steady counter, so that frames stay in order.

    The counter is the performance counter: Windows advances the other one (time.monotonic) in steps of 16 ms.
    """

    def __init__(self) -> None:
        self._epoch = time.time() - time.perf_counter()

    def now(self) -> float:
        return self._epoch + time.perf_counter()

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)
