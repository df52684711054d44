"""Processes of trials, and the data that they share."""

from __future__ import annotations

import math
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.core.machine import STATUS, peak_memory
from beamline.features.trials import launch as trial_run
from beamline.features.trials.launch import (
    JOB,
    TrialData,
    TrialJob,
    compile_kernels,
    run_trial,
    write_array,
)
from beamline.features.trials.tradeoff import plan
from beamline.features.trials.trial import Trial
from beamline.features.trials.view_choices import ViewChoice
from recon.base.geometry import Geometry
from recon.base.method import Energies
from recon.base.volume import Grid
from tests.beamline.prepared_views import prepared_views
from tests.beamline.scans import TwoCylinders

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))


@pytest.mark.parametrize(
    ("program", "limit", "status", "said"),
    [
        ("import time; time.sleep(60)", 0.5, "out of time", "--max-seconds"),
        ("import sys; sys.exit('it broke')", math.inf, "failed", "it broke"),
        ('print(\'{"event": "failed", "message": "no matter"}\')', math.inf, "failed", "no matter"),
        ('print(\'words\'); print(\'{"event": "result", "seconds": 2.5, "curve": [[1, 2]]}\')', 60.0, "done", ""),
    ],
)
def test_what_becomes_of_a_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, limit: float, status: str, said: str
) -> None:
    monkeypatch.setattr(trial_run, "COMMAND", [sys.executable, "-c", program])
    outcome = run_trial(Trial("method", "fbp", 10), tmp_path, 0, limit)
    assert (outcome.status, said in outcome.message) == (status, True)
    assert (outcome.seconds == 2.5 and outcome.curve == [[1, 2]]) is (status == "done")


def test_a_full_disk_ends_all_trials(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = 'import sys; print(\'{"event": "failed", "message": "v.npy: the disk is full"}\'); sys.exit(5)'
    monkeypatch.setattr(trial_run, "COMMAND", [sys.executable, "-c", program])
    with pytest.raises(DataError, match=r"v\.npy:"):
        run_trial(Trial("method", "fbp", 10), tmp_path, 0)


def test_kernels_are_compiled_once_for_each_method_start_loss_and_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial_run, "COMMAND", [sys.executable, "-c", ""])
    compile_kernels(plan(("r2", "fbp", "sirt"), 60, 1000, "quick"), tmp_path)
    job = JOB.validate_json((tmp_path / "job.json").read_bytes())
    words = ("start", "fit.loss", "fit.kernel")
    kinds = [(trial.method, *(trial.settings.get(name, "") for name in words)) for trial in job.compiled]
    assert sorted(kinds) == [
        ("fbp", "", "", ""), ("r2", "", "", ""), ("r2", "", "", "gaussian"), ("r2", "", "l2", ""),
        ("r2", "", "poisson", ""), ("r2", "tv", "", ""), ("sirt", "", "", ""),
    ]  # fmt: skip
    assert job.data == tmp_path / "data"  # whose geometry decides which kernels are used


def test_a_job_comes_through_its_file(tmp_path: Path) -> None:
    groups = [[0, 1], [2, 3], [4, 5]]
    settings = {"steps": 3, "weight": 3.0, "start": "tv", "moves": None, "fast": True}
    trial = Trial("method", "r2", 3, 2, settings, choice=ViewChoice("means", groups), seconds_asked=1.5)
    back = JOB.validate_json(JOB.dump_json(TrialJob(tmp_path / "data", trial, 7, tmp_path / "v.npy", [trial]))).trial
    assert back is not None and back.choice is not None
    assert (back.choice.label, back.choice.groups) == ("means", groups)
    assert replace(back, choice=None) == replace(trial, choice=None)
    assert [type(value) for value in back.settings.values()] == [int, float, str, type(None), bool]


@pytest.mark.slow
def test_a_real_trial_in_a_real_process(tmp_path: Path) -> None:
    """Its memory is its own: this process, which has more, does not show in it."""
    views = Geometry.parallel(SCAN.angles, SCAN.shape)
    prepared = prepared_views(SCAN.line_integrals().astype(np.float32), views)
    data = TrialData(prepared, SCAN.truth(Grid.matching(views)))
    data.save(tmp_path / "data")
    ballast = np.ones(90_000_000)  # 720 MB
    outcome = run_trial(Trial("method", "fbp", 30), tmp_path, 0, 120)
    assert outcome.status == "done", outcome.message
    assert outcome.quality("psnr") > 20
    assert (outcome.peak_bytes is None) != STATUS.is_file()  # Linux
    assert outcome.peak_bytes is None or 5e7 < outcome.peak_bytes < ballast.nbytes < (peak_memory() or 0)


def test_values_survive_the_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    views = Geometry.cone(
        rng.random(9), (40, 60), 0.5, 60.0, 120.0, shifts=rng.random((9, 2)), roll=0.1, tilt=rng.random(9)
    )
    images = rng.random((9, 40, 60)).astype(np.float32)
    whole = prepared_views(images, views, weights=images / 2)
    energies = Energies(np.arange(9), rng.random((9, 2)))
    whole = replace(whole, energies=energies, stretch=1.5)
    prepared = replace(whole.of_views(np.arange(3)), held_out=(images[3:], views.select(range(3, 9))))
    TrialData(prepared, images, np.arange(6.0)).save(tmp_path / "data")
    write_array(tmp_path / "data" / "reference.os-sirt-tv.npy", images[:1])
    write_array(tmp_path / "data" / "data.regions.npy", np.ones((1, 2, 3), np.int8))
    back = TrialData.load(tmp_path / "data")
    assert prepared.held_out is not None and back.prepared.held_out is not None
    for one, other in ((back.geometry, prepared.geometry), (back.prepared.held_out[1], prepared.held_out[1])):
        for f in fields(Geometry):
            np.testing.assert_array_equal(getattr(one, f.name), getattr(other, f.name))
    np.testing.assert_array_equal(back.prepared.projections.data, images[:3])
    np.testing.assert_array_equal(back.prepared.projections.weights, images[:3] / 2)
    np.testing.assert_array_equal(back.prepared.held_out[0], images[3:])
    np.testing.assert_array_equal(back.truth, images)
    np.testing.assert_array_equal(back.shown_held_out, np.arange(6.0))
    np.testing.assert_array_equal(back.references["os-sirt-tv"], images[:1])
    assert back.regions is not None and back.regions.shape == (1, 2, 3) and list(back.references) == ["os-sirt-tv"]
    assert back.prepared.energies is not None and back.prepared.energies.of_view.tolist() == [0, 1, 2]
    for name in ("stretch", "length_unit", "n_projections", "axis_col"):
        assert getattr(back.prepared, name) == getattr(prepared, name)
    assert isinstance(back.prepared.projections.data, np.memmap)


def test_without_truth_and_views_held_out(tmp_path: Path) -> None:
    views = Geometry.parallel(np.arange(3.0), (2, 4))
    TrialData(prepared_views(np.zeros((3, 2, 4), np.float32), views), None).save(tmp_path / "data")
    back = TrialData.load(tmp_path / "data")
    assert (back.truth, back.regions, back.references, back.prepared.held_out) == (None, None, {}, None)
    assert back.prepared.energies is None
