"""`beamline bench recon`: the machine first, then what was measured, for people or one event a line."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.core.machine import machine_line

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
