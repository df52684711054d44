"""Streams of random numbers, and the fixed patterns that are made of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from drivers.orca_quest import SENSOR_SHAPE
from recon.base.jit import njit
from simulators.pixels.pattern import STEP, TAIL, begin, binned, mix, normal, normals, places, uniform
from tests.simulators import chance, shots

N = 400_000


@njit()
def _normals(key, rows, cols):  # type: ignore[no-untyped-def]
    out = np.empty((rows, cols))
    for row in range(rows):
        state = begin(key, row)
        for col in range(cols):
            out[row, col], state = normal(state)
    return out


@njit()
def _uniforms(state, n):  # type: ignore[no-untyped-def]
    out = np.empty(n)
    for i in range(n):
        out[i], state = uniform(state)
    return out


@njit()
def _bits(state, n):  # type: ignore[no-untyped-def]
    out = np.empty(n, np.uint64)
    for i in range(n):
        state += STEP
        out[i] = mix(state)
    return out


@pytest.fixture(scope="module")
def drawn() -> NDArray[np.float64]:
    return _normals(np.uint64(7), 2, N)


def test_the_hash_is_splitmix64() -> None:
    """The numbers that Vigna's reference program prints for the seed 1234567."""
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert _bits(np.uint64(1234567), 4).tolist() == expected


def test_uniform_numbers_are_even_in_all_bits() -> None:
    u = _uniforms(np.uint64(3), N)
    assert (u.min() >= 0, u.max() < 1) == (True, True)
    for shift in (1, 256, 2**16, 2**32):  # the first bits, and those further down
        part = (u * shift) % 1
        assert stats.chisquare(np.bincount((part * 512).astype(int), minlength=512)).pvalue > chance.FALSE_ALARM
    chance.uncorrelated(u[1:], u[:-1])


def test_normal_numbers_are_normal(drawn: NDArray[np.float64]) -> None:
    chance.mean_is(drawn, 0.0, 1.0)
    chance.variance_is(drawn, 1.0)
    chance.skewness_is(drawn, 0.0)
    chance.mean_is(drawn**4, 3.0, 96.0)  # E x⁸ - (E x⁴)² = 105 - 9
    chance.normal_like(drawn)


@njit()
def _tail(state, n):  # type: ignore[no-untyped-def]
    found = [0.0 for _ in range(0)]
    for _ in range(n):
        x, state = normal(state)
        if abs(x) > TAIL:
            found.append(x)
    return np.array(found)


def test_the_ziggurat_s_tail_is_the_normal_s() -> None:
    n = 20_000_000
    tail = _tail(np.uint64(11), n)
    expected = 2 * stats.norm.sf(TAIL) * n
    assert abs(tail.size - expected) < chance.SIGMAS * math.sqrt(expected)
    even = stats.norm.sf(np.abs(tail)) / stats.norm.sf(TAIL)
    assert stats.kstest(even, "uniform").pvalue > chance.FALSE_ALARM
    assert abs((tail > 0).mean() - 0.5) < chance.SIGMAS / 2 / math.sqrt(tail.size)


def test_neighbours_rows_and_keys_have_no_part_in_each_other(drawn: NDArray[np.float64]) -> None:
    chance.uncorrelated(drawn[:, 1:], drawn[:, :-1])
    chance.uncorrelated(drawn[0], drawn[1])
    chance.uncorrelated(drawn[0, 1:], drawn[1, :-1])  # nor a step apart
    chance.uncorrelated(drawn, _normals(np.uint64(8), 2, N))
    chance.uncorrelated(drawn[:, 1:] ** 2, drawn[:, :-1] ** 2)


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
