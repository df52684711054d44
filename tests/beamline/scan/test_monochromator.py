"""The monochromator is at the energy that the scan names before its first frame, and the file has it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.core.stop import StopRequest
from beamline.features.doctor.examine import examine
from beamline.features.files.nexus import nexus_findings
from beamline.features.tuning.tune import tune
from beamline.instrument import connect as devices
from beamline.scan.preflight import dry_run
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from drivers.base.errors import DeviceError
from drivers.base.frame import FrameKind
from recon.prep.matter import mass_attenuation
from tests.beamline import ran
from tests.beamline.ball_scan import shipped, small, with_scene
from tests.beamline.fakes import FakeInstrument
from tests.drivers.soft_ioc import PREFIX, TickingClock, Variables, serve_pva

KIND = "devices.monochromator={kind: simulated}"
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


class RecordingMonochromator:
    """A monochromator that notes when it was told, among the frames of the fake instrument."""

    name = "monochromator"

    def __init__(self, instrument: FakeInstrument, broken: bool = False) -> None:
        self._log, self._broken, self._energy = instrument.log, broken, 7.0

    def move_to(self, energy: float) -> None:
        if self._broken:
            raise DeviceError(self.name, "it is stuck")
        self._log.append(f"energy {energy}")
        self._energy = energy

    def energy(self) -> float | None:
        return self._energy


@pytest.mark.parametrize(("asked", "written"), [("8.34", 8.34), ("null", 7.0)])
def test_it_is_there_before_the_first_frame_and_in_the_file(tmp_path: Path, asked: str, written: float) -> None:
    frames: list[int] = []
    instrument = FakeInstrument(on_frame=lambda n: frames.append(len(instrument.log)))
    instrument.devices = replace(instrument.devices, monochromator=RecordingMonochromator(instrument))
    run = ran.Ran(tmp_path, instrument, KIND, f"scan.energy={asked}")
    assert run.error is None and run.folder is not None
    told = [i for i, line in enumerate(instrument.log) if line.startswith("energy")]
    assert len(told) == (asked != "null") and all(i < frames[0] for i in told)
    with h5py.File(run.folder / "scan.h5") as file:
        group = file["entry/instrument/monochromator"]
        assert group.attrs["NX_class"] == "NXmonochromator" and group["energy"].attrs["units"] == "keV"
        assert group["energy"][()] == file["entry/instrument/beam/incident_energy"][()] == written
        assert not nexus_findings(file)


def test_one_that_does_not_obey_ends_the_scan_safely_without_a_frame(tmp_path: Path) -> None:
    instrument = FakeInstrument()
    instrument.devices = replace(instrument.devices, monochromator=RecordingMonochromator(instrument, broken=True))
    run = ran.Ran(tmp_path, instrument, KIND, "scan.energy=8.34")
    assert isinstance(run.error, DeviceError) and "it is stuck" in str(run.error)
    assert "close shutter" in instrument.log
    run.assert_good_file(0, "failed")


def test_the_simulated_beam_has_the_energy_in_a_scan_and_in_tune(tmp_path: Path) -> None:
    """One instrument at energies around nickel's edge: line integrals are to one another as the tables have them."""
    settings = with_scene(small(KIND, *SHORT, "scan.exposure_s=0.05"), NICKEL)
    with devices.connect(settings) as on:
        depths = dict[float, float]()
        assert on.devices.monochromator is not None and on.devices.monochromator.energy() == 8.3
        for energy in (8.4, 8.2, 8.4):
            here = settings.model_copy(update={"scan": settings.scan.model_copy(update={"energy": energy})})
            result = run_scan(here, tmp_path, instrument=on)
            with open_scan(result.path) as source:
                assert source.energy_kev == energy
                mean = {
                    kind: np.mean([f.counts for f in source.frames() if f.kind is kind], axis=0, dtype=np.float64)
                    for kind in (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION)
                }
            dark = mean[FrameKind.DARK]
            depth = -np.log((mean[FrameKind.PROJECTION] - dark) / (mean[FrameKind.FLAT] - dark))
            depths[energy] = float(depth.max())
            per_mm = 0.1 * 8.902 * float(mass_attenuation("Ni", energy))
            assert 0.008 < depths[energy] / per_mm < 0.01
        assert depths[8.4] > 5 * depths[8.2]
        assert depths[8.4] / depths[8.2] == pytest.approx(
            float(mass_attenuation("Ni", 8.4) / mass_attenuation("Ni", 8.2)), rel=0.01
        )
        tune(
            settings.model_copy(update={"scan": settings.scan.model_copy(update={"energy": 8.35})}),
            on,
            StopRequest(),
            print,
        )
        assert on.devices.monochromator.energy() == 8.35


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("scan.energy=8.3",), r"scan\.energy needs a monochromator, and devices\.monochromator\.kind is none"),
        (
            ("devices.monochromator={kind: simulated, range_kev: [4, 8]}", "scan.energy=8.3"),
            r"scan\.energy: 8\.3 keV is not within devices\.monochromator\.range_kev 4 \.\.\. 8",
        ),
        (("devices.monochromator={kind: manual}",), r"simulated.*monochromator real"),
    ],
)
def test_a_wrong_configuration_is_refused(words: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        small(*words)


def test_a_beam_of_many_energies_has_no_monochromator() -> None:
    tube = NICKEL | {"beam": {"photons_per_s": 1.0e5, "tube": {"kv": 60}}}
    with pytest.raises(ConfigError, match="gives one energy"):
        dry_run(with_scene(small(KIND, "scan.energy=8.3"), tube))


def test_the_doctor_reads_where_it_stands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("p4p")
    monkeypatch.setattr("beamline.features.doctor.examine.MOST", 1 << 20)
    url = f"pva://{PREFIX}e"
    chosen = f"devices.monochromator={{kind: epics, pv: '{url}', status_pv: '{url}', timeout_s: 0.5, unit: eV, " + (
        "range_kev: [4, 25]}"
    )
    settings = shipped("instrument", chosen, f"storage.folder={tmp_path}")
    served, clock = Variables({"e": 8340.0}), TickingClock()

    def found() -> tuple[str, str]:
        (one,) = [check for check in examine(settings, clock) if check.name == "monochromator"]
        return one.verdict, one.observed

    with serve_pva(served, clock, monkeypatch) as ioc:
        assert found() == ("ok", "8.34 keV.")
        served.values["e"] = 8.34
        clock.sleep(1)
        assert found() == ("warning", "It stands at 0.00834 keV.")
        ioc.stop()
    assert found()[0] == "failed"
