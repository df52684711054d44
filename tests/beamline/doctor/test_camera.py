"""The doctor on the camera: a fake USB bus through real pyusb, and libraries that are there, are not, or are others."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import usb.core

from beamline.config.devices import DcamOrca
from beamline.doctor import camera
from beamline.doctor.check import Grade
from drivers import usb as preflights
from tests.drivers.dcam.fake import World, build
from tests.drivers.usb_bus import Bus, Descriptor

CAMERA = DcamOrca(kind="dcam")


def test_a_camera_on_a_fast_link() -> None:
    check = camera.link(CAMERA, Bus(Descriptor()))
    assert (check.verdict, check.advice) == (Grade.OK, "")
    assert "0661:1234 (C15550-20UP 000123)" in check.found and "5 Gbit/s" in check.found
    assert check.values["devices"][0]["serial"] == "000123"


def test_a_slow_link_fails_and_says_what_to_do() -> None:
    """The plan reckons with 334 MB/s: a camera at 480 Mbit/s would lose frames."""
    check = camera.link(CAMERA, Bus(Descriptor(speed=3)))
    assert check.verdict is Grade.FAILED
    assert "480 Mbit/s" in check.found and "5 Gbit/s" in check.expected
    assert "USB 3 cable" in check.advice and "without a hub" in check.advice


def test_an_absent_camera_fails_where_one_is_configured() -> None:
    assert camera.link(CAMERA, Bus()).verdict is Grade.FAILED
    check = camera.link(None, Bus())  # who knows whether it is a CoaXPress one
    assert check.verdict is Grade.WARNING
    assert "Switch the camera on" in check.advice


def test_several_cameras_are_told_apart_by_the_configuration() -> None:
    bus = Bus(Descriptor(), Descriptor(idProduct=0x2917, texts=("detector", "7"), address=8))
    check = camera.link(CAMERA, bus)
    assert check.verdict is Grade.WARNING
    assert "usb_product" in check.advice
    assert camera.link(DcamOrca(kind="dcam", usb_product=0x1234), bus).verdict is Grade.OK
    assert camera.link(DcamOrca(kind="dcam", usb_serial="000123"), bus).verdict is Grade.OK
    assert camera.link(DcamOrca(kind="dcam", usb_serial="000999"), bus).verdict is Grade.FAILED


def test_a_coaxpress_camera_is_not_looked_for_on_usb() -> None:
    class Untouched(Bus):
        def enumerate_devices(self) -> Any:
            raise AssertionError("the bus was asked")

    check = camera.link(DcamOrca(kind="dcam", link="coaxpress"), Untouched())
    assert check.verdict is Grade.NOT_APPLICABLE


@pytest.mark.parametrize("configured", [CAMERA, None])
def test_without_libusb_it_cannot_be_checked(monkeypatch: pytest.MonkeyPatch, configured: DcamOrca | None) -> None:
    def no_backend(**_: Any) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(preflights.usb.core, "find", no_backend)
    check = camera.link(configured)
    assert check.verdict is Grade.CANNOT_CHECK
    assert "libusb" in check.advice


def test_a_speed_that_is_not_told_cannot_be_checked() -> None:
    assert camera.link(CAMERA, Bus(Descriptor(speed=None))).verdict is Grade.CANNOT_CHECK


def test_no_library(tmp_path: Path) -> None:
    absent = DcamOrca(kind="dcam", library=str(tmp_path / "libdcamapi.so"))
    check = camera.library(absent)
    assert check.verdict is Grade.FAILED
    assert "cannot be loaded" in check.found and "runtime" in check.advice


def test_no_library_on_a_computer_without_a_camera(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    check = camera.library(None)
    if check.verdict is not Grade.OK:  # a computer that has one
        assert check.verdict is Grade.WARNING


@pytest.mark.skipif(sys.platform != "linux", reason="a library that every Linux has")
def test_another_library_is_not_taken_for_it() -> None:
    check = camera.library(DcamOrca(kind="dcam", library="libm.so.6"))
    assert check.verdict is Grade.FAILED
    assert "is not a DCAM-API version 4 library" in check.found


def test_a_library_is_found_without_a_session(tmp_path: Path) -> None:
    library = build(tmp_path)
    versioned = tmp_path / "libdcamapi.so.4.24.7"
    library.rename(versioned)
    link = tmp_path / "libdcamapi.so"
    link.symlink_to(versioned)
    check = camera.library(DcamOrca(kind="dcam", library=str(link)))
    assert check.verdict is Grade.OK
    assert check.values == {"library": str(versioned), "version": "4.24.7"}
    assert "version 4.24.7" in check.found
    assert camera.version_of(library.with_name("libfake.so")) == ""


def test_with_a_session_the_camera_is_asked(tmp_path: Path) -> None:
    world = World(build(tmp_path))
    configured = DcamOrca(kind="dcam", library=str(world.path))
    for _ in range(2):  # a session that stayed open would forbid the second
        check = camera.library(configured, session=True)
        assert check.verdict is Grade.OK
        assert check.values["cameras"][0]["model"] in check.found
        assert world.live == 0
    check = camera.library(configured.model_copy(update={"index": 7}), session=True)
    assert check.verdict is Grade.FAILED
    assert "devices.camera.index" in check.advice
