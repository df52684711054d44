"""Faults of the stage's motion and of the trigger cable, on every controller."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from beamline.scan.ledger import LedgerError
from drivers.base.frame import FrameKind
from tests.drivers.faults import table
from tests.drivers.faults.aftermath import (
    assert_at_rest,
    assert_kept,
    assert_next_scan_works,
    assert_reported_once,
    assert_speaks,
)
from tests.drivers.faults.rig import VIEWS, Rig

RigOf = Callable[[str], Rig]


@pytest.mark.parametrize(("row", "kind"), table.one_quick_each(table.MOTION))
def test_a_stage_that_stops_early(rig_of: RigOf, row: table.MotionFault, kind: str, tmp_path: Path) -> None:
    """The views before it are in the file; no view is called missing, for it was never reached."""
    rig = rig_of(kind)
    row.breaks(rig)
    scanned = rig.scan(tmp_path)
    assert_speaks(scanned.error, "stage")
    assert re.search(rf"{row.words} 38\.0000 deg.*It is at 2[1-5]\.", str(scanned.error))
    assert re.search(row.says[kind], str(scanned.error))
    assert_reported_once(scanned)
    assert scanned.warnings == []
    assert_at_rest(rig, scanned)
    assert_kept(scanned)
    assert len(scanned.rows()[FrameKind.PROJECTION]) in range(6, VIEWS)
    assert_next_scan_works(rig, tmp_path, row.flags.get(kind, ""))


@pytest.mark.parametrize(("row", "kind"), table.one_quick_each(table.MOTION[:2]))
def test_a_stage_that_stops_early_in_a_step_scan(
    rig_of: RigOf, row: table.MotionFault, kind: str, tmp_path: Path
) -> None:
    """Between views it stands, so that a stop from elsewhere has no effect there."""
    rig = rig_of(kind)
    row.breaks(rig)
    scanned = rig.scan(tmp_path, "scan.mode=step")
    assert_speaks(scanned.error, "stage")
    assert f"{row.words} 22.0000 deg" in str(scanned.error)
    assert re.search(row.says[kind], str(scanned.error))
    assert_reported_once(scanned)
    assert_at_rest(rig, scanned)
    assert_kept(scanned, list(range(6)))


@pytest.mark.parametrize(("row", "kind"), table.one_quick_each(table.PULSES))
def test_a_trigger_cable_that_loses_or_picks_up_pulses(
    rig_of: RigOf, row: table.PulseFault, kind: str, tmp_path: Path
) -> None:
    rig = rig_of(kind)
    row.breaks(rig)
    scanned = rig.scan(tmp_path)
    assert isinstance(scanned.error, LedgerError)
    assert row.words in str(scanned.error)
    assert "Repeat the missing projections, or reconstruct without these projections" in str(scanned.error)
    assert [index - table.FIRST_VIEW for index in scanned.error.missing] == list(row.missing)
    assert_reported_once(scanned)
    assert_at_rest(rig, scanned)
    assert_kept(scanned, [view for view in range(VIEWS) if view not in row.missing], row.invalid)
