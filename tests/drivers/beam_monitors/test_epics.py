"""The ring current from a process variable of a test IOC."""

from __future__ import annotations

import pytest

from drivers.base.errors import DeviceError
from drivers.base.protocols import BeamMonitor
from drivers.beam_monitors import TextBeamMonitor
from drivers.epics.devices import PvSource
from tests.drivers.soft_ioc import PREFIX, TickingClock, Variables, serve_pva
from tests.messages import refused

pytest.importorskip("p4p")
URL = f"pva://{PREFIX}"


def test_the_ring_current(monkeypatch: pytest.MonkeyPatch) -> None:
    served, clock = Variables({"ring": 199.4}), TickingClock()
    with serve_pva(served, clock, monkeypatch):
        monitor: BeamMonitor = TextBeamMonitor(PvSource(f"{URL}ring", 5.0), clock, pattern="(.*)", unit="A", scale=1e-3)
        reading = monitor.reading()
        assert (reading.value, reading.unit, reading.time) == (pytest.approx(0.1994), "A", clock.now())
        served.values["ring"] = float("nan")
        clock.sleep(1)
        with refused(DeviceError):
            monitor.reading()
        served.values["ring"], served.severity = 1e-30, 3
        clock.sleep(1)
        with refused(DeviceError):
            monitor.reading()
        monitor.close()
        with refused(DeviceError):
            monitor.reading()
