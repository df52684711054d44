"""Simulated shutter and sample mover: a state each, with no travel time; the simulated camera looks at both."""

from __future__ import annotations


class SimulatedShutter:
    """Implements `drivers.protocols.Shutter`; it starts closed, as a beamline does."""

    def __init__(self, name: str = "shutter") -> None:
        self.name = name
        self._open = False

    def open(self) -> None:
        self._open = True

    def close(self) -> None:
        self._open = False

    def is_open(self) -> bool:
        return self._open


class SimulatedSampleMover:
    """Implements `drivers.protocols.SampleMover`; it starts with the sample in the beam."""

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
