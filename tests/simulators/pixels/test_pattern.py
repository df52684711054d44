"""Pattern: it lies on the sensor, whatever the ROI and the binning, and is even or normal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from drivers.orca_quest import SENSOR_SHAPE
from simulators.pixels.pattern import binned, normals, places
from tests.simulators import chance, shots


def test_the_pattern_is_normal_and_neighbours_are_independent() -> None:
    n = normals("prnu", 1, shots.sized(600, 700))
    chance.normal_like(n)
    chance.mean_is(n, 0.0, 1.0)
    chance.variance_is(n, 1.0)
    assert np.unique(n).size == n.size  # no two streams meet
    chance.uncorrelated(n[1:], n[:-1])
    chance.uncorrelated(n[:, 1:], n[:, :-1])
    chance.uncorrelated(n[1:, 1:], n[:-1, :-1])
    chance.uncorrelated(n, normals("prnu", 2, shots.sized(600, 700)))
    chance.uncorrelated(n, normals("offset", 1, shots.sized(600, 700)))
    np.testing.assert_array_equal(n, normals("prnu", 1, shots.sized(600, 700, frame=9, seed=9)))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 500), st.integers(0, 1000), st.integers(1, 12), st.integers(1, 12))
def test_a_region_sees_its_part(row: int, col: int, rows: int, cols: int) -> None:
    region = normals("prnu", 1, shots.shot(roi=(4 * row, 4 * col, 4 * rows, 4 * cols)))
    wider = normals("prnu", 1, shots.shot(roi=(4 * row, 4 * col, 4 * rows + 8, 4 * cols + 4)))
    np.testing.assert_array_equal(region, wider[: 4 * rows, : 4 * cols])
    shifted = normals("prnu", 1, shots.shot(roi=(4 * row + 4, 4 * col + 8, 4 * rows, 4 * cols)))
    np.testing.assert_array_equal(region[4:, 8:], shifted[:-4, :-8])


@pytest.mark.parametrize("binning", [1, 2, 4])
def test_binned_pixels_are_sums(binning: int) -> None:
    n = normals("prnu", 1, shots.sized(24, 32))
    sums = binned(n, binning)
    assert sums.shape == (24 // binning, 32 // binning)
    for row, col in ((0, 0), (2, 3), (5, 7)):
        part = n[row * binning : (row + 1) * binning, col * binning : (col + 1) * binning]
        assert sums[row, col] == pytest.approx(part.sum())


def test_places_are_a_share_of_the_sensor_and_evenly_scattered() -> None:
    (rows, cols), value = places("hot_pixels", 0, 0.01, shots.sized(*SENSOR_SHAPE))
    drawn = round(0.01 * SENSOR_SHAPE[0] * SENSOR_SHAPE[1])
    assert 0.99 * drawn < rows.size < drawn  # some are drawn twice
    assert np.unique(rows * SENSOR_SHAPE[1] + cols).size == rows.size
    for even in (rows / SENSOR_SHAPE[0], cols / SENSOR_SHAPE[1], value):
        assert stats.chisquare(np.bincount((even * 64).astype(int), minlength=64)).pvalue > chance.FALSE_ALARM
    chance.uncorrelated(rows, cols)
    chance.uncorrelated(value, rows)
    (others, _), _ = places("dead_pixels", 0, 0.01, shots.sized(*SENSOR_SHAPE))
    assert not np.array_equal(others[:100], rows[:100])


def test_places_move_with_the_region_and_are_binned() -> None:
    seen = np.zeros((60, 80))
    (rows, cols), value = places("hot_pixels", 3, 0.02, shots.shot())
    seen[rows, cols] = value
    moved = np.zeros((60, 80))
    (rows, cols), value = places("hot_pixels", 3, 0.02, shots.shot(roi=(1124, 2016, 60, 80)))
    moved[rows, cols] = value
    np.testing.assert_array_equal(seen[4:, 8:], moved[:-4, :-8])
    small = np.zeros((30, 40))
    at, value = places("hot_pixels", 3, 0.02, shots.shot(binning=2))
    np.add.at(small, at, value)
    np.testing.assert_allclose(small, seen.reshape(30, 2, 40, 2).sum(axis=(1, 3)))
