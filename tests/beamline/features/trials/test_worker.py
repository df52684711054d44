"""One trial: the arrays come through the file as they were, the figures are those of the volume it made."""

from __future__ import annotations

import itertools
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.core.machine import STATUS, peak_memory
from beamline.features.trials import worker as module
from beamline.features.trials.trial import Trial
from beamline.features.trials.view_choices import ViewChoice
from beamline.features.trials.worker import DATA, VOLUME, TrialData, TrialJob, add_references, main
from beamline.projections.prepared import with_views_held_out
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.method import SampleRadius
from recon.base.volume import Grid, Volume
from recon.methods import by_name, names_of_one_volume
from recon.voxels.fbp import fbp
from recon.voxels.projector import project
from recon.voxels.resolution import ViewResolution, at_voxel_resolution
from tests.beamline.prepared_views import prepared_views
from tests.beamline.scans import TwoCylinders

pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))


@pytest.fixture
def data() -> TrialData:
    views = Geometry.parallel(SCAN.angles, SCAN.shape, pixel_pitch=0.5, axis_col=SCAN.axis_col)
    integrals = SCAN.line_integrals().astype(np.float32)
    held = np.arange(3, 30, 9)
    half = TwoCylinders(SCAN.angles, SCAN.shape, SCAN.axis_col, 0.5)
    prepared = with_views_held_out(prepared_views(integrals, views), held)
    return TrialData(prepared, half.truth(Grid.matching(views)))


def run(trial: Trial, data: TrialData, seed: int, *clocks: Any) -> dict[str, Any]:
    return module.run(trial, data, seed, *clocks)[0]


def done(data: TrialData, folder: Path, trial: Trial, keep: bool = False) -> int:
    """The exit code of a process that runs the trial."""
    folder.mkdir(exist_ok=True)
    data.save(folder / DATA)
    TrialJob(trial, 0, keep).save(folder)
    return main(folder)


@pytest.mark.parametrize("method", ["fbp", "fista-tv", "sirt"])
def test_rays_that_were_not_measured_do_not_count(data: TrialData, method: str) -> None:
    """Whatever stands for them in the views that are used, and in those held out."""
    assert data.prepared.held_out is not None
    measured = np.ones((4, 40), np.bool_)
    measured[:, :5] = False
    figures = []
    for filled in (0.0, 3.0):
        used, (held, unseen) = data.prepared.projections.data.copy(), data.prepared.held_out
        used[:, :, :5] = filled
        views = replace(data.prepared.projections, data=used)
        held = np.where(measured, held, np.float32(filled))
        given = replace(data.prepared, projections=views, held_out=(held, unseen), measured=measured)
        trial = Trial("method", method, data.geometry.n_views)
        found = run(trial, replace(data, prepared=given), 0)
        figures.append([*found["metrics"].values(), *found["squared_residuals"]])
    np.testing.assert_array_equal(figures[0], figures[1])
    blind = run(trial, replace(data, prepared=replace(given, measured=None)), 0)
    assert blind["metrics"]["residual_held_out"] > 1.2 * found["metrics"]["residual_held_out"]


def test_the_figures_are_those_of_an_fbp_of_the_same_views(data: TrialData) -> None:
    found = run(Trial("method", "fbp", data.geometry.n_views), data, 0)
    expected = fbp(data.prepared.projections.data, data.geometry, filter="hann")
    assert data.truth is not None and data.prepared.held_out is not None
    assert found["metrics"]["psnr"] == pytest.approx(psnr(data.truth, expected))
    volume = Volume(expected, Grid.matching(data.geometry))
    unseen, geometry = data.prepared.held_out
    resolution = ViewResolution.of(geometry, volume.grid)
    seen = at_voxel_resolution(np.ascontiguousarray(unseen.swapaxes(1, 2)), resolution).swapaxes(1, 2)
    left = np.linalg.norm(project(volume, geometry) - seen) / np.linalg.norm(unseen)
    assert found["metrics"]["residual_held_out"] == pytest.approx(left, rel=1e-6)
    assert found["gaussians"] is None
    if STATUS.is_file():  # Linux: this process has its libraries and these arrays, and never had more than now
        assert 1e8 < found["peak_bytes"] <= peak_memory()


def test_a_volume_that_is_written_is_the_one_measured(data: TrialData, tmp_path: Path, capsys: Any) -> None:
    assert done(data, tmp_path, Trial("method", "fbp", 27), keep=True) == 0
    expected = fbp(data.prepared.projections.data, data.geometry, filter="hann")
    np.testing.assert_array_equal(np.load(tmp_path / VOLUME), expected)
    assert data.truth is not None
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["metrics"]["psnr"] == pytest.approx(psnr(data.truth, expected))


def test_a_fit_does_not_learn_from_the_views_that_judge_it(data: TrialData) -> None:
    """Spoiling them changes its residual and nothing else."""
    trial = Trial("method", "r2", 27, settings={"steps": 100, "gaussians": 150})
    assert data.prepared.held_out is not None
    unseen, geometry = data.prepared.held_out
    spoilt = replace(data, prepared=replace(data.prepared, held_out=(2 * unseen, geometry)))
    kept, other = (run(trial, d, 0)["metrics"] for d in (data, spoilt))
    assert kept["psnr"] == other["psnr"] and kept["residual_held_out"] < other["residual_held_out"]


@pytest.mark.parametrize(
    "method",
    [name for name in names_of_one_volume() if not by_name(name).traits.direct],
)
def test_a_trial_with_a_time_ends_when_it_is_over(data: TrialData, method: str) -> None:
    """On a clock that goes on by a tenth of a second whenever it is asked."""
    ticks = itertools.count()
    trial = Trial("method", method, 27, seconds_asked=8.0)
    alone = replace(data, prepared=replace(data.prepared, held_out=None))
    found = run(trial, alone, 0, lambda: 0.1 * next(ticks))
    own_length = by_name(method).traits.own_length
    assert (0 if own_length else 0.6 * 8) < found["seconds"] < 1.1 * 8
    assert np.isfinite(found["metrics"]["psnr"])


def test_as_a_process_it_speaks_lines_of_json(
    tmp_path: Path, data: TrialData, capsys: pytest.CaptureFixture[str]
) -> None:
    assert done(data, tmp_path / "one", Trial("method", "fbp", 27)) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["event"] == "result"
    views = data.prepared.projections
    empty = replace(data.prepared, projections=replace(views, data=np.zeros_like(views.data)))
    trial = Trial("method", "r2", 27, settings={"steps": 2, "gaussians": 10})
    assert done(TrialData(empty, None), tmp_path / "two", trial) == 1
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["event"] == "failed" and "no matter" in last["message"]


def test_data_and_job_come_through_their_folder(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    views = Geometry.cone(
        rng.random(9), (40, 60), 0.5, 60.0, 120.0, shifts=rng.random((9, 2)), roll=0.1, tilt=rng.random(9)
    )
    images: NDArray[np.float32] = rng.random((9, 40, 60)).astype(np.float32)
    whole = replace(
        prepared_views(images, views, weights=images / np.float32(2)), sample_radius=SampleRadius(3.0, 2.0, 4.0, 0.1)
    )
    prepared = replace(whole.of_views(np.arange(3)), held_out=(images[3:], views.select(range(3, 9))))
    TrialData(prepared, images).save(tmp_path / "data")
    add_references(tmp_path / "data", {"os-sirt-tv": images[:1]}, np.ones((1, 2, 3), np.int8))
    back = TrialData.load(tmp_path / "data")
    assert prepared.held_out is not None and back.prepared.held_out is not None
    for one, other in ((back.geometry, prepared.geometry), (back.prepared.held_out[1], prepared.held_out[1])):
        for each in fields(Geometry):
            np.testing.assert_array_equal(getattr(one, each.name), getattr(other, each.name))
    np.testing.assert_array_equal(back.prepared.projections.weights, images[:3] / 2)
    np.testing.assert_array_equal(back.prepared.held_out[0], images[3:])
    np.testing.assert_array_equal(back.truth, images)
    np.testing.assert_array_equal(back.references["os-sirt-tv"], images[:1])
    assert back.regions is not None and back.regions.shape == (1, 2, 3) and list(back.references) == ["os-sirt-tv"]
    for name in ("stretch", "length_unit", "n_projections", "axis_col", "sample_radius", "inside"):
        assert getattr(back.prepared, name) == getattr(prepared, name)
    assert isinstance(back.prepared.projections.data, np.memmap)  # read where it is used
    settings: dict[str, Any] = {"steps": 3, "weight": 3.0, "start": "tv"}
    job = TrialJob(Trial("method", "r2", 3, settings, 1.5, ViewChoice("means", [[0, 1], [2, 3]])), 7, True)
    job.save(tmp_path)
    again = TrialJob.load(tmp_path)
    assert again.trial.choice is not None and again.trial.choice.groups == [[0, 1], [2, 3]]
    assert replace(again, trial=replace(again.trial, choice=None)) == replace(
        job, trial=replace(job.trial, choice=None)
    )
    assert [type(value) for value in again.trial.settings.values()] == [int, float, str]
