"""Beam log: every reading is kept and reported, an outage is reported once; a beam monitor never affects a scan."""

import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.events import Event
from beamline.scan import supervision as beam_log
from beamline.scan.run import run_scan
from beamline.scan.supervision import BeamLog
from beamline.storage.writers.layout import BEAM
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.protocols import BeamReading
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import small

SILENT = DeviceTimeout("beam monitor", "no answer")


class Scripted:
    """Says what stands in the script, then waits until it is let go and says one more."""

    name = "beam monitor"

    def __init__(self, *script: float | Exception) -> None:
        self._script = list(script)
        self.asked, self.over, self.let_go = 0, threading.Event(), threading.Event()

    def reading(self) -> BeamReading:
        self.asked += 1
        if not self._script:
            self.over.set()
            assert self.let_go.wait(30)
            return BeamReading(-1.0, "nA", 99.0)
        said = self._script.pop(0)
        if isinstance(said, Exception):
            raise said
        return BeamReading(said, "nA", float(self.asked))

    def close(self) -> None: ...


def test_readings_are_told_and_an_outage_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beam_log, "LAST_WAIT", 0.01)
    monitor = Scripted(1.5, SILENT, SILENT, SILENT, 2.5, ZeroDivisionError("a defect"), 3.5)
    told: list[tuple[str, Mapping[str, Any]]] = []
    with BeamLog(monitor, 0.0, lambda event: told.append((event.event, event.data))) as log:
        assert monitor.over.wait(30)
    monitor.let_go.set()  # a reading that ends after the scan is nobody's
    log._thread.join(30)
    assert [(reading.value, reading.time) for reading in log.readings] == [(1.5, 1.0), (2.5, 5.0), (3.5, 7.0)]
    assert [data["value"] for event, data in told if event == "beam"] == [1.5, 2.5, 3.5]
    warnings = [data["message"] for event, data in told if event == "warning"]
    assert len(warnings) == 4
    assert warnings[0] == f"{SILENT} The scan continues without readings until the monitor answers again."
    assert "answers again after 3 failed readings." in warnings[1]
    assert "ZeroDivisionError: a defect" in warnings[2]
    assert "after 1 failed reading." in warnings[3]


CHOSEN = "devices.beam_monitor={kind: electrometer, port: 'sim://electrometer', unit: nA, period_s: 0.001}"


def scan(folder: Path, monitor: Scripted) -> tuple[Path, list[Event]]:
    events: list[Event] = []
    instrument = replace(FakeInstrument().connected(), beam_monitor=monitor)
    return run_scan(small(CHOSEN), folder, [events.append], instrument=instrument).path, events


def test_a_scan_keeps_the_readings_in_its_file(tmp_path: Path) -> None:
    monitor = Scripted()
    monitor.let_go.set()
    path, events = scan(tmp_path, monitor)
    told = [event.data for event in events if event.event == "beam"]
    assert told
    with h5py.File(path) as file:
        assert file[BEAM].attrs["NX_class"] == "NXlog"
        np.testing.assert_array_equal(file[f"{BEAM}/value"][()], [data["value"] for data in told])
        np.testing.assert_array_equal(file[f"{BEAM}/time"][()], [data["read_at"] for data in told])
        assert [file[f"{BEAM}/{name}"].attrs["units"] for name in ("time", "value")] == ["s", "nA"]


@pytest.mark.parametrize("error", [SILENT, DeviceError("beam monitor", "over range"), RuntimeError("a defect")])
def test_a_monitor_that_fails_stops_no_scan(tmp_path: Path, error: Exception) -> None:
    path, events = scan(tmp_path, Scripted(*[error] * 100_000))
    assert [event.data["status"] for event in events if event.event == "scan_done"] == ["complete"]
    warnings = [event.data["message"] for event in events if event.event == "warning"]
    assert len([message for message in warnings if "The scan continues" in message]) == 1
    with h5py.File(path) as file:
        assert file[f"{BEAM}/value"].shape == (0,)
        assert file["entry/progress/status"][()] == b"complete"


def test_a_monitor_that_hangs_holds_up_no_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beam_log, "LAST_WAIT", 0.01)
    monitor = Scripted(7.0)
    path, events = scan(tmp_path, monitor)
    monitor.let_go.set()
    assert [event.data["status"] for event in events if event.event == "scan_done"] == ["complete"]
    with h5py.File(path) as file:
        assert set(file[f"{BEAM}/value"][()]) <= {7.0}
