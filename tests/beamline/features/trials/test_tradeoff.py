"""The trade-off: which trials it compares, and its command."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.energies import EnergyScans, read_spectra
from beamline.features.trials import runner
from beamline.features.trials.launch import ComparedScan, TrialData
from beamline.features.trials.tradeoff import planned_tradeoff
from beamline.features.trials.trial import Outcome, Trial, TrialTable
from beamline.projections.selection import Selection
from beamline.storage.readers.open import SourceOptions
from recon.base.geometry import Geometry
from simulators.samples.materials.materials import known
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.features.materials.test_command import ENERGIES, scans, spectra  # noqa: F401 - scans is a fixture
from tests.beamline.scans import TwoCylinders, write_exchange

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))


def asked(path: Path, axis_col: float) -> ComparedScan:
    return ComparedScan(SourceOptions(path), Selection(axis_col=axis_col), path.parent / "out", ("fbp",))


def planned(scan: ComparedScan, warn: Callable[[str], None], **several: Any) -> tuple[TrialData, TrialTable]:
    planned = planned_tradeoff(scan, warn, **several)
    return planned.data, planned.table


def test_views_in_time_keep_their_times(tmp_path: Path) -> None:
    """The file states no times: views follow each other evenly, which a warning says."""
    path, said = write_exchange(tmp_path / "scan.h5", SCAN), list[str]()
    data, table = planned(asked(path, SCAN.axis_col), said.append, volumes=2)
    assert data.prepared.held_out is not None and data.truth is None and data.shown_held_out is not None
    angles = np.concatenate((data.geometry.angles, data.prepared.held_out[1].angles))
    shown = np.concatenate((data.shown, data.shown_held_out))
    np.testing.assert_allclose(np.degrees(angles) / 6, shown)  # a view each 6 degrees and second
    assert data.geometry.n_views == 27 and shown.size == 30
    assert any("no times of the views" in warning for warning in said)
    assert "over 29 s" in table.scan["views used"]
    assert [outcome.trial.group for outcome in table.outcomes] == ["method", "parts", "parts", *["one fit"] * 3]


def at_energies(files: list[Path], table: Path) -> EnergyScans:
    return EnergyScans(tuple(map(SourceOptions, files)), read_spectra(table))


def test_views_of_energies_keep_their_energies(scans: list[Path], tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("xraylib")
    several: dict[str, Any] = {"scans": at_energies(scans, spectra(tmp_path)), "states": ("fresh", "charged")}
    data, table = planned(asked(scans[0], 31.5), lambda said: None, **several)
    prepared, unseen = data.prepared, data.shown_held_out
    assert prepared.held_out is not None and prepared.energies is not None and unseen is not None
    assert data.geometry.n_views == 84 and prepared.held_out[1].n_views == 12
    assert np.bincount(np.concatenate((data.shown, unseen)).astype(int)).tolist() == [24] * 4
    oxide = known("NMC811")
    assert oxide is not None and prepared.energies.cross_sections.shape == (len(ENERGIES), 2)
    assert table.scan["materials"] == "fresh, charged"
    brightest = [max(float(image.max()) for image in prepared.projections.data[data.shown == e]) for e in range(4)]
    assert np.argmin(brightest) == 0  # below the edge
    assert [outcome.trial.method for outcome in table.outcomes] == ["fbp", "materials", "materials"]
    assert isinstance(prepared.held_out[1], Geometry)


def test_a_folder_that_exists_is_refused_before_scans_are_read(tmp_path: Path) -> None:
    pytest.importorskip("xraylib")
    (tmp_path / "out").mkdir()
    several = {"scans": at_energies([tmp_path / "none.h5"], spectra(tmp_path))}
    with pytest.raises(Exception, match="never overwritten"):
        planned(asked(tmp_path / "none.h5", 1.0), print, **several)


def test_states_that_are_no_materials_are_refused(scans: list[Path], tmp_path: Path) -> None:  # noqa: F811
    several: dict[str, Any] = {"scans": at_energies(scans, spectra(tmp_path)), "states": ("fresh", "full")}
    with pytest.raises(ConfigError, match="materials fresh, charged"):
        planned(asked(scans[0], 31.5), print, **several)


@pytest.fixture(autouse=True)
def _nothing_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "compile_kernels", lambda *_: None)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_exchange(tmp_path / "scan.h5", SCAN)
    return tmp_path


@pytest.fixture
def quick_trials(monkeypatch: pytest.MonkeyPatch) -> list[Trial]:
    seen: list[Trial] = []

    def trial(trial: Trial, *_: object, keep: Path | None) -> Outcome:
        seen.append(trial)
        return Outcome(trial, "done", float(len(seen)), 10**8, {"residual_held_out": 1 / (1 + len(seen))})

    monkeypatch.setattr(runner, "run_trial", trial)
    return seen


def test_the_table_is_on_stdout_and_the_rest_on_stderr(folder: Path, quick_trials: list[Trial]) -> None:
    result = beamline("tradeoff", "scan.h5", "--axis", "20.7", "--methods", "fbp", "--views", "fixed:20")
    assert result.exit_code == 0, result.output
    assert (folder / "scan_tradeoff" / "tradeoff.html").is_file()
    assert "fbp, 20 views" in result.stdout and "s a dB" in result.stdout
    assert "1/2 fbp, 20 views" in result.stderr and "1/2" not in result.stdout
    assert result.stdout.split()[-1] == str(Path("scan_tradeoff/tradeoff.html"))
    assert [t.views for t in quick_trials] == [20, 10]


def test_json_is_one_event_a_line(folder: Path, quick_trials: list[Trial]) -> None:
    result = beamline("tradeoff", "scan.h5", "--axis", "20.7", "--full", "--json", "-o", "out")
    assert result.exit_code == 0, result.output
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert (events[0]["event"], events[-1]["event"]) == ("tradeoff_started", "done")
    assert events[-1]["output"] == "out"
    assert events[0]["trials"] == len(quick_trials) > 10
    assert {"r2", "fbp"} <= {trial.method for trial in quick_trials}


def test_a_sample_that_changes_is_compared_by_parts_and_in_one_fit(folder: Path, quick_trials: list[Trial]) -> None:
    result = beamline("tradeoff", "scan.h5", "--axis", "20.7", "--methods", "fbp", "--time", "2")
    assert result.exit_code == 0, result.output
    assert [t.group for t in quick_trials] == ["method", "parts", "parts", "one fit", "one fit", "one fit"]
    assert "series, 27 views, 2 volumes, motion learnt" in result.stdout
    record = json.loads((folder / "scan_tradeoff" / "tradeoff.json").read_text(encoding="utf-8"))
    assert "--time 2" in record["command"] and record["trials"][2]["trial"]["parts"] == 4


def test_a_dry_run_says_what_would_run_and_writes_nothing(folder: Path, quick_trials: list[Trial]) -> None:
    asked = ("scan.h5", "--axis", "20.7", "--methods", "fbp,sirt", "--dry-run")
    result = beamline("tradeoff", *asked)
    assert result.exit_code == 0, result.output
    rows = [line.split() for line in result.stdout.splitlines() if line.startswith(("fbp", "sirt"))]
    said = {" ".join(row[:-2]): (float(row[-2]), float(row[-1])) for row in rows}
    assert list(said)[:2] == ["fbp, 27 views", "sirt, 27 views, 60 iterations"] and len(said) == 5
    assert said["sirt, 27 views, 60 iterations"][0] >= said["sirt, 27 views, 20 iterations"][0]
    assert "scan_tradeoff: tradeoff.csv" in result.stdout and not quick_trials
    assert left(folder) == {"scan.h5"}
    event = json.loads(beamline("tradeoff", *asked, "--json").stdout.splitlines()[-1])
    assert event["event"] == "done" and [trial["label"] for trial in event["trials"]] == list(said)


SIGNALS = [signal.SIGINT, signal.SIGTERM] + ([] if sys.platform == "win32" else [signal.SIGHUP])


def test_ctrl_c_is_exit_code_4_with_a_table(
    folder: Path, monkeypatch: pytest.MonkeyPatch, quick_trials: list[Trial]
) -> None:
    trial = runner.run_trial

    def interrupted(*arguments: Any, **named: Any) -> Outcome:
        if len(quick_trials) == 2:
            signal.raise_signal(signal.SIGINT)
        return trial(*arguments, **named)

    monkeypatch.setattr(runner, "run_trial", interrupted)
    result = beamline("tradeoff", "scan.h5", "--axis", "20.7", "-o", "out")
    assert result.exit_code == 4, result.output
    assert "after 2 of" in result.stderr
    assert "fbp, 27 views" in result.stdout and "interrupted" in result.stdout and "not run" in result.stdout
    assert {"tradeoff.json", "tradeoff.csv", "tradeoff.html"} < left(folder / "out")


@pytest.mark.parametrize("number", SIGNALS)
def test_ctrl_c_before_the_first_result_is_exit_code_130_and_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setattr(runner, "run_trial", lambda *_, **__: signal.raise_signal(number))
    result = beamline("tradeoff", "scan.h5", "--axis", "20.7", "-o", "out")
    assert result.exit_code == 130, result.output
    assert result.stderr.endswith("beamline: interrupted\n") and result.stdout == ""
    assert left(folder) == {"scan.h5"}


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (["--methods", "r2,magic"], 2, "magic"),
        (["--views", "fixed:31"], 2, "30"),
        (["--truth", "missing.npz"], 2, "missing.npz"),
        (["--max-seconds", "0"], 2, "0"),
        (["--max-seconds", "nan"], 2, "finite"),
        (["--seed", "-1"], 2, "--seed"),
        (["-o", "scan.h5"], 2, "scan.h5"),
        (["scan.h5"], 2, "--spectra"),
        (["--states", "fresh,charged"], 2, "--spectra"),
        (["--time", "3"], 2, "3 volumes of 27 views: expected"),
        (["--time", "2", "--spectra", "table.csv"], 2, "one of them"),
        (["--time", "2", "--seconds", "5"], 2, "one volume"),
        (["--time", "2", "--truth", "volume.npz"], 2, "several"),
        (["--spectra", "table.csv", "--photons-per-count", "1"], 2, "frames"),
        (["--spectra", "missing.csv"], 5, "missing.csv"),
    ],
)
def test_bad_input_leaves_nothing(folder: Path, options: list[str], code: int, said: str) -> None:
    result = beamline("tradeoff", "scan.h5", *options)
    assert result.exit_code == code, result.output
    assert said in result.stderr
    assert result.stdout == ""
    assert left(folder) == {"scan.h5"}
