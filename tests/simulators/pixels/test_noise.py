"""Noise: the expansion within its bound and the sums against scipy, then the numbers themselves by chi-square."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special, stats

from simulators.frame.shot import CannotExposeError
from simulators.pixels.noise import LEAST, add_normal, poisson, summed
from tests.simulators import chance

SHAPE = (512, 512)


def _poisson(mean: float, seed: int = 0) -> NDArray[np.float64]:
    return poisson(np.full(SHAPE, mean), np.random.default_rng(seed))


@pytest.mark.parametrize("mean", [LEAST, 3.3, 17.0, 240.0, 5e3, 1e5])
def test_the_sums_find_the_quantile_at_its_very_edges(mean: float) -> None:
    """Where Φ(w) passes scipy's P(K <= k), the quantile goes from k to k + 1; seven standard deviations either way."""
    spread = math.sqrt(mean)
    for k in np.unique(np.rint(np.linspace(max(mean - 7 * spread, 0), mean + 7 * spread, 40))):
        lower, upper = stats.poisson.cdf(k, mean), stats.poisson.sf(k, mean)
        edge = special.ndtri(lower) if lower < 0.5 else -special.ndtri(upper)
        assert summed(edge - 1e-8, mean) == k
        assert summed(edge + 1e-8, mean) == k + 1
    for w in (-8.2, -5.5, 5.5, 8.2):  # far from where the expansion is right
        k = summed(w, mean)
        tail = special.ndtr(-abs(w))
        inner, outer = (stats.poisson.cdf(k + n, mean) if w < 0 else stats.poisson.sf(k - 1 - n, mean) for n in (0, -1))
        assert outer <= tail <= inner or k == 0


@pytest.mark.parametrize("mean", [0.003, 0.5, 1.99, 2.01, 5.0, 12.0, 29.0, 31.0, 200.0, 5000.0, 80_000.0])
def test_poisson_numbers_are_poisson(mean: float) -> None:
    k = _poisson(mean)
    chance.poisson_like(k, mean)
    chance.mean_is(k, mean, mean)
    chance.variance_is(k, mean, 1 / mean)
    if mean > 1:
        chance.mean_is((k - mean) ** 3, mean, 15 * mean**3 + 24 * mean**2 + mean)  # central moments 3 and 6


@pytest.mark.parametrize("along", ["rows", "columns"])
def test_each_pixel_has_its_own_expectation(along: str) -> None:
    levels = np.geomspace(0.05, 20_000, 64)
    mean = np.repeat(levels, 4096).reshape(64, 4096)
    if along == "columns":  # small and large ones in every row
        mean = np.ascontiguousarray(mean.T)
    k = poisson(mean.copy(), np.random.default_rng(3))
    z = (k - mean) / np.sqrt(mean)
    for level, numbers in zip(levels, z if along == "rows" else z.T, strict=True):
        chance.mean_is(numbers, 0.0, 1.0)
        chance.variance_is(numbers, 1.0, 1 / level)
    np.testing.assert_array_equal(poisson(np.zeros(SHAPE), np.random.default_rng(0)), 0)


def test_neighbours_and_frames_are_independent() -> None:
    for mean in (0.5, 300.0):
        k, other = _poisson(mean), _poisson(mean, seed=1)
        chance.uncorrelated(k[:, 1:], k[:, :-1])
        chance.uncorrelated(k[1:], k[:-1])
        chance.uncorrelated(k, other)


def test_the_number_of_threads_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
        frame = _poisson(40.0)
        add_normal(frame, 0.4, np.random.default_rng(5))
        frames.append(frame)
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], frames[2])


def test_normal_noise_has_the_rms_of_each_pixel() -> None:
    image = np.full(SHAPE, 7.0)
    add_normal(image, 0.43, np.random.default_rng(0))
    chance.mean_is(image, 7.0, 0.43**2)
    chance.variance_is(image, 0.43**2)
    chance.normal_like((image - 7) / 0.43)
    rms = np.random.default_rng(4).uniform(0.1, 2.0, SHAPE)
    image = np.zeros(SHAPE)
    add_normal(image, rms, np.random.default_rng(0))
    chance.normal_like(image / rms)


@pytest.mark.parametrize("bad", [-1e-9, math.nan, math.inf, 2e9])
def test_what_is_no_expectation_is_refused_and_nothing_is_written(bad: float) -> None:
    image = np.full((4, 5), 3.0)
    image[2, 2] = bad
    before = image.copy()
    with pytest.raises(CannotExposeError, match=r"be 0 ... 1e\+09"):
        poisson(image, np.random.default_rng(0))
    np.testing.assert_array_equal(image, before)
