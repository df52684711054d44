"""Trigger line: the cable from the stage's trigger output to the camera. The stage schedules pulses, the camera
receives them.

Pulses are put on the line with the time of their rising edge, often before that time, because the stage knows its
motion when it starts. A consumer uses a pulse only after the clock has passed its time, because a stop cancels later
pulses.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from operator import attrgetter

from drivers.base.clock import Clock


@dataclass(frozen=True, order=True)
class Pulse:
    """A rising edge: its time in s since the Unix epoch and the stage's true angle at that time in radians."""

    time: float
    angle: float


class TriggerLine:
    """Pulses in the order of time, and the sample's true angle. It can be used from several threads."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._pulses: list[Pulse] = []
        self._angle: Callable[[float], float] | None = None
        self._lock = threading.Lock()

    def schedule(self, pulses: Iterable[Pulse]) -> None:
        """Put pulses on the line, in any order.

        Raises:
            ValueError: a time is not finite; the line is not changed.
        """
        new = list(pulses)
        if bad := [pulse for pulse in new if not math.isfinite(pulse.time)]:
            raise ValueError(f"a pulse needs a finite time, got {bad[0]}; no pulse was scheduled")
        with self._lock:
            self._pulses = sorted([*self._pulses, *new])

    def cancel_after(self, time: float) -> None:
        """Remove the pulses later than `time`."""
        with self._lock:
            del self._pulses[bisect_right(self._pulses, time, key=attrgetter("time")) :]

    def next_after(self, time: float) -> Pulse | None:
        """The first pulse strictly later than `time`, even if it is in the future; None if there is none."""
        with self._lock:
            index = bisect_right(self._pulses, time, key=attrgetter("time"))
            return self._pulses[index] if index < len(self._pulses) else None

    def attach_angle(self, angle: Callable[[float], float]) -> None:
        """Set the function of the sample's true angle: radians at a time. A later call replaces it."""
        with self._lock:
            self._angle = angle

    def angle_at(self, time: float) -> float:
        """The true angle in radians at `time`; 0 if no stage turns the sample."""
        with self._lock:
            angle = self._angle
        return 0.0 if angle is None else float(angle(time))
