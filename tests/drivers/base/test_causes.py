"""Causes: messages of loaders, operating systems and servers as a sentence with a remedy."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

import pytest
import serial

from drivers.base.causes import of_bytes, of_library, of_port

NOT_FOUND = "cannot open shared object file: No such file or directory"
LOADERS = {
    "{0}: wrong ELF class: ELFCLASS32": ("the library is built for 32-bit programs", "for this Python"),
    f"{{0}}: {NOT_FOUND}": ("for another processor", "for this processor"),
    f"libusb-1.0.so.0: {NOT_FOUND}": (
        "it needs libusb-1.0.so.0, which was not found",
        "Install the package that contains libusb-1.0.so.0",
    ),
    "{0}: undefined symbol: dcam_new": ("dcam_new is missing", "for this operating system"),
    "/lib/libc.so.6: version `GLIBC_2.38' not found (required by {0})": (
        "`GLIBC_2.38' is missing",
        "for this operating system",
    ),
    "{0}: invalid ELF header": ("not a library that can be loaded", "Check the file"),
    "{0}: file too short": ("not a library that can be loaded", "Check the file"),
    "[WinError 193] %1 is not a valid Win32 application": ("another processor", "for this processor"),
    "Could not find module '{0}' (or one of its dependencies).": (
        "a library on which this library depends",
        "with all its parts",
    ),
    "dlopen({0}, 10): Library not loaded: @rpath/libusb.dylib": ("needs @rpath/libusb.dylib", "@rpath/libusb.dylib"),
    "dlopen({0}, 10): (mach-o file, but is an incompatible architecture)": ("another processor", "for this processor"),
}


@pytest.mark.parametrize("said", LOADERS)
def test_what_a_loader_says_of_a_library_that_is_there(said: str, tmp_path: Path) -> None:
    (library := tmp_path / "libdcamapi.so").touch()
    for words, sentence in zip(LOADERS[said], of_library(str(library), OSError(said.format(library))), strict=True):
        assert words in sentence


def test_of_a_library_that_is_not_there_nothing_more_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lib.so").touch()
    monkeypatch.chdir(tmp_path)  # in which no loader looks for a name without a folder
    assert of_library("lib.so", OSError(f"lib.so: {NOT_FOUND}")) == ("", "")
    assert of_library("/nowhere/lib.so", OSError(f"/nowhere/lib.so: {NOT_FOUND}")) == ("", "")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no groups of files")
def test_the_group_that_owns_a_port_is_named(tmp_path: Path) -> None:
    import grp

    (port := tmp_path / "ttyUSB0").touch(0o660)
    os.chmod(port, 0o660)  # noqa: PTH101 - whatever the mask of the process is
    group, mine = grp.getgrgid(port.stat().st_gid).gr_name, f"add {port}"
    denied = serial.SerialException(errno.EACCES, mine)
    told = of_port(str(port), denied)
    assert f"`sudo usermod -aG {group} $USER`" in told if group != "root" else "udev rule" in told
    if os.geteuid() == 0:
        other = next(entry for entry in grp.getgrall() if entry.gr_name in ("dialout", "uucp", "users"))
        os.chown(port, 0, other.gr_gid)
        assert f"belongs to the group {other.gr_name}: `sudo usermod -aG {other.gr_name} $USER`" in of_port(
            str(port), denied
        )
    port.chmod(0o600)  # a group that has no right to it gives none
    assert "udev rule" in of_port(str(port), denied)


PORTS = {
    "another program": (serial.SerialException(errno.EBUSY, "busy"), "Another program uses the port"),
    "exclusive": (
        serial.SerialException(errno.EAGAIN, "Could not exclusively lock port"),
        "Another program uses the port",
    ),
    "on Windows": (
        serial.SerialException("could not open port 'COM3': PermissionError(13, 'Zugriff verweigert', None, 5)"),
        "Another program uses the port",
    ),
    "not there": (serial.SerialException(errno.ENOENT, "no such file"), "Check the cable and the name of the port"),
    "a URL of another kind": (ValueError("invalid URL"), "Check the cable and the name of the port"),
}


@pytest.mark.parametrize("what", PORTS)
def test_what_to_do_about_a_port_that_does_not_open(what: str) -> None:
    problem, words = PORTS[what]
    assert words in of_port("/dev/ttyUSB7", problem)


def test_a_server_that_refuses_is_told_from_a_cable() -> None:
    with pytest.raises(serial.SerialException) as refused:
        serial.serial_for_url("socket://127.0.0.1:1")
    assert "accepts no further client" in of_port("socket://127.0.0.1:1", refused.value)


def test_bytes_of_telnet_are_noise_on_a_serial_line() -> None:
    assert "Telnet" in of_bytes("socket://here:7777", "\xff\xfb\x01")[0]
    assert "not text" in of_bytes("/dev/ttyUSB0", "\xff\xfb\x01")[0]
    for good in ("", "@01 0 00 OK BUSY WR 0", "1=0.5 \n2=3", "R0S100+0000000\r\n"):
        assert of_bytes("socket://here:7777", good) == of_bytes("/dev/gerät", good) == ("", "")
