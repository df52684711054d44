"""A USB bus for tests: a pyusb backend with invented devices, so that real pyusb does the work."""

from __future__ import annotations

import array
import errno
from dataclasses import dataclass
from typing import Any

import usb.backend
import usb.core

ENGLISH = bytes((4, 3, 9, 4))


@dataclass
class Descriptor:
    """A device descriptor as libusb gives it; the camera by default."""

    idVendor: int = 0x0661  # noqa: N815 - pyusb's names
    idProduct: int = 0x1234  # noqa: N815
    speed: int | None = 4
    texts: tuple[str, str] | None = ("C15550-20UP", "000123")  # None: permission denied
    address: int = 7
    bLength: int = 18  # noqa: N815
    bDescriptorType: int = 1  # noqa: N815
    bcdUSB: int = 0x0310  # noqa: N815
    bDeviceClass: int = 0  # noqa: N815
    bDeviceSubClass: int = 0  # noqa: N815
    bDeviceProtocol: int = 0  # noqa: N815
    bMaxPacketSize0: int = 9  # noqa: N815
    bcdDevice: int = 1  # noqa: N815
    iManufacturer: int = 0  # noqa: N815
    iProduct: int = 1  # noqa: N815
    iSerialNumber: int = 2  # noqa: N815
    bNumConfigurations: int = 1  # noqa: N815
    bus: int = 2
    port_number: int = 1
    port_numbers: tuple[int, ...] = (1,)


class Bus(usb.backend.IBackend):  # type: ignore[misc]
    """Devices on a bus that answer string requests; `open` counts handles not yet closed."""

    def __init__(self, *devices: Descriptor) -> None:
        self.devices, self.open = devices, 0

    def enumerate_devices(self) -> Any:
        return iter(self.devices)

    def get_device_descriptor(self, dev: Descriptor) -> Descriptor:
        return dev

    def get_parent(self, dev: Descriptor) -> None:
        return None

    def open_device(self, dev: Descriptor) -> Descriptor:
        if dev.texts is None:
            raise usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
        self.open += 1
        return dev

    def close_device(self, dev_handle: Descriptor) -> None:
        self.open -= 1

    def ctrl_transfer(
        self, dev_handle: Any, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data: Any, timeout: int
    ) -> int:
        index = wValue & 0xFF
        text = ENGLISH
        if index:
            body = dev_handle.texts[index - 1].encode("utf-16-le")
            text = bytes((len(body) + 2, 3)) + body
        data[: len(text)] = array.array("B", text)
        return len(text)
