"""The filters respond to what moves faster than the sample, but not to the sample, rings or the beam."""

import numpy as np
import pytest

from beamline.monitor.foreign.ghost import REACH, Clutter, covariance, filters, window

LAGS = (-4, -3, -2, -1, 0, 1, 2, 3, 4)
CLUTTER = Clutter(speed=0.25, structure=1.0, common=4e-4, noise=2.5e-5)
VIEWS, COLS = window(LAGS)


def moving(speed: float, size: float = 0.75) -> np.ndarray:
    return np.exp(-0.5 * ((COLS - speed * VIEWS) / size) ** 2)


SPEEDS = np.array([-0.9, 0.9, 1e3])
MADE = filters(LAGS, CLUTTER, np.array([moving(speed) for speed in SPEEDS]), SPEEDS)


def outputs(pattern: np.ndarray) -> np.ndarray:
    """Of the filters in the middle of a window, in standard deviations of clutter and noise as assumed."""
    return np.einsum("slt,lt->s", MADE.weights, pattern.reshape(len(LAGS), -1))


def test_the_covariance_is_one() -> None:
    matrix = covariance(LAGS, CLUTTER)
    np.testing.assert_allclose(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() >= 0.99 * CLUTTER.noise
    np.testing.assert_allclose(np.diag(matrix), CLUTTER.structure + 1 + CLUTTER.common + CLUTTER.noise, rtol=1e-6)


def test_the_output_has_the_variance_one_on_clutter_and_its_strength_on_the_signal() -> None:
    flat = MADE.weights.reshape(3, -1).astype(float)
    np.testing.assert_allclose(np.einsum("sp,pq,sq->s", flat, covariance(LAGS, CLUTTER), flat), 1, rtol=1e-2)
    np.testing.assert_allclose([outputs(moving(s))[i] for i, s in enumerate(SPEEDS)], MADE.strength, rtol=1e-3)


@pytest.mark.parametrize("pattern", ["still", "slow", "ring", "beam"])
def test_what_turns_stays_or_flickers_is_not_seen(pattern: str) -> None:
    crumb = outputs(0.05 * moving(0.9))[1]
    assert crumb > 5
    seen = {
        "still": 0.05 * moving(0.0, 2.0),
        "slow": 0.05 * moving(0.2, 2.0),
        "ring": np.tile(np.eye(2 * REACH + 1)[REACH], len(LAGS)) * 0.5,
        "beam": 0.02 * np.isin(VIEWS, [0.0]),
    }[pattern]
    assert np.abs(outputs(seen)).max() < 0.25 * crumb
