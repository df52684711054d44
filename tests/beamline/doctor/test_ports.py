"""The doctor on ports: serial ones by their names, network ones by a connection on this computer."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

import pytest

from beamline.doctor.check import Grade
from beamline.doctor.ports import port, ports
from drivers.serial.ports import SerialPort

ADAPTER = SerialPort("/dev/ttyUSB7", 0x0403, 0x6001, "FT1234", "FT232R")


def test_what_there_is_is_told() -> None:
    check = ports((ADAPTER,))
    assert check.verdict is Grade.OK
    assert "/dev/ttyUSB7 0403:6001 serial FT1234 (FT232R)" in check.found
    assert check.values["ports"] == [vars(ADAPTER)]
    assert ports(()).verdict is Grade.WARNING


def test_a_port_that_is_not_there_names_those_that_are() -> None:
    check = port("stage port", "/dev/ttyUSB_none", (ADAPTER,))
    assert check.verdict is Grade.FAILED
    assert "There is no port /dev/ttyUSB_none; there are /dev/ttyUSB7" in check.found
    assert "there are no serial ports" in port("stage port", "COM99_none", ()).found


@pytest.mark.skipif(sys.platform == "win32", reason="device files")
def test_a_port_by_its_name_or_a_link_to_it(tmp_path: Path) -> None:
    """A file stands for the device: nothing is written to it."""
    device = tmp_path / "ttyUSB7"
    device.write_bytes(b"")
    link = tmp_path / "by-id"
    link.symlink_to(device)
    listed = SerialPort(str(device), 0x0403, 0x6001, "FT1234", "")
    for url in (device, link):
        check = port("stage port", str(url), (listed,))
        assert check.verdict is Grade.OK
        assert "0403:6001" in check.found
    assert port("stage port", str(device), ()).verdict is Grade.OK  # not listed, as a pty, but there
    assert device.read_bytes() == b""


@pytest.mark.skipif(sys.platform == "win32", reason="permissions of device files")
def test_a_port_that_may_not_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "ttyUSB7"
    device.write_bytes(b"")
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) != str(device))  # root may open everything
    check = port("stage port", str(device), ())
    assert check.verdict is Grade.FAILED
    assert "dialout" in check.advice


def test_a_network_port_is_connected_to_and_hears_nothing() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        assert port("stage port", url, ()).verdict is Grade.OK
        connection, _ = server.accept()
        with connection:
            connection.settimeout(10)
            assert connection.recv(100) == b""
    check = port("stage port", url, ())
    assert check.verdict is Grade.FAILED
    assert "accepts no connection" in check.found and "only one connection" in check.advice


@pytest.mark.parametrize("url", ["socket://host", "socket://host:none", "socket://:7777"])
def test_addresses_that_are_none(url: str) -> None:
    assert port("stage port", url, ()).verdict is Grade.FAILED


def test_simulated_and_other_ports() -> None:
    assert port("stage port", "sim://pm16c", ()).verdict is Grade.NOT_APPLICABLE
    assert port("stage port", "rfc2217://host:1", ()).verdict is Grade.CANNOT_CHECK
