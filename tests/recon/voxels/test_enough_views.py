"""Enough views: the gain predicted falls with the views, and angles that are a part of the circle are never enough."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.voxels.enough_views import Gain, Goal, predicted_gains, well_spread
from tests.recon.hard_cases import spheres

GOLDEN = (5**0.5 - 1) / 2


@pytest.mark.usefixtures("one_thread")
def test_the_gain_predicted_falls_with_the_views(rng: np.random.Generator) -> None:
    geometry = Geometry.parallel(np.linspace(0, np.pi, 90, endpoint=False), (8, 48))
    data = spheres.projections(geometry)
    data = -np.log(rng.poisson(2000 * np.exp(-data)) / 2000).astype(np.float32)
    order = np.argsort(np.arange(90) * GOLDEN % 1).argsort()
    data, planned = data[order], geometry.select(order)
    few, most = (np.mean(predicted_gains(data[:n], planned, rng, 2)) for n in (10, 85))
    assert few > most + 1 and abs(most) < 1
    with pytest.raises(ValueError, match="no view to predict"):
        predicted_gains(data, planned, rng, 1)
    with pytest.raises(ValueError, match=r"zero|matter"):
        predicted_gains(np.zeros_like(data[:20]), planned, rng, 1)


@given(st.integers(3, 400), st.floats(0, 10))
def test_golden_angles_are_well_spread_at_any_time(n: int, start: float) -> None:
    assert well_spread(start + np.pi * (np.arange(n) * GOLDEN % 1))


def test_a_sequence_is_well_spread_at_the_end_of_half_a_turn_only() -> None:
    turn = np.radians(np.arange(0, 360, 2.0))
    spread = [n for n in range(4, 181) if well_spread(turn[:n])]
    assert spread == list(range(88, 181))
    interlaced = np.concatenate([turn[:90][i::3] for i in (0, 2, 1)])
    assert all(well_spread(interlaced[:n]) for n in range(30, 91))


@given(st.integers(2, 500), st.integers(1, 300), st.integers(1, 300))
def test_shares_of_a_gain_add_up(n: int, first: int, rest: int) -> None:
    planned = n + first + rest
    whole, later = Gain(n, planned, 1, 1, 1), Gain(n + first, planned, 1, 1, 1)
    share = whole.share_of(first)
    assert 0 < share < 1 and later.share_of(rest) == whole.share_of(first + rest) == 1
    assert share + np.log(planned / (n + first)) / np.log(planned / n) == pytest.approx(1)


def test_a_goal_is_met_by_the_upper_end() -> None:
    gain = Gain.of(90, 180, [0.1, 0.3])
    assert (gain.mean, gain.low, gain.high) == pytest.approx((0.2, 0.0, 0.4))
    assert Goal(psnr_loss=0.41).met(gain) and not Goal(psnr_loss=0.39).met(gain)
    of_ten = 0.4 * np.log(100 / 90) / np.log(2)
    assert Goal(of_ten + 0.01).met(gain) and not Goal(of_ten - 0.01).met(gain)
    assert not Goal(of_ten - 0.01, 0.41).met(gain)
    for wrong in ((None, None), (0.0, None), (None, -1.0)):
        with pytest.raises(ValueError, match="number of dB"):
            Goal(*wrong)
