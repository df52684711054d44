"""Simulated shutter and sample mover: one state each, no travel time, or on a cable; the simulated camera asks both."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from simulators.devices.trigger_line import TriggerLine


class BeamGate(Protocol):
    """The part of a shutter that a simulated camera asks."""

    def is_open(self) -> bool: ...


class SampleGate(Protocol):
    """The part of a sample mover that a simulated camera asks."""

    def is_in(self) -> bool: ...


IN_PLACE = math.radians(0.1)  # How far a motor may be from its place while the sample is seen there


class MovedSample:
    """A sample that a motor moves: it is in the beam while the motor stands at `inside` (rad)."""

    def __init__(self, axis: TriggerLine, inside: float) -> None:
        self._axis, self._inside = axis, inside

    def is_in(self) -> bool:
        return abs(self._axis.angle_at(self._axis.clock.now()) - self._inside) < IN_PLACE


class SimulatedShutter:
    """Implements `drivers.base.protocols.Shutter`; it starts closed, as a beamline does."""

    by_hand = False

    def __init__(self, name: str = "shutter") -> None:
        self.name = name
        self._open = False

    def open(self) -> None:
        self._open = True

    def close(self) -> None:
        self._open = False

    def is_open(self) -> bool:
        return self._open


class WiredShutter:
    """A shutter that follows the level of a cable; the camera asks it, the driver sets the cable's other end."""

    def __init__(self, high: Callable[[], bool], open_high: bool = True) -> None:
        self._high, self._open_high = high, open_high

    def is_open(self) -> bool:
        return self._high() is self._open_high


class SimulatedSampleMover:
    """Implements `drivers.base.protocols.SampleMover`; it starts with the sample in the beam."""

    def __init__(self, name: str = "sample mover") -> None:
        self.name = name
        self._in = True

    def out(self) -> None:
        self._in = False

    def back(self) -> None:
        self._in = True

    def is_in(self) -> bool:
        """Whether the sample is in the beam; the simulated camera asks it."""
        return self._in
