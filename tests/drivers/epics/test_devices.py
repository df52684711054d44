"""Shutter and beam monitor behind process variables of a soft IOC: commands work, and all ways to fail."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import Shutter
from drivers.epics.channel import open_channel, url_problem
from drivers.epics.devices import PvShutter, ShutterPvs
from tests.drivers.soft_ioc import PREFIX, PvaIoc, TickingClock, Variables, serve_pva
from tests.messages import refused

pytest.importorskip("p4p")
URL = f"pva://{PREFIX}"
PVS = ShutterPvs(f"{URL}open", f"{URL}blade", f"{URL}close", status_open="Open", close_value=1, timeout=5.0, travel=4.0)


class Blade(Variables):
    """A shutter with two commands and a status, as at many beamlines; `stuck`: it does not move."""

    def __init__(self) -> None:
        super().__init__({"open": 0.0, "close": 0.0, "blade": 0.0}, {"blade": ("Closed", "Open")}, follow=self._move)
        self.stuck, self.sent = False, list[str]()

    def _move(self, name: str, value: float | str) -> None:
        self.sent.append(name)
        if not self.stuck:
            self.values["blade"] = float(name == "open")


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Blade, PvShutter, TickingClock, PvaIoc]]:
    with ExitStack() as served:
        blade, clock = Blade(), TickingClock()
        ioc = served.enter_context(serve_pva(blade, clock, monkeypatch))
        shutter = PvShutter(PVS, clock)
        served.callback(shutter.disconnect)
        yield blade, shutter, clock, ioc


Rig = tuple[Blade, PvShutter, TickingClock, PvaIoc]


def test_it_opens_and_closes_and_closing_is_always_sent(rig: Rig) -> None:
    blade, pv_shutter, clock, _ = rig
    shutter: Shutter = pv_shutter
    assert not shutter.is_open() and not shutter.by_hand
    for _ in range(2):
        shutter.open()
        assert shutter.is_open()
    shutter.close()
    shutter.close()
    assert not shutter.is_open()
    assert blade.sent == ["open", "close", "close"]
    assert clock.now() == TickingClock().now()  # it does not wait for a blade that has arrived


def test_a_blade_that_follows_late_is_waited_for(rig: Rig) -> None:
    blade, shutter, clock, _ = rig
    blade.stuck, began = True, clock.now()

    def late() -> None:
        if clock.now() > began + 2:
            blade.values["blade"] = 1.0

    clock.ticked.insert(0, late)
    shutter.open()
    assert shutter.is_open() and 2 < clock.now() - began < 4


@pytest.mark.parametrize("wanted", [True, False])
def test_a_blade_that_does_not_move_is_an_error(rig: Rig, wanted: bool) -> None:
    blade, shutter, _, _ = rig
    if not wanted:
        shutter.open()
    blade.stuck = True
    with refused(DeviceTimeout):
        (shutter.open if wanted else shutter.close)()


def test_a_status_that_nobody_vouches_for_is_not_closed(rig: Rig) -> None:
    blade, shutter, clock, _ = rig
    blade.severity = 3
    clock.sleep(1)
    for act in (shutter.is_open, shutter.open, shutter.close):
        with refused(DeviceError):
            act()


def test_an_ioc_that_is_gone_is_an_error(rig: Rig) -> None:
    *_, ioc = rig
    ioc.stop()
    short = ShutterPvs(PVS.open_pv, PVS.status_pv, PVS.close_pv, timeout=0.5)
    with refused(DeviceTimeout):
        PvShutter(short, TickingClock())


@pytest.mark.parametrize("url", ["", "ring", "pva://", "http://ring", "pva://a b"])
def test_what_is_no_process_variable_is_refused(url: str) -> None:
    assert "expected pva://NAME" in url_problem(url)
    with refused(DeviceRefused):
        open_channel(url, "device", 1.0)


def test_a_library_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "p4p.client.thread", None)
    with refused(DeviceError):
        open_channel("pva://ring", "device", 1.0)
