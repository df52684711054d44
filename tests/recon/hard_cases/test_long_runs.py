"""Many steps on data that a model can explain exactly: nothing drifts or grows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting import optimise as fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project
from tests.recon.helpers import run_steps

VIEWS = Geometry.parallel(np.linspace(0, math.pi, 12, endpoint=False), (12, 24))
N = 40


def _start_and_data() -> tuple[Gaussians, np.ndarray]:
    """A disturbed model with one Gaussian that no view sees, and projections of the undisturbed one."""
    rng = np.random.default_rng(0)
    places, shapes = rng.uniform(-4.5, 4.5, (N, 3)), rng.uniform(0.7, 1.8, (N, 3))
    densities, quaternions = rng.uniform(0.2, 1, N), rng.normal(size=(N, 4))
    places[-1] = 900.0
    truth = Gaussians.from_physical(places, shapes, densities, quaternions, density_unit=0.7)
    moved = places + np.where(np.arange(N)[:, None] < N - 1, 0.3, 0) * rng.normal(size=(N, 3))
    start = Gaussians.from_physical(moved, 1.2 * shapes, 0.8 * densities, quaternions + 0.1, density_unit=0.7)
    return start, project(truth, VIEWS).numpy()


@pytest.mark.parametrize(
    ("steps", "loss"),
    [
        (1500, 9e-4),
        pytest.param(30_000, 6e-4, marks=[pytest.mark.slow, pytest.mark.long, pytest.mark.timeout(600)]),
    ],
)
def test_steps_without_drift(steps: int, loss: float) -> None:
    start, data = _start_and_data()
    # A lower last rate than by default, for which the bounds below were measured: the loss falls as far as it lets.
    settings = FitSettings(policy=None, tv_weight=0.0, pace=20.0, decay=0.03)
    problem = fit.problem_of(Views(data, VIEWS), Grid.matching(VIEWS), 0.7, settings)
    state = fit.init(start, 0)
    losses: list[float] = []

    def kept(state: fit.FitState) -> bool:
        losses.append(float(state.loss))
        return False

    run_steps(state, problem, settings, steps, kept)
    # The path of Adam on absolute differences depends on every bit while rates are high. Over 16 seeds the running loss
    # of 20 steps rose to 2.4 times its best so far, a mean over a twentieth of the run to 1.6 times, and the last one
    # was within 1.1 of the best.
    after = np.array(losses[100:])
    assert (after < 5 * np.minimum.accumulate(after)).all()
    twentieths = np.array(losses).reshape(20, -1).mean(axis=1)
    assert (twentieths < 2.5 * np.minimum.accumulate(twentieths)).all()
    assert twentieths[-1] < 1.2 * twentieths.min()
    assert twentieths[-1] < 0.2 * twentieths[1]
    # What is minimised, at the end: 4.9e-4 to 5.5e-4 after 30 000 steps (10 runs, two versions of the kernels),
    # 5.0e-4 to 7.3e-4 after 1500 (8 runs). The root mean square of a single state scatters more:
    # 0.0013 to 0.0020 in all of them.
    assert twentieths[-1] < loss
    assert fit.misfit_of(state, problem, settings) < 0.003
    p = state.parameters
    assert all(np.isfinite(values).all() for arrays in (p, state.first, state.second) for values in arrays.values())
    # A gradient is across its quaternion, so that every step makes it longer: they are brought back now and then.
    lengths = np.linalg.norm(p["quaternions"], axis=1)
    assert np.abs(lengths - 1).max() < 1e-6
    seen = np.abs(p["means"]).max(axis=1) < 800
    assert seen.sum() == N - 1
    assert np.abs(p["means"][seen]).max() < 12  # the field's half
    scales = np.exp(p["log_scales"][seen])
    assert scales.min() > 0.3 * VIEWS.pixel_pitch and scales.max() < 4
    assert np.abs(p["raw"][seen]).max() < 4
    # No view sees the last one: not a bit of it has moved.
    np.testing.assert_array_equal(p["means"][~seen], start.means.numpy()[-1:])
    np.testing.assert_array_equal(p["raw"][~seen], start.raw_densities.numpy()[-1:])
