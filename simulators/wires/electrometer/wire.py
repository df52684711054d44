"""Simulated electrometer, the wire: `READ?` gives a current with its unit, a time and a status, as a picoammeter does.

Form of answers, from memory of the Keithley 6485: `+1.042700E-12A,+2.345000E+00,+0.000000E+00`. An unknown command gets
no answer.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Set
from typing import Any

from drivers.base.clock import Clock

OVER_RANGE = 9.9e37


class ElectrometerWire:
    """Bytes in by `receive`, bytes out by `transmit`. Safe from several threads.

    Args:
        current: A, as a function of the time in s since 1970.
        end: of lines, both ways.
        latency: s that a reading takes.
        silent: readings (from 0) that get no answer.
        spoilt: readings that get these bytes in the place of an answer.
    """

    def __init__(
        self,
        clock: Clock,
        current: Callable[[float], float] = lambda time: 1e-9,
        *,
        end: bytes = b"\r\n",
        latency: float = 0.02,
        silent: Set[int] = frozenset(),
        spoilt: Mapping[int, bytes] = {},
    ) -> None:
        self.clock = clock
        self.heard: list[str] = []
        self.readings = 0
        self._current, self._end, self.latency = current, end, latency
        self._silent, self._spoilt = silent, spoilt
        self._started = clock.now()
        self._in, self._coming = bytearray(), list[tuple[float, bytes]]()
        self._lock = threading.Lock()

    def receive(self, data: bytes) -> None:
        """Bytes from the host, in pieces of any size."""
        with self._lock:
            self._in += data
            while self._end in self._in:
                line, _, rest = bytes(self._in).partition(self._end)
                self._in = bytearray(rest)
                self._do(line.decode("ascii", errors="replace").strip().upper())

    def transmit(self) -> bytes:
        """Bytes for the host that are due and not yet taken."""
        with self._lock:
            now = self.clock.now()
            due = b"".join(piece for time, piece in self._coming if time <= now)
            self._coming = [(time, piece) for time, piece in self._coming if time > now]
            return due

    def _do(self, command: str) -> None:
        self.heard.append(command)
        if command == "READ?":
            at, self.readings = self.readings, self.readings + 1
            if at in self._spoilt:
                self._answer(self._spoilt[at])
            elif at not in self._silent:
                now = self.clock.now() + self.latency
                self._answer(f"{self._current(now):+.6E}A,{now - self._started:+.6E},{0:+.6E}".encode())

    def _answer(self, text: bytes) -> None:
        self._coming.append((self.clock.now() + self.latency, text + self._end))


def matching(settings: Any, clock: Clock) -> ElectrometerWire:
    """The electrometer whose lines end as those of a section of the configuration."""
    return ElectrometerWire(clock, end=settings.end)
