"""Volumes in time from one scan: known answers, against sub-scans and one volume of all views; what is refused."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.series import Series, TimedViews, fit_series, hats
from recon.voxels.projector import Projector

SIDE, ROWS = 40, 4
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
    dense = Geometry.parallel(angles, (ROWS, wide), 1 / fine)
    box = replace(Grid.matching(dense), slice_pitch=1 / fine)
    seen = [
        Projector(dense.select([v]), box).forward(discs(t, wide))[0].reshape(ROWS, SIDE, fine).mean(2)
        for v, t in enumerate(times)
    ]
    noisy = np.stack(seen) + noise * np.random.default_rng(1).standard_normal((n, ROWS, SIDE))
    return TimedViews(noisy.astype(np.float32), Geometry.parallel(angles, (ROWS, SIDE)), times)


def psnr(found: F32, truth: F32) -> float:
    return float(10 * np.log10(np.ptp(truth) ** 2 / ((found - truth) ** 2).mean()))


def test_shares_are_those_of_linear_interpolation() -> None:
    knots = np.array([2.0, 4.0, 6.0])
    expected = np.array([[1.0, 0, 0], [1, 0, 0], [0.25, 0.75, 0], [0, 0, 1], [0, 0, 1]])
    assert np.array_equal(hats([1.0, 2.0, 3.5, 6.0, 9.0], knots), expected)


def test_the_residual_is_that_of_the_series_in_the_views() -> None:
    views = views_of(60, noise=0.05)
    found = fit_series(views, 3, motion=True, tv_weight=0.05)
    projector = Projector(views.geometry, found.grid)
    model = np.stack([projector.subset([v]).forward(found.at(t))[0] for v, t in enumerate(views.times)])
    left = np.linalg.norm(model - views.projections) / np.linalg.norm(views.projections)
    assert left == pytest.approx(found.residual, rel=0.15)  # views of a moment count as simultaneous, steps go on


def mean_psnr(at: dict[float, F32]) -> float:
    return psnr(
        np.stack(list(at.values())),
        np.stack([discs(t, 2 * SIDE).reshape(ROWS, SIDE, 2, SIDE, 2).mean((2, 4)) for t in at]),
    )


def of_sub_scans(views: TimedViews, parts: int) -> Series:
    """FISTA-TV of each part of the scan, linear in time between their middles."""
    edges = np.arange(parts + 1) * views.times.size // parts
    cut = [np.arange(a, b) for a, b in itertools.pairwise(edges)]
    volumes = [
        recon.reconstruct(views.projections[at], views.geometry.select(at), method=recon.FistaTv()).volume.data
        for at in cut
    ]
    times: F64 = np.array([views.times[at].mean() for at in cut])
    return Series(times, np.stack(volumes), Grid.matching(views.geometry), 0.0)


def test_one_fit_beats_sub_scans_and_one_volume_of_all_views() -> None:
    views = views_of(60, noise=0.05)
    times = (0.5, 2.0, 3.5, 5.0, 6.5, 8.0, 9.5)
    whole = recon.reconstruct(views.projections, views.geometry, method=recon.FistaTv()).volume.data
    others = [mean_psnr(dict.fromkeys(times, whole))]
    for parts in (2, 3, 4, 6):
        apart = of_sub_scans(views, parts)
        others.append(mean_psnr({t: apart.at(t) for t in times}))
    found = fit_series(views, 4, tv_weight=0.1)
    assert mean_psnr({t: found.at(t) for t in times}) > max(others)


def test_the_same_seed_gives_the_same_bits_and_a_stop_the_volumes_so_far() -> None:
    views, heard = views_of(48, noise=0.05), list[int]()

    def go_on(sweep: int, residual: float) -> bool:
        heard.append(sweep)
        return sweep < 3

    first = fit_series(views, 3, tv_weight=0.05, go_on=go_on)
    assert np.array_equal(first.volumes, fit_series(views, 3, tv_weight=0.05, go_on=lambda sweep, _: sweep < 3).volumes)
    assert heard == [1, 2, 3]
    assert first.volumes.dtype == np.float32


@pytest.mark.parametrize("knots", [1, 3])
def test_too_few_and_too_many_volumes_are_refused(knots: int) -> None:
    with pytest.raises(ValueError, match="2 volumes or more, and 12 views or more for each"):
        fit_series(views_of(24), knots)


@pytest.mark.parametrize("times", [np.zeros(24), np.arange(23.0), np.full(24, np.nan)])
def test_times_that_say_nothing_are_refused(times: F64) -> None:
    with pytest.raises(ValueError, match="one a view"):
        replace(views_of(24), times=times)
