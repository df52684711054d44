"""Wire: the far end of a serial cable: bytes in, bytes out."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable
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


class BytesWire:
    """A simulated device with bytes on their way from and to the host; one call at a time."""

    def __init__(self, clock: Clock, latency: float = 0.0) -> None:
        """`latency`: s until a reply can be read."""
        self.clock, self.latency = clock, latency
        self._in, self._out = bytearray(), list[tuple[float, bytes]]()
        self._lock = threading.RLock()

    def receive(self, data: bytes) -> None:
        """See `Wire`."""
        with self._lock:
            self._take(data)

    def transmit(self) -> bytes:
        """See `Wire`."""
        with self._lock:
            now = self.clock.now()
            due = b"".join(piece for time, piece in self._out if time <= now)
            self._out = [(time, piece) for time, piece in self._out if time > now]
            return due

    def output_is_high(self, number: int) -> bool:
        """See `Controller`."""
        return False

    @abstractmethod
    def _take(self, data: bytes) -> None:
        """Act on bytes from the host."""

    def _take_lines(self, data: bytes, end: bytes, act: Callable[[bytes], None]) -> None:
        """Act on each line that is complete with these bytes; the rest waits for its end."""
        *lines, rest = bytes(self._in + data).split(end)
        self._in = bytearray(rest)
        for line in lines:
            act(line)

    def _send(self, data: bytes) -> None:
        if data:
            self._out.append((self.clock.now() + self.latency, data))

    def _turns(self, line: TriggerLine, angle_at: Callable[[float], float]) -> None:
        """The trigger line learns the sample's true angle, asked under the device's lock."""

        def locked(time: float) -> float:
            with self._lock:
                return angle_at(time)

        line.attach_angle(locked)


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
