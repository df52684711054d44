"""`beamline bench`: the machine first, then what was measured, for people or one event a line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.core.machine import machine_line
from beamline.features.doctor.rate import STAGES

pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = ("--gaussians", "200", "--side", "32", "--no-volumes")


def test_for_people() -> None:
    result = CliRunner().invoke(main, ["bench", "recon", *SMALL])
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[0] == machine_line()
    assert [line.split()[0] for line in lines[2:]] == ["footprints", "forward", "backward", "step"]
    assert "ns a pair" in lines[3] and " ms " in lines[5]


def test_for_programs() -> None:
    result = CliRunner().invoke(main, ["bench", "recon", *SMALL, "--json"])
    assert result.exit_code == 0, result.output
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert [e["event"] for e in events] == ["bench_started", "bench", "bench", "bench", "bench", "done"]
    assert events[0]["machine"]["threads"] == 1
    assert events[2]["ns_per_pair"] > 0 and events[4]["ns_per_pair"] is None


def test_bad_sizes_are_usage() -> None:
    assert CliRunner().invoke(main, ["bench", "recon", "--side", "4"]).exit_code == 2


def test_the_rate_of_acquisition(tmp_path: Path) -> None:
    few = ["bench", "acquire", str(tmp_path), "--size", "16x32", "--seconds", "0.001", "--rounds", "1"]
    result = CliRunner().invoke(main, few)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[0] == machine_line() and lines[1].startswith("16 x 32 pixels, 1.02 kB a frame")
    table = [line for line in lines if "(" in line and " to " in line][:5]
    assert [line[:27].rstrip() for line in table] == list(STAGES)
    assert all(line.split()[-3] == "0" for line in table), "frames are lost"
    assert "runs: 10/10" in result.stderr and list(tmp_path.iterdir()) == []
    result = CliRunner().invoke(main, [*few, "--json"])
    events = [json.loads(line) for line in result.stdout.splitlines()]
    found = [event for event in events if event["event"] == "bench"]
    assert [event["stage"] for event in found] == list(STAGES) and found[0]["ratio"] == 1
    assert events[0]["rows"] == 16 and events[-1]["event"] == "done"


@pytest.mark.parametrize("size", ["16", "16x", "8x64", "ax64", "64x64x64"])
def test_no_size_of_a_frame(tmp_path: Path, size: str) -> None:
    result = CliRunner().invoke(main, ["bench", "acquire", str(tmp_path), "--size", size])
    assert result.exit_code == 2 and "no size of a frame" in result.stderr
