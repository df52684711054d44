"""Dry run: the figures of the shipped scans, its errors, and that it loads and touches nothing else."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from beamline.config.load import config_folder, load
from beamline.core.errors import ConfigError
from beamline.core.events import Event
from beamline.instrument.connect import connect
from beamline.scan.dry_run import disk_of, dry_run, refuse_violations
from beamline.scan.run import run_scan
from tests.beamline.ball_scan import shipped
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import SMALL, small
from tests.messages import refused

REPOSITORY = Path(__file__).parents[3]


@pytest.mark.parametrize("name", ["simulated", "instrument", "demo"])
def test_shipped_scans_may_start(name: str) -> None:
    worked = dry_run(shipped(name, f"storage.folder={REPOSITORY.as_posix()}"))
    assert [v for v in worked.timeline.violations if "disk" not in v] == []
    assert worked.timeline.blur_px < 1
    if name == "demo":
        views = worked.timeline.views
        assert views.n == 180
        assert worked.timeline.duration < 25


def test_a_coarse_stage_is_planned_on_its_counts() -> None:
    settings = shipped("simulated", "devices.stage.counts_per_turn=36000", "scan.angles={scheme: fixed, views: 70}")
    worked = dry_run(settings)
    assert worked.timeline.step_counts == 257  # of 257.14
    assert any("257.143 counts" in remark for remark in worked.timeline.remarks)


def test_what_a_live_volume_takes_is_told() -> None:
    def said(name: str, *overrides: str) -> list[str]:
        return [remark for remark in dry_run(shipped(name, *overrides)).timeline.remarks if "live volume" in remark]

    here = f"storage.folder={REPOSITORY.as_posix()}"
    assert "`beamline recon` makes the full volume" in said("instrument", here)[0]
    assert "uses 360 projections of 144 x 160 pixels and about" in said("simulated")[0]
    assert said("simulated", "recon.live=false") == said("simulated", "recon.method=fbp") == []


def test_the_disk_is_that_of_the_run_that_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert disk_of(tmp_path / "a" / "b") == tmp_path
    free = {tmp_path: SimpleNamespace(free=7)}
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: free.get(folder, SimpleNamespace(free=10**15)))
    assert dry_run(shipped("demo")).free_bytes == 10**15
    assert dry_run(shipped("demo"), tmp_path).free_bytes == 7


def test_violations_are_refused_all_at_once() -> None:
    worked = dry_run(shipped("demo")).timeline
    refuse_violations(worked)
    with refused(ConfigError):
        refuse_violations(replace(worked, violations=("too fast",)))
    with refused(ConfigError):
        refuse_violations(replace(worked, violations=("too fast", "too far")))


def test_instrument_loads_no_simulator_and_a_dry_run_no_vendor_library() -> None:
    code = (
        "import sys; from beamline.config import load as config; from beamline.scan.dry_run import dry_run;"
        "d = dry_run(config.load(config.config_folder() / 'instrument.yaml', (), {})); assert d.lines();"
        "bad = [m for m in sys.modules if m.startswith(('simulators', 'drivers.dcam', 'torch'))]; assert not bad, bad"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("preview_bin", [1, 3])
def test_the_bytes_predicted_are_what_the_file_takes(tmp_path: Path, preview_bin: int) -> None:
    overrides = [*SMALL, "simulation.clock=virtual", "devices.stage.low_deg=-60", f"storage.preview_bin={preview_bin}"]
    config = load(config_folder() / "simulated.yaml", overrides, environment={})
    events: list[Event] = []
    result = run_scan(config, tmp_path, [events.append])
    predicted = next(event.data["total_bytes"] for event in events if event.event == "run_started")
    assert 0 < result.bytes - predicted < 152_000  # numbers of each frame, in chunks of 4 kB, and the metadata


@pytest.mark.parametrize("mode", ["fly", "step"])
def test_the_duration_predicted_is_what_it_takes(tmp_path: Path, mode: str) -> None:
    """From the stage's zero through a quarter turn away from it and back, with darks and flats at both ends."""
    angles = "scan.angles={scheme: sector, views: 12, first_deg: 200, last_deg: 290}"
    overrides = [*SMALL, f"scan.mode={mode}", angles, "simulation.clock=virtual", "scan.darks.at=both"]
    overrides += ["devices.camera.roi=[1148, 2028, 8, 40]", "scan.flats.exposure_s=0.5", "references.on_fault=log"]
    config = load(config_folder() / "simulated.yaml", overrides, environment={})
    with connect(config) as instrument:
        began = instrument.clock.now()
        events: list[Event] = []
        run_scan(config, tmp_path, [events.append], instrument=instrument)
        seconds = instrument.clock.now() - began
        assert instrument.devices.stage.position() == 0.0
    predicted = next(event.data["duration"] for event in events if event.event == "run_started")
    assert predicted == pytest.approx(seconds, rel=0.03, abs=0.05 * 12)  # looks at a moving stage are 20 ms apart


@pytest.mark.parametrize("below", ["", "deeper/still"])
def test_a_file_where_runs_should_go_is_refused(tmp_path: Path, below: str) -> None:
    (tmp_path / "runs").write_text("a file")
    instrument = FakeInstrument()
    with refused(ConfigError):
        run_scan(small(), tmp_path / "runs" / below, instrument=instrument.connected())
    assert instrument.log == []
