"""Causes: what a library that does not load, a port that does not open, and foreign bytes on a line come from.

The one place where drivers turn what others say (loaders, operating systems, servers) into a sentence and the way on.
"""

from __future__ import annotations

import errno
import os
import platform
import re
import struct
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple


class Cause(NamedTuple):
    """What is the matter, and what to do. Both are empty where nothing is known."""

    what: str = ""
    advice: str = ""


THIS_PYTHON = f"this Python is for {8 * struct.calcsize('P')} bits on {platform.machine() or 'an unknown processor'}"
_OTHER_KIND = Cause(f"it is for another kind of computer; {THIS_PYTHON}", "Install the library for this computer")
_LOADERS: tuple[tuple[str, Cause], ...] = (
    (r"ELFCLASS(\d+)", Cause(f"it is for {{0}} bits; {THIS_PYTHON}", _OTHER_KIND.advice)),
    (r"WinError 193|incompatible architecture|not a mach-o", _OTHER_KIND),
    (
        r"([^\s:(]+): cannot open shared|Library not loaded: (\S+)",
        Cause("it needs {0}, which is not found", "Install what has {0}, or add its folder to LD_LIBRARY_PATH"),
    ),
    (
        r"one of its dependencies|WinError 126",
        Cause("a library that it needs is not found", "Install the vendor's runtime again, with all its parts"),
    ),
    (
        r"(?:undefined symbol:|symbol not found[^:]*:|version) (\S+)",
        Cause("it does not fit the other libraries here: {0} is missing", "Install the version for this system"),
    ),
)
"""What the loaders of Linux, macOS and Windows say of a library that is there."""


def of_library(name: str, problem: OSError) -> Cause:
    """Why a library that is there is not loaded; empty if it is not there."""
    if not Path(name).exists():
        return Cause()
    for said, cause in _LOADERS:
        if match := re.search(said, str(problem), re.IGNORECASE):
            named = next(filter(None, match.groups()), "")
            if Path(named).name == Path(name).name:  # so Linux says of a library for another processor
                return _OTHER_KIND
            return Cause(*(text.format(named) for text in cause))
    return Cause("it is there, but no library that can be loaded", "Check the file and the right to read it")


def of_port(url: str, problem: BaseException) -> str:
    """What to do about a port that does not open."""
    number = getattr(problem, "errno", None) or getattr(problem.__context__, "errno", None)
    if number in (errno.EACCES, errno.EPERM) and os.name == "posix":
        return _right_to(Path(url))
    if number in (errno.EBUSY, errno.EAGAIN) or "PermissionError(13" in str(problem):
        return f"Another program holds it, which `fuser {url}` names on Linux: close that"
    if number == errno.ECONNREFUSED:
        return "Nothing listens there, or the server takes no further client: check the port's number, close others"
    return "Check the cable, the port's name in the configuration and that no other program holds it"


def _right_to(port: Path) -> str:
    """How an account gets the right to a port that it may not open (POSIX)."""
    group, allowed = "", 0
    with suppress(OSError, KeyError):  # a group without a name
        allowed, group = port.stat().st_mode & 0o060, port.group()
    if allowed == 0o060 and group not in ("", "root"):
        return f"It belongs to the group {group}: `sudo usermod -aG {group} $USER`, then log out and in"
    return "This account has no right to it: ask for a udev rule that gives it to a group of yours (MODE, GROUP)"


NO_TEXT = re.compile(r"[^\t\n\r -~]")
"""A character that no text of a device has."""
TELNET = Cause(
    "the server speaks Telnet (FF and FA to FE begin its negotiation)",
    "Set this port of the terminal server to raw TCP: no Telnet, no RFC 2217",
)
_FOREIGN: tuple[tuple[str, Cause], ...] = (
    (r"\xff[\xf0-\xfe]", TELNET),
    (
        r"(?i)\b(login|username|user name|password) ?:",
        Cause("a login is asked for", "Set this port of the terminal server to raw TCP, without a login"),
    ),
    (
        r"(?i)HTTP/\d|<html|SSH-\d",
        Cause("a web or SSH server answers", "Give the number of the port that leads to the serial line"),
    ),
    (
        r"(?i)(already|port|line)( is)? in use|\bport \S*(is )?busy|too many (clients|connections|sessions)",
        Cause("another client holds the server's port", "Close the other program, or allow a second client"),
    ),
    (
        NO_TEXT.pattern,
        Cause("it has bytes that are no text", "Check baud rate and cable, and that the device speaks text"),
    ),
)


def of_bytes(url: str, heard: str) -> Cause:
    """Who speaks on a line that a device should speak on, by what was heard there (bytes as Latin-1)."""
    rows = _FOREIGN if url.lower().startswith("socket:") else _FOREIGN[1:]  # on a serial line it is noise
    return next((cause for said, cause in rows if re.search(said, heard)), Cause())
