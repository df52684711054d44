"""Wire: the other end of a serial cable, bytes in and bytes out; and `sim://name`, which opens it.

pyserial opens such a URL by the same code path as a real port. After this module is imported, pyserial finds the scheme
in `simulators.wires.protocol_sim`. Names are valid in the whole process, like the ports of a computer.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Protocol, Self

import serial
from serial.serialutil import PortNotOpenError, SerialBase, SerialException, to_bytes

from drivers.base.clock import Clock
from simulators.devices.trigger_line import TriggerLine


class Wire(Protocol):
    """A simulated device; it can be used from several threads."""

    @property
    def clock(self) -> Clock: ...

    def receive(self, data: bytes) -> None:
        """Bytes from the host, in pieces of any size."""

    def transmit(self) -> bytes:
        """Bytes that were sent so far and not read yet."""


class Controller(Wire, Protocol):
    """A simulated controller of a stage."""

    def output_is_high(self, number: int) -> bool:
        """The level of a digital output; False if no output has that number."""


class BytesWire:
    """A simulated device with bytes in transit from and to the host; it processes one call at a time."""

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
        """Process each line that is complete with these bytes; an incomplete rest is kept."""
        *lines, rest = bytes(self._in + data).split(end)
        self._in = bytearray(rest)
        for line in lines:
            act(line)

    def _send(self, data: bytes) -> None:
        if data:
            self._out.append((self.clock.now() + self.latency, data))

    def _turns(self, line: TriggerLine, angle_at: Callable[[float], float]) -> None:
        """Give the trigger line a function for the sample's true angle; the function uses the device's lock."""

        def locked(time: float) -> float:
            with self._lock:
                return angle_at(time)

        line.attach_angle(locked)


class Build(Protocol):
    """Build of a simulated controller, and its faults: a frozen dataclass in the folder of each controller."""

    @classmethod
    def matching(cls, settings: Any) -> Self:
        """The controller that fits a driver with these settings.

        Raises:
            ValueError: the simulated controller cannot have a setting; the message names it and the reason.
        """

    def controller(self, clock: Clock, line: TriggerLine) -> Controller:
        """The controller with its trigger output wired to `line`, which also learns the sample's true angle."""


SCHEME = "sim://"
POLL = 1e-3  # s on the device's clock between two checks for a missing reply

if "simulators.wires" not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append("simulators.wires")


# pyserial gives its handler only the URL, so the registered devices and the open ports are kept here by name.
_WIRES: dict[str, Wire] = {}
_OPEN: dict[str, Wire] = {}
_LOCK = threading.Lock()


def register(name: str, wire: Wire) -> str:
    """Register a simulated device; returns the URL that opens it. The device replaces one with the same name."""
    with _LOCK:
        _WIRES[name] = wire
        _OPEN.pop(name, None)
    return SCHEME + name


def plugged(url: str) -> Wire | None:
    """The simulated device of a URL, for drivers that exchange no bytes; None if no device is registered for it."""
    with _LOCK:
        return _WIRES.get(url[len(SCHEME) :])


class SimulatedSerial(SerialBase):  # type: ignore[misc]  # pyserial carries no types
    """pyserial's side of a simulated port. Bytes arrive at once, whatever the baud rate; timeouts run on the device's
    clock, so that a virtual second costs nothing."""

    is_open: bool

    def open(self) -> None:
        if self.is_open:
            raise SerialException("port is already open")
        self._name = self.port[len(SCHEME) :]
        with _LOCK:
            if self._name in _OPEN:
                raise SerialException(f"could not open port {SCHEME}{self._name}: it is open already")
            if self._name not in _WIRES:
                known = ", ".join(SCHEME + known for known in sorted(_WIRES)) or "none"
                raise SerialException(
                    f"could not open port {SCHEME}{self._name}: there is no such simulated port, only {known}"
                )
            self._wire = _OPEN[self._name] = _WIRES[self._name]
        self._wire.transmit()  # opening a port drops earlier bytes, as an operating system does
        self._received = bytearray()
        self.is_open = True

    def close(self) -> None:
        if self.is_open:
            self.is_open = False
            with _LOCK:
                if _OPEN.get(self._name) is self._wire:
                    del _OPEN[self._name]

    @property
    def in_waiting(self) -> int:
        self._take()
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        self._take()
        deadline = None if self.timeout is None else self._wire.clock.now() + self.timeout
        while len(self._received) < size and (deadline is None or self._wire.clock.now() < deadline):
            self._wire.clock.sleep(POLL)
            self._take()
        taken = bytes(self._received[:size])
        del self._received[:size]
        return taken

    def write(self, data: bytes) -> int:
        if not self.is_open:
            raise PortNotOpenError()
        sent = to_bytes(data)
        self._wire.receive(sent)
        return len(sent)

    def reset_input_buffer(self) -> None:
        self._take()
        self._received.clear()

    def _take(self) -> None:
        if not self.is_open:
            raise PortNotOpenError()
        self._received += self._wire.transmit()

    def _reconfigure_port(self) -> None:
        """pyserial calls it when a setting changes; settings do not affect this port."""

    def _update_dtr_state(self) -> None:
        """No modem lines."""

    def _update_rts_state(self) -> None:
        """No modem lines."""
