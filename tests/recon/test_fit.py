"""The fit as a whole: it converges, repeats bit for bit, and its gradient is the loss's slope."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from recon import fit
from recon.density_control import DensityPolicy
from recon.gaussians import Gaussians
from recon.geometry import Geometry
from recon.losses import projection_loss
from recon.losses import total_variation as twin_tv
from recon.splat import Truncation, project, voxelize
from recon.volume import Grid
from tests.recon.conftest import Make
from tests.recon.helpers import as_leaves, gradients, in_double

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (22, 26), pixel_pitch=0.5)
GRID = Grid.matching(VIEWS)
PLAIN = fit.FitSettings(policy=None, tv_weight=0.0)


def _problem(truth: Gaussians, settings: fit.FitSettings) -> fit.Problem:
    return fit.make_problem(project(truth, VIEWS).numpy(), VIEWS, GRID, truth.density_unit, settings)


def _disturbed(truth: Gaussians, rng: np.random.Generator) -> Gaussians:
    noise = [
        torch.from_numpy(rng.normal(size=t.shape).astype(np.float32))
        for t in (truth.means, truth.log_scales, truth.quaternions, truth.raw_densities)
    ]
    return Gaussians(
        truth.means + 0.15 * noise[0], truth.log_scales + 0.15 * noise[1], truth.quaternions,
        truth.raw_densities + 0.3 * noise[3], truth.density_unit,
    )  # fmt: skip


def test_a_disturbed_model_finds_back_to_the_data(random_gaussians: Make, rng: np.random.Generator) -> None:
    truth = random_gaussians(30, extent=8.0, smallest=0.6)
    problem = _problem(truth, PLAIN)
    start = _disturbed(truth, rng)
    state = fit.init(start, 0)
    expected = voxelize(truth, GRID).numpy()
    before = np.sqrt(((voxelize(start, GRID).numpy() - expected) ** 2).mean())
    fit.run(state, problem, PLAIN, 600)
    after = np.sqrt(((fit.volume_of(state, GRID, PLAIN).data - expected) ** 2).mean())
    assert after < 0.2 * before
    assert state.residual < 0.03


def test_the_same_seed_gives_the_same_bits(random_gaussians: Make, rng: np.random.Generator) -> None:
    truth = random_gaussians(30, extent=8.0)
    settings = fit.FitSettings(policy=DensityPolicy(start=0, every=5, threshold=1e-9))
    problem, start = _problem(truth, settings), _disturbed(truth, rng)
    ends = [fit.run(fit.init(start, 7, fit.growth(settings)), problem, settings, 20).parameters for _ in range(2)]
    for name in fit.NAMES:
        np.testing.assert_array_equal(ends[0][name], ends[1][name])
    assert ends[0]["raw"].size == 45  # the policy grew the model to its limit


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_units_do_not_matter(random_gaussians: Make, rng: np.random.Generator, unit: float) -> None:
    # Densities (and data) in other units are the same fit.
    truth = random_gaussians(20, extent=8.0)
    start = _disturbed(truth, rng)

    def loss(factor: float) -> float:
        scaled = [replace_unit(g, factor) for g in (truth, start)]
        problem = _problem(scaled[0], PLAIN)
        return fit.run(fit.init(scaled[1], 0), problem, PLAIN, 10).loss

    assert loss(unit) == pytest.approx(loss(1.0), rel=1e-3)


def test_one_step_moves_along_the_twins_gradient(random_gaussians: Make, rng: np.random.Generator) -> None:
    # The whole chain, fused kernels and all, against autograd through the twin: Adam's first moments are 0.1 gradients.
    settings = replace(PLAIN, truncation=Truncation(9.0, 1e-12), tv_weight=0.05, tv_size=64, tv_moves=True)
    truth = random_gaussians(12, extent=7.0)
    start = _disturbed(truth, rng)
    problem = _problem(truth, settings)
    state = fit.init(start, 0)
    twin = in_double(fit.gaussians_of(state))
    scale = problem.half_field * problem.unit
    image = project(twin, VIEWS.select([5]))[0] / scale
    loss = projection_loss(image, torch.from_numpy(problem.images[5]).double(), settings.ssim_weight)
    loss = loss + settings.tv_weight * twin_tv(voxelize(twin, GRID) / problem.unit)
    loss.backward()
    fit.step(state, problem, settings, 0.0, view=5)
    assert state.loss == pytest.approx(loss.item(), rel=1e-4)
    for name, key in zip(("means", "log_scales", "quaternions", "raw_densities"), fit.NAMES, strict=True):
        expected = gradients(twin)[name].numpy()
        found = state.first[key] / 0.1
        np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max(), err_msg=name)


def test_bad_data_are_refused(random_gaussians: Make) -> None:
    data = project(random_gaussians(3), VIEWS).numpy()
    with pytest.raises(ValueError, match="shape"):
        fit.make_problem(data[1:], VIEWS, GRID, 1.0, PLAIN)
    data[2, 3, 4] = np.nan
    with pytest.raises(ValueError, match="1 of"):
        fit.make_problem(data, VIEWS, GRID, 1.0, PLAIN)


def test_a_model_without_gaussians_or_with_bad_ones_is_refused(random_gaussians: Make) -> None:
    g = random_gaussians(3)
    with pytest.raises(ValueError, match="no Gaussians"):
        fit.init(g.select(torch.zeros(3, dtype=torch.bool)), 0)
    with pytest.raises(ValueError, match=r"means .* 9 values"):
        fit.init(replace(g, means=g.means * torch.nan), 0)


def test_any_kind_of_tensor_starts_a_fit(random_gaussians: Make) -> None:
    g = random_gaussians(5)
    for other in (in_double(g), as_leaves(g)):
        state = fit.init(other, 0)
        for name, values in fit.init(g, 0).parameters.items():
            assert state.parameters[name].dtype == np.float32
            np.testing.assert_allclose(state.parameters[name], values, rtol=1e-6)


def test_views_of_nothing_leave_a_model_to_go_on_with(random_gaussians: Make) -> None:
    # All Gaussians fade below the pruning limit; the fit goes on, and no array becomes empty.
    g = random_gaussians(10, extent=6.0)
    policy = DensityPolicy(start=0, stop=2, every=10, prune_below=1e3)
    settings = fit.FitSettings(policy=policy)
    empty = np.zeros((VIEWS.n_views, *VIEWS.detector_shape), np.float32)
    state = fit.run(fit.init(g, 0), fit.make_problem(empty, VIEWS, GRID, 1.0, settings), settings, 25)
    assert state.n == 10 and state.step == 25
    assert all(np.isfinite(values).all() for values in state.parameters.values())


def replace_unit(g: Gaussians, factor: float) -> Gaussians:
    """The same shapes with all densities times `factor`."""
    return replace(g, density_unit=g.density_unit * factor)
