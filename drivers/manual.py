"""Manual devices, from shutter to monochromator: asks an operator to act and keeps the state that was confirmed.

The state is unknown while the operator is asked, and stays unknown if the request is not confirmed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Ask = Callable[[str], None]
"""Shows the operator a request and returns once it is confirmed; raises the caller's own error otherwise."""


class _Manual:
    """A device that the operator moves; `_state` is what he has confirmed last, None where it is not known."""

    _name = ""

    def __init__(self, ask: Ask, name: str = "") -> None:
        self.name, self._ask = name or self._name, ask
        self._state: Any = None

    def _bring(self, state: object, request: str) -> None:
        """Ask for a state, unless it is the present one."""
        if self._state != state:
            self._state = None
            self._ask(request)
            self._state = state


class ManualShutter(_Manual):
    """Implements `drivers.base.protocols.Shutter` by asking the operator.

    The state of the shutter at the start is not known, so the first `open` or `close` always asks. Later ones ask only
    if the state changes.
    """

    by_hand = True
    _name = "shutter"

    def open(self) -> None:
        self._bring(True, "Open the beam shutter.")

    def close(self) -> None:
        self._bring(False, "Close the beam shutter.")

    def is_open(self) -> bool:
        """The state last confirmed; False before the first confirmation, the safe assumption for a measurement."""
        return self._state is True


class ManualSampleMover(_Manual):
    """Implements `drivers.base.protocols.SampleMover` by asking the operator; the sample starts in the beam."""

    _name = "sample mover"

    def __init__(self, ask: Ask, name: str = "") -> None:
        super().__init__(ask, name)
        self._state = "in"

    def out(self) -> None:
        self._bring("out", "Move the sample out of the beam.")

    def back(self) -> None:
        self._bring("in", "Move the sample back into the beam, to the same place.")


class ManualFilter(_Manual):
    """Implements `drivers.base.protocols.Filter` by asking the operator; which one is in at the start is not known."""

    _name = "filter"

    def put(self, place: str) -> None:
        self._bring(place, f"Put the filter into the beam: {place}.")

    def place(self) -> str | None:
        place: str | None = self._state
        return place


class ManualMonochromator(_Manual):
    """Implements `drivers.base.protocols.Monochromator` by asking the operator; the first energy is not known."""

    _name = "monochromator"

    def move_to(self, energy: float) -> None:
        self._bring(energy, f"Set the monochromator to {energy:.7g} keV.")

    def energy(self) -> float | None:
        energy: float | None = self._state
        return energy
