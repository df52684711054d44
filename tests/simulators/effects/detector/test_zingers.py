"""Zingers: rate, exponential charges, in one frame only; tracks are straight."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from simulators.effects.detector.zingers import Zingers
from simulators.frame.shot import CannotExposeError
from tests.simulators import chance, shots


def _frame(effect: Zingers, number: int, side: int = 400) -> NDArray[np.float64]:
    return effect.apply(np.zeros((side, side)), shots.sized(side, side, exposure=0.01, frame=number))


def test_zingers_are_as_many_as_their_rate_says_and_in_one_frame_only() -> None:
    frames = np.stack([_frame(Zingers(1000.0, 500.0), k) for k in range(60)])
    chance.mean_is((frames > 0).sum(axis=(1, 2)), 10.0, 10.0)  # 10 ms of 1000/s
    charges = frames[frames > 0]
    assert stats.kstest(charges, "expon", args=(0, 500)).pvalue > chance.FALSE_ALARM
    assert ((frames > 0).sum(axis=0) <= 2).all()
    assert not _frame(Zingers(0.0), 0).any()


def test_places_are_even() -> None:
    rows, cols = np.nonzero(_frame(Zingers(2e5), 0))
    for at in (rows, cols):
        assert stats.chisquare(np.bincount(at // 40, minlength=10)).pvalue > chance.FALSE_ALARM


def test_tracks_are_straight_and_as_long_as_they_should_be() -> None:
    lengths, charges = [], []
    for k in range(400):
        frame = _frame(Zingers(100.0, tracks=1.0, length=15.0), k)
        rows, cols = np.nonzero(frame)
        alone = abs(np.ptp(rows)) < 150 and abs(np.ptp(cols)) < 150 if rows.size else False
        inside = alone and min(rows.min(), cols.min(), 399 - rows.max(), 399 - cols.max()) > 0
        if not inside:
            continue
        points = np.stack([rows - rows.mean(), cols - cols.mean()])
        _, across = np.linalg.svd(points, compute_uv=False) if rows.size > 1 else (0.0, 0.0)
        if across > 0.5 * np.sqrt(rows.size):
            continue  # two that met
        lengths.append(np.hypot(np.ptp(rows), np.ptp(cols)))
        charges.append(frame.sum())
    assert len(lengths) > 100
    assert np.mean(lengths) == pytest.approx(15.0, abs=1 + chance.SIGMAS * 15 / np.sqrt(len(lengths)))
    assert max(lengths) > 40
    assert np.mean(charges) == pytest.approx(3000, rel=1.5 * chance.SIGMAS / np.sqrt(len(charges)))


def test_charge_spreads_by_the_radius_and_is_kept() -> None:
    row, col = np.indices((400, 400))
    spreads = []
    for k in range(60):
        frame = _frame(Zingers(60.0, radius=2.0), k)
        if not frame.any():
            continue
        total = frame.sum()
        variances = [(frame * (axis - (frame * axis).sum() / total) ** 2).sum() / total for axis in (row, col)]
        if max(variances) < 16:  # one alone
            spreads.extend(variances)
    assert len(spreads) > 20
    # Each of n numbers is a variance of 200 drops: 2² and rounding's 1/12, times 199/200.
    expected = (4 + 1 / 12) * 199 / 200
    assert np.mean(spreads) == pytest.approx(expected, abs=chance.SIGMAS * expected * np.sqrt(2 / 200 / len(spreads)))


def test_each_keeps_its_own_charge_when_it_spreads() -> None:
    """By next to nothing: the frame is that of zingers that do not spread."""
    np.testing.assert_allclose(_frame(Zingers(5000.0, radius=1e-9), 0), _frame(Zingers(5000.0), 0), rtol=1e-9)


def test_more_zingers_than_a_frame_can_hold_are_refused() -> None:
    """They would fill the memory."""
    with pytest.raises(CannotExposeError, match=r"1e\+12 a"):
        _frame(Zingers(1e12), 0)
