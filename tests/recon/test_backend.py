"""The CPU backend's operations make the step that a fit makes."""

from __future__ import annotations

import numpy as np
import pytest

from recon import fit
from recon.backend import backend_for
from recon.geometry import Geometry
from recon.volume import Grid
from tests.recon.conftest import Make


def test_a_step_in_the_backends_operations_is_the_fits(random_gaussians: Make, rng: np.random.Generator) -> None:
    geometry = Geometry.parallel([0.7, 1.9], (15, 22), pixel_pitch=0.5)
    grid = Grid.matching(geometry)
    settings = fit.FitSettings(policy=None, tv_weight=0.0)
    problem = fit.make_problem(rng.random((2, 15, 22)).astype(np.float32), geometry, grid, 0.7, settings)
    state = fit.init(random_gaussians(30, 8.0), 3)
    backend, cut = backend_for("cpu"), settings.truncation
    mine, first, second = ([backend.array(a) for a in arrays] for arrays in _arrays(state))
    run = backend.begin(*mine, 1 / problem.half_field)
    loss = backend.projection_loss(geometry.detector_shape, settings.ssim_weight)
    view = run.view(geometry, 1, cut.faint, cut.sigmas)
    value, slope = loss(view.image, problem.images[1], loss.target_maps(problem.images[1]))
    centres = view.backward(slope)
    rates = [rate * settings.pace for rate in settings.rates]
    rates[0] *= problem.half_field
    backend.adam(mine, run.gradients(), first, second, rates, 1)

    fit.step(state, problem, settings, 0.0, view=1)
    assert float(value) == pytest.approx(state.loss, rel=1e-6)
    np.testing.assert_allclose(np.hypot(*centres.T) * 11, state.statistic, rtol=1e-5)
    low = np.log(settings.smallest * geometry.pixel_pitch)
    mine[1] = np.clip(mine[1], low, np.log(problem.half_field))
    for a, name in zip(mine, fit.NAMES, strict=True):
        np.testing.assert_allclose(backend.numpy(a), state.parameters[name], rtol=1e-5, atol=1e-6)


def _arrays(state: fit.FitState) -> list[list[np.ndarray]]:
    return [[source[name] for name in fit.NAMES] for source in (state.parameters, state.first, state.second)]
