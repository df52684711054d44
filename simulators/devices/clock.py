"""Simulated time: a virtual clock that jumps instead of waiting, and a clock that runs faster than its base."""

from __future__ import annotations

import threading

from drivers.clock import Clock


class VirtualClock:
    """Time that moves only when somebody sleeps: `sleep` jumps and returns at once. Safe from several threads.

    Args:
        start: s since the Unix epoch. The default is a round moment (2026-11-20 05:20:00 UTC), so that runs repeat.
    """

    def __init__(self, start: float = 1_795_152_000.0) -> None:
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
    """A clock that starts at its base's time and then runs `speed` times as fast.

    Raises:
        ValueError: speed is not positive.
    """

    def __init__(self, base: Clock, speed: float) -> None:
        if not speed > 0:
            raise ValueError(f"a clock's speed must be positive, not {speed}; 1 is the base clock's own")
        self._base, self._speed, self._start = base, float(speed), base.now()

    def now(self) -> float:
        return self._start + (self._base.now() - self._start) * self._speed

    def sleep(self, seconds: float) -> None:
        self._base.sleep(seconds / self._speed)
