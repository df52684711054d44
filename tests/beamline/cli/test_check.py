"""`beamline check`: its verdict, its figures, and exit code 2; nothing moves and nothing is written."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.config import load as config
from beamline.config.section import port_problem

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
    assert (result.stdout + result.stderr).count("period_s 0.02 is below the camera's minimum of") == 1
    assert "limits are exceeded, nothing was started" in result.stderr
    result = run(DEMO, "--json", *broken)
    assert result.exit_code == 2
    (line,) = result.stdout.splitlines()
    event = json.loads(line)
    assert (event["event"], event["exit_code"]) == ("failed", 2)
    assert "period_s 0.02" in event["message"]


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("optics.pixel_size_um", 4600, "is 4600 um, but the camera's pixels are 4.6 um"),
        ("optics.pixel_size_um", 450, ""),
        ("optics.distance_mm", 0.1, "less than half the field of"),
        ("optics.distance_mm", 0, ""),
        ("optics.distance_mm", 5, ""),
    ],
)
def test_optics_that_cannot_go_with_the_camera_are_doubted(key: str, value: float, sentence: str) -> None:
    result = run(DEMO, "--set", f"{key}={value}")
    assert result.exit_code == 0
    assert (f"Warning: {key}" in result.stderr) is bool(sentence) and sentence in result.stderr


@pytest.mark.parametrize(
    ("port", "good"),
    [
        ("socket:host:7777", False),
        ("socket://host", False),
        ("sim:pm16c", False),
        ("socket://host:7777", True),
        ("/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0", True),
        ("COM3", True),
    ],
)
def test_a_port_that_cannot_be_is_refused(port: str, good: bool) -> None:
    assert (port_problem(port) == "") is good
    if not good:
        result = run(DEMO, "--set", f"devices.stage.port={port}")
        assert result.exit_code == 2 and "is not a port; expected a port such as COM3" in result.stderr
