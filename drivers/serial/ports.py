"""Serial ports of this computer, with what their USB adapters tell of themselves; none is opened."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from serial.tools import list_ports


@dataclass(frozen=True)
class SerialPort:
    """A port as configurations name it; USB ids are None and texts empty where it has none."""

    device: str
    vendor: int | None
    product: int | None
    serial: str
    description: str

    def __str__(self) -> str:
        usb = "" if self.vendor is None else f" {self.vendor:04x}:{self.product or 0:04x}"
        serial = f" serial {self.serial}" if self.serial else ""
        return f"{self.device}{usb}{serial}" + (f" ({self.description})" if self.description else "")


def serial_ports() -> tuple[SerialPort, ...]:
    """What pyserial lists, in the order of names."""
    return tuple(sorted((_described(port) for port in list_ports.comports()), key=lambda port: port.device))


def _described(port: Any) -> SerialPort:
    description = "" if port.description in (None, "n/a") else port.description
    return SerialPort(port.device, port.vid, port.pid, port.serial_number or "", description)
