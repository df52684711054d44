"""Flags as a finding of `validate`: numbers by check and level, and how bad that is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from beamline.monitor.check import Level
from beamline.storage.describe import describe
from beamline.storage.rules.validate import validate
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

FRAMES = frames_of(TwoCylinders(angles=np.radians(np.arange(0, 180, 10.0))))  # 2 darks, 2 flats, 18 views


@pytest.mark.parametrize(
    ("alarms", "severity", "said"),
    [
        (range(0), "info", "flagged 1 of 22 frames: beam 1 warn."),
        (
            range(6, 9),
            "warning",
            "flagged 4 of 22 frames: beam 1 warn 3 alarm. Frames with an alarm: 6-8. A reconstruction leaves 3 v",
        ),
        (range(6, 20), "error", "Frames with an alarm: 6-19. 4 of 18 views have none, 10 are needed"),
        (range(2), "warning", "Frames with an alarm: 0-1."),
    ],
)
def test_flags_are_counted_by_check_and_level(tmp_path: Path, alarms: range, severity: str, said: str) -> None:
    path = write_flagged(tmp_path / "s.h5", FRAMES, {**dict.fromkeys(alarms, Level.ALARM), 5: Level.WARN})
    (finding,) = [finding for finding in validate(path) if finding.rule == "flags"]
    assert finding.severity == severity
    assert said in finding.message
    assert describe(path)["reconstructable"] is (severity != "error")


def test_a_scan_without_flags_has_no_finding(tmp_path: Path) -> None:
    path = write_flagged(tmp_path / "s.h5", FRAMES, {})
    assert [finding for finding in validate(path) if finding.rule == "flags"] == []
    assert (describe(path)["flagged_frames"], describe(path)["flags"]) == (0, {})
