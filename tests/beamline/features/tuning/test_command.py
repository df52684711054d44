"""`beamline tune`: what is printed, and its exit code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from beamline.config.load import config_folder
from tests.beamline.cli.small_scan import beamline

DEMO = (
    str(config_folder() / "demo.yaml"),
    "--set",
    "simulation.clock=virtual",
    "--set",
    "devices.camera.roi=[1140, 1968, 24, 160]",
)


def test_the_exposure_to_take_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = beamline("tune", *DEMO)
    assert result.exit_code == 0, result.output
    names = [line.split()[0] for line in result.stdout.splitlines()]
    assert names == ["dark", "flat", "saturated", "photons", "view", "noise", "exposure"]
    assert "scan.exposure_s=0.05" in result.stdout
    assert list(tmp_path.iterdir()) == []  # nothing is written


def test_references_that_would_stop_a_scan_end_with_6() -> None:
    result = beamline("tune", *DEMO, "--set", "scan.exposure_s=0.095", "--angle", "30", "--json")
    assert result.exit_code == 6
    done = json.loads(result.stdout.splitlines()[-1])
    assert done["event"] == "done" and done["saturated"] > 0.9 and 0.04 < done["advised"] < 0.07
    assert "0.05" in result.stderr.splitlines()[-1]
