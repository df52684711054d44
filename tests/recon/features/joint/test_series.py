"""Volumes in time from one scan: known answers, comparison with sub-scans and a single volume, and errors."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import recon
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.features.joint.proportions import SOLUTION_STEPS
from recon.features.joint.series import TimedViews, TimedVolumes, fit_series, hats, of_moments
from recon.voxels.projector import Projector
from tests.refused_calls import refused_calls

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 40, endpoint=False), (2, 8), pixel_pitch=1.0)
ONES = np.ones((40, 2, 8), np.float32)


SIDE, ROWS = 40, 2
GOLDEN = np.pi * (np.sqrt(5) - 1) / 2


def discs(seconds: float, side: int = SIDE) -> F32:
    """Discs in a ring [z, y, x], each of which loses half of its density at a time of its own between 0 and 10 s."""
    y, x = (np.mgrid[:side, :side] - (side - 1) / 2) * 2 / side
    slice_ = 0.4 * ((np.hypot(x, y) < 0.85) & (np.hypot(x, y) > 0.78)).astype(np.float32)
    rng = np.random.default_rng(4)
    for at_x in (-0.5, -0.17, 0.17, 0.5):
        for at_y in (-0.4, 0.0, 0.4):
            begin = rng.uniform(0, 7)
            slice_ += (np.hypot(x - at_x, y - at_y) < 0.14) * np.float32(1 - 0.5 * np.clip((seconds - begin) / 3, 0, 1))
    return np.ascontiguousarray(np.repeat(slice_[None], ROWS, 0))


def views_of(n: int, noise: float = 0.0, fine: int = 2) -> TimedViews:
    """Golden-angle views over 10 s. The sample has `fine` voxels a pixel."""
    times = (np.arange(n) + 0.5) * 10 / n
    angles, wide = GOLDEN * np.arange(n), SIDE * fine
    dense = Geometry.parallel(angles, (ROWS, wide), pixel_pitch=1 / fine)
    box = replace(Grid.matching(dense), slice_pitch=1 / fine)
    seen = [
        Projector(dense.select([v]), box).forward(discs(t, wide))[0].reshape(ROWS, SIDE, fine).mean(2)
        for v, t in enumerate(times)
    ]
    noisy = np.stack(seen) + noise * np.random.default_rng(1).standard_normal((n, ROWS, SIDE))
    return TimedViews(noisy.astype(np.float32), Geometry.parallel(angles, (ROWS, SIDE)), times)


@pytest.fixture
def no_factors(monkeypatch: pytest.MonkeyPatch) -> None:
    """No trial of factors of the mean, which takes most of the time of a fit."""
    monkeypatch.setattr("recon.features.joint.series.smooth_factors", lambda *_: None)


def psnr(found: F32, truth: F32) -> float:
    return float(10 * np.log10(np.ptp(truth) ** 2 / ((found - truth) ** 2).mean()))


def test_shares_are_those_of_linear_interpolation() -> None:
    knots = np.array([2.0, 4.0, 6.0])
    expected = np.array([[1.0, 0, 0], [1, 0, 0], [0.25, 0.75, 0], [0, 0, 1], [0, 0, 1]])
    assert np.array_equal(hats([1.0, 2.0, 3.5, 6.0, 9.0], knots), expected)


@pytest.mark.slow
def test_the_residual_is_that_of_the_series_in_the_views() -> None:
    views = views_of(60, noise=0.05)
    found = fit_series(views, 3, motion=True, tv_weight=0.15)
    projector = Projector(views.geometry, found.grid)
    model = np.stack([projector.subset([v]).forward(found.at(t))[0] for v, t in enumerate(views.times)])
    left = np.linalg.norm(model - views.projections) / np.linalg.norm(views.projections)
    assert left == pytest.approx(found.residual, rel=0.15)  # that of the last sweep, while its steps go on


@pytest.mark.usefixtures("no_factors")
def test_a_linear_change_is_found_from_views_without_noise() -> None:
    """Views of the model itself: what bounds the error is the number of sweeps (60: 49 dB, 120: 62 dB). With views that
    count as of eight moments it is 29 dB after any number."""
    n = 60
    times, geometry = np.linspace(0, 10, n), Geometry.parallel(GOLDEN * np.arange(n), (ROWS, SIDE))
    truth = np.stack([discs(0.0), discs(10.0)])
    whole = Projector(geometry, Grid.matching(geometry))
    data = np.einsum("vk,kvrc->vrc", hats(times, np.array([0.0, 10.0])), np.stack([whole.forward(x) for x in truth]))
    found = fit_series(
        TimedViews(data.astype(np.float32), geometry, times), 2, motion=False, tv_weight=0.01, sweeps=120
    )
    assert psnr(found.volumes, truth) > 50
    assert psnr(found.at(5.0), truth.mean(0)) > 50


@pytest.mark.usefixtures("no_factors")
def test_a_scan_counts_at_most_so_many_moments_and_learns_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    views, found = views_of(60, noise=0.05), list[F32]()
    for most in (16, 64):
        monkeypatch.setattr("recon.features.joint.series.MOMENTS", most)
        found.append(fit_series(views, 3, motion=False, tv_weight=0.5, sweeps=20).volumes)
    assert psnr(found[0], found[1]) > 35


def mean_psnr(at: dict[float, F32]) -> float:
    return psnr(
        np.stack(list(at.values())),
        np.stack([discs(t, 2 * SIDE).reshape(ROWS, SIDE, 2, SIDE, 2).mean((2, 4)) for t in at]),
    )


def of_sub_scans(views: TimedViews, parts: int) -> TimedVolumes:
    """FISTA-TV of each part of the scan, linear in time between their middles."""
    edges = np.arange(parts + 1) * views.times.size // parts
    cut = [np.arange(a, b) for a, b in itertools.pairwise(edges)]
    volumes = [
        recon.reconstruct(views.projections[at], views.geometry.select(at), method=recon.FistaTv()).volume.data
        for at in cut
    ]
    times: F64 = np.array([views.times[at].mean() for at in cut])
    return TimedVolumes(times, np.stack(volumes), Grid.matching(views.geometry), 0.0)


@pytest.mark.slow
def test_one_fit_beats_sub_scans_and_one_volume_of_all_views() -> None:
    views = views_of(60, noise=0.05)
    times = (0.5, 2.0, 3.5, 5.0, 6.5, 8.0, 9.5)
    whole = recon.reconstruct(views.projections, views.geometry, method=recon.FistaTv()).volume.data
    others = [mean_psnr(dict.fromkeys(times, whole))]
    for parts in (2, 3, 4, 6):
        apart = of_sub_scans(views, parts)
        others.append(mean_psnr({t: apart.at(t) for t in times}))
    found = fit_series(views, 4, motion=False, tv_weight=0.35)
    assert found.smooth is not None  # each disc changes by a factor of its own
    assert mean_psnr({t: found.at(t) for t in times}) > max(others) + 1


def test_the_same_seed_gives_the_same_bits_and_a_stop_the_volumes_so_far() -> None:
    views, heard = views_of(48, noise=0.05), list[int]()

    def go_on(sweep: int, residual: float) -> bool:
        heard.append(sweep)
        return sweep < 3

    first = fit_series(views, 3, motion=False, tv_weight=0.05, sweeps=6, go_on=go_on)
    again = fit_series(views, 3, motion=False, tv_weight=0.05, sweeps=6, go_on=lambda sweep, _: sweep < 3)
    assert np.array_equal(first.volumes, again.volumes)
    assert heard[-3:] == [1, 2, 3]
    assert first.volumes.dtype == np.float32


def blobs() -> F32:
    """A cylinder [z, y, x] with discs of other densities."""
    rng = np.random.default_rng(2)
    y, x = (np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2) * 2 / SIDE
    slice_ = 0.4 * (np.hypot(x, y) < 0.6).astype(np.float32)
    for _ in range(12):
        at_x, at_y = rng.uniform(-0.45, 0.45, 2)
        slice_[np.hypot(x - at_x, y - at_y) < rng.uniform(0.06, 0.15)] = rng.choice([0, 0.7, 1.0])
    return np.ascontiguousarray(np.repeat(slice_[None], ROWS, 0))


@pytest.mark.slow
@pytest.mark.parametrize("moves", [True, pytest.param(False, marks=pytest.mark.long)])
def test_views_held_out_tell_a_sample_that_moves_from_one_that_fades_where_angles_rise(moves: bool) -> None:
    """By five columns of forty in half a turn: views before and after one held out predict it, too."""
    times, geometry = np.linspace(0, 10, 48), Geometry.parallel(np.pi * np.arange(48) / 48, (ROWS, SIDE))
    still, projector = blobs(), Projector(geometry, Grid.matching(geometry))

    def at(seconds: float) -> F32:
        if moves:
            return np.asarray(ndimage.shift(still, (0, 0, seconds / 2 - 2.5), order=1), np.float32)
        return still - np.float32(seconds / 20) * np.maximum(still - np.float32(0.4), 0)

    seen = np.stack([projector.subset([v]).forward(at(t))[0] for v, t in enumerate(times)])
    seen += 0.02 * seen.max() * np.random.default_rng(1).standard_normal(seen.shape).astype(np.float32)
    found = fit_series(TimedViews(seen, geometry, times), 2, tv_weight=2.3, sweeps=2)
    assert found.unseen_residuals is not None
    without, with_motion = found.unseen_residuals
    assert (found.motion is not None) == (with_motion < without) == moves


def test_an_end_of_the_factors_gives_the_volumes_without() -> None:
    views, past = views_of(48, noise=0.05), list[int]()

    def go_on(sweep: int, residual: float) -> bool:
        past.append(sweep)
        return not (sweep <= 0 and 10 in past)

    kept = fit_series(views, 3, motion=False, tv_weight=0.35, sweeps=10, go_on=go_on)
    assert past[-1] == 1 - SOLUTION_STEPS and kept.smooth is None
    whole = fit_series(views, 3, motion=False, tv_weight=0.35, sweeps=10)
    assert whole.smooth is not None and psnr(kept.volumes, whole.volumes) > 20


@pytest.mark.parametrize("asked", [1, 40])
def test_a_stop_within_a_sweep_gives_volumes(asked: int) -> None:
    """Also while the weight is tried."""
    calls = list[int]()

    def stop() -> bool:
        calls.append(1)
        return len(calls) >= asked

    found = fit_series(views_of(48, noise=0.05), 3, stop=stop)
    assert np.isfinite(found.volumes).all()
    assert found.volumes.min() > -1e-6  # rounding
    assert len(calls) < asked + 8


def test_a_gap_with_too_few_views_for_a_volume_is_refused() -> None:
    views = views_of(60)
    gap = replace(views, times=np.where(views.times < 3, views.times, views.times + 20))
    with pytest.raises(
        ValueError,
        match=r"volume 2 of 4.*: 0 projections are closer to this time than 4.9.*, but at least 6 are needed",
    ):
        fit_series(gap, 4)


def test_each_part_of_a_scan_with_a_moment_a_view_sees_all_times_and_directions() -> None:
    """Also the views held out, of which there are eight parts."""
    views = views_of(72)
    for parts in (8, 9):
        timed, past = of_moments(views, np.array([0.0, 10.0]), 72)
        part = timed.parted(parts)
        assert past.size == 72
        for number in range(parts):
            own = np.flatnonzero(part == number)
            assert own.size == 72 // parts
            assert np.diff(np.r_[-1, own, 72]).max() <= 72 / 3
            angles = np.sort(np.mod(views.geometry.angles[own], np.pi))
            assert np.diff(np.r_[angles, angles[0] + np.pi]).max() < np.pi / 3


test_calls_that_are_refused = refused_calls(__file__, globals())
