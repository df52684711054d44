"""Dark current: Poisson of rate x exposure, scattered or asked of every pixel."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.effects.dark_current import FEW, DarkCurrent
from tests.simulators import chance, shots


@pytest.mark.parametrize(("exposure", "binning"), [(0.05, 1), (20.0, 1), (20.0, 2), (100.0, 1), (100.0, 4)])
def test_dark_electrons_are_poisson(exposure: float, binning: int) -> None:
    shot = shots.sized(600, 700, exposure=exposure, binning=binning)
    dark, mean = DarkCurrent().apply(np.zeros((600, 700)), shot), 0.0036 * exposure * binning**2
    chance.mean_is(dark, mean, mean)
    chance.variance_is(dark, mean, 1 / mean)
    chance.poisson_like(dark, mean)
    chance.uncorrelated(dark[1:], dark[:-1])


def test_either_way_has_one_distribution() -> None:
    for rate in (0.99 * FEW, 1.01 * FEW):
        dark = DarkCurrent(rate).apply(np.zeros((600, 700)), shots.sized(600, 700, exposure=1.0))
        chance.poisson_like(dark, rate)


def test_it_adds_new_electrons_to_each_frame() -> None:
    one, other = (DarkCurrent(5.0).apply(np.full((60, 80), 10.5), shots.shot(frame=k)) for k in (1, 2))
    assert set(np.unique(one)) <= {10.5, 11.5, 12.5}
    assert (one != other).any()
