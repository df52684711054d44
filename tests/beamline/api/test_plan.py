"""`api.plan`: files, tables, rows and values of several scans in one call, without a device."""

from __future__ import annotations

from pathlib import Path

import pytest

from beamline import api
from beamline.config.load import config_folder

SIMULATED = config_folder() / "simulated.yaml"


def test_files_tables_and_rows_are_planned_together(tmp_path: Path) -> None:
    table = tmp_path / "day.csv"
    table.write_text(f"config,sample.name\n{SIMULATED},a\nnone.yaml,b\n", "utf-8")
    row = {"config": str(SIMULATED), "sample.name": "c", "scan.exposure_s": 0.02}
    plan = api.plan([str(SIMULATED), table, row], set={"scan.angles.views": 120}, output=tmp_path)
    assert [scan.sample for scan in plan.scans] == ["battery", "a", "", "c"]
    assert [scan.valid for scan in plan.scans] == [True, True, False, True] and not plan.valid
    assert {scan.needs.n_frames for scan in plan.scans if scan.valid} == {150}
    assert "none.yaml does not exist" in str(plan.scans[2].faults[0])
    assert plan.needs.volume_seconds == 3 * 1800.0
    assert api.plan([SIMULATED], output=tmp_path, live=False).needs.volume_seconds == 0.0
    assert isinstance(plan, api.QueuePlan) and isinstance(plan.scans[0], api.PlannedScan)
    assert isinstance(plan.scans[2].faults[0], api.ScanFault)


def test_a_value_that_is_wrong_for_all_is_a_fault_of_each(tmp_path: Path) -> None:
    plan = api.plan([SIMULATED] * 2, set={"scan.modd": 1}, output=tmp_path)
    said = [str(fault) for scan in plan.scans for fault in scan.faults]
    assert len(said) == 2 and said[0].startswith("--set scan.modd=1: scan.modd is not a known key")
    with pytest.raises(api.ConfigError, match="object"):
        api.plan([SIMULATED], set={"scan.mode": object()})


def test_nothing_is_written_and_no_device_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("beamline.instrument.connect.connect", lambda *_, **how: pytest.fail("a device was used"))
    assert api.plan([SIMULATED, config_folder() / "instrument.yaml"], set={"scan.angles.views": 400}).scans
    assert list(tmp_path.iterdir()) == []


def test_a_list_is_expected() -> None:
    with pytest.raises(api.ConfigError, match=r"^scans must be "):
        api.plan(str(SIMULATED))
