"""Simulated shutter and sample mover: a state each, with no travel time; the simulated camera looks at both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class BeamGate(Protocol):
    """What lets the beam through or not: all that a simulated camera asks of a shutter."""

    def is_open(self) -> bool: ...


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
    """A shutter that follows the level of a cable; the camera looks at it, the driver at the cable's other end."""

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
        """The sample is in the beam: what the simulated camera asks."""
        return self._in
