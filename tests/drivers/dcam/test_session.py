"""USB preflight with a fake pyusb backend: real pyusb, invented bus."""

from __future__ import annotations

import errno
from typing import Any

import pytest
import usb.core

from drivers.dcam.session import Verdict, preflight
from tests.drivers.dcam.usb_bus import Bus, Descriptor


def test_a_camera_on_a_fast_link_is_ready() -> None:
    bus = Bus(Descriptor(), Descriptor(idVendor=0x1D6B))
    found = preflight(backend=bus)
    assert found.verdict is Verdict.READY
    assert found.message == "USB device 0661:1234 (C15550-20UP 000123) on bus 2, address 7, 5 Gbit/s is connected."
    assert bus.open == 0  # the vendor's driver must be able to open it


@pytest.mark.parametrize(
    ("speed", "verdict"),
    [(2, Verdict.SLOW), (3, Verdict.SLOW), (4, Verdict.READY), (5, Verdict.READY), (6, Verdict.READY)],
)
def test_speed_decides(speed: int, verdict: Verdict) -> None:
    found = preflight(backend=Bus(Descriptor(speed=speed)))
    assert found.verdict is verdict
    assert verdict is Verdict.READY or "needs a SuperSpeed link" in found.message


@pytest.mark.parametrize("speed", [None, 0])
def test_a_speed_that_cannot_be_read_is_not_guessed(speed: int | None) -> None:
    assert preflight(backend=Bus(Descriptor(speed=speed))).verdict is Verdict.UNKNOWN


@pytest.mark.parametrize("bus", [Bus(), Bus(Descriptor(idVendor=0x1D6B))], ids=["empty", "others only"])
def test_no_camera_on_the_bus(bus: Bus) -> None:
    found = preflight(backend=bus)
    assert (found.verdict, found.devices) == (Verdict.ABSENT, ())
    assert "0661:*" in found.message and "CoaXPress" in found.message


def test_another_product_of_the_vendor_is_not_the_camera() -> None:
    bus = Bus(Descriptor(idProduct=0x2917))
    assert preflight(product=0x1234, backend=bus).verdict is Verdict.ABSENT
    assert preflight(product=0x2917, backend=bus).verdict is Verdict.READY


def test_two_cameras_are_told_apart_by_serial_number() -> None:
    bus = Bus(Descriptor(), Descriptor(texts=("C15550-20UP", "000456"), address=8))
    both = preflight(backend=bus)
    assert both.verdict is Verdict.AMBIGUOUS
    assert "000123" in both.message and "000456" in both.message
    assert [device.address for device in preflight(serial="000456", backend=bus).devices] == [8]
    missing = preflight(serial="000789", backend=bus)
    assert missing.verdict is Verdict.ABSENT and "000789" in missing.message


def test_texts_that_may_not_be_read_do_not_hide_the_camera() -> None:
    found = preflight(serial="000123", backend=Bus(Descriptor(texts=None)))
    assert found.verdict is Verdict.READY
    assert "no readable name" in found.message


def test_without_libusb_it_cannot_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_backend(**_: Any) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr("usb.core.find", no_backend)
    found = preflight()
    assert found.verdict is Verdict.UNKNOWN
    assert "libusb is not installed" in found.message


def test_a_bus_that_fails_is_reported_not_raised() -> None:
    class Broken(Bus):
        def enumerate_devices(self) -> Any:
            raise usb.core.USBError("Input/Output Error", -1, errno.EIO)

    found = preflight(backend=Broken())
    assert found.verdict is Verdict.UNKNOWN
    assert "Input/Output Error" in found.message
