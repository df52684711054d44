"""USB check before a camera is opened: is it connected, and on a SuperSpeed link? Only descriptors are read."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import usb.core
import usb.util

HAMAMATSU = 0x0661
_LINKS = {1: "1.5 Mbit/s", 2: "12 Mbit/s", 3: "480 Mbit/s", 4: "5 Gbit/s", 5: "10 Gbit/s", 6: "20 Gbit/s"}


class Verdict(StrEnum):
    READY = "ready"
    SLOW = "slow"  # the camera works, at a fraction of its frame rate
    ABSENT = "absent"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"  # this machine cannot check


@dataclass(frozen=True)
class UsbDevice:
    """Descriptors of one USB device. Texts without read permission are empty; `speed` is libusb's number."""

    vendor: int
    product: int
    bus: int | None
    address: int | None
    speed: int | None
    name: str
    serial: str

    def __str__(self) -> str:
        link = _LINKS.get(self.speed or 0, "unknown speed")
        identity = " ".join(text for text in (self.name, self.serial) if text) or "no readable name"
        return f"{self.vendor:04x}:{self.product:04x} ({identity}) on bus {self.bus}, address {self.address}, {link}"


@dataclass(frozen=True)
class Preflight:
    """The verdict, one sentence for the operator, and the devices found."""

    verdict: Verdict
    message: str
    devices: tuple[UsbDevice, ...] = ()


def preflight(
    vendor: int = HAMAMATSU, product: int | None = None, serial: str | None = None, backend: Any = None
) -> Preflight:
    """Look for one camera on USB; every outcome is a verdict, never an exception.

    Args:
        vendor, product: USB ids; without the product id other devices of the vendor match too.
        serial: serial number, needed with several cameras of one kind.
        backend: a pyusb backend; None takes the installed libusb.
    """
    fields = {"idVendor": vendor} if product is None else {"idVendor": vendor, "idProduct": product}
    wanted = f"{vendor:04x}:{'*' if product is None else f'{product:04x}'}"
    try:
        connected = [_describe(device) for device in usb.core.find(find_all=True, backend=backend, **fields)]
    except usb.core.NoBackendError:
        return Preflight(Verdict.UNKNOWN, "USB cannot be checked: libusb is not installed on this machine.")
    except usb.core.USBError as error:
        return Preflight(Verdict.UNKNOWN, f"USB cannot be checked: {error}.")
    # A device whose serial number cannot be read may be the requested one.
    devices = tuple(device for device in connected if not (serial and device.serial and device.serial != serial))
    if not devices:
        which = f"{wanted} with serial number {serial}" if serial else wanted
        message = f"No USB device {which} is connected (a CoaXPress camera does not show on USB)."
        return Preflight(Verdict.ABSENT, message)
    if len(devices) > 1:
        message = (
            f"Several USB devices match {wanted}: {'; '.join(map(str, devices))}. Give product id and serial number."
        )
        return Preflight(Verdict.AMBIGUOUS, message, devices)
    (device,) = devices
    if not device.speed:
        return Preflight(Verdict.UNKNOWN, f"USB device {device} is connected; its link speed cannot be read.", devices)
    if device.speed < usb.util.SPEED_SUPER:
        message = f"USB device {device} needs a SuperSpeed link (5 Gbit/s): use another cable or a USB 3 port."
        return Preflight(Verdict.SLOW, message, devices)
    return Preflight(Verdict.READY, f"USB device {device} is connected.", devices)


def _describe(device: Any) -> UsbDevice:
    texts = []
    for index in (device.iProduct, device.iSerialNumber):
        try:
            texts.append(usb.util.get_string(device, index) or "")
        except (usb.core.USBError, ValueError, NotImplementedError):  # no name without permission or language
            texts.append("")
    usb.util.dispose_resources(device)  # so that the vendor's driver can open it
    name, serial = (text.strip("\0 ") for text in texts)
    return UsbDevice(device.idVendor, device.idProduct, device.bus, device.address, device.speed, name, serial)
