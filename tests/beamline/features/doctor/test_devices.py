"""The doctor on the camera: a fake USB bus through real pyusb, and libraries that are there, are not, or are others."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path
from typing import Any

import pytest
import usb.core

from beamline.config.devices import DcamOrca
from beamline.features.doctor import devices
from beamline.features.doctor.check import Grade
from beamline.features.doctor.devices import port, ports
from drivers.dcam import session as preflights
from drivers.serial.line import SerialPort
from tests.drivers.dcam.fake import World, build
from tests.drivers.dcam.usb_bus import Bus, Descriptor

CAMERA = DcamOrca(kind="dcam")


def test_a_camera_on_a_fast_link() -> None:
    check = devices.link(CAMERA, Bus(Descriptor()))
    assert (check.verdict, check.advice) == (Grade.OK, "")
    assert "0661:1234 (C15550-20UP 000123)" in check.observed and "5 Gbit/s" in check.observed
    assert check.values["devices"][0]["serial"] == "000123"


def test_a_slow_link_fails_and_says_what_to_do() -> None:
    """The plan reckons with 334 MB/s: a camera at 480 Mbit/s would lose frames."""
    check = devices.link(CAMERA, Bus(Descriptor(speed=3)))
    assert check.verdict is Grade.FAILED
    assert "480 Mbit/s" in check.observed and "5 Gbit/s" in check.expected
    assert "USB 3 cable" in check.advice and "without a hub" in check.advice


def test_an_absent_camera_fails_where_one_is_configured() -> None:
    assert devices.link(CAMERA, Bus()).verdict is Grade.FAILED
    check = devices.link(None, Bus())  # who knows whether it is a CoaXPress one
    assert check.verdict is Grade.WARNING
    assert "Switch the camera on" in check.advice


def test_several_cameras_are_told_apart_by_the_configuration() -> None:
    bus = Bus(Descriptor(), Descriptor(idProduct=0x2917, texts=("detector", "7"), address=8))
    check = devices.link(CAMERA, bus)
    assert check.verdict is Grade.WARNING
    assert "usb_product" in check.advice
    assert devices.link(DcamOrca(kind="dcam", usb_product=0x1234), bus).verdict is Grade.OK
    assert devices.link(DcamOrca(kind="dcam", usb_serial="000123"), bus).verdict is Grade.OK
    assert devices.link(DcamOrca(kind="dcam", usb_serial="000999"), bus).verdict is Grade.FAILED


def test_a_coaxpress_camera_is_not_looked_for_on_usb() -> None:
    class Untouched(Bus):
        def enumerate_devices(self) -> Any:
            raise AssertionError("the bus was asked")

    check = devices.link(DcamOrca(kind="dcam", link="coaxpress"), Untouched())
    assert check.verdict is Grade.NOT_APPLICABLE


@pytest.mark.parametrize("configured", [CAMERA, None])
def test_without_libusb_it_cannot_be_checked(monkeypatch: pytest.MonkeyPatch, configured: DcamOrca | None) -> None:
    def no_backend(**_: Any) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(preflights.usb.core, "find", no_backend)
    check = devices.link(configured)
    assert check.verdict is Grade.CANNOT_CHECK
    assert "libusb" in check.advice


def test_no_library(tmp_path: Path) -> None:
    absent = DcamOrca(kind="dcam", library=str(tmp_path / "libdcamapi.so"))
    check = devices.library(absent)
    assert check.verdict is Grade.FAILED
    assert "cannot be loaded" in check.observed and "runtime" in check.advice


@pytest.mark.skipif(sys.platform != "linux", reason="a library that every Linux has")
def test_another_library_is_not_taken_for_it() -> None:
    check = devices.library(DcamOrca(kind="dcam", library="libm.so.6"))
    assert check.verdict is Grade.FAILED
    assert "is not a DCAM-API version 4 library" in check.observed


def test_a_library_is_found_without_a_session(tmp_path: Path) -> None:
    library = build(tmp_path)
    check = devices.library(DcamOrca(kind="dcam", library=str(library)))
    assert (check.verdict, check.values) == (Grade.OK, {"library": str(library)})


def test_with_a_session_the_camera_is_asked(tmp_path: Path) -> None:
    world = World(build(tmp_path))
    configured = DcamOrca(kind="dcam", library=str(world.path))
    for _ in range(2):  # a session that stayed open would forbid the second
        check = devices.library(configured, session=True)
        assert check.verdict is Grade.OK
        assert check.values["cameras"][0]["model"] in check.observed
        assert world.live == 0
    check = devices.library(configured.model_copy(update={"index": 7}), session=True)
    assert check.verdict is Grade.FAILED
    assert "devices.camera.index" in check.advice


ADAPTER = SerialPort("/dev/ttyUSB7", 0x0403, 0x6001, "FT1234", "FT232R")


def test_what_there_is_is_told() -> None:
    check = ports((ADAPTER,))
    assert check.verdict is Grade.OK
    assert "/dev/ttyUSB7 0403:6001 serial FT1234 (FT232R)" in check.observed
    assert check.values["ports"] == [vars(ADAPTER)]
    assert ports(()).verdict is Grade.WARNING


def test_a_port_that_is_not_there_names_those_that_are() -> None:
    check = port("stage port", "/dev/ttyUSB_none", (ADAPTER,))
    assert check.verdict is Grade.FAILED
    assert "There is no port /dev/ttyUSB_none; there are /dev/ttyUSB7" in check.observed
    assert "there are no serial ports" in port("stage port", "COM99_none", ()).observed


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
        assert "0403:6001" in check.observed
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
    assert "accepts no connection" in check.observed and "only one connection" in check.advice
