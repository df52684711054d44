"""Materials from projections at several energies: known answers, gradients, and one volume per energy."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

import recon
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.features.joint.energy_fit import EnergyFit, EnergyViews
from recon.features.joint.spectral import TRIAL_SWEEPS, fit_materials
from recon.reconstruction import reconstruct
from recon.voxels.methods import EarlyTv
from recon.voxels.projector import Projector

SECTIONS = np.array([[0.2, 1.0], [0.5, 0.9], [1.0, 0.2], [0.9, 0.4]])  # [energy, material]
# NMC811, fresh and charged, at 8.320 ... 8.380 keV: they differ in a line of the edge alone. In 1/px of 1.1 um.
EDGE = 1.1e-3 * np.array([[28.2, 28.1], [31.7, 30.4], [117.4, 96.7], [114.3, 128.8], [97.7, 103.9], [91.4, 91.4]])
SIDE, ROWS = 32, 4


def balls(side: int = SIDE, rows: int = ROWS) -> F32:
    """Two materials, [material, z, y, x]: a ring of the first around a mixture of both, and a ball of the second."""
    y, x = (np.mgrid[:side, :side] - (side - 1) / 2) * 2 / side
    far = np.hypot(x + 0.1, y)
    first = np.where(far < 0.3, 0.6, 0.0) + ((far >= 0.3) & (far < 0.5))
    second = np.where(far < 0.3, 0.4, 0.0) + (np.hypot(x - 0.6, y - 0.2) < 0.25)
    return np.ascontiguousarray(np.repeat(np.stack([first, second])[:, None], rows, 1), np.float32)


def views_of(truth: F32, each: int, sections: F64 = SECTIONS, noise: float = 0.0, fine: int = 1) -> EnergyViews:
    """So many views of each energy, interlaced in angle; `truth` has `fine` voxels a pixel, and views are binned."""
    n, (rows, side) = len(sections) * each, (truth.shape[1], truth.shape[-1])
    angles, energy = np.arange(n) * np.pi / n, np.arange(n) % len(sections)
    dense = Geometry.parallel(angles, (rows, side), axis_col=(side - 1) / 2)
    projector = Projector(dense, Grid.matching(dense))
    lines = sum(
        projector.forward(np.ascontiguousarray(volume)) * sections[energy, m][:, None, None]
        for m, volume in enumerate(truth)
    )
    binned = lines.reshape(n, rows, side // fine, fine).mean(3) / fine
    geometry = Geometry.parallel(angles, (rows, side // fine), axis_col=(side // fine - 1) / 2)
    noisy = binned + noise * np.random.default_rng(5).standard_normal(binned.shape)
    return EnergyViews(noisy.astype(np.float32), geometry, energy, sections)


def rms(values: F32) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_densities_are_found_from_views_that_each_see_one_energy() -> None:
    truth = balls()
    found = fit_materials(views_of(truth, 12), tv_weight=1e-3, sweeps=60)
    assert rms(found.densities - truth) < 0.05 * rms(truth)
    assert found.residual < 0.01
    assert found.densities.dtype == np.float32


def test_the_descent_is_minus_the_gradient(rng: np.random.Generator) -> None:
    views = views_of(balls(16, 2), 3, noise=0.1)
    fit = EnergyFit(views, Grid.matching(views.geometry), rng)
    at, along = (rng.standard_normal(fit.z.shape).astype(np.float32) for _ in range(2))

    def half_squares(z: F32) -> float:
        fit.z = np.ascontiguousarray(z, np.float32)
        return sum(fit.descent(subset, np.empty_like(z)) for subset in fit.subsets) / 2

    slope = half_squares(at + 0.5 * along) - half_squares(at - 0.5 * along)  # exact: the squares are quadratic
    fit.z = at
    total = np.zeros(at.shape)
    for subset in fit.subsets:
        out = np.empty_like(at)
        fit.descent(subset, out)
        total += out
    assert -float(np.vdot(total, along)) == pytest.approx(slope, rel=1e-3)


@pytest.mark.slow
def test_few_views_an_energy_tell_the_share_of_a_material_better_than_one_volume_an_energy() -> None:
    """The error of the share is at most half of that by FISTA-TV at each energy with its best of four weights; two
    thirds if that is iterated until the volume stands still."""
    fine = np.repeat(np.repeat(balls(64), 2, 2), 2, 3)
    views = views_of(fine, 10, EDGE, noise=0.02, fine=2)
    truth = fine.reshape(2, ROWS, 64, 2, 64, 2).mean((3, 5))
    matter, share = truth.sum(0) > 0.9, truth[1] / np.maximum(truth.sum(0), 0.1)

    def error(densities: F32) -> float:
        found = densities[1] / np.maximum(densities.sum(0), 0.05)
        return rms((np.clip(found, 0, 1) - share)[matter])

    def separately(method: recon.FistaTv) -> F32:
        volumes = []
        for energy in range(len(EDGE)):
            own = views.energy == energy
            volumes.append(
                reconstruct(
                    views.projections[own], views.geometry.select(np.flatnonzero(own)), method=method
                ).volume.data
            )
        return np.einsum("me,ezyx->mzyx", np.linalg.pinv(EDGE), np.stack(volumes)).astype(np.float32)

    weights, together = (0.003, 0.01, 0.03, 0.1), error(fit_materials(views).densities)
    assert together < 0.5 * min(error(separately(EarlyTv(tv_weight=weight))) for weight in weights)
    assert together < 2 / 3 * min(error(separately(recon.FistaTv(tv_weight=weight))) for weight in weights)


def test_rays_of_weight_zero_do_not_count() -> None:
    views = views_of(balls(), 12)
    weight = np.ones_like(views.projections)
    weight[:, :, 20] = 0
    wrong = np.where(weight > 0, views.projections, np.float32(99))
    spoilt = EnergyViews(wrong, views.geometry, views.energy, SECTIONS, weight)
    densities = fit_materials(spoilt, tv_weight=1e-3, sweeps=60).densities
    assert rms(densities - balls()) < 0.1 * rms(balls())


def test_the_same_seed_gives_the_same_bits_and_a_stop_the_volumes_so_far() -> None:
    views, heard = views_of(balls(), 8, noise=0.05), []

    def go_on(sweep: int, residual: float) -> bool:
        heard.append((sweep, residual))
        return sweep < 3

    first = fit_materials(views, go_on=go_on)
    assert np.array_equal(first.densities, fit_materials(views, go_on=lambda sweep, residual: sweep < 3).densities)
    assert heard[-1] == (3, first.residual)
    assert [sweep for sweep, _ in heard if sweep > 0] == [1, 2, 3]


def test_what_differs_between_energies_gets_a_weight_as_heavy_or_heavier() -> None:
    first, *others = fit_materials(views_of(balls(), 8, noise=0.05)).weights
    assert others and all(math.log2(each / first) in range(5) for each in others)


def test_each_sweep_of_a_trial_of_weights_may_end_the_fit() -> None:
    heard: list[int] = []
    views = views_of(balls(), 8, noise=0.05)

    most = math.inf

    def go_on(sweep: int, residual: float) -> bool:
        heard.append(sweep)
        return len(heard) < most

    fit_materials(views, sweeps=1, go_on=go_on)
    assert heard[-2:] == [0, 1] and max(heard[:-1]) == 0
    assert (np.diff(heard[:-1]) >= 1).all() and -heard[0] < TRIAL_SWEEPS  # what follows at most only falls
    tried = len(heard) - 1
    assert 5 * 8 <= tried <= TRIAL_SWEEPS
    for stop in (1, tried - 3):  # in the first trial, and in those of the other components
        heard.clear()
        most = stop
        fit_materials(views, sweeps=2, go_on=go_on)
        assert len(heard) == stop + 1 and heard[-1] == 1


def test_views_of_nothing_leave_nothing() -> None:
    views = views_of(np.zeros_like(balls()), 8)
    made = fit_materials(views, sweeps=2)
    assert not made.densities.any()
    assert made.residual == 0


def test_the_share_of_nothing_is_not_a_number() -> None:
    found = fit_materials(views_of(balls(), 12), tv_weight=1e-3, sweeps=40)
    share = found.share(1, [0], least=0.5)
    truth = balls()
    assert np.isnan(share[truth.sum(0) == 0]).mean() > 0.95
    assert np.nanmedian(share[(truth[0] > 0.5) & (truth[1] > 0)]) == pytest.approx(0.4, abs=0.03)


@pytest.mark.parametrize(
    ("sections", "energy", "said"),
    [
        ([[1.0, 2.0], [0.5, 1.0]], [0, 1, 0, 1], "separate 2 materials with 2 energies"),
        ([[1.0, 2.0], [2.0, 1.0]], [0, 0, 0, 0], "separate 2 materials with 1 energy:"),
        ([[1.0, 2.0], [2.0, 1.0]], [0, 2, 0, 1], "an index from 0 to 1"),
        ([[1.0, 2.0], [2.0, 1.0]], [0, 1, 0], "for each of the 4 projections"),
        ([[0.0, 0.0], [0.0, 0.0]], [0, 1, 0, 1], "separate 2 materials with 2 energies"),
        ([[1.0, np.nan], [0.5, 1.0]], [0, 1, 0, 1], "cross_sections must be finite"),
    ],
)
def test_what_does_not_fit_is_refused(sections: Sequence[Sequence[float]], energy: list[int], said: str) -> None:
    geometry = Geometry.parallel(np.arange(4.0), (2, 8))
    with pytest.raises(ValueError, match=said):
        EnergyViews(np.zeros((4, 2, 8), np.float32), geometry, np.array(energy), np.array(sections))


def test_values_that_are_not_finite_are_refused() -> None:
    views = views_of(balls(), 4)
    with pytest.raises(ValueError, match="weight 0"):
        EnergyViews(views.projections * np.float32(np.nan), views.geometry, views.energy, SECTIONS)


@pytest.mark.parametrize("at", [5, 300])
@pytest.mark.parametrize("tv_weight", [None, 1e-3])
def test_a_stop_is_asked_for_within_a_sweep_and_keeps_the_steps_before(tv_weight: float | None, at: int) -> None:
    """Stopped at a view's energy of some step: nothing is asked again, and the volumes are those of whole steps."""
    asked, sweeps = list[int](), list[int]()

    def stop() -> bool:
        asked.append(1)
        return len(asked) >= at

    def go_on(sweep: int, residual: float) -> bool:
        sweeps.append(sweep)
        return True

    views = views_of(balls(), 12)
    found = fit_materials(views, tv_weight=tv_weight, sweeps=40, go_on=go_on, stop=stop)
    assert np.isfinite(found.densities).all() and (found.densities > -1e-6).all()
    assert found.densities.any() and len(asked) <= at + 3 and len(sweeps) <= at // (len(SECTIONS) * 2) + 1
    if tv_weight is not None and at == 300:
        assert rms(found.densities - balls()) < 0.3 * rms(balls())
