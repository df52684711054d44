"""`beamline study`: the table with its figures, rows that are left out, and what an interruption leaves."""

from __future__ import annotations

import csv
import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.features.trials import runner
from beamline.features.trials.run_trial import TrialData, averaged
from beamline.features.trials.trial import MethodTrial, Outcome
from recon.base.volume import Grid, Volume
from recon.judgement import contrast
from tests.beamline.cli.small_scan import beamline
from tests.beamline.html_page import parsed_page
from tests.beamline.scans import TwoCylinders, write_exchange

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 1.875)), shape=(4, 40))  # 96 views
ERROR = 1e-3  # 1/mm, of every voxel that a row reconstructs


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[MethodTrial, TrialData]]:
    """Rows are off the truth by ERROR everywhere; the FBP of all views is the truth."""
    found: list[tuple[MethodTrial, TrialData]] = []

    def trial(trial: MethodTrial, data: TrialData) -> tuple[Outcome, NDArray[np.float32]]:
        grid = Grid.matching(data.geometry)
        volume = SCAN.truth(grid) + np.float32(ERROR if found else 0)
        figures, _ = data.measured(trial, Volume(volume, grid))
        assert trial.choice is not None
        found.append((trial, replace(data, views=averaged(data.views, trial.choice))))
        return Outcome(trial, "done", 2.0, 10**8, figures, cpu_seconds=1.0), volume

    monkeypatch.setattr(runner, "run_trial", trial)
    return found


def _rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "study.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_rows_are_compared_with_the_volume_of_all_views_and_with_the_truth(folder: Path, seen: list[Any]) -> None:
    write_exchange(folder / "many.h5", SCAN)
    truth = SCAN.truth(Grid((4, 40, 40)))
    np.save(folder / "truth.npy", truth)
    result = beamline("study", "fixed-views", "many.h5", "--axis", "20.7", "--truth", "truth.npy", "-m", "fbp")
    assert result.exit_code == 0, result.output
    rows = _rows(folder / "many_fixed-views")
    assert [(row["views"], row["status"]) for row in rows] == [
        ("0", "not run"), ("0", "not run"), ("90", "done"), ("45", "done"),
    ]  # fmt: skip
    assert "asks for 360 projections" in rows[0]["message"] and "fixed, 360 views is left out" in result.stderr
    peak = 20 * np.log10(truth.max() / ERROR)
    grid = Grid((4, 40, 40))
    contrasts = contrast(Volume(truth, grid), {"row": Volume(truth + np.float32(ERROR), grid)}, 0)["row"]
    for row in rows[2:]:
        figures = {name: float(row[name]) for name in ("psnr_all", "psnr", "ssim_all", "ssim3d", "snr", "cnr")}
        assert figures["psnr_all"] == pytest.approx(peak, abs=1e-3) == figures["psnr"]
        assert figures["ssim_all"] == pytest.approx(figures["ssim3d"]) and 0 < figures["ssim3d"] < 1
        assert {name: figures[name] for name in ("snr", "cnr")} == pytest.approx(contrasts, abs=1e-3)  # as of `recon`
    first, *others = seen
    assert first[1].geometry.n_views == 96
    assert {trial.settings["filter"] for trial, _ in seen} == {"hann"}  # one filter, so that all views are "equal"
    assert [data.geometry.n_views for _, data in others] == [90, 45]
    left = {path.name for path in (folder / "many_fixed-views").iterdir()}
    assert left == {"study.csv", "report.html", "quality.png", "slices.png", "slices_fbp.png"}
    assert [row["frames"] for row in rows[2:]] == ["90", "45"]
    page = parsed_page((folder / "many_fixed-views" / "report.html").read_text(encoding="utf-8"))
    assert f"{peak:.2f}" in page.text and any("asks for 360 projections" in text for text in page.text)


def test_every_method_gets_the_options_that_it_takes(folder: Path, seen: list[Any]) -> None:
    write_exchange(folder / "many.h5", SCAN)
    methods = ("-m", "r2", "-m", "sirt", "-m", "fbp")
    result = beamline(
        "study", "fixed-views", "many.h5", "--axis", "20.7", *methods, "--steps", "50", "--iterations", "7",
        "--filter", "ram-lak",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    settings = {"r2": {"steps": 50}, "sirt": {"iterations": 7}, "fbp": {"filter": "ram-lak"}}
    assert {trial.method for trial, _ in seen} == set(settings)
    assert all(trial.settings == settings[trial.method] for trial, _ in seen)
    assert "r2: steps 50." in result.stdout and "sirt: iterations 7." in result.stdout
    assert (folder / result.stdout.split()[-1]).read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


def test_in_equal_time_all_but_direct_methods_have_it(folder: Path, seen: list[Any]) -> None:
    write_exchange(folder / "many.h5", SCAN)
    result = beamline("study", "fixed-views", "many.h5", "--axis", "20.7", "-m", "sirt", "-m", "fbp", "--seconds", "3")
    assert result.exit_code == 0, result.output
    assert [trial.seconds_asked for trial, _ in seen] == [None, 3.0, 3.0, None, 3.0, None]
    assert "Each reconstruction had 3 s" in result.stdout


def test_windows_reach_the_method_as_means_of_light(folder: Path, seen: list[Any]) -> None:
    write_exchange(folder / "many.h5", replace(SCAN, angles=np.radians(np.arange(0, 180, 0.5)), shape=(2, 40)))
    result = beamline("study", "window-average", "many.h5", "--axis", "20.7", "-m", "fbp", "--json")
    assert result.exit_code == 0, result.output
    whole, *rows = (data for _, data in seen)
    mean = rows[3]  # after three of single views: two views side by side
    assert mean.geometry.n_views == 180
    light = np.exp(-whole.views.data.astype(np.float64)).reshape(180, 2, 2, 40).mean(axis=1)
    np.testing.assert_allclose(mean.views.data, -np.log(light), atol=1e-5)
    np.testing.assert_allclose(np.degrees(mean.geometry.angles), np.arange(180) + 0.25, atol=1e-6)
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert (events[0]["event"], events[-1]["event"], events[-1]["done"]) == ("trials_started", "done", len(rows))


def test_ctrl_c_leaves_the_rows_done_and_says_so(
    folder: Path, seen: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_exchange(folder / "many.h5", SCAN)
    trial = vars(runner)["run_trial"]

    def interrupted(*arguments: Any) -> Any:
        if len(seen) == 3:
            signal.raise_signal(signal.SIGINT)
        return trial(*arguments)

    monkeypatch.setattr(runner, "run_trial", interrupted)
    result = beamline("study", "random", "many.h5", "--axis", "20.7", "-m", "fbp", "--draws", "2", "-o", "out")
    assert result.exit_code == 4, result.output
    assert "stopped after 2 of 6 trials" in result.stderr and "interrupted" in result.stdout
    done = [row["row"] for row in _rows(folder / "out") if row["status"] == "done"]
    assert done == ["fixed, 90 views", "random, 90 views, draw 1"]
    assert (folder / "out" / "report.html").is_file() and not (folder / "out" / "work").exists()
