"""Manual devices, from shutter to monochromator: asks an operator to act and keeps the state that was confirmed.

The state is unknown while the operator is asked, and stays unknown if the request is not confirmed.
"""

from __future__ import annotations

from collections.abc import Callable

Ask = Callable[[str], None]
"""Shows the operator a request and returns once it is confirmed; raises the caller's own error otherwise."""


class ManualShutter:
    """Implements `drivers.base.protocols.Shutter` by asking the operator.

    The state of the shutter at the start is not known, so the first `open` or `close` always asks. Later ones ask only
    if the state changes.
    """

    by_hand = True

    def __init__(self, ask: Ask, name: str = "shutter") -> None:
        self.name = name
        self._ask = ask
        self._open: bool | None = None

    def open(self) -> None:
        if self._open is not True:
            self._open = None
            self._ask("Open the beam shutter.")
            self._open = True

    def close(self) -> None:
        if self._open is not False:
            self._open = None
            self._ask("Close the beam shutter.")
            self._open = False

    def is_open(self) -> bool:
        """The state last confirmed; False before the first confirmation, the safe assumption for a measurement."""
        return self._open is True


class ManualSampleMover:
    """Implements `drivers.base.protocols.SampleMover` by asking the operator; the sample starts in the beam."""

    def __init__(self, ask: Ask, name: str = "sample mover") -> None:
        self.name = name
        self._ask = ask
        self._in: bool | None = True

    def out(self) -> None:
        if self._in is not False:
            self._in = None
            self._ask("Move the sample out of the beam.")
            self._in = False

    def back(self) -> None:
        if self._in is not True:
            self._in = None
            self._ask("Move the sample back into the beam, to the same place.")
            self._in = True


class ManualFilter:
    """Implements `drivers.base.protocols.Filter` by asking the operator; which one is in at the start is not known."""

    def __init__(self, ask: Ask, name: str = "filter") -> None:
        self.name = name
        self._ask = ask
        self._place: str | None = None

    def put(self, place: str) -> None:
        if place != self._place:
            self._place = None
            self._ask(f"Put the filter into the beam: {place}.")
            self._place = place

    def place(self) -> str | None:
        return self._place


class ManualMonochromator:
    """Implements `drivers.base.protocols.Monochromator` by asking the operator; the first energy is not known."""

    def __init__(self, ask: Ask, name: str = "monochromator") -> None:
        self.name = name
        self._ask = ask
        self._energy: float | None = None

    def move_to(self, energy: float) -> None:
        if energy != self._energy:
            self._energy = None
            self._ask(f"Set the monochromator to {energy:.7g} keV.")
            self._energy = energy

    def energy(self) -> float | None:
        return self._energy
