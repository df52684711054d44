"""The trade-off: which trials it compares, and its command."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.features.trials import runner
from beamline.features.trials.trial import MethodTrial, Outcome
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import TwoCylinders, write_exchange

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_exchange(tmp_path / "scan.h5", SCAN)
    return tmp_path


@pytest.fixture
def quick_trials(monkeypatch: pytest.MonkeyPatch) -> list[MethodTrial]:
    seen: list[MethodTrial] = []

    def trial(trial: MethodTrial, *_: object) -> tuple[Outcome, None]:
        seen.append(trial)
        return Outcome(trial, "done", float(len(seen)), 10**8, {"residual_held_out": 1 / (1 + len(seen))}), None

    monkeypatch.setattr(runner, "run_trial", trial)
    return seen


def test_the_table_is_on_stdout_and_the_rest_on_stderr(folder: Path, quick_trials: list[MethodTrial]) -> None:
    result = beamline("tradeoff", "scan.h5", "--axis", "20.7", "--methods", "fbp", "--views", "fixed:20")
    assert result.exit_code == 0, result.output
    assert (folder / "scan_tradeoff" / "tradeoff.html").is_file()
    assert "fbp, 20 views" in result.stdout and "s a dB" in result.stdout
    assert "1/2 fbp, 20 views" in result.stderr and "1/2" not in result.stdout
    assert result.stdout.split()[-1] == str(Path("scan_tradeoff/tradeoff.html"))
    assert [t.views for t in quick_trials] == [20, 10]


def test_ctrl_c_is_exit_code_4_with_a_table(
    folder: Path, monkeypatch: pytest.MonkeyPatch, quick_trials: list[MethodTrial]
) -> None:
    trial = vars(runner)["run_trial"]

    def interrupted(*arguments: Any) -> Any:
        if len(quick_trials) == 2:
            signal.raise_signal(signal.SIGINT)
        return trial(*arguments)

    monkeypatch.setattr(runner, "run_trial", interrupted)
    result = beamline("tradeoff", "scan.h5", "--axis", "20.7", "-o", "out")
    assert result.exit_code == 4, result.output
    assert "after 2 of" in result.stderr
    assert "fbp, 27 views" in result.stdout and "interrupted" in result.stdout and "not run" in result.stdout
    assert {"tradeoff.csv", "tradeoff.html"} < left(folder / "out")
