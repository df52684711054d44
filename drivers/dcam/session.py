"""Session: finds the camera on USB, starts the library, opens one camera and its wait handle, and closes them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import usb.core
import usb.util

from drivers.base.errors import DeviceError
from drivers.dcam import codes
from drivers.dcam.abi import Dcam, DcamError
from drivers.dcam.codes import DcamEvent, Error


class Session:
    """One open camera in the library. A process can have one session at a time.

    Args:
        library: path of the DCAM-API library; None: the installed one.
        index: number of the camera among those that DCAM finds, from 0.
        device: name of the camera in error messages.

    Raises:
        DeviceError: there is no library or no camera; nothing remains open.
    """

    def __init__(self, library: Path | None, index: int, device: str) -> None:
        self.dcam = Dcam(library, device)
        self._device = device
        self._steps: list[Callable[[], None]] = []  # close what was opened, in reverse order
        try:
            cameras = self._start()
            if index >= cameras:
                raise DeviceError(
                    device,
                    f"there is no camera {index}",
                    expected=f"an index below {cameras}, the number of cameras that DCAM found",
                    advice="Correct the camera's index in the configuration",
                    state="Nothing was changed",
                )
            self.camera = self.dcam.dev_open(index)
            # also ends a capture and frees the ring buffer
            self._steps.append(lambda: self.dcam.dev_close(self.camera))
            self.wait, supported = self.dcam.wait_open(self.camera)
            self._steps.append(lambda: self.dcam.wait_close(self.wait))
            self.events = (DcamEvent.FRAMEREADY | DcamEvent.STOPPED) & supported
        except BaseException:
            with suppress(DcamError):
                self.close()
            raise

    def close(self) -> None:
        """Close everything, also if a step fails. Calling it again does nothing.

        Raises:
            DcamError: the first failure. An unplugged camera is not a failure.
        """
        steps, self._steps = self._steps[::-1], []
        run_all(*steps)

    def _start(self) -> int:
        self._steps.append(self._end)  # a session that failed to start must also be ended
        try:
            return self.dcam.api_init()
        except DcamError as error:
            if error.code in (Error.BUSY, Error.EXCLUDED):
                self._steps.clear()  # ending it would end the session of another camera in this process, too
            if error.code != Error.NOCAMERA:
                raise
            raise DeviceError(
                self._device,
                "DCAM finds no camera",
                request=error.request,
                reply=codes.error_name(error.code),
                expected="a camera that is switched on and has started up",
                advice=f"Switch the camera on and check its cable. {preflight().message}",
                state="Nothing was changed",
            ) from error

    def _end(self) -> None:
        try:
            self.dcam.api_uninit()
        except DcamError:
            # Try once more, because a session that stays open would block every later one in this process.
            self.dcam.api_uninit()
            raise


def run_all(*steps: Callable[[], None]) -> None:
    """Run every step, also after a failed step.

    Raises:
        DcamError: the first failure. An unplugged camera is not a failure, because there is nothing to undo.
    """
    first: DcamError | None = None
    for step in steps:
        try:
            step()
        except DcamError as error:
            first = first or (None if error.code == Error.NOCONNECTION else error)
    if first is not None:
        raise first


HAMAMATSU = 0x0661
_LINKS = {1: "1.5 Mbit/s", 2: "12 Mbit/s", 3: "480 Mbit/s", 4: "5 Gbit/s", 5: "10 Gbit/s", 6: "20 Gbit/s"}


class Verdict(StrEnum):
    READY = "ready"
    SLOW = "slow"  # the camera works, but at a fraction of its frame rate
    ABSENT = "absent"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"  # this computer cannot check USB


@dataclass(frozen=True)
class UsbDevice:
    """Descriptors of one USB device.

    Texts that cannot be read for lack of permission are empty; `speed` is libusb's number.
    """

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
    """The result, one sentence for the operator, and the devices found."""

    verdict: Verdict
    message: str
    devices: tuple[UsbDevice, ...] = ()


def preflight(
    vendor: int = HAMAMATSU, product: int | None = None, serial: str | None = None, backend: Any = None
) -> Preflight:
    """Look for one camera on USB. Every outcome is a result, never an exception.

    Args:
        vendor, product: USB ids; without the product id, other devices of the vendor also match.
        serial: serial number; needed if there are several cameras of one kind.
        backend: a pyusb backend; None: the installed libusb.
    """
    fields = {"idVendor": vendor} if product is None else {"idVendor": vendor, "idProduct": product}
    wanted = f"{vendor:04x}:{'*' if product is None else f'{product:04x}'}"
    try:
        connected = [_describe(device) for device in usb.core.find(find_all=True, backend=backend, **fields)]
    except usb.core.NoBackendError:
        return Preflight(Verdict.UNKNOWN, "USB cannot be checked, because libusb is not installed on this computer.")
    except usb.core.USBError as error:
        return Preflight(Verdict.UNKNOWN, f"USB cannot be checked: {error}.")
    # a device whose serial number cannot be read may be the requested one
    devices = tuple(device for device in connected if not (serial and device.serial and device.serial != serial))
    if not devices:
        which = f"{wanted} with serial number {serial}" if serial else wanted
        message = f"No USB device {which} is connected (CoaXPress cameras are not USB devices)."
        return Preflight(Verdict.ABSENT, message)
    if len(devices) > 1:
        message = (
            f"Several USB devices match {wanted}: {'; '.join(map(str, devices))}. Give product id and serial number."
        )
        return Preflight(Verdict.AMBIGUOUS, message, devices)
    (device,) = devices
    if not device.speed:
        return Preflight(Verdict.UNKNOWN, f"USB device {device} is connected; its link speed is unknown.", devices)
    if device.speed < usb.util.SPEED_SUPER:
        message = f"Use another cable or a USB 3 port: USB device {device} needs a SuperSpeed link (5 Gbit/s)."
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
