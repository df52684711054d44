"""Serial port: what pyserial opens by URL, set up for short requests and replies."""

from __future__ import annotations

import contextlib
import socket
from typing import Any

import serial


def open_port(url: str, baudrate: int, quiet: float, write_timeout: float) -> Any:
    """The open port, 8N1 and nobody else's; a read ends after `quiet` s, a write after `write_timeout` s.

    Raises:
        OSError, ValueError: it does not open.
    """
    port = serial.serial_for_url(url, baudrate=baudrate, timeout=quiet, write_timeout=write_timeout, exclusive=True)
    if url.lower().startswith("socket://"):
        # Each request at once: gathering small packets (Nagle) costs 40 to 200 ms for every command and its read-back.
        with contextlib.suppress(OSError), socket.fromfd(port.fileno(), socket.AF_INET, socket.SOCK_STREAM) as twin:
            twin.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            port.reset_input_buffer()  # other ports do it as they open
    return port
