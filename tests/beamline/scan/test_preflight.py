"""Dry run: the figures of the shipped scans, what it refuses, and what it does not load or touch."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from beamline.config import load as config
from beamline.config.models import Config
from beamline.core.errors import ConfigError
from beamline.scan.preflight import dry_run, free_bytes, refuse_violations

REPOSITORY = Path(__file__).parents[3]


def shipped(name: str, *overrides: str) -> Config:
    return config.load(config.config_folder() / f"{name}.yaml", overrides, {})


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
    assert "`beamline recon` makes the full one" in said("instrument", here)[0]
    assert "of 360 views of 144 x 160 pixels, in about" in said("simulated")[0]
    assert said("simulated", "recon.live=false") == said("simulated", "recon.method=fbp") == []


def test_the_disk_is_that_of_the_run_that_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beamline.scan.preflight.free_bytes", lambda folder: 7 if folder == tmp_path else 10**15)
    assert dry_run(shipped("demo")).free_bytes == 10**15
    assert dry_run(shipped("demo"), tmp_path).free_bytes == 7


def test_violations_are_refused_all_at_once() -> None:
    worked = dry_run(shipped("demo")).timeline
    refuse_violations(worked)
    with pytest.raises(ConfigError, match=r"^a limit is violated, nothing was started: too fast\.$"):
        refuse_violations(replace(worked, violations=("too fast",)))
    with pytest.raises(ConfigError, match=r"^2 limits are violated, nothing was started:\n  too fast\n  too far$"):
        refuse_violations(replace(worked, violations=("too fast", "too far")))


def test_instrument_loads_no_simulator_and_a_dry_run_no_vendor_library() -> None:
    code = (
        "import sys; from beamline.config import load as config; from beamline.scan.preflight import dry_run;"
        "d = dry_run(config.load(config.config_folder() / 'instrument.yaml', (), {})); assert d.lines();"
        "bad = [m for m in sys.modules if m.startswith(('simulators', 'drivers.dcam', 'torch'))]; assert not bad, bad"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_room_on_a_disk_for_a_folder_that_is_not_there_yet(tmp_path: Path) -> None:
    assert free_bytes(tmp_path / "a" / "b") > 0
    assert not (tmp_path / "a").exists()
