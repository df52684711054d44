"""Plan of a queue: the sums of the scans that can run, as text and as JSON, and the disk for all of them."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from beamline.config.load import config_folder
from beamline.core.errors import ConfigError
from beamline.core.events import json_of
from beamline.scan.queue_plan import queue_of
from beamline.scan.queue_planning import plan_queue

SIMULATED = config_folder() / "simulated.yaml"


def test_a_disk_that_cannot_hold_all_is_a_fault_of_the_queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = plan_queue([SIMULATED] * 3, place=tmp_path).scans
    each = scans[0].needs.total_bytes
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=3 * each))
    plan = queue_of(scans)
    assert [scan.valid for scan in plan.scans] == [True] * 3 and not plan.valid
    assert (plan.free_bytes, plan.needs.total_bytes) == (3 * each, 3 * each)
    with pytest.raises(ConfigError, match=r"the scans do not fit on the disk:\n  all scans that can run need 60\.7 MB"):
        plan.refuse_impossible()
    assert queue_of(scans[:2]).valid and queue_of(()).valid


def test_the_table_has_one_value_a_cell_and_the_json_every_value(tmp_path: Path) -> None:
    plan = plan_queue([SIMULATED, tmp_path / "none.yaml"], ["optics.dose_rate_gy_s=1"], place=tmp_path)
    head, good, bad, *rest = plan.lines()[0].split("\n") + plan.lines()[1:]

    def cells(line: str) -> list[str]:
        return [cell.strip() for cell in line.split("  ") if cell]

    assert cells(head) == [
        "scan", "from", "can run", "frames", "size (MB)", "time (h:min:s)", "requests", "dose (Gy)",
    ]  # fmt: skip
    assert cells(good) == ["battery", str(SIMULATED), "yes", "390", "20.2", "0:00:44", "0", "36.43"]
    assert cells(bad) == ["-", str(tmp_path / "none.yaml"), "no", *5 * "-"]
    assert "2 scans, 1 can run: 20.2 MB of " in rest[-1] and "at most 0:30:00 for the live volumes" in rest[-1]
    data = plan.data()
    assert data["duration"] == data["scans"][0]["duration"] == plan.scans[0].needs.duration
    assert data["scans"][0]["parts"] == {**plan.scans[0].needs.parts} and data["scans"][1]["duration"] == 0
    assert '"faults": [{"message": ' in json_of(data) and '"file": null' not in json_of(data["scans"])
    assert '"line": null' in json_of(data["scans"][1])
