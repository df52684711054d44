"""`beamline recon` ended from outside: it delivers what it has, or leaves no file; a checkpoint can be resumed."""

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.reconstruct import checkpoints, job, pipeline
from beamline.reconstruct.record import write_result
from beamline.storage.writers.recon_file import read_reconstruction
from recon.base.method import Progress
from recon.splatting import optimise as fit
from recon.voxels import fbp as fbp_module
from recon.voxels.fbp import FbpPlan, fbp_block
from tests.beamline.cli.small_scan import SCAN, beamline, left, succeeds

pytestmark = pytest.mark.usefixtures("one_thread")

HANGUP = [] if sys.platform == "win32" else [signal.SIGHUP]


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


@pytest.mark.parametrize("number", [signal.SIGINT, *HANGUP])
def test_a_fit_that_is_interrupted_delivers_what_it_has(
    folder: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    steps = _signal_at_step(monkeypatch, number, {20})
    result = beamline("recon", "scan.h5", "--steps", "100000", "--gaussians", "50", "--no-report")
    assert result.exit_code == 4, result.output
    assert "The reconstruction was stopped early" in result.stderr
    assert steps[-1] == 20
    parameters = read_reconstruction(folder / "scan_r2.h5").parameters
    assert parameters["ended_early"] and parameters["steps"] == 20


def test_a_fit_that_is_interrupted_twice_leaves_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _signal_at_step(monkeypatch, signal.SIGINT, {20}, times=2)
    result = beamline("recon", "scan.h5", "--steps", "100000", "--gaussians", "50", "--no-report")
    assert result.exit_code == 130
    assert left(folder) == {"scan.h5"}


@pytest.mark.slow
def test_iterations_that_are_interrupted_deliver_what_they_have(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = job.progress_events

    def watched(*arguments: Any) -> Callable[[Progress], None]:
        listen = told(*arguments)

        def heard(progress: Progress) -> None:
            listen(progress)
            if progress.step == 5:
                signal.raise_signal(signal.SIGINT)

        return heard

    monkeypatch.setattr(job, "progress_events", watched)
    result = beamline("recon", "scan.h5", "-m", "sirt", "--iterations", "100000", "--no-report")
    assert result.exit_code == 4, result.output
    assert "The reconstruction was stopped early" in result.stderr
    record = read_reconstruction(folder / "scan_sirt.h5")
    assert record.parameters["ended_early"] and record.history["step"][-1] == 5


def test_an_fbp_that_is_interrupted_ends_at_once_and_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(plan: FbpPlan, *arguments: Any) -> None:
        if plan.geometry.n_views == SCAN.angles.size:  # not the toy that is reconstructed before
            signal.raise_signal(signal.SIGINT)
        fbp_block(plan, *arguments)

    monkeypatch.setattr(fbp_module, "fbp_block", interrupted)
    before = set(folder.iterdir())
    result = beamline("recon", "scan.h5", "-m", "fbp", "-o", "out.h5")
    assert result.exit_code == 130, result.output
    assert set(folder.iterdir()) == before


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGHUP")
def test_a_terminal_that_closes_does_not_end_what_nohup_keeps(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _signal_at_step(monkeypatch, signal.SIGHUP, {5})
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        result = beamline("recon", "scan.h5", "--steps", "20", "--gaussians", "50", "--no-report")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert result.exit_code == 0, result.output


@pytest.mark.slow
def test_a_fit_whose_last_checkpoint_is_lost_writes_its_volume_and_says_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, checkpoint: object) -> None:
        raise DataError(f"{path} could not be written (No space left on device).")

    monkeypatch.setattr(checkpoints, "write_checkpoint", refuse)
    options = ("--steps", "6", "--gaussians", "50", "--axis", "20.7", "--finish", "0", "--no-report")
    result = beamline("recon", "scan.h5", *options, "-o", "out.h5", "--checkpoint", "fit.h5")
    assert (result.exit_code, left(folder)) == (5, {"scan.h5", "out.h5"}), result.output
    assert "last checkpoint could not be written: fit.h5 could not be written" in result.stderr
    assert read_reconstruction(folder / "out.h5").volume.data.any()


@pytest.mark.slow
def test_an_interrupted_fit_goes_on_from_its_checkpoint(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("--steps", "60", "--gaussians", "50", "--axis", "20.7", "--no-report")
    succeeds("recon", "scan.h5", *options, "-o", "whole.h5")
    with monkeypatch.context() as patched:
        _signal_at_step(patched, signal.SIGINT, {20})
        result = beamline("recon", "scan.h5", *options, "-o", "part.h5", "--checkpoint", "fit.h5")
    assert result.exit_code == 4, result.output
    result = succeeds("recon", "scan.h5", *options, "-o", "rest.h5", "--checkpoint", "fit.h5", "--resume", "fit.h5")
    assert "Time of reconstruction, since resumed" in result.stdout
    whole, rest = (read_reconstruction(folder / name) for name in ("whole.h5", "rest.h5"))
    np.testing.assert_array_equal(rest.volume.data, whole.volume.data)
    assert left(folder) == {"scan.h5", "whole.h5", "part.h5", "rest.h5", "fit.h5"}
    result = beamline("recon", "scan.h5", *options, "-o", "other.h5", "--resume", "fit.h5", "--rows", "0:1")
    assert result.exit_code == 5
    assert "belongs to another fit, so it cannot be resumed: projections" in result.stderr
    assert "detector_shape" in result.stderr
    assert "other.h5" not in left(folder)
    fewer = [*options[2:], "--steps", "20", "-o", "other.h5", "--resume", "fit.h5"]
    result = beamline("recon", "scan.h5", *fewer)
    assert result.exit_code == 2
    assert "contains 60 steps, more than the 20 steps that you requested" in result.stderr
    assert "--steps" in result.stderr and "other.h5" not in left(folder)


def test_ctrl_c_while_a_volume_is_measured_and_written_does_not_discard_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = write_result

    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return write(*arguments)

    monkeypatch.setattr(pipeline, "write_result", interrupted)
    succeeds("recon", "scan.h5", "-m", "sirt", "--iterations", "3", "--no-report")
    assert not read_reconstruction(folder / "scan_sirt.h5").parameters.get("ended_early")
