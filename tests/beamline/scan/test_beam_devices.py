"""Filter and monochromator are set as the scan wants before its first frame, and the file records it."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
import pytest

from beamline.config.models import Config
from beamline.core.errors import ConfigError
from beamline.core.stop import StopRequest
from beamline.features.tuning.tune import tune
from beamline.instrument import connect as devices
from beamline.instrument.connect import ConnectedDevices
from beamline.instrument.states import device_states
from beamline.scan.dry_run import dry_run
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from drivers.base.errors import DeviceError
from drivers.base.frame import FrameKind
from drivers.in_beam import PlacedStage
from recon.prep.matter import mass_attenuation
from tests.beamline import ran
from tests.beamline.ball_scan import COMMON, shipped, small, with_scene
from tests.beamline.fakes import FakeInstrument
from tests.drivers.soft_ioc import PREFIX, TickingClock, Variables, serve_pva
from tests.refused_calls import refused_calls
from tests.slow_cases import others_slow

FILTER = "devices.filter={kind: simulated, places: [none, Al 1 mm]}"
MONOCHROMATOR = "devices.monochromator={kind: simulated}"
MOTOR = f"{{kind: epics, port: 'sim://epics', {COMMON}}}"
SHORT = (
    "scan.angles={scheme: fixed, views: 4}",
    "scan.flats={count: 2}",
    "scan.darks={count: 2}",
    "recon.live=false",
    "scan.mode=step",
)


NICKEL = {  # a thin cylinder on the axis: a ray near its middle passes about 0.01 mm of nickel
    "phantom": {"kind": "solids", "solids": [{"kind": "cylinder", "radius": 0.005, "height": 1.0, "material": "Ni"}]},
    "beam": {"photons_per_s": 1.0e5, "energy_kev": 8.3},
}


class Recording:
    """A filter or a monochromator that notes when it was told, among the frames of the fake instrument."""

    def __init__(self, instrument: FakeInstrument, name: str, stands: Any, broken: bool = False) -> None:
        self.name, self._log, self._broken, self._stands = name, instrument.log, broken, stands

    def put(self, place: Any) -> None:
        if self._broken:
            raise DeviceError(self.name, "it is stuck")
        self._log.append(f"{self.name} {place}")
        self._stands = place

    def place(self) -> Any:
        return self._stands

    move_to, energy = put, place


def _filter_in(file: h5py.File, written: Any) -> None:
    group = file["entry/instrument/filter"]
    assert (group.attrs["NX_class"], group["type"].asstr()[()]) == ("NXattenuator", written)


def _energy_in(file: h5py.File, written: Any) -> None:
    group = file["entry/instrument/monochromator"]
    assert group.attrs["NX_class"] == "NXmonochromator" and group["energy"].attrs["units"] == "keV"
    assert group["energy"][()] == file["entry/instrument/beam/incident_energy"][()] == written


DEVICES: dict[str, tuple[str, str, Any, Callable[[h5py.File, Any], None]]] = {
    "filter": (FILTER, "scan.filter", "none", _filter_in),
    "monochromator": (MONOCHROMATOR, "scan.energy", 7.0, _energy_in),
}
"""Configuration, the scan's key, where it stands, and what the file says."""


@pytest.mark.parametrize(
    ("name", "asked", "written"),
    others_slow(
        [
            ("filter", "Al 1 mm", "Al 1 mm"), ("monochromator", "8.34", 8.34), ("filter", "null", "none"),
            ("monochromator", "null", 7.0),
        ],
        2,
    ),
)  # fmt: skip
def test_it_is_there_before_the_first_frame_and_in_the_file(
    tmp_path: Path, name: str, asked: str, written: Any
) -> None:
    kind, key, stands, in_file = DEVICES[name]
    frames: list[int] = []
    instrument = FakeInstrument(on_frame=lambda n: frames.append(len(instrument.log)))
    changed: dict[str, Any] = {name: Recording(instrument, name, stands)}
    instrument.devices = replace(instrument.devices, **changed)
    run = ran.Ran(tmp_path, instrument, kind, f"{key}={asked}")
    assert run.error is None and run.folder is not None
    told = [i for i, line in enumerate(instrument.log) if line.startswith(name)]
    assert len(told) == (asked != "null") and all(i < frames[0] for i in told)
    with h5py.File(run.folder / "scan.h5") as file:
        in_file(file, written)


@pytest.mark.parametrize(("name", "asked"), [("filter", "Al 1 mm"), ("monochromator", "8.34")])
def test_one_that_does_not_obey_ends_the_scan_safely_without_a_frame(tmp_path: Path, name: str, asked: str) -> None:
    kind, key, stands, _ = DEVICES[name]
    instrument = FakeInstrument()
    instrument.devices = replace(
        instrument.devices, **cast(Any, {name: Recording(instrument, name, stands, broken=True)})
    )
    run = ran.Ran(tmp_path, instrument, kind, f"{key}={asked}")
    assert isinstance(run.error, DeviceError) and "it is stuck" in str(run.error)
    assert "close shutter" in instrument.log
    run.assert_good_file(0, "failed")


def test_a_motor_brings_it_there_for_a_scan_and_for_tune(tmp_path: Path) -> None:
    places = f"devices.filter={{kind: stage, places: {{none: 0, Cu: 12}}, stage: {MOTOR}}}"
    settings = small(places, "scan.filter=Cu", *SHORT)
    on: ConnectedDevices
    for act in (lambda: run_scan(settings, tmp_path, instrument=on), lambda: tune(settings, on, StopRequest(), print)):
        with devices.connect(settings) as on:
            assert isinstance(on.devices.filter, PlacedStage) and on.devices.filter.place() == "none"
            act()
            assert on.devices.filter.place() == "Cu"
            assert math.degrees(on.devices.filter._stage.position()) == pytest.approx(12, abs=1e-3)


def test_the_simulated_beam_has_the_energy_in_a_scan_and_in_tune(tmp_path: Path) -> None:
    """One instrument at energies around nickel's edge: line integrals are to one another as the tables have them."""
    settings = with_scene(small(MONOCHROMATOR, *SHORT, "scan.exposure_s=0.05"), NICKEL)

    def at_energy(energy: float) -> Config:
        return settings.model_copy(update={"scan": settings.scan.model_copy(update={"energy": energy})})

    with devices.connect(settings) as on:
        depths = dict[float, float]()
        assert on.devices.monochromator is not None and on.devices.monochromator.energy() == 8.3
        for energy in (8.4, 8.2, 8.4):
            result = run_scan(at_energy(energy), tmp_path, instrument=on)
            with open_scan(result.path) as source:
                assert source.energy_kev == energy
                dark, flat, view = (
                    np.mean([f.counts for f in source.frames() if f.kind is kind], axis=0, dtype=np.float64)
                    for kind in (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION)
                )
            depth = -np.log((view - dark) / (flat - dark))
            depths[energy] = float(depth.max())
            per_mm = 0.1 * 8.902 * float(mass_attenuation("Ni", energy))
            assert 0.008 < depths[energy] / per_mm < 0.01
        assert depths[8.4] / depths[8.2] == pytest.approx(
            float(mass_attenuation("Ni", 8.4) / mass_attenuation("Ni", 8.2)), rel=0.01
        )
        tune(at_energy(8.35), on, StopRequest(), print)
        assert on.devices.monochromator.energy() == 8.35


def test_a_beam_of_many_energies_has_no_monochromator() -> None:
    tube = NICKEL | {"beam": {"photons_per_s": 1.0e5, "tube": {"kv": 60}}}
    with pytest.raises(ConfigError, match="gives a single energy"):
        dry_run(with_scene(small(MONOCHROMATOR, "scan.energy=8.3"), tube))


URL = f"pva://{PREFIX}it"
STANDS: dict[str, tuple[str, dict[float, Any]]] = {
    "filter": (
        f"{{kind: epics, pv: '{URL}', places: {{none: 0, Cu: 2}}, timeout_s: 0.5}}",
        {2.0: {"place": "Cu"}, 1.0: {"place": "none of the named places"}},
    ),
    "monochromator": (
        f"{{kind: epics, pv: '{URL}', status_pv: '{URL}', timeout_s: 0.5, unit: eV, range_kev: [4, 25]}}",
        {8340.0: {"energy_kev": 8.34}},
    ),
}


@pytest.mark.parametrize("name", STANDS)
def test_a_check_reads_where_it_stands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str) -> None:
    pytest.importorskip("p4p")
    section, stands = STANDS[name]
    settings = shipped("instrument", f"devices.{name}={section}", f"storage.folder={tmp_path}")
    served, clock = Variables({"it": 0.0}), TickingClock()

    def found() -> tuple[str, dict[str, Any]]:
        (one,) = [state for state in device_states(settings, clock) if state.name == name]
        return one.fault, dict(one.values)

    with serve_pva(served, clock, monkeypatch) as ioc:
        for value, expected in stands.items():
            served.values["it"] = value
            clock.sleep(1)
            assert found() == ("", expected)
        ioc.stop()
    assert found()[0]


test_calls_that_are_refused = refused_calls(__file__, globals())
