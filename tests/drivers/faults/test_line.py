"""Faults of the serial line for every controller, and a pulled plug, in each phase of a scan."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.drivers.faults import table
from tests.drivers.faults.aftermath import (
    assert_at_rest,
    assert_complete,
    assert_kept,
    assert_known_to_be_unsafe,
    assert_next_scan_works,
    assert_reported_once,
    assert_speaks,
)
from tests.drivers.faults.rig import KINDS, Phase, Rig
from tests.slow_cases import others_slow

RigOf = Callable[[str], Rig]


def test_the_table_speaks_of_every_controller() -> None:
    table.applies()


@pytest.mark.parametrize("kind", others_slow(KINDS))
def test_without_a_fault_a_scan_is_complete(rig_of: RigOf, kind: str, tmp_path: Path) -> None:
    rig = rig_of(kind)
    scanned = rig.scan(tmp_path)
    assert_complete(scanned)
    assert scanned.warnings == []
    assert_at_rest(rig, scanned)
    assert rig.cable.phase is Phase.GOING_BACK


@pytest.mark.parametrize(
    ("row", "kind", "phase"),
    [
        pytest.param(row, kind, phase, id=f"{row.fault}-{kind}-{phase.name.lower()}", marks=table.slow_but(kind))
        for row in table.LINE
        for kind in KINDS
        if kind not in row.not_on
        for phase in table.phases_of(kind, row)
    ],
)
def test_one_bad_reply(rig_of: RigOf, row: table.LineFault, kind: str, phase: Phase, tmp_path: Path) -> None:
    rig = rig_of(kind)
    rig.cable.spoil(phase, lambda reply: row.spoil(rig, reply))
    scanned = rig.scan(tmp_path)
    assert rig.cable.spoilt, "the fault did not happen"
    assert_at_rest(rig, scanned)
    if kind in row.harmless_on:
        assert_complete(scanned)
        assert scanned.warnings == []
    else:
        assert isinstance(scanned.error, row.error)
        assert row.words in str(scanned.error)
        assert_speaks(scanned.error, "stage", row.replied)
        if phase is Phase.OPENING:
            assert scanned.folder is None
            assert "Nothing has moved" in str(scanned.error)
        else:
            assert_reported_once(scanned)
            assert_kept(scanned)
            assert "the stage may be turning" in str(scanned.error)
    if phase is table.phases_of(kind, row)[-1]:
        assert_next_scan_works(rig, tmp_path)


@pytest.mark.parametrize(
    ("kind", "phase"),
    [
        pytest.param(kind, phase, id=f"{kind}-{phase.name.lower()}", marks=table.slow_but(kind))
        for kind in KINDS
        for phase in (list(Phase) if kind == table.CAMERA_KIND else [Phase.TURNING])
    ],
)
def test_stage_unplugged(rig_of: RigOf, kind: str, phase: Phase, tmp_path: Path) -> None:
    rig = rig_of(kind)
    rig.cable.unplug(phase)
    scanned = rig.scan(tmp_path)
    assert_speaks(scanned.error, "stage", replied=False)
    assert f"{table.PORT_FAILED}: device disconnected" in str(scanned.error)
    if phase is Phase.OPENING:
        assert scanned.folder is None
        assert_at_rest(rig, scanned)
    else:
        assert_reported_once(scanned)
        assert_known_to_be_unsafe(rig, scanned)
        assert_kept(scanned)
    if phase in (Phase.OPENING, Phase.TURNING):
        assert_next_scan_works(rig, tmp_path, "" if phase is Phase.OPENING else table.NOT_RESTORED[kind])


@pytest.mark.parametrize("kind", others_slow(KINDS))
def test_stage_unplugged_while_it_turns_and_nobody_asks_it(rig_of: RigOf, kind: str, tmp_path: Path) -> None:
    """Every pulse still comes, so that every view is in the file; then the stage does not answer."""
    rig = rig_of(kind)
    rig.at_frame[table.FIRST_VIEW + 5] = rig.cable.pull
    scanned = rig.scan(tmp_path)
    assert_speaks(scanned.error, "stage", replied=False)
    assert_reported_once(scanned)
    assert_known_to_be_unsafe(rig, scanned)
    assert_kept(scanned, list(range(12)))


def test_a_scan_begun_while_an_unplugged_stage_still_turns_is_refused(rig_of: RigOf, tmp_path: Path) -> None:
    rig = rig_of(table.CAMERA_KIND)
    rig.cable.unplug(Phase.TAXI)
    rig.scan(tmp_path)
    rig.repair()
    assert rig.moving
    scanned = rig.scan(tmp_path)
    assert "opening is not possible while it moves" in str(scanned.error)
    assert scanned.folder is None
    assert_next_scan_works(rig, tmp_path, table.NOT_RESTORED[table.CAMERA_KIND])
