"""The fit as a whole: it converges, repeats bit for bit, and its gradient is that of the loss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.kernel import Truncation
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting import optimise as fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.problem import FitProblem
from recon.splatting.settings import NAMES, DensityPolicy, FitSettings
from tests.recon.conftest import Make
from tests.recon.helpers import as_leaves, gradients, in_double, run_steps
from tests.recon.kernels.reference import on_grid as voxelize
from tests.recon.kernels.reference import project, projection_loss
from tests.recon.kernels.reference import total_variation as reference_tv

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (22, 26), pixel_pitch=0.5)
GRID = Grid.matching(VIEWS)
PLAIN = FitSettings(policy=None, tv_weight=0.0, views_per_step=1, pace=3.0, decay=0.1)


def _problem(truth: Gaussians, settings: FitSettings) -> FitProblem:
    return fit.problem_of(Views(project(truth, VIEWS).numpy(), VIEWS), GRID, truth.density_unit, settings)


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
    run_steps(state, problem, PLAIN, 600)
    after = np.sqrt(((fit.volume_of(state, GRID, problem.geometry, PLAIN).data - expected) ** 2).mean())
    assert after < 0.2 * before
    assert state.residual < 0.03


def test_one_step_moves_along_the_gradient_of_the_reference(random_gaussians: Make, rng: np.random.Generator) -> None:
    # The whole chain of fused kernels against autograd through the reference: Adam's first moments are 0.1 gradients.
    settings = replace(PLAIN, truncation=Truncation(9.0, 1e-12), tv_weight=0.05, tv_size=64, tv_moves=True)
    truth = random_gaussians(12, extent=7.0)
    start = _disturbed(truth, rng)
    problem = _problem(truth, settings)
    state = fit.init(start, 0)
    double = in_double(fit.gaussians_of(state))
    scale = problem.half_field * problem.unit
    image = project(double, VIEWS.select([5]))[0] / scale
    loss = projection_loss(image, torch.from_numpy(problem.images[5]).double(), settings.ssim_weight)
    loss = loss + float(settings.tv_weight or 0) * reference_tv(voxelize(double, GRID) / problem.unit)
    loss.backward()
    fit.step(state, problem, settings, 0.0, view=5)
    assert state.loss == pytest.approx(loss.item(), rel=1e-4)
    for name, key in zip(("means", "log_scales", "quaternions", "raw_densities"), NAMES, strict=True):
        expected = gradients(double)[name].numpy()
        found = state.first[key] / 0.1
        np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max(), err_msg=name)


def test_the_statistic_is_the_gradient_with_respect_to_the_centre_per_half_detector(
    random_gaussians: Make, rng: np.random.Generator
) -> None:
    settings = replace(PLAIN, truncation=Truncation(9.0, 1e-12))
    truth = random_gaussians(12, extent=7.0)
    problem = _problem(truth, settings)
    state = fit.init(_disturbed(truth, rng), 0)
    double = in_double(fit.gaussians_of(state))
    image = project(double, VIEWS.select([5]))[0] / (problem.half_field * problem.unit)
    projection_loss(image, torch.from_numpy(problem.images[5]).double(), settings.ssim_weight).backward()
    dx, dy, dz = gradients(double)["means"].numpy().T
    across = dx * np.cos(VIEWS.angles[5]) + dy * np.sin(VIEWS.angles[5])
    fit.step(state, problem, settings, 0.0, view=5)
    expected = np.hypot(across, dz) * VIEWS.pixel_pitch * VIEWS.detector_shape[1] / 2
    np.testing.assert_allclose(state.statistic, expected, atol=1e-3 * expected.max())


@pytest.mark.parametrize("fraction", [0.0, 0.5, 1.0])
def test_rates_decay_by_the_schedule(random_gaussians: Make, rng: np.random.Generator, fraction: float) -> None:
    # The first step of Adam is as long as the rate, whatever the gradient.
    truth = random_gaussians(12, extent=7.0)
    problem = _problem(truth, PLAIN)
    state = fit.init(_disturbed(truth, rng), 0)
    before = {name: values.copy() for name, values in state.parameters.items()}
    fit.step(state, problem, PLAIN, fraction)
    for name, rate in zip(NAMES, (2e-4 * problem.half_field, 5e-3, 1e-3, 1e-2), strict=True):
        moved = np.abs(state.parameters[name] - before[name]).max()
        assert moved == pytest.approx(3 * rate * 10**-fraction, rel=0.01), name


def test_total_variation_sees_the_box_that_was_drawn(random_gaussians: Make) -> None:
    settings = replace(PLAIN, truncation=Truncation(9.0, 1e-12), tv_weight=50.0, tv_size=5)
    truth = random_gaussians(12, extent=7.0)
    problem = _problem(truth, settings)
    state = fit.init(truth, 3)
    double = in_double(fit.gaussians_of(state))
    draw = np.random.default_rng(3)
    cut = tuple(slice(c, c + 5) for c in (int(draw.integers(0, n - 5 + 1)) for n in GRID.shape))
    image = project(double, VIEWS.select([5]))[0] / (problem.half_field * problem.unit)
    expected = projection_loss(image, torch.from_numpy(problem.images[5]).double(), settings.ssim_weight)
    expected = expected + float(settings.tv_weight or 0) * reference_tv(voxelize(double, GRID)[cut] / problem.unit)
    fit.step(state, problem, settings, 0.0, view=5)
    assert state.loss == pytest.approx(expected.item(), rel=1e-4)


def test_every_view_comes_once_before_any_comes_twice(random_gaussians: Make) -> None:
    problem, state = _problem(random_gaussians(3), PLAIN), fit.init(random_gaussians(3), 0)
    fit.step(state, problem, PLAIN, 0.0)
    assert len(set(state.drawn)) == VIEWS.n_views - 1


def test_nothing_shrinks_below_what_the_pixels_can_see(random_gaussians: Make) -> None:
    problem = _problem(random_gaussians(3), PLAIN)
    state = fit.init(random_gaussians(5, smallest=0.001, largest=0.01), 0)
    fit.step(state, problem, PLAIN, 0.0)
    np.testing.assert_allclose(np.exp(state.parameters["log_scales"]), 0.3 * VIEWS.pixel_pitch, rtol=1e-5)


def test_copies_start_without_momentum_and_without_statistic(random_gaussians: Make, rng: np.random.Generator) -> None:
    truth = random_gaussians(30, extent=8.0)
    settings = FitSettings(policy=DensityPolicy(start=0, stop=2, every=5, threshold=1e-9))
    state = fit.init(_disturbed(truth, rng), 7, 1.5)
    run_steps(state, _problem(truth, settings), settings, 5)
    assert state.n == 45 and not state.statistic.any() and state.statistic.shape == (45,)
    for moments in (state.first, state.second):
        assert (np.abs(moments["log_scales"]).sum(axis=1) == 0).sum() == 15


def test_density_control_keeps_to_its_window(random_gaussians: Make, rng: np.random.Generator) -> None:
    truth = random_gaussians(20, extent=8.0)
    settings = FitSettings(policy=DensityPolicy(start=0.4, stop=0.6, every=1, threshold=1e-9))
    counts: list[int] = []
    state = fit.init(_disturbed(truth, rng), 7, 10.0)
    run_steps(state, _problem(truth, settings), settings, 10, lambda s: bool(counts.append(s.n)))
    assert counts[:4] == [20] * 4 and counts[3] < counts[4] < counts[5] and counts[5:] == [counts[5]] * 5


@pytest.mark.parametrize(("share", "grows"), [(0.75, False), (0.4, True)])
def test_the_threshold_is_held_against_the_mean_over_steps(
    random_gaussians: Make, rng: np.random.Generator, share: float, grows: bool
) -> None:
    truth = random_gaussians(20, extent=8.0)
    start, problem = _disturbed(truth, rng), _problem(truth, PLAIN)
    total = run_steps(fit.init(start, 7), problem, PLAIN, 2).statistic.max()  # of two steps, so twice the mean
    policy = DensityPolicy(start=0, stop=2, every=2, threshold=share * float(total), prune_below=0)
    settings = replace(PLAIN, policy=policy)
    assert (run_steps(fit.init(start, 7, 2.0), problem, settings, 2).n > 20) == grows


@pytest.mark.parametrize(("length", "density"), [(1e-3, 1.0), (1e3, 1.0), (1.0, 1e-3), (1.0, 1e3)])
def test_units_do_not_matter(random_gaussians: Make, rng: np.random.Generator, length: float, density: float) -> None:
    """Of lengths, or of densities and with them of data: the same fit."""
    truth = random_gaussians(20, extent=8.0)
    start = _disturbed(truth, rng)
    settings = replace(PLAIN, tv_weight=0.15)

    def loss(length: float, density: float) -> float:
        views = Geometry.parallel(VIEWS.angles, VIEWS.detector_shape, pixel_pitch=VIEWS.pixel_pitch * length)
        unit = 0.7 * density / length
        scaled = [
            replace(g, means=g.means * length, log_scales=g.log_scales + np.log(length), density_unit=unit)
            for g in (truth, start)
        ]
        problem = fit.problem_of(Views(project(scaled[0], views).numpy(), views), Grid.matching(views), unit, settings)
        return run_steps(fit.init(scaled[1], 0), problem, settings, 10).loss

    assert loss(length, density) == pytest.approx(loss(1.0, 1.0), rel=1e-3)


def test_a_step_on_all_views_takes_the_mean_gradient_and_the_sum_of_the_statistics(random_gaussians: Make) -> None:
    """Adam's first moment after one step is a tenth of the gradient. The statistic of each view is that of its own
    gradient, not of its share of the step: the threshold is for a mean over views."""
    g = random_gaussians(12, extent=6.0)
    problem = fit.problem_of(Views(project(replace(g, means=g.means + 0.2), VIEWS).numpy(), VIEWS), GRID, 1.0, PLAIN)
    singles = [fit.step(fit.init(g, 0), problem, PLAIN, 0.0, view=v) for v in range(VIEWS.n_views)]
    together = fit.step(fit.init(g, 0), problem, replace(PLAIN, views_per_step=VIEWS.n_views), 0.0)
    for name in NAMES:
        expected = np.mean([single.first[name] for single in singles], axis=0)
        np.testing.assert_allclose(together.first[name], expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(together.statistic, np.sum([each.statistic for each in singles], axis=0), rtol=1e-4)
    assert together.views_shown == VIEWS.n_views


def test_the_misfit_of_all_views_is_the_root_mean_square_of_theirs(random_gaussians: Make) -> None:
    g = random_gaussians(12, extent=6.0)
    moved = replace(g, means=g.means + 0.2)
    model, data = (project(one, VIEWS).numpy().astype(np.float64) for one in (moved, g))
    each = np.linalg.norm((model - data).reshape(24, -1), axis=1) / np.linalg.norm(data.reshape(24, -1), axis=1)
    assert each.min() > 0.01 and each.max() < 0.9  # far from 0 and 1, which are their own squares
    found = fit.misfit_of(fit.init(moved, 0), _problem(g, PLAIN), PLAIN)
    assert found == pytest.approx(np.sqrt((each**2).mean()), rel=2e-3)


def test_a_model_without_gaussians_or_with_bad_ones_is_refused(random_gaussians: Make) -> None:
    g = random_gaussians(3)
    with pytest.raises(ValueError, match="at least one Gaussian"):
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
    settings = FitSettings(policy=policy)
    empty = np.zeros((VIEWS.n_views, *VIEWS.detector_shape), np.float32)
    state = run_steps(fit.init(g, 0), fit.problem_of(Views(empty, VIEWS), GRID, 1.0, settings), settings, 25)
    assert state.n == 10 and state.step == 25
    assert all(np.isfinite(values).all() for values in state.parameters.values())


def test_quaternions_are_brought_to_length_one_without_a_turn(
    random_gaussians: Make, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    # After the step that does it the model is the same and the next gradient's measure is that of Adam's moments.
    truth = random_gaussians(12, extent=7.0)
    problem = _problem(truth, PLAIN)
    start = _disturbed(truth, rng)
    states = []
    for every in (100, 3):
        monkeypatch.setattr(fit, "NORMALISE", every)
        states.append(run_steps(fit.init(start, 0), problem, PLAIN, 3))
    kept, brought = states
    q, unit = kept.parameters["quaternions"], brought.parameters["quaternions"]
    length = np.linalg.norm(q, axis=1, keepdims=True)
    assert np.abs(length - 1).max() > 0.01
    np.testing.assert_allclose(unit, q / length, rtol=1e-6)
    np.testing.assert_allclose(brought.first["quaternions"], kept.first["quaternions"] * length, rtol=1e-5)
    np.testing.assert_allclose(brought.second["quaternions"], kept.second["quaternions"] * length**2, rtol=1e-5)
