"""One trial: the figures are those of the volume it made."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import psutil
import pytest

from beamline.core.machine import STATUS, peak_memory
from beamline.features.trials import run_trial as module
from beamline.features.trials.run_trial import TrialData, run_trial
from beamline.features.trials.trial import MethodTrial, Outcome
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.method import RunControl
from recon.base.view_data import RayWeights, Views
from recon.base.volume import Grid, Volume
from recon.methods import by_name, names_of_trials
from recon.voxels.fbp import fbp
from recon.voxels.projector import project
from recon.voxels.resolution import ViewResolution, at_voxel_resolution
from tests.beamline.scans import TwoCylinders

pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))


@pytest.fixture
def data() -> TrialData:
    views = Geometry.parallel(SCAN.angles, SCAN.shape, pixel_pitch=0.5, axis_col=SCAN.axis_col)
    integrals = SCAN.line_integrals().astype(np.float32)
    held = np.arange(3, 30, 9)
    half = TwoCylinders(SCAN.angles, SCAN.shape, SCAN.axis_col, 0.5)
    return TrialData(Views(integrals, views).holding_out(held), half.truth(Grid.matching(views)))


def run(trial: MethodTrial, data: TrialData, control: RunControl | None = None) -> Outcome:
    return run_trial(trial, data, control or RunControl())[0]


@pytest.mark.parametrize("method", ["fbp", "fista-tv", "sirt"])
def test_rays_that_were_not_measured_do_not_count(data: TrialData, method: str) -> None:
    """Whatever stands for them in the views that are used, and in those held out."""
    measured = np.ones((4, 40), np.bool_)
    measured[:, :5] = False
    figures = []
    for filled in (0.0, 3.0):
        lines = np.where(measured, data.views.data, np.float32(filled))
        weights = RayWeights((np.broadcast_to(measured.astype(np.float32), lines.shape),))
        given = replace(data.views, data=lines, weights=weights)
        trial = MethodTrial("method", method, data.geometry.n_views)
        found = run(trial, replace(data, views=given))
        figures.append([*found.metrics.values(), *found.squared_residuals])
    np.testing.assert_array_equal(figures[0], figures[1])
    blind = run(trial, replace(data, views=replace(given, weights=None)))
    assert blind.metrics["residual_held_out"] > 1.2 * found.metrics["residual_held_out"]


def test_the_figures_are_those_of_an_fbp_of_the_same_views(data: TrialData) -> None:
    found = run(MethodTrial("method", "fbp", data.geometry.n_views), data)
    expected = fbp(data.views.seen.data, data.geometry, filter="hann")
    apart = data.views.unseen
    assert data.truth is not None and apart is not None
    assert found.metrics["psnr"] == pytest.approx(psnr(data.truth, expected))
    volume = Volume(expected, Grid.matching(data.geometry))
    unseen, geometry = apart.data, apart.geometry
    resolution = ViewResolution.of(geometry, volume.grid)
    seen = at_voxel_resolution(np.ascontiguousarray(unseen.swapaxes(1, 2)), resolution).swapaxes(1, 2)
    left = np.linalg.norm(project(volume, geometry) - seen) / np.linalg.norm(unseen)
    assert found.metrics["residual_held_out"] == pytest.approx(left, rel=1e-6)
    assert found.gaussians is None
    if STATUS.is_file():  # Linux: this process has its libraries and these arrays, and never had more than now
        assert found.peak_bytes is not None and 1e8 < found.peak_bytes <= (peak_memory() or 0)


def test_a_fit_does_not_learn_from_the_views_that_judge_it(data: TrialData) -> None:
    """Spoiling them changes its residual and nothing else."""
    trial = MethodTrial("method", "r2", 27, settings={"steps": 100, "gaussians": 150})
    lines = data.views
    assert lines.held_out.size and lines.used is not None
    twice = np.where(lines.used[:, None, None], lines.data, 2 * lines.data)
    spoilt = replace(data, views=replace(lines, data=twice))
    kept, other = (run(trial, d).metrics for d in (data, spoilt))
    assert kept["psnr"] == other["psnr"] and kept["residual_held_out"] < other["residual_held_out"]


@pytest.mark.parametrize(
    "method",
    [name for name in names_of_trials() if by_name(name).fitted],
)
def test_a_trial_with_a_time_ends_when_it_is_over(data: TrialData, method: str) -> None:
    """On a clock that goes on by a tenth of a second whenever it is asked."""
    ticks = itertools.count()
    trial = MethodTrial("method", method, 27, seconds_asked=8.0)
    alone = replace(data, views=data.views.seen)
    found = run(trial, alone, RunControl(now=lambda: 0.1 * next(ticks)))
    own_length = not by_name(method).ended_by(8.0)
    assert (0 if own_length else 0.6 * 8) < found.seconds < 1.1 * 8
    assert np.isfinite(found.metrics["psnr"])


@pytest.mark.parametrize(
    ("error", "said"), [(ValueError("no matter"), "no matter"), (MemoryError("3 GB"), "Out of memory (3 GB)")]
)
def test_a_method_that_refuses_or_lacks_memory_is_an_outcome(
    data: TrialData, monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr(module, "run_on", refuse)
    outcome, volume = run_trial(MethodTrial("method", "fbp", 27), data)
    assert (outcome.status, volume) == ("failed", None) and said in outcome.message


def test_the_memory_of_a_trial_is_its_own_and_not_that_of_earlier_ones(data: TrialData) -> None:
    if not STATUS.is_file():
        pytest.skip("only Linux counts the peak anew")
    ballast = np.ones(90_000_000)  # 720 MB
    del ballast
    peak = run(MethodTrial("method", "fbp", 27), data).peak_bytes
    assert peak is not None and peak < psutil.Process().memory_info().rss + 3e8
