"""The weight of total variation from noise: its first value, its update from the residual, and its effect."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.iterative import solve
from recon.voxels.methods import FistaTv, OsSirtTv
from recon.voxels.priors import TvWeight
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]
VIEWS = Geometry.parallel(np.linspace(0, np.pi, 48, endpoint=False), (12, 64))
GRID = Grid.matching(VIEWS)


def _residual(sigma: float) -> F32:
    return np.random.default_rng(0).normal(0, sigma, (9, 40, 40)).astype(np.float32)


@cache
def _grains() -> tuple[F32, F32]:
    """Grains of one density with sharp edges in a disc, and their projections, from voxels of half the size."""
    rng = np.random.default_rng(8)
    fine = Grid((24, 128, 128), 0.5)
    z, y, x = np.meshgrid(*fine.coordinates(), indexing="ij")
    volume = np.zeros(fine.shape, np.float32)
    for _ in range(60):
        radius, angle = 24 * np.sqrt(rng.random()), 2 * np.pi * rng.random()
        centre = radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-6, 6)
        near = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2
        volume[near < rng.uniform(2, 6) ** 2] = 0.05
    views = Geometry.parallel(VIEWS.angles, (24, 128), pixel_pitch=0.5)
    data = Projector(views, fine).forward(volume).reshape(48, 12, 2, 64, 2).mean(axis=(2, 4))
    return volume.reshape(12, 2, 64, 2, 64, 2).mean(axis=(1, 3, 5)), data.astype(np.float32)


def test_it_rises_by_the_square_of_the_missing_noise_in_the_residual() -> None:
    balance = TvWeight(first=2.0, noise=1.0, sweeps=8)
    assert balance.value == 2.0
    balance.after_sweep(_residual(0.8))
    assert balance.value == pytest.approx(2.0 / 0.8**2, rel=0.05)
    balance.after_sweep(_residual(1.0))
    assert balance.value == pytest.approx(2.0, rel=0.05)


def test_it_stays_between_its_first_value_and_four_times_that() -> None:
    balance = TvWeight(first=2.0, noise=1.0, sweeps=8)
    values = []
    for sigma in (30.0, 0.01):
        balance.after_sweep(_residual(sigma))
        values.append(balance.value)
    assert values == [2.0, 8.0]


def test_what_no_volume_explains_makes_it_heavier_when_three_eighths_are_done() -> None:
    balance = TvWeight(first=2.0, noise=1.0, sweeps=8)
    values = []
    for sigma in (9.0, 3.0, 2.0, 5.0, 1.4, 1.0, 100.0):
        balance.after_sweep(_residual(sigma))
        values.append(balance.value)
    assert values == pytest.approx([2, 2, 8, 8, 2 * 1.4**2, 2, 2], rel=0.05)


def test_a_slow_method_is_looked_at_later() -> None:
    """OS-SIRT has not converged after three sweeps; what it still left of the views made the weight too heavy."""
    balance = TvWeight(1.0, 1.0, sweeps=40)
    assert [balance.after_sweep(_residual(2.0)) for _ in range(14)] == [1.0] * 14
    assert balance.after_sweep(_residual(1.0)) == pytest.approx(1.0, rel=0.05)


@pytest.mark.slow
def test_both_methods_make_the_same_of_a_porous_slice_in_a_fan(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the weight by the noise; OS-SIRT-TV was 5.9 dB below FISTA-TV on a slice of bone."""
    monkeypatch.setattr("recon.voxels.trial.preferred_strength", lambda *_: None)
    n, views = 160, 50
    y, x = np.mgrid[: 2 * n, : 2 * n] - (n - 0.5)
    off = np.hypot(x, y)
    bone = (gaussian_filter(rng.normal(size=off.shape), 5) > 0.02) | (off > 0.75 * n)
    fine = np.where((off < 0.85 * n) & bone, 1.5 / n, 0).astype(np.float32)
    image = fine.reshape(n, 2, n, 2).mean((1, 3))
    fan, finer = (Geometry.fan(np.arange(views) * 2 * np.pi / views, k * n, 2 / k, 4 * n, 8 * n) for k in (1, 2))
    data = Projector(finer, Grid((1, 2 * n, 2 * n), 0.5)).forward(fine[None]).reshape(views, 1, n, 2).mean(3)
    data = (data + rng.normal(0, 0.02, data.shape)).astype(np.float32)
    projector = Projector(fan, Grid((1, n, n)))
    fista, sirt = (psnr(solve(method, projector, data).data, image[None]) for method in (FistaTv(), OsSirtTv()))
    assert sirt > fista - 1


def test_nothing_is_changed_by_a_residual_that_says_nothing() -> None:
    balance = TvWeight(first=2.0, noise=1.0, sweeps=8)
    balance.after_sweep(np.zeros((2, 3, 3), np.float32))
    assert balance.value == 2.0


@pytest.mark.slow
@pytest.mark.parametrize(("method", "sigma"), [(FistaTv(), 0.02), (OsSirtTv(), 0.08)], ids=["fista-tv", "os-sirt-tv"])
def test_its_volume_is_near_that_of_the_best_weight(method: FistaTv | OsSirtTv, sigma: float) -> None:
    (truth, clean), projector = _grains(), Projector(VIEWS, GRID)
    data = clean + np.random.default_rng(1).normal(0, sigma, clean.shape).astype(np.float32)
    found = psnr(truth, solve(method, projector, data).data)
    scale = {FistaTv: 1e-4, OsSirtTv: 1e-3}[type(method)]
    by_hand = [psnr(truth, solve(type(method)(tv_weight=scale * w), projector, data).data) for w in (0.3, 1, 3, 10, 30)]
    assert found > max(by_hand) - 1.0


def test_without_noise_there_is_next_to_no_total_variation() -> None:
    (truth, clean), projector = _grains(), Projector(VIEWS, GRID)
    found, free = (psnr(truth, solve(FistaTv(tv_weight=w), projector, clean).data) for w in (None, 0.0))
    assert found > free - 0.5


@pytest.mark.slow
@pytest.mark.parametrize("method", [FistaTv(), OsSirtTv()], ids=["fista-tv", "os-sirt-tv"])
def test_faint_matter_beside_metal_has_no_checkerboard(method: FistaTv | OsSirtTv) -> None:
    """A weight in units of the metal (tv_weight=0.004) leaves one of a quarter of the faint density."""
    z, y, x = np.meshgrid(*GRID.coordinates(), indexing="ij")
    volume = np.where(np.hypot(x, y) < 26, np.float32(0.002), np.float32(0))
    volume = np.where((np.hypot(x - 6, y + 4) < 5) & (z > 2), np.float32(0.2), volume)
    projector = Projector(VIEWS, GRID)
    noise = np.random.default_rng(0).normal(0, 0.01, projector.projection_shape).astype(np.float32)
    found = solve(method, projector, projector.forward(volume) + noise).data
    board = np.where(np.indices(GRID.shape).sum(axis=0) % 2, 1, -1)
    faint = (np.hypot(x, y) < 20) & (z < -2)
    assert found[faint].mean() == pytest.approx(0.002, rel=0.1)
    assert abs((found * board)[faint].mean()) < 0.03 * 0.002
