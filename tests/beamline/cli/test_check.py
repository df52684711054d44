"""`beamline check`: the verdict, the figures, and exit code 2 with nothing moved or written."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.config import load as config

DEMO = str(config.config_folder() / "demo.yaml")


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["check", *arguments])


def test_a_good_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(DEMO)
    assert (result.exit_code, result.stderr) == (0, "")
    for part in (
        "20-199",
        "1° = 1000 counts of 0.001°",
        "18.182°/s",
        "taxi",
        "blur",
        "skew",
        "0:00:1",
        "free",
        "is valid",
    ):
        assert part in result.stdout
    assert list(tmp_path.iterdir()) == []  # no run folder, nothing


def test_violations() -> None:
    broken = ("--set", "scan.period_s=0.02", "--set", "scan.angles.start_deg=190")
    result = run(DEMO, *broken)
    assert result.exit_code == 2
    assert "is valid" not in result.stdout
    assert (result.stdout + result.stderr).count("period_s 0.02 is below the camera's least") == 1
    assert "limits are violated, nothing was started" in result.stderr
    result = run(DEMO, "--json", *broken)
    assert result.exit_code == 2
    (line,) = result.stdout.splitlines()
    event = json.loads(line)
    assert (event["event"], event["exit_code"]) == ("failed", 2)
    assert "period_s 0.02" in event["message"]
