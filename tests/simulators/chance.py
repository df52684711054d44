"""Chance: tests that compare random samples with theory; each test fails by chance once in a million runs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

FALSE_ALARM = 1e-6
SIGMAS = float(stats.norm.isf(FALSE_ALARM / 2))
"""4.89: largest distance of a normal number from its mean, in standard deviations."""


def mean_is(sample: ArrayLike, mean: float, variance: float) -> None:
    """Assert that independent numbers have this mean, given their variance."""
    values = np.asarray(sample, dtype=np.float64)
    sigmas = (values.mean() - mean) / math.sqrt(variance / values.size)
    assert abs(sigmas) < SIGMAS, f"mean {values.mean():g} is {sigmas:.2f} standard errors from {mean:g}"


def variance_is(sample: ArrayLike, variance: float, excess: float = 0.0) -> None:
    """Assert that independent numbers have this variance, given their excess kurtosis (1 / mean for Poisson)."""
    values = np.asarray(sample, dtype=np.float64)
    sigmas = (values.var(ddof=1) - variance) / (variance * math.sqrt((2 + excess) / values.size))
    assert abs(sigmas) < SIGMAS, f"variance {values.var():g} is {sigmas:.2f} standard errors from {variance:g}"


def skewness_is(sample: ArrayLike, skewness: float) -> None:
    """Assert the skewness of independent, nearly normal numbers; its standard error is √(6 / n)."""
    values = np.asarray(sample, dtype=np.float64).ravel()
    sigmas = (stats.skew(values) - skewness) / math.sqrt(6 / values.size)
    assert abs(sigmas) < SIGMAS, f"skewness is {sigmas:.2f} standard errors from {skewness:g}"


def uncorrelated(first: ArrayLike, second: ArrayLike) -> None:
    """Assert that independent numbers have a correlation of 0; its standard error is 1 / √n."""
    a, b = np.ravel(first), np.ravel(second)
    sigmas = float(np.corrcoef(a, b)[0, 1]) * math.sqrt(a.size)
    assert abs(sigmas) < SIGMAS, f"correlation is {sigmas:.2f} standard errors from 0"


def poisson_like(sample: ArrayLike, mean: float) -> None:
    """Pearson's chi-square test of whole numbers against scipy's Poisson; the tails are merged to at least 20
    expected."""
    values = np.asarray(sample).ravel()
    low, high = stats.poisson.ppf(20 / values.size, mean), stats.poisson.isf(20 / values.size, mean)
    edges = np.arange(int(low), int(high) + 1)
    share = np.diff(np.concatenate([[0.0], stats.poisson.cdf(edges, mean), [1.0]]))
    seen = np.bincount(np.searchsorted(edges, values), minlength=share.size)
    assert (values == np.rint(values)).all()
    if share.size > 1 and share[-1] * values.size < 20:  # almost no values above the last edge
        share, seen = np.append(share[:-2], share[-2:].sum()), np.append(seen[:-2], seen[-2:].sum())
    assert stats.chisquare(seen, share * values.size).pvalue > FALSE_ALARM


def normal_like(sample: ArrayLike, bins: int = 500) -> None:
    """Pearson's chi-square test against the normal distribution, in bins of equal probability."""
    values = np.ravel(sample)
    edges = stats.norm.ppf(np.arange(1, bins) / bins)
    seen = np.bincount(np.searchsorted(edges, values), minlength=bins)
    assert stats.chisquare(seen).pvalue > FALSE_ALARM
