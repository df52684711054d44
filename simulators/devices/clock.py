"""Simulated time: a virtual clock that jumps instead of waiting, and a clock that runs faster than its base."""

from __future__ import annotations

import threading

from drivers.base.clock import Clock

# s since the Unix epoch: a round time (2026-11-20 05:20:00 UTC), so that runs are repeatable
VIRTUAL_START = 1_795_152_000.0


class VirtualClock:
    """Time that advances only during `sleep`, which jumps and returns at once. It can be used from several threads.

    Args:
        start: s since the Unix epoch.
    """

    def __init__(self, start: float = VIRTUAL_START) -> None:
        self._now = float(start)
        self._lock = threading.Lock()

    def now(self) -> float:
        with self._lock:
            return self._now

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            with self._lock:
                self._now += seconds


class ScaledClock:
    """A clock that starts at the time of its base, or at `not_before` if this is later, and runs `speed` times as fast.

    Raises:
        ValueError: speed is not positive.
    """

    def __init__(self, base: Clock, speed: float, not_before: float = 0.0) -> None:
        if not speed > 0:
            raise ValueError(f"the speed of a clock must be positive, got {speed}; 1 is the speed of the base clock")
        self._base, self._speed, self._base_start = base, float(speed), base.now()
        self._start = max(self._base_start, not_before)

    def now(self) -> float:
        return self._start + (self._base.now() - self._base_start) * self._speed

    def sleep(self, seconds: float) -> None:
        self._base.sleep(seconds / self._speed)
