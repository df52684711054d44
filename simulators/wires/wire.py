"""Wire: the far end of a serial cable: bytes in, bytes out."""

from __future__ import annotations

from typing import Any, Protocol, Self

from drivers.base.clock import Clock
from simulators.devices.trigger_line import TriggerLine


class Wire(Protocol):
    """A simulated device; safe from several threads."""

    @property
    def clock(self) -> Clock: ...

    def receive(self, data: bytes) -> None:
        """Bytes from the host, in pieces of any size."""

    def transmit(self) -> bytes:
        """Bytes sent by now and not taken yet."""


class Controller(Wire, Protocol):
    """A simulated controller of a stage."""

    def output_is_high(self, number: int) -> bool:
        """The level of a digital output; False if no output has that number."""


class Build(Protocol):
    """How a simulated controller is built, and its faults: a frozen dataclass in each controller's folder."""

    @classmethod
    def matching(cls, settings: Any) -> Self:
        """The controller that fits a driver with these settings.

        Raises:
            ValueError: the simulated controller cannot have a setting; the message names it and the reason.
        """

    def controller(self, clock: Clock, line: TriggerLine) -> Controller:
        """The controller with its trigger output wired to `line`, which also learns the sample's true angle."""
