"""Serial ports: the list of this computer's, and a port opened for short requests and replies."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import dataclass
from typing import Any

import serial
from serial.tools import list_ports


@dataclass(frozen=True)
class SerialPort:
    """A serial port by its device name, with the ids and texts of its USB adapter; None and "" without one."""

    device: str
    vendor: int | None
    product: int | None
    serial: str
    description: str

    def __str__(self) -> str:
        usb = "" if self.vendor is None else f" {self.vendor:04x}:{self.product or 0:04x}"
        number = f" serial {self.serial}" if self.serial else ""
        return f"{self.device}{usb}{number}" + (f" ({self.description})" if self.description else "")


def serial_ports() -> tuple[SerialPort, ...]:
    """The ports that pyserial lists, by device name; none is opened."""
    return tuple(sorted((_described(port) for port in list_ports.comports()), key=lambda port: port.device))


def _described(port: Any) -> SerialPort:
    description = "" if port.description in (None, "n/a") else port.description
    return SerialPort(port.device, port.vid, port.pid, port.serial_number or "", description)


def open_port(url: str, baudrate: int, quiet: float, write_timeout: float) -> Any:
    """Open a port by its pyserial URL: 8 data bits, no parity, 1 stop bit, exclusive access.

    Args:
        quiet: s without a byte after which a read ends.
        write_timeout: s after which a write fails.

    Raises:
        OSError, ValueError: it does not open.
    """
    port = serial.serial_for_url(url, baudrate=baudrate, timeout=quiet, write_timeout=write_timeout, exclusive=True)
    if url.lower().startswith("socket://"):
        # Send each request at once: Nagle's algorithm, which gathers small packets, costs 40 to 200 ms for every
        # command and its read-back.
        with contextlib.suppress(OSError), socket.fromfd(port.fileno(), socket.AF_INET, socket.SOCK_STREAM) as copy:
            copy.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            port.reset_input_buffer()  # other kinds of port do this at opening
    return port
