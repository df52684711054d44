"""`beamline monitor`: what is printed, for people and for programs, and its exit code."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.config.load import config_folder
from tests.beamline.cli.small_scan import beamline
from tests.beamline.scans import TwoCylinders, frames_of, write_exchange, write_flagged

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(8, 40))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a scan whose frames 8 and 9 are frame 7 once more, and no flags in it."""
    monkeypatch.chdir(tmp_path)
    frames = frames_of(SCAN)
    frames[8], frames[9] = (replace(frames[i], counts=frames[7].counts) for i in (8, 9))
    write_flagged(tmp_path / "scan.h5", frames, {})
    return tmp_path


def test_flags_are_listed_with_frames_score_limit_and_advice(here: Path) -> None:
    before = (here / "scan.h5").read_bytes()
    result = beamline("monitor", "scan.h5")
    assert result.exit_code == 7
    lines = result.stdout.splitlines()
    assert lines[0] == "alarm stuck       2 frames: 8-9"
    assert lines[1].strip() == "worst score 2 (limit 0 repetitions), in frame 9"
    assert "restart the camera" in lines[2]
    assert lines[-1] == "scan.h5: 34 frames, flagged: stuck 2 alarm"
    assert "2 of 34 frames have an alarm. The list of these frames is on stdout" in result.stderr.splitlines()[-1]
    assert "34/34" in result.stderr
    assert (here / "scan.h5").read_bytes() == before


def test_json_has_an_event_where_a_check_begins_and_all_frames_at_the_end(here: Path) -> None:
    result = beamline("monitor", "scan.h5", "--json", "--follow")
    assert result.exit_code == 7
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert [(e["check"], e["frame"]) for e in events if e["event"] == "flag"] == [("stuck", 8)]
    done = events[-1]
    assert (done["event"], done["n_frames"], done["alarmed_frames"]) == ("done", 34, 2)
    assert done["flags"] == {"stuck": {"alarm": 2}}
    (kind,) = done["kinds"]
    assert (kind["check"], kind["level"], kind["frames"], kind["score"]) == ("stuck", "alarm", [8, 9], 2)


def test_bad_references_are_told_and_limits_may_be_given(here: Path) -> None:
    write_exchange(here / "lit.h5", SCAN, {"data_dark": np.full((2, *SCAN.shape), 15000, np.uint16)})
    result = beamline("monitor", "lit.h5")
    assert result.exit_code == 7
    assert "Darks in frames 0-1: these darks were exposed to the beam." in result.stdout.splitlines()[3]
    limits = "--config", str(config_folder() / "demo.yaml"), "--set", "references.light_in_darks=0.9"
    assert "these darks were exposed" not in beamline("monitor", "lit.h5", *limits).stdout
    assert beamline("monitor", "lit.h5", "--set", "references.light_in_darks=0.9").exit_code == 2


@pytest.mark.usefixtures("real_pictures")
def test_the_worst_frames_may_be_had_as_a_picture(here: Path) -> None:
    assert beamline("monitor", "scan.h5", "--sheet", "sheet.png").exit_code == 7
    assert (here / "sheet.png").read_bytes().startswith(b"\x89PNG")
    again = beamline("monitor", "scan.h5", "--sheet", "sheet.png")
    assert again.exit_code == 5 and "never overwritten" in again.stderr
