"""Rendering and moments of footprint tables compared with dense float64 sums, with and without the recurrence."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.base.kernel import Kernel
from recon.kernels.cpu.boxes import DEEPEST, box_of, is_upright, padded_shape
from recon.kernels.cpu.footprints import HU, HV, KV, SHEAR, K, U, V, W
from recon.kernels.cpu.project import moments, render

F64 = NDArray[np.float64]
STATED_ERROR = 1e-5  # of the footprint's weight, see the kernels


def _table(centres: F64, long: F64, short: F64, turn: F64, weights: F64, reach: float = 5.5) -> NDArray[np.float32]:
    """Footprints with standard deviations `long`, `short` (px) at an angle `turn` from the columns' direction."""
    c, s = np.cos(turn), np.sin(turn)
    uu, vv = long**2 * c**2 + short**2 * s**2, long**2 * s**2 + short**2 * c**2
    uv = (long**2 - short**2) * c * s
    table = np.empty((len(long), 8), np.float32)
    table[:, U], table[:, V] = centres.T
    table[:, K], table[:, SHEAR], table[:, KV] = vv / (long * short) ** 2, uv / vv, 1 / vv
    table[:, W], table[:, HU], table[:, HV] = weights, reach * np.sqrt(uu), reach * np.sqrt(vv)
    return table


def _dense(
    table: NDArray[np.float32], shape: tuple[int, int], kernel: Kernel = Kernel.GAUSSIAN
) -> tuple[F64, F64, F64, F64]:
    """G and D [n, row, col] and the offsets (across, down) of the pixels, in float64 and without an end."""
    t = table.astype(np.float64)
    across = np.arange(shape[1])[None, None, :] - t[:, U, None, None]
    down = np.arange(shape[0])[None, :, None] - t[:, V, None, None]
    k, shear, kv = (t[:, column, None, None] for column in (K, SHEAR, KV))
    square = k * (across - shear * down) ** 2 + kv * down**2
    t = np.maximum(1 - square / kernel.radius**2, 0)
    value, slope = (t**2, t / 2) if kernel.is_compact else (np.exp(-0.5 * square),) * 2
    return value, slope, across, down


def _image(table: NDArray[np.float32], shape: tuple[int, int], kernel: Kernel = Kernel.GAUSSIAN) -> NDArray[np.float32]:
    image = np.full(shape, np.nan, np.float32)
    render(table, image, kernel=kernel)
    return image


def _smooth(table: NDArray[np.float32], i: int, shape: tuple[int, int]) -> bool:
    return bool(is_upright.py_func(table, i, box_of.py_func(table, i, *shape, padded_shape(*shape)[0])[0]))


def _one(long: float, short: float, turn: float, centre: tuple[float, float] = (31.3, 30.6)) -> NDArray[np.float32]:
    return _table(np.array([centre]), np.array([long]), np.array([short]), np.array([turn]), np.ones(1))


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize("sigma", [0.3, 0.5, 1.0, 2.0, 4.0, 9.0, 30.0])
def test_the_recurrence_stays_within_its_stated_error(rng: np.random.Generator, sigma: float, kernel: Kernel) -> None:
    # Boxes of 4 to 100 rows, up to seven starts; upright and as slanted as the recurrence takes them.
    n, shape = 24, (64, 80)
    ratio, turn = rng.uniform(0.45, 1, n), rng.uniform(-2, 2, n)
    table = _table(rng.uniform(28, 36, (n, 2)), np.full(n, sigma), ratio * sigma, turn, np.ones(n), kernel.reach(3.5))
    expected = _dense(table, shape, kernel)[0]
    inside = (expected > np.exp(-0.5 * 3.45**2)) | kernel.is_compact
    for i in range(n):
        assert _smooth(table, i, shape)
        assert np.abs(_image(table[i : i + 1], shape, kernel) - expected[i])[inside[i]].max() < STATED_ERROR


@pytest.mark.parametrize("kernel", Kernel)
@pytest.mark.parametrize("shape", [(64, 80), (61, 45), (1, 40), (3, 5), (50, 1)])
def test_image_and_moments_equal_dense_sums(rng: np.random.Generator, shape: tuple[int, int], kernel: Kernel) -> None:
    n = 60
    centres = rng.uniform(-3, 3 + np.array(shape[::-1]), (n, 2))
    long = np.exp(rng.uniform(np.log(0.4), np.log(12), n))
    reach = kernel.reach(5.5)
    table = _table(centres, long, long * rng.uniform(0.05, 1, n), rng.uniform(-2, 2, n), rng.uniform(0.1, 2, n), reach)
    value, slope, across, down = _dense(table, shape, kernel)
    expected = np.einsum("n,nrc->rc", table[:, W].astype(np.float64), value)
    np.testing.assert_allclose(_image(table, shape, kernel), expected, atol=1e-5 * max(1, expected.max()))
    g = rng.normal(size=shape).astype(np.float32)
    aside = across - table[:, SHEAR, None, None].astype(np.float64) * down
    terms = (value, *(slope * x for x in (aside, down, aside**2, aside * down, down**2)))
    sums = np.stack([(g * x).sum((1, 2)) for x in terms], 1)
    scale = np.stack([np.abs(x).sum((1, 2)) for x in terms], 1)
    assert (
        np.abs(moments(table, g, kernel=kernel) - sums)
        < 1e-5 * scale + 1e-4 * np.abs(table[:, [HU]] + table[:, [HV]]) ** 2
    ).all()


def _slack(table: NDArray[np.float32]) -> F64:
    """Error [n] of G that float32 leaves: a step of it in the shear shifts a needle's far end."""
    t = np.abs(table.astype(np.float64))
    span = np.minimum(50, t[:, HU]) + t[:, SHEAR] * np.minimum(50, t[:, HV])
    return 1e-5 + 4e-7 * (span * np.sqrt(t[:, K]) * 3.5 + t[:, KV] * 50)


sizes = st.floats(-4, 4).map(lambda x: 10**x)
places = st.floats(-80, 160)


@given(
    st.lists(st.tuples(sizes, sizes, st.floats(-4, 4), places, places, st.floats(0, 1e8)), min_size=1, max_size=5),
    st.sampled_from(Kernel),
)
def test_any_footprint_is_finite_and_its_moment_is_the_adjoint(rows: list[tuple[float, ...]], kernel: Kernel) -> None:
    long, short, turn, x, y, weights = np.array(rows).T
    table = _table(np.stack((x, y), 1), long, short, turn, weights, kernel.reach(3.5))
    shape = (33, 47)
    image = _image(table, shape, kernel)
    assert np.isfinite(image).all() and (image >= 0).all()
    assert float(image.max()) <= 1.001 * weights.sum()
    g = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    found = moments(table, g, kernel=kernel)
    assert np.isfinite(found).all()
    # <image, g> = Σ W M₀: both passes take the same pixels, with the same values but for rounding.
    left, right = np.vdot(image.astype(np.float64), g), np.vdot(weights, found[:, 0].astype(np.float64))
    size = float(np.vdot(image.astype(np.float64), np.abs(g)))
    assert abs(left - right) <= float(_slack(table).max()) * size + 1e-30


@given(sizes, sizes, st.floats(-4, 4), st.floats(0, 46), st.floats(0, 32), st.sampled_from(Kernel))
def test_any_footprint_is_right_within_its_reach(
    long: float, short: float, turn: float, x: float, y: float, kernel: Kernel
) -> None:
    place = np.array([[x, y]])
    table = _table(place, np.array([long]), np.array([short]), np.array([turn]), np.ones(1), kernel.reach(3.5))
    value = _dense(table, (33, 47), kernel)[0][0]
    outside = 0.0 if kernel.is_compact else np.exp(-0.5 * 3.5**2)
    assert (
        np.abs(_image(table, (33, 47), kernel) - value) <= _slack(table) + np.where(value < 1.01 * outside, outside, 0)
    ).all()


def test_the_gate_takes_needles_and_what_starts_too_far_down_from_the_recurrence() -> None:
    shape = (256, 256)
    for table in (_one(100.0, 0.01, 0.6, (128, 128)), _one(8.0, 0.6, 0.8, (128, 128)), _one(3.0, 0.05, 0.4, (9, 9))):
        assert not _smooth(table, 0, shape)
        row0, *_ = box_of.py_func(table, 0, *shape, 256)
        down, across = float(row0) - float(table[0, V]), float(table[0, HU])
        k, shear, kv = (float(table[0, column]) for column in (K, SHEAR, KV))
        deepest = 0.5 * (k * max((across - shear * down) ** 2, (across + shear * down) ** 2) + kv * down**2)
        assert deepest > DEEPEST
    # A dot of 0.05 px is one pixel and passes; on the last row its group of rows starts three above, and it may not.
    assert _smooth(_one(0.05, 0.05, 0.0, (128.02, 127.97)), 0, shape)
    assert not _smooth(_one(0.05, 0.05, 0.0, (128.02, 254.99)), 0, shape)
    for y in (127.97, 254.99):
        dot = _one(0.05, 0.05, 0.0, (128.02, y))
        np.testing.assert_allclose(_image(dot, shape), _dense(dot, shape)[0][0], atol=1e-6)
