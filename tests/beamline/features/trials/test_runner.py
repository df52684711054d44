"""A comparison as a whole: what is written, what is left when it is ended, and that its processes end."""

from __future__ import annotations

import csv
import errno
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event
from beamline.features.trials import runner, tradeoff
from beamline.features.trials.front import TRADEOFF
from beamline.features.trials.launch import ComparedScan
from beamline.features.trials.layout import text
from beamline.features.trials.runner import run_comparison
from beamline.features.trials.tradeoff import planned_tradeoff
from beamline.features.trials.trial import Outcome, Trial, TrialTable
from beamline.projections.scan_statistics import LightAsked
from beamline.projections.selection import Selection
from beamline.storage.readers.open import SourceOptions
from drivers.base.clock import SystemClock
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from tests.beamline.cli.small_scan import left
from tests.beamline.scans import TwoCylinders, write_exchange

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))
FIGURES = {"quality_seconds.png", "quality_memory.png", "quality_dose.png"}
TABLES = {"tradeoff.json", "tradeoff.csv", "tradeoff.html"}


def _options(tmp_path: Path, **changes: Any) -> ComparedScan:
    if not (tmp_path / "scan.h5").exists():
        write_exchange(tmp_path / "scan.h5", SCAN)
    scan = ComparedScan(SourceOptions(tmp_path / "scan.h5"), Selection(axis_col=SCAN.axis_col), tmp_path / "out")
    return replace(scan, **{"methods": ("r2", "fbp"), "command": "beamline tradeoff scan.h5", **changes})


def run_tradeoff(scan: ComparedScan, *how: Any, **more: Any) -> TrialTable:
    return run_comparison(partial(planned_tradeoff, scan), scan, *how, **more)


def _made_up(trial: Trial, *_: object, keep: Path | None = None) -> Outcome:
    """A trial that takes no time: more work gives more quality, for more seconds and memory."""
    if keep is not None:
        np.save(keep, np.zeros((4, 5, 6), np.float32))
    amount = float((trial.settings.get("steps") or 20) * trial.views / trial.binning)
    metrics = {"residual_held_out": 1 / amount, "psnr": math.log(amount)}
    return Outcome(trial, "done", amount / 1000, int(1e6 * amount), metrics, curve=((0.1, 10.0), (0.2, 11.0)))


@pytest.fixture(autouse=True)
def _nothing_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "compile_kernels", lambda *_: None)


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., Outcome]], None]:
    def use(trial: Callable[..., Outcome]) -> None:
        monkeypatch.setattr(runner, "run_trial", trial)

    use(_made_up)
    return use


def _rows(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "tradeoff.csv").read_text(encoding="utf-8").splitlines()))


@pytest.mark.usefixtures("real_pictures")
def test_all_that_is_promised_is_in_the_folder(tmp_path: Path, made_up: object) -> None:
    events: list[Event] = []
    table = run_tradeoff(_options(tmp_path), events.append, SystemClock())
    assert left(tmp_path / "out") == TABLES | FIGURES | {"curves.png", "slices.png"}
    record = json.loads((tmp_path / "out" / "tradeoff.json").read_text(encoding="utf-8"))
    rows = _rows(tmp_path / "out")
    assert len(record["trials"]) == len(rows) == len(table.outcomes)
    assert [row["status"] for row in rows] == ["done"] * len(rows)
    assert record["quality"] == "residual_held_out"
    for row, outcome in zip(rows, table.outcomes, strict=True):
        assert float(row["seconds"]) == outcome.seconds
        assert float(row["quality_db"]) == pytest.approx(20 * math.log10(1000 * outcome.seconds))
    page = (tmp_path / "out" / "tradeoff.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 5
    assert all(outcome.trial.label in page for outcome in table.compared)
    assert [e.event for e in events if e.event != "progress"] == [
        "tradeoff_started", "state", *["trial"] * len(rows), "done"
    ]  # fmt: skip
    progress = [e.data for e in events if e.event == "progress"]
    assert [p["n"] for p in progress] == list(range(len(rows)))
    assert progress[0]["eta_s"] is None and progress[-1]["eta_s"] >= 0


def test_each_trial_has_the_photons_of_its_views(tmp_path: Path, made_up: object) -> None:
    options = _options(tmp_path, light=LightAsked(2.0))
    table = run_tradeoff(options, lambda e: None, SystemClock())
    with options.source.open() as source:
        counts = source.read(range(len(source.image_key))).astype(float)
        flats, darks = (counts[source.image_key == kind].mean() for kind in (FrameKind.FLAT, FrameKind.DARK))
    photons = 2 * (flats - darks)
    assert "in 30 views" in table.scan["light"] and table.dose.axis == "photons a pixel in the open beam"
    for row, outcome in zip(_rows(tmp_path / "out"), table.outcomes, strict=True):
        assert float(row["photons"]) == pytest.approx(photons * outcome.trial.views)


def test_with_a_truth_no_view_is_kept_back(tmp_path: Path, made_up: object) -> None:
    grid = Grid.matching(Geometry.parallel([0.0], SCAN.shape))
    np.save(tmp_path / "truth.npy", SCAN.truth(grid))
    seen: list[Trial] = []
    made_up(lambda trial, *rest, keep=None: seen.append(trial) or _made_up(trial))  # type: ignore[operator, func-returns-value]
    table = run_tradeoff(_options(tmp_path, truth=str(tmp_path / "truth.npy")), lambda e: None, SystemClock())
    assert table.by == "psnr"
    assert max(trial.views for trial in seen) == 30


def test_ctrl_c_leaves_the_trials_done_so_far(tmp_path: Path, made_up: Any) -> None:
    done: list[Trial] = []

    def interrupted(trial: Trial, *_: object, keep: Path | None = None) -> Outcome:
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(trial)
        return _made_up(trial)

    made_up(interrupted)
    events: list[Event] = []
    table = run_tradeoff(_options(tmp_path), events.append, SystemClock())
    assert table.stopped and len(table.compared) == 3
    rows = _rows(tmp_path / "out")
    assert [row["status"] for row in rows] == ["done"] * 3 + ["interrupted"] + ["not run"] * (len(rows) - 4)
    assert "interrupted: ended before it was done" in text(table, TRADEOFF)
    assert left(tmp_path / "out") >= TABLES | FIGURES
    assert "work" not in left(tmp_path / "out")
    assert events[-1].event == "done" and events[-1].data["stopped"]


@pytest.mark.parametrize("where", ["run_trial", "compile_kernels"])
def test_ctrl_c_before_the_first_trial_is_done_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    def interrupted(*_: object, **__: object) -> Outcome:
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, where, interrupted)
    events: list[Event] = []
    with pytest.raises(KeyboardInterrupt):
        run_tradeoff(_options(tmp_path), events.append, SystemClock())
    assert left(tmp_path) == {"scan.h5"}
    assert events[-1].event != "done"


def _full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")  # as a write tells it: without a name


@pytest.mark.parametrize(("where", "name"), [((np, "save"), ".npy"), ((Path, "write_bytes"), "tradeoff.json")])
def test_a_full_disk_names_the_file_and_is_not_in_the_way_of_the_next_try(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made_up: object, where: tuple[object, str], name: str
) -> None:
    options = _options(tmp_path)
    with monkeypatch.context() as full:
        full.setattr(*where, _full)
        with pytest.raises(DataError, match=rf"{re.escape(name)} could"):
            run_tradeoff(options, lambda e: None, SystemClock())
    assert left(tmp_path) == {"scan.h5"}
    assert run_tradeoff(options, lambda e: None, SystemClock()).compared


def test_a_disk_that_is_full_later_keeps_the_trials_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made_up: Any
) -> None:
    def filling(trial: Trial, *_: object, keep: Path | None = None) -> Outcome:
        if trial.views != 27:
            monkeypatch.setattr(Path, "write_bytes", _full)
        return _made_up(trial)

    made_up(filling)
    with pytest.raises(DataError, match=r"tradeoff\.json"):
        run_tradeoff(_options(tmp_path), lambda e: None, SystemClock())
    assert [row["status"] for row in _rows(tmp_path / "out")][:2] == ["done", "done"]
    assert left(tmp_path / "out") == {"tradeoff.json", "tradeoff.csv"}


def test_events_and_page_tell_the_settings_and_short_times(tmp_path: Path, made_up: Any) -> None:
    def short(trial: Trial, *_: object, keep: Path | None = None) -> Outcome:
        made = _made_up(trial)
        return replace(made, seconds=made.seconds * 1e-4, cpu_seconds=made.seconds * 1e-4)

    made_up(short)
    events: list[Event] = []
    table = run_tradeoff(_options(tmp_path), events.append, SystemClock())
    told = next(e.data for e in events if e.event == "trial")
    first = table.outcomes[0]
    assert {name: told[name] for name in first.trial.settings} == first.trial.settings
    assert {"steps", "gaussians"} == set(first.trial.settings) and told["views"] == first.trial.views
    assert told["cpu_seconds"] == first.cpu_seconds
    page = (tmp_path / "out" / "tradeoff.html").read_text(encoding="utf-8")
    said = text(table, TRADEOFF)
    assert "* on" not in page and "Bold: on the front" in page
    assert "*: on the front" in said
    for words in (said, page):
        assert "0.00 s" not in words and " µs" in words and ">0.00<" not in words
    fbp = next(o for o in table.compared if o.trial.method == "fbp")
    assert f"{fbp.seconds:.2e}".replace("e-0", "e-") in said  # 5.40e-05 s: three digits where two decimals say 0.00


def test_a_limit_of_time_bounds_reading_compiling_and_the_page(
    tmp_path: Path, made_up: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a clock on which reading takes 20 s, compiling 10 s and each trial a time that goes with its work."""
    at = 0.0

    def passing(seconds: float, then: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            nonlocal at
            at += seconds
            return then(*args, **kwargs)

        return run

    def trial(one: Trial, work: Path, seed: int, left: float, keep: Path | None) -> Outcome:
        nonlocal at
        outcome = _made_up(one, keep=keep)
        taken = outcome.seconds * (3 if one.halves else 1)
        at += min(2 + taken, left)
        return outcome if 2 + taken <= left else Outcome(one, "out of time")

    monkeypatch.setattr(tradeoff, "opened_scan", passing(20.0, tradeoff.opened_scan))
    monkeypatch.setattr(runner, "compile_kernels", passing(10.0, lambda *_: None))
    made_up(trial)
    table = run_tradeoff(_options(tmp_path, max_seconds=55.0), lambda e: None, SystemClock(), lambda: at)
    assert at <= 50.0
    done = [outcome.trial for outcome in table.compared]
    assert [each.method for each in done[:2]] == ["fbp", "r2"]  # each method once, the direct one first
    assert not any(each.halves for each in done)
    left_out = [outcome for outcome in table.outcomes if outcome.status == "not run" and outcome.message]
    assert left_out and any("not begun: it would take about" in outcome.message for outcome in left_out)
    assert len(left_out) == len(table.outcomes) - len(table.compared)  # each that is left out says so


def test_the_time_that_passed_before_the_run_counts(tmp_path: Path, made_up: Any) -> None:
    limits: list[float] = []

    def timed(trial: Trial, work: Path, seed: int, left: float, keep: Path | None) -> Outcome:
        limits.append(left)
        return _made_up(trial)

    made_up(timed)
    run_tradeoff(_options(tmp_path, max_seconds=60.0), lambda e: None, SystemClock(), lambda: 100.0, begun=80.0)
    assert set(limits) == {60.0 - 20.0 - 5.0}


def test_a_trial_that_fails_is_a_line_of_the_table(tmp_path: Path, made_up: Any) -> None:
    def failing(trial: Trial, *_: object, keep: Path | None = None) -> Outcome:
        return Outcome(trial, "failed", message="no room") if trial.method == "fbp" else _made_up(trial)

    made_up(failing)
    table = run_tradeoff(_options(tmp_path), lambda e: None, SystemClock())
    assert "failed: no room" in text(table, TRADEOFF)
    assert "failed: no room" in (tmp_path / "out" / "tradeoff.html").read_text(encoding="utf-8")
    made_up(lambda trial, *_, **__: Outcome(trial, "failed", message="no room"))
    table = run_tradeoff(_options(tmp_path, folder=tmp_path / "b"), lambda e: None, SystemClock())
    assert "No trial has both" in text(table, TRADEOFF)
    assert left(tmp_path / "b") == TABLES


@pytest.mark.parametrize(
    ("changes", "error", "said"),
    [
        ({"folder": Path()}, DataError, "never overwritten"),
        ({"folder": Path("no/such/folder")}, DataError, "does not exist"),
        ({"truth": "missing.npz"}, ConfigError, "missing.npz"),
        ({"light": LightAsked(1.0, "water")}, ConfigError, "--dose-in needs"),
        ({"selection": Selection(views="first:1")}, ConfigError, "at least 2"),
    ],
)
def test_what_cannot_be_done_leaves_nothing(
    tmp_path: Path, changes: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        run_tradeoff(_options(tmp_path, **changes), lambda e: None, SystemClock())
    assert left(tmp_path) == {"scan.h5"}


def test_two_views_leave_none_to_judge_by(tmp_path: Path) -> None:
    few = TwoCylinders(angles=np.radians([0.0, 90.0]), shape=(4, 40))
    write_exchange(tmp_path / "scan.h5", few)
    with pytest.raises(ConfigError, match="--truth"):
        run_tradeoff(_options(tmp_path), lambda e: None, SystemClock())
