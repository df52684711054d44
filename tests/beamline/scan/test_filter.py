"""The filter is at the place that the scan names before its first frame, and the file has the name."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import h5py
import pytest

from beamline.core.errors import ConfigError
from beamline.core.stop import StopRequest
from beamline.features.doctor.examine import examine
from beamline.features.files.nexus import nexus_findings
from beamline.features.tuning.tune import tune
from beamline.instrument import connect as devices
from beamline.scan.run import run_scan
from drivers.base.errors import DeviceError
from drivers.in_beam import PlacedStage
from tests.beamline import ran
from tests.beamline.ball_scan import COMMON, shipped, small
from tests.beamline.fakes import FakeInstrument
from tests.drivers.soft_ioc import PREFIX, TickingClock, Variables, serve_pva

KIND = "devices.filter={kind: simulated, places: [none, Al 1 mm]}"
MOTOR = f"{{kind: epics, port: 'sim://epics', {COMMON}}}"
SHORT = (
    "scan.angles={scheme: fixed, views: 4}",
    "scan.flats={count: 2}",
    "scan.darks={count: 2}",
    "recon.live=false",
    "scan.mode=step",
)


class RecordingFilter:
    """A filter that notes when it was told, among the frames of the fake instrument."""

    name = "filter"

    def __init__(self, instrument: FakeInstrument, broken: bool = False) -> None:
        self._log, self._broken, self._place = instrument.log, broken, "none"

    def put(self, place: str) -> None:
        if self._broken:
            raise DeviceError(self.name, "it is stuck")
        self._log.append(f"filter {place}")
        self._place = place

    def place(self) -> str | None:
        return self._place


@pytest.mark.parametrize(("asked", "written"), [("Al 1 mm", "Al 1 mm"), ("null", "none")])
def test_it_is_there_before_the_first_frame_and_in_the_file(tmp_path: Path, asked: str, written: str) -> None:
    frames: list[int] = []
    instrument = FakeInstrument(on_frame=lambda n: frames.append(len(instrument.log)))
    instrument.devices = replace(instrument.devices, filter=RecordingFilter(instrument))
    run = ran.Ran(tmp_path, instrument, KIND, f"scan.filter={asked}")
    assert run.error is None and run.folder is not None
    told = [i for i, line in enumerate(instrument.log) if line.startswith("filter")]
    assert len(told) == (asked != "null") and all(i < frames[0] for i in told)
    with h5py.File(run.folder / "scan.h5") as file:
        group = file["entry/instrument/filter"]
        assert (group.attrs["NX_class"], group["type"].asstr()[()]) == ("NXattenuator", written)
        assert not nexus_findings(file)


def test_one_that_does_not_obey_ends_the_scan_safely_without_a_frame(tmp_path: Path) -> None:
    instrument = FakeInstrument()
    instrument.devices = replace(instrument.devices, filter=RecordingFilter(instrument, broken=True))
    run = ran.Ran(tmp_path, instrument, KIND, "scan.filter=Al 1 mm")
    assert isinstance(run.error, DeviceError) and "it is stuck" in str(run.error)
    assert "close shutter" in instrument.log
    run.assert_good_file(0, "failed")


def test_a_motor_brings_it_there_for_a_scan_and_for_tune(tmp_path: Path) -> None:
    places = f"devices.filter={{kind: stage, places: {{none: 0, Cu: 12}}, stage: {MOTOR}}}"
    settings = small(places, "scan.filter=Cu", *SHORT)
    for act in (lambda: run_scan(settings, tmp_path, instrument=on), lambda: tune(settings, on, StopRequest(), print)):
        with devices.connect(settings) as on:
            assert isinstance(on.devices.filter, PlacedStage) and on.devices.filter.place() == "none"
            act()
            assert on.devices.filter.place() == "Cu"
            assert math.degrees(on.devices.filter._stage.position()) == pytest.approx(12, abs=1e-3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            (KIND, "scan.filter=Cu"),
            r"scan\.filter 'Cu' is not one of the filter's places; devices\.filter has none, Al 1 mm",
        ),
        (("scan.filter=Cu",), r"scan\.filter 'Cu' is not one of the filter's places; devices\.filter has none"),
        (("devices.filter={kind: epics, pv: 'pva://f', places: {a: 1, b: 1}}",), "two places have the same value"),
        (("devices.filter={kind: epics, pv: 'pva://f', places: {a: 1}}",), r"simulated.*filter real"),
        (
            (f"devices.filter={{kind: stage, places: {{a: 999}}, stage: {MOTOR}}}",),
            "a 999 is beyond the limits",
        ),
    ],
)
def test_a_wrong_configuration_is_refused(words: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        small(*words)


def test_the_doctor_reads_where_it_stands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("p4p")
    monkeypatch.setattr("beamline.features.doctor.examine.MOST", 1 << 20)
    chosen = f"devices.filter={{kind: epics, pv: 'pva://{PREFIX}f', places: {{none: 0, Cu: 2}}, timeout_s: 0.5}}"
    settings = shipped("instrument", chosen, f"storage.folder={tmp_path}")
    served, clock = Variables({"f": 2.0}), TickingClock()

    def found() -> tuple[str, str]:
        (one,) = [check for check in examine(settings, clock) if check.name == "filter"]
        return one.verdict, one.observed

    with serve_pva(served, clock, monkeypatch) as ioc:
        assert found() == ("ok", "Cu.")
        served.values["f"] = 1.0
        clock.sleep(1)
        assert found() == ("warning", "It stands at no place that has a name.")
        ioc.stop()
    assert found()[0] == "failed"
