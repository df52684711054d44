"""R2 through the public call: start and end of fits, held-out projections, checkpoints, all beams and likelihoods."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import recon
import recon.splatting.initialise
from recon import R2, DataUse, RunControl
from recon.assess.metrics import psnr
from recon.base.kernel import Kernel, RayModel
from recon.splatting.settings import FitSettings
from recon.voxels.projector import Projector
from simulators.samples.bodies.phantom import Phantom
from tests.messages import refused
from tests.recon.few_views import GRID, PITCH, SHAPE, VIEWS
from tests.slow_cases import others_slow


def test_a_model_can_be_continued_and_keeps_its_kernel(noisy: np.ndarray) -> None:
    other = next(kernel for kernel in Kernel if kernel is not FitSettings().kernel)
    first = recon.reconstruct(noisy, VIEWS, R2(steps=60, gaussians=800, finish=0, fit=FitSettings(kernel=other)))
    second = recon.reconstruct(
        noisy, VIEWS, R2(steps=60, gaussians=first.gaussians, finish=0, fit=FitSettings(policy=None))
    )
    assert second.history[-1].residual < first.history[-1].residual
    assert second.history[-1].n_gaussians == first.history[-1].n_gaussians
    assert second.settings["kernel"] is other and second.gaussians is not None and second.gaussians.kernel is other


def test_no_step_gives_the_starting_point(noisy: np.ndarray) -> None:
    result = recon.reconstruct(noisy, VIEWS, R2(steps=0, gaussians=300, finish=0))
    assert [p.step for p in result.history] == [0] and result.history[0].n_gaussians == 300
    assert result.gaussians is not None and result.volume.data.max() > 0
    # Scaled to the data: the sum of the volume is that of the line integrals.
    mass = float(result.volume.data.sum()) * PITCH
    assert mass == pytest.approx(float(noisy.sum(axis=(1, 2)).mean()), rel=0.1)


def test_a_time_budget_is_kept(noisy: np.ndarray) -> None:
    ticks = iter(np.arange(0, 1e6, 0.05))
    control = RunControl(now=lambda: float(next(ticks)))
    result = recon.reconstruct(noisy, VIEWS, R2(seconds=2.0, gaussians=500), control=control)
    assert 5 <= result.history[-1].step <= 40


def test_views_held_out_are_measured_and_not_fitted(noisy: np.ndarray) -> None:
    spoilt = noisy.copy()
    spoilt[5] *= 3
    fit, use = R2(steps=60, gaussians=500, finish=0), DataUse(held_out=(5, 17))
    kept, other = (recon.reconstruct(data, VIEWS, fit, use=use) for data in (noisy, spoilt))
    np.testing.assert_array_equal(kept.volume.data, other.volume.data)
    assert kept.history[-1].n_views == 22
    assert other.history[-1].held_out > 3 * kept.history[-1].held_out > 0


@pytest.mark.slow
def test_a_fit_may_end_where_views_held_out_stop_getting_better(noisy: np.ndarray) -> None:
    loud = noisy + np.random.default_rng(0).normal(0, 0.3, noisy.shape).astype(np.float32)
    use = DataUse(held_out=tuple(range(0, 24, 4)))
    fit = R2(steps=3000, gaussians=3000, early_stop=True, fit=FitSettings(pace=15.0))
    ticks = itertools.count()
    every_step = RunControl(now=lambda: float(next(ticks)))  # a clock of seconds would leave steps out of the history
    early = recon.reconstruct(loud, VIEWS, fit, use=use, control=every_step)
    assert early.history[-1].step < 3000
    lowest = min(p.held_out for p in early.history if np.isfinite(p.held_out))
    # What comes back is the model that was best, not the one that stopped.
    again = recon.reconstruct(loud, VIEWS, R2(steps=0, gaussians=early.gaussians), use=use)
    assert again.history[-1].held_out == pytest.approx(lowest, rel=1e-4)


def test_a_fit_can_be_left_and_taken_up_again(noisy: np.ndarray) -> None:
    whole = recon.reconstruct(noisy, VIEWS, R2(steps=120, gaussians=600, finish=0))
    asked: list[int] = []
    control = RunControl(should_stop=lambda: asked.append(0) or len(asked) >= 50)
    part = recon.reconstruct(noisy, VIEWS, R2(steps=120, gaussians=600, finish=0), control=control)
    assert part.history[-1].step == 50 and part.checkpoint is not None
    rest = recon.reconstruct(noisy, VIEWS, R2(steps=120, finish=0), control=RunControl(resume=part.checkpoint))
    np.testing.assert_array_equal(rest.volume.data, whole.volume.data)


def test_checkpoints_are_handed_out_as_the_fit_goes_on(noisy: np.ndarray) -> None:
    kept: list[dict[str, np.ndarray]] = []
    ticks = iter(range(100_000))
    fit = R2(steps=60, gaussians=600, finish=0)
    control = RunControl(
        now=lambda: float(next(ticks)), checkpoint_every=50.0, on_checkpoint=lambda arrays: kept.append(dict(arrays))
    )
    whole = recon.reconstruct(noisy, VIEWS, fit, control=control)
    steps = [int(arrays["counts"][1]) for arrays in kept]
    assert len(steps) > 2 and steps == sorted(set(steps)) and steps[-1] < 60
    rest = recon.reconstruct(noisy, VIEWS, fit, control=RunControl(resume=kept[1]))
    np.testing.assert_array_equal(rest.volume.data, whole.volume.data)


@pytest.mark.slow
def test_early_stopping_goes_on_where_a_fit_was_left(noisy: np.ndarray) -> None:
    # The best model so far was the first one; a fit that was interrupted later must still give it back.
    loud = noisy + np.random.default_rng(0).normal(0, 0.3, noisy.shape).astype(np.float32)
    fit, use = R2(steps=600, gaussians=2000, early_stop=True), DataUse(held_out=(3, 15))
    whole = recon.reconstruct(loud, VIEWS, fit, use=use)
    asked: list[int] = []
    control = RunControl(should_stop=lambda: asked.append(0) or len(asked) >= 220)
    part = recon.reconstruct(loud, VIEWS, fit, use=use, control=control)
    control = RunControl(resume=part.checkpoint)
    rest = recon.reconstruct(loud, VIEWS, R2(steps=600, early_stop=True), use=use, control=control)
    assert rest.history[-1].step == whole.history[-1].step > 220
    np.testing.assert_array_equal(rest.volume.data, whole.volume.data)


@pytest.mark.parametrize("weight", others_slow([1e-20, 1e-3, 1e20]))
def test_only_ratios_of_weights_count(noisy: np.ndarray, weight: float) -> None:
    alone, weighed = (
        recon.reconstruct(noisy, VIEWS, R2(steps=30, gaussians=400, finish=2), use=DataUse(weights=w)).volume.data
        for w in (None, np.full(noisy.shape, weight, np.float32))
    )
    np.testing.assert_allclose(weighed, alone, atol=1e-3 * float(alone.max()))


@pytest.mark.parametrize(
    ("held_out", "message"),
    [
        ((False,) * 20 + (True,) * 4, "held_out must be .* whole number"),
        ((7,), r"projections \[7\] are zero everywhere"),
    ],
)
def test_views_that_cannot_be_held_out_are_refused(noisy: np.ndarray, held_out: tuple[int, ...], message: str) -> None:
    blank = noisy.copy()
    blank[7] = 0
    with pytest.raises(ValueError, match=message):
        recon.reconstruct(blank, VIEWS, R2(steps=3, gaussians=100), use=DataUse(held_out=held_out))
    with refused(ValueError):
        recon.reconstruct(noisy, VIEWS, R2(steps=3, gaussians=100), use=DataUse(held_out=(2.9,)))  # type: ignore[arg-type]


def test_a_checkpoint_of_more_views_is_refused(noisy: np.ndarray) -> None:
    kept = recon.reconstruct(noisy, VIEWS, R2(steps=2, gaussians=100, finish=0)).checkpoint
    with refused(ValueError):
        recon.reconstruct(noisy[:12], VIEWS.select(range(12)), R2(steps=4), control=RunControl(resume=kept))


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        FitSettings(loss="poisson"),
        FitSettings(joined_pixels=2),
        pytest.param(FitSettings(views_per_step=3), marks=pytest.mark.long),
    ],
)
def test_every_way_to_fit_beats_fbp(phantom: Phantom, noisy: np.ndarray, settings: FitSettings) -> None:
    truth = phantom.attenuation(GRID)
    baseline = psnr(truth, recon.reconstruct(noisy, VIEWS, "fbp").volume.data)
    result = recon.reconstruct(noisy, VIEWS, R2(steps=300, gaussians=2500, fit=settings))
    assert psnr(truth, result.volume.data) > baseline + 1


@pytest.mark.slow
def test_pixels_brighter_than_the_beam_do_not_rule_a_poisson_fit(phantom: Phantom, noisy: np.ndarray) -> None:
    # Gamma quanta, or a flat field that was covered, in one pixel of two hundred. They weigh as rays through air do,
    # so more than rays through matter: 22.9 dB, squares alike for all 25.3; by e^3 as much it was 18.5.
    bright = np.where(np.random.default_rng(9).random(noisy.shape) < 0.005, np.float32(-3), noisy)
    likely, squares = (
        recon.reconstruct(bright, VIEWS, R2(steps=300, gaussians=2500, fit=FitSettings(loss=loss))).volume.data
        for loss in ("poisson", "l2")
    )
    truth = phantom.attenuation(GRID)
    assert psnr(truth, likely) > psnr(truth, squares) - 3


@pytest.mark.slow
def test_a_cone_beam_scan_is_fitted(phantom: Phantom) -> None:
    # Data of the voxel projector: nothing of the fit's own formulas.
    truth = phantom.attenuation(GRID)
    around = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    cone = recon.Geometry.cone(around, SHAPE, 2 * PITCH, 12.0, 24.0, axis_col=18.3)
    data = Projector(cone, GRID).forward(truth)
    baseline = psnr(truth, recon.reconstruct(data, cone, "fbp", grid=GRID).volume.data)
    settings = FitSettings(rays=RayModel(exact_above=0.01))
    result = recon.reconstruct(data, cone, R2(steps=500, gaussians=2500, start="fbp", fit=settings), grid=GRID)
    assert psnr(truth, result.volume.data) > baseline + 1
