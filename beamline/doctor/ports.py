"""Doctor on the ports: does the configured port of a device exist, and may it be opened? No byte is sent."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

from beamline.doctor.check import Diagnosis, Grade
from drivers.serial.ports import SerialPort

CONNECT_TIMEOUT = 2.0  # s for a TCP connection


def ports(found: Sequence[SerialPort]) -> Diagnosis:
    """All serial ports of this computer."""
    listed = "; ".join(map(str, found)) or "none"
    return Diagnosis(
        "serial ports",
        Grade.OK if found else Grade.WARNING,
        f"{listed}.",
        "the adapter of a stage on a serial line (a stage on the network shows none)",
        "" if found else "Plug the adapter in; on Linux `dmesg` shows whether the system recognised it",
        {"ports": [vars(port) for port in found]},
    )


def port(name: str, url: str, found: Sequence[SerialPort]) -> Diagnosis:
    """One device's port.

    Args:
        name: of the check.
        url: as configured.
        found: the serial ports of this computer.
    """
    if url.lower().startswith("sim://"):
        return Diagnosis(name, Grade.NOT_APPLICABLE, f"{url} is simulated.")
    if url.lower().startswith("socket://"):
        return _network(name, url)
    if "://" in url:
        return Diagnosis(name, Grade.CANNOT_CHECK, f"{url} can only be tried by opening it.")
    listed = "; ".join(map(str, found)) or "no serial ports"
    known = next((one for one in found if _same(one.device, url)), None)
    said = partial(Diagnosis, name, values={"port": url, "ports": [vars(one) for one in found]})
    expected = f"the port {url} of the configuration"
    if known is None and (sys.platform == "win32" or not Path(url).exists()):
        advice = (
            "Plug the adapter in, switch the controller on, and set the port to one of those found. A name under "
            "/dev/serial/by-id stays the same when adapters are plugged in another order"
        )
        return said(Grade.FAILED, f"There is no port {url}; there are {listed}.", expected, advice)
    if sys.platform != "win32" and not os.access(url, os.R_OK | os.W_OK):
        expected = f"permission to read and write {url}"
        advice = (
            "Add the user to the port's group (Debian and Ubuntu: sudo usermod -a -G dialout $USER) and log in again"
        )
        return said(Grade.FAILED, f"{known or url} may not be opened by this user.", expected, advice)
    return said(Grade.OK, f"{known or url}.", expected)


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
        found, advice = f"{url} is not an address.", "Correct the configuration"
        return Diagnosis(name, Grade.FAILED, found, "socket://host:port", advice)
    try:
        socket.create_connection((host, number), CONNECT_TIMEOUT).close()
    except OSError as error:
        advice = (
            "Check the controller's power, its address and port on its panel, and the network. Close other programs: "
            "many controllers accept only one connection"
        )
        return Diagnosis(name, Grade.FAILED, f"{host}:{number} accepts no connection ({error}).", expected, advice)
    return Diagnosis(name, Grade.OK, f"{host}:{number} accepts connections.", expected)
