"""`beamline runs`: a table for people, an event for programs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.beamline.cli.small_scan import beamline
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran


def test_a_line_a_run_newest_first(tmp_path: Path) -> None:
    Ran(tmp_path, FakeInstrument(), "sample.name=cathode-3")
    (tmp_path / "2020-01-02T03-04-05_\x1b[31mred").mkdir()
    (tmp_path / "2020-01-02T03-04-05_\x1b[31mred" / "events.jsonl").touch()
    result = beamline("runs", str(tmp_path))
    head, first, second = result.stdout.splitlines()
    assert result.exit_code == 0
    assert head.split()[:3] == ["time", "(UTC)", "sample"]
    assert first.split()[2:5] == ["cathode-3", "19", "done"] and first.endswith("_cathode-3")
    assert second.startswith("2020-01-02 03:04:05  \\x1b[31mred") and "\x1b" not in result.stdout
    (line,) = beamline("runs", str(tmp_path), "--json").stdout.splitlines()
    done = json.loads(line)
    assert done["event"] == "done"
    assert [(run["sample"], run["frames"], run["state"]) for run in done["runs"]] == [
        ("cathode-3", 19, "done"), ("\x1b[31mred", None, "died"),
    ]  # fmt: skip


def test_no_run_is_no_error_and_no_folder_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = beamline("runs")
    assert result.exit_code == 2 and "no folder runs" in result.stderr
    (tmp_path / "runs").mkdir()
    result = beamline("runs")
    assert (result.exit_code, result.stdout) == (0, "") and "no run in runs" in result.stderr
