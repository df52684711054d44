"""`beamline recon`: options, exit codes, what is printed and what is left."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from beamline import budget, offline
from beamline.cli.main import main
from beamline.cli.recon import repeated, report_beside
from beamline.storage.recon_file import read_reconstruction
from recon import fit, reconstruction
from recon.fbp import fbp
from recon.fit import Progress
from recon.quality import Speeds
from recon.reconstruction import DEFAULT_STEPS
from tests.beamline.scans import BEAM, DARK, TwoCylinders, write_exchange

pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(2, 40), pixel_size_mm=0.5)
N = SCAN.angles.size


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a good scan in it."""
    monkeypatch.chdir(tmp_path)
    write_exchange(tmp_path / "scan.h5", SCAN)
    return tmp_path


def _beamline(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def _left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_defaults_and_results(folder: Path) -> None:
    result = _beamline("recon", "scan.h5", "-m", "fbp")
    assert result.exit_code == 0, result.output
    assert _left(folder) == {"scan.h5", "scan_fbp.h5", "scan_fbp.html"}
    lines = dict(line.split(maxsplit=1) for line in result.stdout.splitlines()[:4])
    assert lines == {
        "output": "scan_fbp.h5",
        "report": "scan_fbp.html",
        "volume": "2 x 40 x 40 in 1/mm",
        **_axis(lines),
    }
    assert "Data residual" in result.stdout
    assert "fbp: 30 views" in result.stderr
    assert "fbp: 30 views" not in result.stdout


def _axis(lines: dict[str, str]) -> dict[str, str]:
    assert float(lines["axis_col"]) == pytest.approx(SCAN.axis_col, abs=0.25)
    return {"axis_col": lines["axis_col"]}


def test_json_is_one_event_a_line_and_done_is_the_last(folder: Path) -> None:
    options = ("--steps", "10", "--gaussians", "100", "--seed", "2", "--no-report", "-o", "out.h5", "--json")
    result = _beamline("recon", "scan.h5", *options, "--views", "fixed:10", "--axis", "20.7", "--bin", "2")
    assert result.exit_code == 0, result.output
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert events[0]["event"] == "recon_started"
    done = events[-1]
    assert done["event"] == "done"
    assert (done["output"], done["report"], done["axis_col"]) == ("out.h5", None, 20.7)
    assert done["shape"] == [1, 20, 20]
    assert {"seconds", "residual", "residual_held_out"} <= set(done)
    assert _left(folder) == {"scan.h5", "out.h5"}
    parameters = read_reconstruction(folder / "out.h5").parameters
    assert (parameters["steps"], parameters["seed"], parameters["views"]) == (10, 2, "fixed:10")


def test_settings_reach_the_file(folder: Path) -> None:
    options = (
        "-m",
        "fbp",
        "--rows",
        "1:2",
        "--air",
        "3,4",
        "--filter",
        "hann",
        "--pixel-size-um",
        "250",
        "--no-report",
    )
    assert _beamline("recon", "scan.h5", *options, "--axis", "20.7").exit_code == 0
    parameters = read_reconstruction(folder / "scan_fbp.h5").parameters
    said = {name: parameters[name] for name in ("rows", "correction_air", "filter", "pixel_pitch")}
    assert said == {"rows": "1:2", "correction_air": "(3, 4)", "filter": "hann", "pixel_pitch": 0.25}


_VIEWS = (N, 2, 40)
CASES: dict[str, tuple[dict[str, Any], list[str], int, str]] = {
    "no flats": ({"data_white": None}, ["--quantity", "counts"], 5, "flats"),
    "no darks": ({"data_dark": None}, ["--quantity", "counts"], 5, "darks"),
    "unknown quantity": ({"data_white": None, "data_dark": None}, [], 5, "--quantity"),
    "wrong shape": ({"data_white": np.full((2, 2, 30), 9000, np.uint16)}, [], 5, "shape"),
    "two dimensions": ({"data": np.zeros((2, 40), np.uint16)}, [], 5, "shape"),
    "angles missing": ({"theta": None}, [], 5, "theta"),
    "too few angles": ({"theta": np.zeros(4)}, [], 5, "4 angles"),
    "NaN angles": ({"theta": np.full(N, np.nan)}, [], 5, "--angles"),
    "all NaN": ({"data": np.full(_VIEWS, np.nan, np.float32)}, [], 5, "NaN"),
    "one view": ({"data": np.full((1, 2, 40), 9000, np.uint16), "theta": np.zeros(1)}, [], 5, "at least 2"),
    "no beam": ({"data_white": np.full((2, 2, 40), DARK, np.uint16)}, [], 5, "no beam"),
    "empty field": ({"data": np.full(_VIEWS, DARK + BEAM, np.uint16)}, [], 5, "scan.h5"),
    "one view chosen": ({}, ["--views", "fixed:1"], 2, "at least 2"),
    "views misspelt": ({}, ["--views", "every:third"], 2, "every:third"),
    "too many views": ({}, ["--views", "fixed:31"], 2, "30"),
    "rows outside": ({}, ["--rows", "1:3"], 2, "0:2"),
    "rows reversed": ({}, ["--rows", "2:1"], 2, "FIRST:END"),
    "bins too large": ({}, ["--bin", "3"], 2, "--bin 3"),
    "axis outside": ({}, ["--axis", "99"], 2, "outside"),
    "axis misspelt": ({}, ["--axis", "middle"], 2, "auto"),
    "air misspelt": ({}, ["--air", "some"], 2, "LEFT,RIGHT"),
    "air too wide": ({}, ["--air", "30,30"], 5, "40 columns"),
    "two budgets": ({}, ["--steps", "5", "--seconds", "5"], 2, "exclude"),
    "budget and steps": ({}, ["--budget", "30s", "--steps", "5"], 2, "exclude"),
    "budget and quality": ({}, ["--budget", "30s", "--quality", "best"], 2, "exclude"),
    "quality and Gaussians": ({}, ["--quality", "best", "--gaussians", "5"], 2, "exclude"),
    "budget misspelt": ({}, ["--budget", "soon"], 2, "such as 30s"),
    "quality misspelt": ({}, ["--quality", "superb"], 2, "preview"),
    "truth missing": ({}, ["--truth", "truth.npz"], 2, "truth.npz"),
    "truth of another shape": ({}, ["--truth", "scan.npy"], 2, "shape"),
    "of the other method": ({}, ["--gaussians", "5"], 2, "r2"),
    "a loss of fbp": ({}, ["--loss", "l2"], 2, "--loss is of the r2 fit"),
    "a checkpoint of fbp": ({}, ["--checkpoint", "fit.h5"], 2, "--checkpoint is of the r2 fit"),
    "iterations of fbp": ({}, ["--iterations", "5"], 2, "--iterations is of the iterative methods"),
    "iterations of a fit": ({}, ["-m", "r2", "--iterations", "5"], 2, "does not go with --method r2"),
    "steps of iterations": ({}, ["-m", "sirt", "--steps", "5"], 2, "--steps is of the r2 fit"),
    "smoothing of sirt": ({}, ["-m", "sirt", "--tv-weight", "0.1"], 2, "fista-tv and os-sirt-tv"),
    "budget and loss": ({}, ["--budget", "30s", "--loss", "l2"], 2, "exclude"),
    "budget and early stop": ({}, ["--budget", "30s", "--early-stop"], 2, "exclude"),
    "following with a start": ({}, ["-m", "r2", "--follow", "--start", "tv"], 2, "finished scan"),
    "loss misspelt": ({}, ["-m", "r2", "--loss", "l3"], 2, "l3"),
    "no such device": ({}, ["-m", "r2", "--device", "abacus"], 2, "--device abacus"),
    "no checkpoint": ({}, ["-m", "r2", "--resume", "none.h5"], 5, "none.h5 is not there"),
    "not a checkpoint": ({}, ["-m", "r2", "--resume", "scan.npy"], 5, "no checkpoint"),
    "a checkpoint in the way": ({}, ["-m", "r2", "--checkpoint", "scan.npy"], 5, "never overwritten"),
    "the scan as checkpoint": ({}, ["-m", "r2", "--checkpoint", "scan.h5"], 2, "FILE and --checkpoint are the same"),
    "the scan to resume": ({}, ["-m", "r2", "--resume", "./scan.h5"], 2, "FILE and --resume are the same"),
    "the scan as output": ({}, ["-o", "scan.h5"], 2, "FILE and --output are the same"),
    "output as checkpoint": ({}, ["-m", "r2", "-o", "a.h5", "--checkpoint", "./a.h5"], 2, "--output and --checkpoint"),
    "default as checkpoint": ({}, ["-m", "r2", "--checkpoint", "scan_r2.h5"], 2, "--output and --checkpoint"),
    "report as checkpoint": ({}, ["-m", "r2", "-o", "a.h5", "--checkpoint", "a.html"], 2, "report and --checkpoint"),
    "output to resume": ({}, ["-m", "r2", "-o", "a.h5", "--resume", "a.h5"], 2, "--output and --resume"),
    "endless smoothing": ({}, ["-m", "fista-tv", "--tv-weight", "inf"], 2, "finite"),
    "no smoothing": ({}, ["-m", "fista-tv", "--tv-weight", "nan"], 2, "finite"),
    "no residual": ({}, ["--max-residual", "nan"], 2, "finite"),
    "no time": ({}, ["-m", "r2", "--seconds", "nan"], 2, "finite"),
    "endless time": ({}, ["-m", "r2", "--seconds", "inf"], 2, "finite"),
    "a pixel of no size": ({}, ["--pixel-size-um", "nan"], 2, "finite"),
    "a seed below zero": ({}, ["--seed", "-1"], 2, "--seed"),
    "a nameless checkpoint": ({}, ["-m", "r2", "--checkpoint", ""], 2, "fit.checkpoint.h5"),
    "no file": ({}, ["-o", "."], 2, "directory"),
    "nameless": ({}, ["-o", ""], 2, "HDF5"),
    "a page": ({}, ["-o", "out.html"], 2, "HDF5"),
    "method misspelt": ({}, ["--method", "r3"], 2, "r3"),
    "folder missing": ({}, ["-o", "no/out.h5"], 5, "does not exist"),
    "fbp cannot follow": ({}, ["--follow"], 2, "--follow"),
}


@pytest.mark.parametrize("method", ["fbp"])
@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_sentence_a_code_and_no_output(folder: Path, case: str, method: str) -> None:
    changes, options, code, said = CASES[case]
    (folder / "scan.h5").unlink()
    write_exchange(folder / "scan.h5", SCAN, changes)
    np.save(folder / "scan.npy", np.arange(8.0).reshape(2, 2, 2))
    before = _left(folder)
    # A budget and a preset are of the fit, whose settings they choose.
    chosen = [] if {"--budget", "--quality"} & set(options) else ["-m", method]
    result = _beamline("recon", "scan.h5", *chosen, *options)
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    assert said in result.stderr
    assert "Traceback" not in result.output
    assert len([line for line in result.stderr.splitlines() if line.startswith(("beamline:", "Error:"))]) == 1
    assert _left(folder) == before


@pytest.mark.parametrize(
    "option",
    ["--steps 5", "--seconds 5", "--gaussians 5", "--start tv", "--loss l2", "--device cuda", "--early-stop",
     "--checkpoint fit.h5", "--resume scan.h5", "--budget 30s", "--quality best"],
)  # fmt: skip
@pytest.mark.parametrize("method", ["fbp", "sirt"])
def test_options_of_the_fit_are_refused_by_name_with_another_method(folder: Path, option: str, method: str) -> None:
    result = _beamline("recon", "scan.h5", "-m", method, *option.split())
    assert result.exit_code == 2 and result.stdout == ""
    assert f"{option.split()[0]} is of the r2 fit; it does not go with --method {method}." in result.stderr
    assert _left(folder) == {"scan.h5"}


def test_a_filter_with_an_iterative_method_is_of_the_fbp_it_is_compared_with(folder: Path) -> None:
    result = _beamline("recon", "scan.h5", "-m", "sirt", "--iterations", "2", "--filter", "ram-lak", "--no-report")
    assert result.exit_code == 0, result.output
    assert read_reconstruction(folder / "scan_sirt.h5").parameters["iterations"] == 2


@pytest.mark.parametrize("name", ["missing.h5", "text.h5", "empty.h5", "half.h5", "folder"])
def test_files_that_cannot_be_read(folder: Path, name: str) -> None:
    (folder / "text.h5").write_text("no scan")
    (folder / "empty.h5").write_bytes(b"")
    (folder / "half.h5").write_bytes((folder / "scan.h5").read_bytes()[:3000])
    (folder / "folder").mkdir()
    before = _left(folder)
    result = _beamline("recon", name)
    assert result.exit_code == 5, result.output
    assert name in result.stderr
    assert result.stderr.startswith("beamline: ")
    assert _left(folder) == before


def test_a_failure_is_the_last_json_event(folder: Path) -> None:
    result = _beamline("recon", "missing.h5", "--json")
    assert result.exit_code == 5
    last = json.loads(result.stdout.splitlines()[-1])
    assert (last["event"], last["exit_code"]) == ("failed", 5)
    assert "missing.h5" in last["message"]


def test_sigterm_ends_it_like_ctrl_c(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the middle of writing: nothing half-written stays, and the last event says why."""

    def interrupted(*_: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("beamline.storage.recon_file._write_entry", interrupted)
    before = signal.getsignal(signal.SIGTERM)
    result = _beamline("recon", "scan.h5", "-m", "fbp", "--json")
    assert result.exit_code == 130
    assert json.loads(result.stdout.splitlines()[-1])["exit_code"] == 130
    assert _left(folder) == {"scan.h5"}
    assert signal.getsignal(signal.SIGTERM) is before


HANGUP = [] if sys.platform == "win32" else [signal.SIGHUP]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, *HANGUP])
def test_a_fit_that_is_interrupted_delivers_what_it_has(
    folder: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    steps = _signal_at_step(monkeypatch, number, {20})
    result = _beamline("recon", "scan.h5", "--steps", "100000", "--gaussians", "50", "--no-report")
    assert result.exit_code == 4, result.output
    assert "The fit was ended early" in result.stderr
    assert steps[-1] == 20
    parameters = read_reconstruction(folder / "scan_r2.h5").parameters
    assert parameters["ended_early"] and parameters["steps"] == 20


def test_a_fit_that_is_interrupted_twice_leaves_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _signal_at_step(monkeypatch, signal.SIGINT, {20}, times=2)
    result = _beamline("recon", "scan.h5", "--steps", "100000", "--gaussians", "50", "--no-report")
    assert result.exit_code == 130
    assert _left(folder) == {"scan.h5"}


def test_iterations_that_are_interrupted_deliver_what_they_have(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = offline.progress_events

    def watched(*arguments: Any) -> Callable[[Progress], None]:
        listen = told(*arguments)

        def heard(progress: Progress) -> None:
            listen(progress)
            if progress.step == 5:
                signal.raise_signal(signal.SIGINT)

        return heard

    monkeypatch.setattr(offline, "progress_events", watched)
    result = _beamline("recon", "scan.h5", "-m", "sirt", "--iterations", "100000", "--no-report")
    assert result.exit_code == 4, result.output
    assert "The iterations were ended early" in result.stderr
    record = read_reconstruction(folder / "scan_sirt.h5")
    assert record.parameters["ended_early"] and record.history["step"][-1] == 5


@pytest.mark.parametrize("options", [["-m", "fbp"], ["--budget", "20s"]])
def test_an_fbp_that_is_interrupted_is_complete_all_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]
) -> None:
    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return fbp(*arguments)

    monkeypatch.setattr(reconstruction, "fbp", interrupted)
    monkeypatch.setattr(budget, "calibrate", lambda *_: Speeds(0.1, 0.1, 1e6, 0.1))
    result = _beamline("recon", "scan.h5", *options, "-o", "out.h5", "--no-report")
    assert result.exit_code == 0, result.output
    assert "as soon as there is a volume" in result.stderr and "ended early" not in result.output
    parameters = read_reconstruction(folder / "out.h5").parameters
    assert parameters["method"] == "fbp" and "ended_early" not in parameters


def test_a_fit_that_is_interrupted_in_its_last_step_is_complete(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _signal_at_step(monkeypatch, signal.SIGINT, {20})
    result = _beamline("recon", "scan.h5", "--steps", "20", "--gaussians", "50", "--no-report")
    assert result.exit_code == 0, result.output
    assert "ended_early" not in read_reconstruction(folder / "scan_r2.h5").parameters


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGHUP")
def test_a_terminal_that_closes_does_not_end_what_nohup_keeps(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _signal_at_step(monkeypatch, signal.SIGHUP, {5})
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        result = _beamline("recon", "scan.h5", "--steps", "20", "--gaussians", "50", "--no-report")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert result.exit_code == 0, result.output


def test_more_gaussians_than_there_is_room_for_are_told(folder: Path) -> None:
    result = _beamline("recon", "scan.h5", "--steps", "2", "--gaussians", "99999999", "--no-report")
    assert result.exit_code == 0, result.output
    start = int(read_reconstruction(folder / "scan_r2.h5").parameters["gaussians_at_start"])
    assert f"Warning: The fit started from {start} Gaussians, not from 99999999" in result.stderr
    result = _beamline("recon", "scan.h5", "--steps", "2", "--gaussians", "50", "--no-report", "-o", "few.h5")
    assert result.exit_code == 0 and "Warning" not in result.stderr


def test_an_interrupted_fit_goes_on_from_its_checkpoint(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("--steps", "60", "--gaussians", "50", "--axis", "20.7", "--no-report")
    assert _beamline("recon", "scan.h5", *options, "-o", "whole.h5").exit_code == 0
    with monkeypatch.context() as patched:
        _signal_at_step(patched, signal.SIGINT, {20})
        result = _beamline("recon", "scan.h5", *options, "-o", "part.h5", "--checkpoint", "fit.h5")
    assert result.exit_code == 4, result.output
    result = _beamline("recon", "scan.h5", *options, "-o", "rest.h5", "--checkpoint", "fit.h5", "--resume", "fit.h5")
    assert result.exit_code == 0, result.output
    assert "Time, since resumed" in result.stdout
    whole, rest = (read_reconstruction(folder / name) for name in ("whole.h5", "rest.h5"))
    np.testing.assert_array_equal(rest.volume.data, whole.volume.data)
    assert _left(folder) == {"scan.h5", "whole.h5", "part.h5", "rest.h5", "fit.h5"}
    result = _beamline("recon", "scan.h5", *options, "-o", "other.h5", "--resume", "fit.h5", "--rows", "0:1")
    assert result.exit_code == 5
    assert "is of another fit: projections" in result.stderr and "detector_shape" in result.stderr
    assert "other.h5" not in _left(folder)
    fewer = [*options[2:], "--steps", "20", "-o", "other.h5", "--resume", "fit.h5"]
    result = _beamline("recon", "scan.h5", *fewer)
    assert result.exit_code == 2
    assert "60 steps behind it" in result.stderr and "--steps" in result.stderr and "other.h5" not in _left(folder)


def test_the_default_of_steps_is_told_as_it_is() -> None:
    assert f"Default: {DEFAULT_STEPS}." in " ".join(_beamline("recon", "--help").stdout.split())


def test_early_stopping_says_which_views_it_takes(folder: Path) -> None:
    result = _beamline("recon", "scan.h5", "--steps", "60", "--gaussians", "50", "--early-stop", "--no-report")
    assert result.exit_code == 0, result.output
    assert "3 of 30 views are held out to say when to stop" in result.stderr


def _signal_at_step(monkeypatch: pytest.MonkeyPatch, number: signal.Signals, at: set[int], times: int = 1) -> list[int]:
    """Raise a signal after some steps of the fit; the steps it has taken."""
    step, taken = fit.step, []

    def watched(state: fit.FitState, *arguments: Any) -> fit.FitState:
        state = step(state, *arguments)
        taken.append(state.step)
        if state.step in at:
            for _ in range(times):
                signal.raise_signal(number)
        return state

    monkeypatch.setattr(fit, "step", watched)
    return taken


def test_results_are_never_overwritten(folder: Path) -> None:
    (folder / "scan_fbp.h5").write_text("precious")
    result = _beamline("recon", "scan.h5", "-m", "fbp")
    assert result.exit_code == 5
    assert (folder / "scan_fbp.h5").read_text() == "precious"


def test_as_a_process(folder: Path) -> None:
    """The same through the operating system: exit code, streams, and no traceback."""
    root = Path(__file__).parents[3]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    command = [sys.executable, "-m", "beamline.cli.main", "recon", "scan.h5", "--views", "fixed:1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("beamline: --views fixed:1")
    assert "Traceback" not in done.stderr
    assert _left(folder) == {"scan.h5"}


def test_the_beamless_fixture_is_refused(folder: Path, shared_data: Path) -> None:
    result = _beamline("recon", str(shared_data / "fixtures" / "esrf_bm05_nxtomo_20x16x16.nx"))
    assert result.exit_code == 5
    assert "no beam" in result.stderr
    assert _left(folder) == {"scan.h5"}


def test_a_measured_scan_from_hdf5_and_from_its_tiffs(folder: Path, shared_data: Path) -> None:
    options = ("-m", "fbp", "--bin", "2", "--no-report")
    scan = shared_data / "diamond_24737_parallel_91x135x160.h5"
    tiffs = shared_data / "diamond_24737_tiff_series.zip"
    assert _beamline("recon", str(scan), *options, "-o", "a.h5").exit_code == 0
    assert _beamline("recon", str(tiffs), *options, "--angle-rows", "10:101", "-o", "b.h5").exit_code == 0
    a, b = (read_reconstruction(folder / name) for name in ("a.h5", "b.h5"))
    assert a.parameters["axis_col"] == pytest.approx(85.75, abs=0.5)
    assert b.parameters["axis_col"] == pytest.approx(85.75, abs=0.5)
    spread = float(a.volume.data.std())
    assert float(np.sqrt(np.mean((a.volume.data - b.volume.data) ** 2))) < 0.05 * spread


@pytest.mark.parametrize(("limit", "code"), [("1.0", 0), ("1e-6", 6)])
def test_a_quality_limit_that_fails_is_told_and_leaves_the_results(folder: Path, limit: str, code: int) -> None:
    result = _beamline("recon", "scan.h5", "-m", "fbp", "--views", "fixed:15", "--max-residual", limit, "--json")
    assert result.exit_code == code, result.output
    assert _left(folder) == {"scan.h5", "scan_fbp.h5", "scan_fbp.html"}
    assert json.loads(result.stdout.splitlines()[-1])["event"] == "done"
    assert ("views held out" in result.stderr) is (code == 6)


def test_a_budget_says_what_it_chose_and_what_more_would_cost(folder: Path) -> None:
    result = _beamline("recon", "scan.h5", "--axis", "20.7", "--budget", "1.5s", "--no-report")
    assert result.exit_code == 0, result.output
    lines = dict(line.split(maxsplit=1) for line in result.stdout.splitlines() if line.startswith("chosen"))
    assert lines["chosen"].startswith("r2, ") and "of 1.5 s" in lines["chosen"]
    assert any(line.startswith("next dB   ") for line in result.stdout.splitlines())
    parameters = read_reconstruction(folder / "scan_r2.h5").parameters
    assert parameters["budget"] == 1.5 and parameters["chosen_method"] == "r2"


@pytest.mark.parametrize("options", [["-m", "fbp"], ["--follow"]])
def test_budgets_are_of_finished_scans_and_the_fit(folder: Path, options: list[str]) -> None:
    result = _beamline("recon", "scan.h5", "--budget", "1m", *options)
    assert result.exit_code == 2
    assert "--budget" in result.stderr and _left(folder) == {"scan.h5"}


def test_names() -> None:
    assert report_beside(Path("runs/x/recon.h5")) == Path("runs/x/report.html")
    assert report_beside(Path("walnut_r2.h5")) == Path("walnut_r2.html")
    assert repeated(["recon", "my scan.h5"]) == "beamline recon 'my scan.h5'"
