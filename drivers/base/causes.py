"""Causes of failures: why a library does not load, why a port does not open, and which other service answers on a line.

Drivers convert messages of other software (loaders, operating systems, servers) to a sentence and advice only here.
"""

from __future__ import annotations

import errno
import re
import sysconfig
from contextlib import suppress
from pathlib import Path

_LOADERS = (
    (
        r"ELFCLASS(\d+)",
        "the library is built for {0}-bit programs, but this Python is not a {0}-bit program",
        "Use the library for this Python",
    ),
    (
        r"^itself: cannot open|WinError 193|incompatible arch|mach-o",
        "the library was built for another processor; this Python runs on " + sysconfig.get_platform(),
        "Use the library for this processor",
    ),
    (
        r"([^\s:(]+): cannot open shared|Library not loaded: (\S+)",
        "it needs {0}, which was not found",
        "Install the package that contains {0}, or add its folder to LD_LIBRARY_PATH",
    ),
    (
        r"one of its dependencies|WinError 126",
        "a library on which this library depends was not found",
        "Install the vendor's runtime again, with all its parts",
    ),
    (
        r"(?:undefined symbol:|symbol not found[^:]*:|version) (\S+)",
        "the library does not match the other libraries on this computer: {0} is missing",
        "Install the version made for this operating system",
    ),
    ("", "the file exists but is not a library that can be loaded", "Check the file and the permission to read it"),
)  # messages of the loaders of Linux (which calls a library for another processor "not found"), macOS and Windows


def of_library(name: str, problem: OSError) -> tuple[str, str]:
    """The reason why a library cannot be loaded, and what to do. Both texts are empty if the library does not exist."""
    for pattern, what, advice in _LOADERS if Path(name).is_absolute() and Path(name).exists() else ():
        if match := re.search(pattern, str(problem).replace(name, "itself"), re.IGNORECASE):
            return what.format(*filter(None, match.groups())), advice.format(*filter(None, match.groups()))
    return "", ""


def of_port(url: str, problem: BaseException) -> str:
    """Advice for a port that does not open."""
    number, group = getattr(problem, "errno", None) or getattr(problem.__context__, "errno", None), "root"
    # there is no file, the group has no name, or the system is Windows
    with suppress(OSError, ValueError, KeyError, NotImplementedError):
        group = Path(url).group() if Path(url).stat().st_mode & 0o060 == 0o060 else group
    rows = (
        (
            number in (errno.EACCES, errno.EPERM) and group != "root",
            f"The port belongs to the group {group}: `sudo usermod -aG {group} $USER`, then log out and in",
        ),
        (
            number in (errno.EACCES, errno.EPERM),
            "This account has no permission to use the port: ask the administrator for a udev rule that gives the port "
            "to one of your groups (GROUP, MODE)",
        ),
        (
            number in (errno.EBUSY, errno.EAGAIN) or "PermissionError(13" in str(problem),  # on Windows
            f"Another program uses the port (on Linux, `fuser {url}` names the program): close that program",
        ),
        (
            number == errno.ECONNREFUSED,
            "No server answers at this port, or the server accepts no further client: check the port "
            "number, and close other clients",
        ),
        (
            True,
            "Check the cable and the name of the port in the configuration, and close other programs that use the port",
        ),
    )
    return next(advice for holds, advice in rows if holds)


NO_TEXT = re.compile(r"[^\t\n\r -~]")  # a character that does not occur in texts of devices
TELNET = re.compile("\xff[\xf0-\xfe]")  # the beginning of its negotiation
_FOREIGN = (  # searched in the URL, a line end, and the received text
    (
        f"^socket:.*{TELNET.pattern}",  # on a serial line, such bytes are noise
        "the server uses Telnet (it sent FF, which starts the negotiation)",
        "Set this port of the terminal server to raw TCP, without Telnet and RFC 2217",
    ),
    (
        r"\b(login|user ?name|password) ?:",
        "the server asks for a login",
        "Set this port of the terminal server to raw TCP, without a login",
    ),
    (
        r"HTTP/\d|<html|SSH-\d",
        "a web or SSH server answers",
        "Give the number of the port that is connected to the serial line",
    ),
    (
        r"already in use|(port|line) is (in use|busy)|too many (clients|connections|sessions)",
        "another client uses the server's port",
        "Close the other program, or configure the server to accept a second client",
    ),
    (
        rf"\n.*{NO_TEXT.pattern}",
        "it contains bytes that are not text",
        "Check the baud rate, the cable, and that the device is set to a text protocol",
    ),
)


def of_bytes(url: str, heard: str) -> tuple[str, str]:
    """The other service that answers on a line instead of the device, recognised by the received text (one character
    per byte), and advice."""
    return next((row[1:] for row in _FOREIGN if re.search(f"(?is){row[0]}", f"{url}\n{heard}")), ("", ""))
