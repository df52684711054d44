"""Streams: splitmix64's published numbers, even and normal numbers by chi-square, and streams that have no part in
each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from recon.base.jit import njit
from simulators.pixels.streams import STEP, TAIL, begin, layers, mix, normal, uniform
from tests.simulators import chance

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
def normals() -> NDArray[np.float64]:
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


def test_normal_numbers_are_normal(normals: NDArray[np.float64]) -> None:
    chance.mean_is(normals, 0.0, 1.0)
    chance.variance_is(normals, 1.0)
    chance.skewness_is(normals, 0.0)
    chance.mean_is(normals**4, 3.0, 96.0)  # E x⁸ - (E x⁴)² = 105 - 9
    chance.normal_like(normals)


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


def test_the_ziggurat_s_layers_are_of_one_area_and_close_at_the_top() -> None:
    x, height = layers()
    base = TAIL * math.exp(-(TAIL**2) / 2) + math.sqrt(2 * math.pi) * stats.norm.sf(TAIL)
    np.testing.assert_allclose(x[1:256] * np.diff(height[1:]), base, rtol=1e-9)  # the uppermost one too
    np.testing.assert_allclose(x[0] * height[1], base, rtol=1e-12)
    assert (np.diff(x) < 0).all()


def test_neighbours_rows_and_keys_have_no_part_in_each_other(normals: NDArray[np.float64]) -> None:
    chance.uncorrelated(normals[:, 1:], normals[:, :-1])
    chance.uncorrelated(normals[0], normals[1])
    chance.uncorrelated(normals[0, 1:], normals[1, :-1])  # nor a step apart
    chance.uncorrelated(normals, _normals(np.uint64(8), 2, N))
    chance.uncorrelated(normals[:, 1:] ** 2, normals[:, :-1] ** 2)
