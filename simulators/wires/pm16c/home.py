"""Simulated Tsuji PM16C-04XD, one channel's home switch: the search for it, and where the search found it.

The manual names the commands. The run of the search is from memory: it starts towards the switch, which tells the side,
passes it, slows down and stands beyond. A preset of the counter does not change the remembered place, because
the manual does not say that it does.
"""

from __future__ import annotations

import math

from simulators.devices.motor import PulseMotor


class HomeSwitch:
    """`at`: its place in pulses since power-on; None without a switch."""

    def __init__(self, motor: PulseMotor, at: int | None) -> None:
        self._motor, self.at = motor, at
        self._found: int | None = None
        self._searched_for: int | None = None
        self._incomplete = -math.inf

    def search(self, speed: float, acceleration: float) -> None:
        """Begin to search (pulses/s, pulses/s²) and forget the result of an earlier search."""
        assert self.at is not None, "the box refuses a search without a switch"
        here, home = self._motor.position(), self.at + self._motor.zero
        self._found, self._searched_for = None, home
        beyond = math.ceil(speed**2 / (2 * acceleration)) if home != here else 0
        self._motor.start(home + (beyond if home > here else -beyond), speed, acceleration)
        self._incomplete = self._motor.move.begin

    def found(self) -> int | None:
        """Where the search passed the switch, in counts; None if it did not."""
        move, home = self._motor.move, self._searched_for
        if home is not None and move.begin == self._incomplete:
            low, high = sorted((round(move.start), self._motor.position()))
            if low <= home <= high:
                self._found, self._searched_for = home, None
        return self._found

    def forget_search(self) -> None:
        """Another move begins: the search is over."""
        self.found()
        self._searched_for = None
