"""Simulated electrometer: `READ?` returns a current with its unit, a time and a status, like a picoammeter.

Form of answers, from memory of the Keithley 6485: `+1.042700E-12A,+2.345000E+00,+0.000000E+00`. An unknown command gets
no answer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from typing import Any

from drivers.base.clock import Clock
from simulators.wires.wire import BytesWire

BEAM_MONITORS = {"electrometer": __name__}

OVER_RANGE = 9.9e37


class ElectrometerWire(BytesWire):
    """The simulated electrometer at the other end of a serial cable.

    Args:
        current: function of the time (s since 1970) that returns the current in A.
        end: line end of requests and replies.
        latency: duration of a reading in s.
        silent: readings (counted from 0) that get no answer.
        spoilt: readings that get these bytes instead of an answer.
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
        super().__init__(clock, latency)
        self.heard: list[str] = []
        self.readings = 0
        self._current, self._end = current, end
        self._silent, self._spoilt = silent, spoilt
        self._started = clock.now()

    def _take(self, data: bytes) -> None:
        self._take_lines(data, self._end, self._do)

    def _do(self, line: bytes) -> None:
        command = line.decode("ascii", errors="replace").strip().upper()
        self.heard.append(command)
        if command == "READ?":
            number, self.readings = self.readings, self.readings + 1
            if number in self._spoilt:
                self._send(self._spoilt[number] + self._end)
            elif number not in self._silent:
                now = self.clock.now() + self.latency
                reading = f"{self._current(now):+.6E}A,{now - self._started:+.6E},{0:+.6E}"
                self._send(reading.encode() + self._end)


def matching(settings: Any, clock: Clock) -> ElectrometerWire:
    """The electrometer with the line ends of a section of the configuration."""
    return ElectrometerWire(clock, end=settings.end)
