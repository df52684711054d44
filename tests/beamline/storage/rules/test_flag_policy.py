"""Flags in `validate`: their numbers by check and level, and how serious they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from beamline.features.files.validate import describe, validate
from beamline.monitor.check import Flag, Level
from beamline.projections.usable_views import usable_views
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.readers.open import open_scan
from beamline.storage.rules.evidence import EvidenceRequest, ScanEvidence
from beamline.storage.rules.flag_policy import frames_flagged
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged
from tests.slow_cases import others_slow

FRAMES = frames_of(TwoCylinders(angles=np.radians(np.arange(0, 180, 10.0))))  # 2 darks, 2 flats, 18 views


@pytest.mark.parametrize(
    ("alarms", "severity", "said"),
    others_slow(
        [
            (
                range(6, 9),
                "warning",
                "flagged 4 of 22 frames: beam 1 warn 3 alarm. Frames with an alarm: 6-8. In a reconstruction (--flags "
                "use): Of 18 projections, 3 have an alarm and are left out (beam 3 alarm)",
            ),
            (
                range(6, 20),
                "error",
                "Frames with an alarm: 6-19. Repeat the scan: only 4 of 18 projections have no alarm, and 10 are",
            ),
            (range(0), "info", "flagged 1 of 22 frames: beam 1 warn."),
            (range(2), "warning", "Frames with an alarm: 0-1."),
        ],
        2,
    ),
)
def test_flags_are_counted_by_check_and_level(tmp_path: Path, alarms: range, severity: str, said: str) -> None:
    path = write_flagged(tmp_path / "s.h5", FRAMES, {**dict.fromkeys(alarms, Level.ALARM), 5: Level.WARN})
    (finding,) = [finding for finding in validate(path) if finding.rule == "flags"]
    assert finding.severity == severity
    assert said in finding.message
    assert describe(path)["reconstructable"] is (severity != "error")


IN_A_PART = (
    "Of 18 projections, 4 are flagged in a part of the image, where rays have half weight (weight 0 for an alarm) "
    "(bands 4 alarm)."
)


@pytest.mark.parametrize(
    ("region", "said"),
    [
        ((0, 1, 4, 8), IN_A_PART),
        (None, "Of 18 projections, 4 have an alarm and are left out (bands 4 alarm)."),
    ],
)
def test_what_a_reconstruction_does_is_said_in_its_own_words(
    tmp_path: Path, region: tuple[int, int, int, int] | None, said: str
) -> None:
    """Views that are masked in a part are not said to be left out: info, validate and recon have one rule."""
    flags = [[Flag("bands", Level.ALARM, row, 0.5, 0.1, "", region)] if 6 <= row < 10 else [] for row in range(22)]
    judged = FrameFlags.of_flags(flags)
    with open_scan(write_flagged(tmp_path / "s.h5", FRAMES, {})) as source:
        (finding,) = frames_flagged(ScanEvidence(source, EvidenceRequest(judge=lambda source: judged)))
        taken = usable_views(ScanEvidence(source, EvidenceRequest(judge=lambda source: judged)), True)
    assert finding.message.endswith(f"In a reconstruction (--flags use): {said}")
    assert taken.sentence.startswith(said)
    assert taken.frames.size == 18 - taken.left_out == (18 if region else 14)
