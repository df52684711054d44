"""A complete comparison: its files, what remains if it is interrupted, and the end of its processes."""

from __future__ import annotations

import csv
import errno
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.core.events import Event
from beamline.features.trials import runner
from beamline.features.trials.runner import ComparedScan, run_comparison
from beamline.features.trials.table import text
from beamline.features.trials.tradeoff import planned_tradeoff
from beamline.features.trials.trial import MethodTrial, Outcome, TrialTable
from beamline.projections.selection import Selection
from beamline.storage.readers.open import SourceOptions
from drivers.base.clock import SystemClock
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from tests.beamline.cli.small_scan import left
from tests.beamline.scans import TwoCylinders, write_exchange

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))
FILES = {"tradeoff.csv", "tradeoff.html", "quality.png"}


def _options(tmp_path: Path, **changes: Any) -> ComparedScan:
    if not (tmp_path / "scan.h5").exists():
        write_exchange(tmp_path / "scan.h5", SCAN)
    scan = ComparedScan(SourceOptions(tmp_path / "scan.h5"), Selection(axis_col=SCAN.axis_col))
    return replace(scan, **{"methods": ("r2", "fbp"), "command": "beamline tradeoff scan.h5", **changes})


def run_tradeoff(scan: ComparedScan, sink: Callable[[Event], None] = lambda e: None) -> TrialTable:
    return run_comparison(
        partial(planned_tradeoff, scan), scan.source.path, Path(scan.source.path).parent / "out", sink, SystemClock()
    )


def _made_up(trial: MethodTrial, *_: object) -> tuple[Outcome, Any]:
    """A trial that takes no time: more work gives more quality, for more seconds and memory."""
    amount = float(int(trial.settings.get("steps") or 20) * trial.views)
    metrics = {"residual_held_out": 1 / amount, "psnr": math.log(amount)}
    return Outcome(trial, "done", amount / 1000, int(1e6 * amount), metrics), np.zeros((4, 40, 40), np.float32)


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., Any]], None]:
    def use(trial: Callable[..., Any]) -> None:
        monkeypatch.setattr(runner, "run_trial", trial)

    use(_made_up)
    return use


def _rows(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "tradeoff.csv").read_text(encoding="utf-8").splitlines()))


@pytest.mark.usefixtures("real_pictures")
def test_all_that_is_promised_is_in_the_folder(tmp_path: Path, made_up: object) -> None:
    events: list[Event] = []
    table = run_tradeoff(_options(tmp_path), events.append)
    assert left(tmp_path / "out") == FILES | {"slices.png"}
    rows = _rows(tmp_path / "out")
    assert [row["status"] for row in rows] == ["done"] * len(table.outcomes)
    for row, outcome in zip(rows, table.outcomes, strict=True):
        assert float(row["seconds"]) == outcome.seconds
        assert float(row["quality_db"]) == pytest.approx(20 * math.log10(1000 * outcome.seconds))
    page = (tmp_path / "out" / "tradeoff.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2
    assert all(outcome.trial.label in page for outcome in table.compared)
    names = [event.event for event in events if event.event != "progress"]
    assert names == ["trials_started", *["trial"] * len(rows), "done"]
    said, first = next(e.data for e in events if e.event == "trial"), table.outcomes[0].trial
    assert {name: said[name] for name in first.settings} == first.settings and said["views"] == first.views


def test_with_a_truth_no_view_is_held_out(tmp_path: Path, made_up: object) -> None:
    np.save(tmp_path / "truth.npy", SCAN.truth(Grid.matching(Geometry.parallel([0.0], SCAN.shape))))
    table = run_tradeoff(_options(tmp_path, truth=str(tmp_path / "truth.npy")))
    assert table.by == "psnr" and max(outcome.trial.views for outcome in table.outcomes) == 30


@pytest.mark.parametrize("done", [0, 3])
def test_ctrl_c_leaves_the_trials_done_so_far(tmp_path: Path, made_up: Any, done: int) -> None:
    begun: list[MethodTrial] = []

    def interrupted(trial: MethodTrial, *_: object) -> Any:
        begun.append(trial)
        if len(begun) > done:
            raise KeyboardInterrupt
        return _made_up(trial)

    made_up(interrupted)
    if not done:
        with pytest.raises(KeyboardInterrupt):
            run_tradeoff(_options(tmp_path))
        assert left(tmp_path) == {"scan.h5"}
        return
    table = run_tradeoff(_options(tmp_path))
    assert table.stopped and len(table.compared) == 3
    rows = _rows(tmp_path / "out")
    assert [row["status"] for row in rows] == ["done"] * 3 + ["interrupted"] + ["not run"] * (len(rows) - 4)
    assert left(tmp_path / "out") == FILES | {"slices.png"}


def _full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")  # as a write reports it: without a name


def test_a_full_disk_names_the_file_and_is_not_in_the_way_of_the_next_try(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made_up: object
) -> None:
    options = _options(tmp_path)
    with monkeypatch.context() as full:
        full.setattr(Path, "write_bytes", _full)
        with pytest.raises(DataError, match=r"tradeoff\.csv could"):
            run_tradeoff(options)
    assert left(tmp_path) == {"scan.h5"}
    assert run_tradeoff(options).compared


def test_a_trial_that_fails_is_a_line_of_the_table(tmp_path: Path, made_up: Any) -> None:
    made_up(lambda trial, *_: (Outcome(trial, "failed", message="no room"), None))
    table = run_tradeoff(_options(tmp_path))
    assert "failed: no room" in text(table) and "No trial has both" in text(table)
    assert "failed: no room" in (tmp_path / "out" / "tradeoff.html").read_text(encoding="utf-8")
    assert left(tmp_path / "out") == {"tradeoff.csv", "tradeoff.html"}
