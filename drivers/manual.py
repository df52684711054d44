"""Manual shutter and sample mover: an operator does the work when asked, and the driver remembers what was done."""

from __future__ import annotations

from collections.abc import Callable

Ask = Callable[[str], None]
"""Puts a request to the operator and returns once it is done; raises whatever the caller uses for "not done"."""


class ManualShutter:
    """Implements `drivers.protocols.Shutter`. What the beamline's shutter does at the start is not known, so `open` and
    `close` always ask the first time; a state that is already there is not asked for again."""

    def __init__(self, ask: Ask, name: str = "shutter") -> None:
        self.name = name
        self._ask = ask
        self._open: bool | None = None

    def open(self) -> None:
        if self._open is not True:
            self._ask("Open the beam shutter.")
            self._open = True

    def close(self) -> None:
        if self._open is not False:
            self._ask("Close the beam shutter.")
            self._open = False

    def is_open(self) -> bool:
        """What was last confirmed; False before that, so that nobody counts on beam."""
        return self._open is True


class ManualSampleMover:
    """Implements `drivers.protocols.SampleMover`. The sample is taken to be in the beam at the start."""

    def __init__(self, ask: Ask, name: str = "sample mover") -> None:
        self.name = name
        self._ask = ask
        self._in = True

    def out(self) -> None:
        if self._in:
            self._ask("Move the sample out of the beam.")
            self._in = False

    def back(self) -> None:
        if not self._in:
            self._ask("Move the sample back into the beam, to the same place.")
            self._in = True
