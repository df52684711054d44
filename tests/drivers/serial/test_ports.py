"""Serial ports as pyserial lists them: USB adapters with their ids, plain ports without."""

from __future__ import annotations

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from drivers.serial.line import SerialPort, serial_ports


def listed(device: str, **facts: object) -> ListPortInfo:
    port = ListPortInfo(device)
    for name, value in facts.items():
        setattr(port, name, value)
    return port


def test_ports_and_what_they_say(monkeypatch: pytest.MonkeyPatch) -> None:
    adapter = listed("/dev/ttyUSB0", vid=0x0403, pid=0x6001, serial_number="FT1234", description="FT232R USB UART")
    monkeypatch.setattr(list_ports, "comports", lambda: [adapter, listed("/dev/ttyS0")])
    plain, usb = serial_ports()
    assert usb == SerialPort("/dev/ttyUSB0", 0x0403, 0x6001, "FT1234", "FT232R USB UART")
    assert str(usb) == "/dev/ttyUSB0 0403:6001 serial FT1234 (FT232R USB UART)"
    assert plain == SerialPort("/dev/ttyS0", None, None, "", "")
    assert str(plain) == "/dev/ttyS0"


def test_this_computer_can_be_asked() -> None:
    assert all(port.device for port in serial_ports())
