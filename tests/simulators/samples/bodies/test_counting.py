"""Counting: the exponential against numpy's, to a thousandth of what leaves a count in doubt."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.samples.bodies.counting import DOUBT, to_counts


def _doubts(depth: float, light: float) -> bool:
    return bool(to_counts(np.array([depth]), light, 65535.0, np.zeros(1, np.uint16)))


def test_the_polynomial_is_numpy_s_exponential_to_1e_13() -> None:
    """Read off its counts at full range, where a count is 1.5e-5, in steps of the light that would tell 1e-13 apart:
    where both round alike at a boundary that moves by so little, they are as close as that."""
    depth = np.linspace(0, 10, 40_001)
    counts = np.empty(depth.size, np.uint16)
    worst = 0.0
    for light in np.random.default_rng(0).uniform(6e4, 6.5e4, 50):
        to_counts(depth, light, 65535.0, counts)
        exact = light * np.exp(-depth)
        # A count that is not the nearest is one whose exact value lies next to a half.
        wrong = counts != np.rint(exact)
        worst = max(worst, float((0.5 - np.abs(exact - np.rint(exact)))[wrong].max(initial=0.0)))
    assert worst < 0.1 * DOUBT


@pytest.mark.parametrize("depth", [0.0, 1e-3, 0.7, 2.0, 5.5])
def test_a_count_is_in_doubt_by_the_middle_of_two_and_nowhere_else(depth: float) -> None:
    for whole in (0, 7, 200, 60_000):
        light = (whole + 0.5) * np.exp(depth)
        near = 1 + 0.5 * DOUBT / (whole + 0.5)
        far = 1 + 2 * DOUBT / (whole + 0.5)
        assert _doubts(depth, light)
        assert _doubts(depth, light * near)
        assert _doubts(depth, light / near)
        assert not _doubts(depth, light * far)
        assert not _doubts(depth, light / far)


def test_extremes() -> None:
    depth = np.array([-1e300, -800.0, 0.0, 800.0, 1e300])
    counts = np.zeros(5, np.uint16)
    assert not to_counts(depth, 1000.25, 4000.0, counts)
    assert counts.tolist() == [4000, 4000, 1000, 0, 0]
