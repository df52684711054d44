"""Doctor on the devices: the camera's USB link and library, and configured ports. No camera opens unless asked to, and
no byte is sent."""

from __future__ import annotations

import os
import re
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import psutil

from beamline.config.devices import DcamOrca
from beamline.features.doctor.check import Diagnosis, Grade, of_error
from drivers.base.errors import DeviceError
from drivers.dcam import session as usb
from drivers.serial.line import SerialPort

if TYPE_CHECKING:
    from drivers.dcam.abi import Dcam


CONNECT_TIMEOUT = 2.0  # s for a TCP connection


def ports(connected: Sequence[SerialPort]) -> Diagnosis:
    """All serial ports of this computer."""
    listed = "; ".join(map(str, connected)) or "none"
    return Diagnosis(
        "serial ports",
        Grade.OK if connected else Grade.WARNING,
        f"{listed}.",
        "the adapter of a stage on a serial line (a stage on the network shows none)",
        "" if connected else "Plug the adapter in; on Linux `dmesg` shows whether the system recognised it",
        {"ports": [vars(port) for port in connected]},
    )


def port(name: str, url: str, connected: Sequence[SerialPort]) -> Diagnosis:
    """One device's port.

    Args:
        name: of the check.
        url: as configured.
        connected: the serial ports of this computer.
    """
    if url.lower().startswith("sim://"):
        return Diagnosis(name, Grade.NOT_APPLICABLE, f"{url} is simulated.")
    if url.lower().startswith("socket://"):
        return _network(name, url)
    if "://" in url:
        return Diagnosis(name, Grade.CANNOT_CHECK, f"{url} can only be tried by opening it.")
    listed = "; ".join(map(str, connected)) or "no serial ports"
    known = next((one for one in connected if _same(one.device, url)), None)
    diagnosis = partial(Diagnosis, name, values={"port": url, "ports": [vars(one) for one in connected]})
    expected = f"the port {url} of the configuration"
    if known is None and (sys.platform == "win32" or not Path(url).exists()):
        advice = (
            "Plug the adapter in, switch the controller on, and set the port to one of those found. A name under "
            "/dev/serial/by-id stays the same when adapters are plugged in another order"
        )
        return diagnosis(Grade.FAILED, f"There is no port {url}; there are {listed}.", expected, advice)
    if sys.platform != "win32" and not os.access(url, os.R_OK | os.W_OK):
        expected = f"permission to read and write {url}"
        advice = (
            "Add the user to the port's group (Debian and Ubuntu: sudo usermod -a -G dialout $USER) and log in again"
        )
        return diagnosis(Grade.FAILED, f"{known or url} may not be opened by this user.", expected, advice)
    return diagnosis(Grade.OK, f"{known or url}.", expected)


def _same(device: str, url: str) -> bool:
    if sys.platform == "win32":
        return device.upper() == url.upper().removeprefix("\\\\.\\")
    return device == url or Path(device).resolve() == Path(url).resolve()


def _network(name: str, url: str) -> Diagnosis:
    """A TCP connection, opened and closed without sending anything."""
    expected = f"a controller that accepts connections at {url}"
    try:
        parts = urlsplit(url)
        host, number = parts.hostname or "", parts.port
    except ValueError:
        host, number = "", None
    if not host or not number:
        observed, advice = f"{url} is not an address.", "Correct the configuration"
        return Diagnosis(name, Grade.FAILED, observed, "socket://host:port", advice)
    try:
        socket.create_connection((host, number), CONNECT_TIMEOUT).close()
    except OSError as error:
        advice = (
            "Check the controller's power, its address and port on its panel, and the network. Close other programs: "
            "many controllers accept only one connection"
        )
        return Diagnosis(name, Grade.FAILED, f"{host}:{number} accepts no connection ({error}).", expected, advice)
    return Diagnosis(name, Grade.OK, f"{host}:{number} accepts connections.", expected)


LINK, LIBRARY = "camera link", "camera library"
_SUPERSPEED = "one Hamamatsu camera on a SuperSpeed link (5 Gbit/s or more)"
_LINK_ADVICE = {
    usb.Verdict.SLOW: "Use the vendor's USB 3 cable, shorter than 3 m, in a port marked SS or blue, without a hub or "
    "extension. Then switch the camera off and on. A camera at 480 Mbit/s gives about 2 full frames a second",
    usb.Verdict.ABSENT: "Switch the camera on, wait for its lamp, check the cable at both ends. On Linux see whether "
    "`lsusb -d 0661:` lists it, on Windows the Device Manager",
    usb.Verdict.AMBIGUOUS: "Set devices.camera.usb_product or usb_serial to the ids listed here",
}
_NO_LIBUSB = (
    "Put libusb-1.0.dll (libusb.info) in a folder of the PATH"
    if sys.platform == "win32"
    else "Install libusb 1.0 (Debian and Ubuntu: apt install libusb-1.0-0)"
)
_VERDICTS = {
    usb.Verdict.READY: Grade.OK,
    usb.Verdict.SLOW: Grade.FAILED,  # the plan assumes the fast link: frames would be lost
    usb.Verdict.ABSENT: Grade.FAILED,
    usb.Verdict.AMBIGUOUS: Grade.WARNING,
    usb.Verdict.UNKNOWN: Grade.CANNOT_CHECK,
}


def link(camera: DcamOrca | None, backend: Any = None) -> Diagnosis:
    """The camera on USB, from its descriptors.

    Args:
        camera: as configured; None: not configured, and a missing camera is no failure.
        backend: of pyusb; None: the installed libusb.
    """
    if camera is not None and camera.link == "coaxpress":
        return Diagnosis(
            LINK, Grade.NOT_APPLICABLE, "A CoaXPress camera is on its frame grabber, not on USB.", _SUPERSPEED
        )
    product, serial = (None, None) if camera is None else (camera.usb_product, camera.usb_serial)
    preflight = usb.preflight(product=product, serial=serial, backend=backend)
    verdict = _VERDICTS[preflight.verdict]
    if verdict is Grade.FAILED and camera is None:
        verdict = Grade.WARNING
    otherwise = "" if verdict is Grade.OK else f"{_NO_LIBUSB}; the camera itself does not need it"
    values = {"devices": [vars(device) for device in preflight.devices]}
    return Diagnosis(
        LINK, verdict, preflight.message, _SUPERSPEED, _LINK_ADVICE.get(preflight.verdict, otherwise), values
    )


def library(camera: DcamOrca | None, session: bool = False) -> Diagnosis:
    """The DCAM-API library and its version; with `session`, also the cameras that it finds.

    Args:
        session: open the camera, which takes seconds and fails while another program uses it.
    """
    from drivers.dcam.abi import Dcam

    path = Path(camera.library) if camera is not None and camera.library else None
    expected = "the DCAM-API runtime of the camera's vendor, version 4"
    try:
        loaded = Dcam(path, "camera")
    except DeviceError as error:
        return of_error(LIBRARY, error, expected, Grade.WARNING if camera is None else Grade.FAILED)
    file = _loaded_file(path)
    version = version_of(file)
    values: dict[str, Any] = {"library": None if file is None else str(file), "version": version}
    observed = f"{file or path or 'the installed library'}, version {version or 'not known'}."
    if not session:
        return Diagnosis(LIBRARY, Grade.OK, observed, expected, values=values)
    index = 0 if camera is None else camera.index
    try:
        cameras = _cameras(loaded)
    except DeviceError as error:
        failure = of_error(LIBRARY, error, f"{expected}, and a camera")
        return replace(failure, observed=f"{observed} {failure.observed}", values=values)
    values["cameras"] = cameras
    listed = "; ".join(", ".join(f"{name} {text}" for name, text in one.items()) for one in cameras)
    if index >= len(cameras):
        observed, expected = f"{observed} {len(cameras)} cameras: {listed}.", f"a camera of index {index}"
        advice = "Set devices.camera.index to one of these cameras"
        return Diagnosis(LIBRARY, Grade.FAILED, observed, expected, advice, values)
    return Diagnosis(LIBRARY, Grade.OK, f"{observed} {listed}.", expected, values=values)


def version_of(file: Path | None) -> str:
    """The version in the name of a library's file (after .so on Linux); "" if there is none."""
    match = None if file is None else re.search(r"\.so\.(\d[\d.]*)$", file.resolve().name)
    return match[1] if match else ""


def _cameras(dcam: Dcam) -> list[dict[str, str]]:
    """The description that each camera reports; the session of the library is ended afterwards."""
    from drivers.dcam.codes import Text

    try:
        return [
            {
                which.name.lower(): dcam.dev_getstring(index, which)
                for which in (Text.MODEL, Text.CAMERAID, Text.BUS, Text.CAMERAVERSION, Text.DCAMAPIVERSION)
            }
            for index in range(dcam.api_init())
        ]
    finally:
        with suppress(DeviceError):  # a session that did not start must be ended, too; its error is already reported
            dcam.api_uninit()


def _loaded_file(path: Path | None) -> Path | None:
    """The file of the library that this process has loaded; None if the system does not report it."""
    if path is not None:
        return path.resolve()
    if sys.platform == "darwin":
        return None
    with suppress(OSError, psutil.Error):
        loaded = (Path(file.path) for file in psutil.Process().memory_maps())
        return next((file for file in loaded if file.name.lower().startswith(("libdcamapi.", "dcamapi.dll"))), None)
    return None
