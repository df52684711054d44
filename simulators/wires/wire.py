"""Wire: the far end of a serial cable, as a simulated device shows it to whatever carries the bytes."""

from __future__ import annotations

from typing import Protocol

from drivers.clock import Clock


class Wire(Protocol):
    """A simulated device; safe from several threads."""

    @property
    def clock(self) -> Clock: ...

    def receive(self, data: bytes) -> None:
        """Bytes from the host, in pieces of any size."""
        ...

    def transmit(self) -> bytes:
        """Bytes sent by now and not taken yet."""
        ...
