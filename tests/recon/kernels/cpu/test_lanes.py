"""Sixteen-lane arithmetic compared with numpy."""

from __future__ import annotations

import numpy as np
from numba import njit

from recon.kernels.cpu import lanes


@njit(fastmath=True)
def _combine(a, b, out):  # type: ignore[no-untyped-def]
    x, y = lanes.load(a, 0, 0), lanes.load(b, 1, 2)
    lanes.store(out, 0, 0, x + y)
    lanes.store(out, 1, 0, x - y * 2)  # a whole number, as float32 and float64, is broadcast
    lanes.store(out, 2, 0, x * y)
    lanes.store(out, 3, 0, lanes.iota() + lanes.zero())
    lanes.store(out, 4, 0, np.float32(2) / x)
    lanes.store(out, 5, 0, lanes.sign(y - y) + lanes.sign(x))
    lanes.store(out, 6, 0, lanes.root(x * x))
    lanes.store(out, 7, 0, lanes.clamp(x, np.float32(-0.5), np.float32(0.25)))
    return lanes.total(x), lanes.lowest(x)


@njit(fastmath=True)
def _exp(a, out):  # type: ignore[no-untyped-def]
    for col in range(0, a.shape[1], 16):
        lanes.store(out, 0, col, lanes.exp(lanes.load(a, 0, col)))


def test_arithmetic_loads_and_sums(rng: np.random.Generator) -> None:
    a, b = (rng.normal(size=(3, 20)).astype(np.float32) for _ in range(2))
    out = np.zeros((8, 16), np.float32)
    total, lowest = _combine(a, b, out)
    x, y = a[0, :16], b[1, 2:18]
    np.testing.assert_allclose(out[0], x + y, rtol=1e-6)
    np.testing.assert_allclose(out[1], x - 2 * y, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(out[2], x * y, rtol=1e-6)
    np.testing.assert_array_equal(out[3], np.arange(16))
    np.testing.assert_allclose(out[4], 2 / x, rtol=1e-6)
    np.testing.assert_array_equal(out[5], np.sign(x))
    np.testing.assert_allclose(out[6], np.abs(x), rtol=1e-6)
    np.testing.assert_array_equal(out[7], np.clip(x, -0.5, 0.25))
    assert abs(total - x.astype(np.float64).sum()) < 1e-5
    assert lowest == x[0]


@njit(fastmath=True)
def _totals(a, out):  # type: ignore[no-untyped-def]
    one, two, three = lanes.load(a, 0, 0), lanes.load(a, 1, 0), lanes.load(a, 2, 0)
    lanes.store_first(out, 0, 0, lanes.totals((one, two, three)), 3)
    lanes.store_first(out, 1, 0, lanes.totals((one, two, three, one, two, three, one)), 7)
    lanes.store_first(out, 2, 0, lanes.totals((two,)), 1)


@njit(fastmath=True)
def _between(a, low, high, out):  # type: ignore[no-untyped-def]
    lanes.store(out, 0, 0, lanes.between(lanes.load(a, 0, 0), low, high))


def test_totals_of_several_come_in_their_order_and_touch_no_more(rng: np.random.Generator) -> None:
    a, out = rng.normal(size=(3, 16)).astype(np.float32), np.full((3, 16), 7, np.float32)
    _totals(a, out)
    sums = a.astype(np.float64).sum(axis=1)
    np.testing.assert_allclose(out[0], [*sums, *[7] * 13], atol=1e-5)
    np.testing.assert_allclose(out[1], [*sums, *sums, sums[0], *[7] * 9], atol=1e-5)
    np.testing.assert_allclose(out[2], [sums[1], *[7] * 15], atol=1e-5)


@njit(fastmath=True)
def _copy_first(a, col, count, out):  # type: ignore[no-untyped-def]
    lanes.store(out, 0, 0, lanes.load_first(a, 0, col, count))
    lanes.store_first(out, 1, col, lanes.load(a, 0, 0), count)


def test_a_part_is_loaded_and_stored_without_its_neighbours(rng: np.random.Generator) -> None:
    a = rng.normal(size=(1, 16)).astype(np.float32)
    for col, count in ((0, 16), (0, 0), (3, 5), (15, 1)):
        out = np.full((2, 16), 7, np.float32)
        _copy_first(a, col, count, out)
        np.testing.assert_array_equal(out[0], [*a[0, col : col + count], *np.zeros(16 - count)])
        np.testing.assert_array_equal(out[1], [*[7] * col, *a[0, :count], *[7] * (16 - col - count)])


def test_between_keeps_a_range_of_lanes(rng: np.random.Generator) -> None:
    a, out = rng.normal(size=(1, 16)).astype(np.float32), np.empty((1, 16), np.float32)
    for low, high in ((0, 16), (3, 9), (-5, 2), (10, 40), (5, 5), (9, 3)):
        _between(a, low, high, out)
        inside = (np.arange(16) >= low) & (np.arange(16) < high)
        np.testing.assert_array_equal(out[0], np.where(inside, a[0], 0))


def test_exp_is_as_good_as_the_rounding_of_its_argument() -> None:
    x = np.linspace(-86, 86, 16 * 4000, dtype=np.float32)[None]
    out = np.empty_like(x)
    _exp(x, out)
    relative = out / np.exp(x.astype(np.float64)) - 1
    # Rounding x log2(e) shifts the result by up to 1.2e-7 |x|; the polynomial's rounding adds 2e-7.
    assert (np.abs(relative) < 2e-7 + 1.2e-7 * np.abs(x)).all()
