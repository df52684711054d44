"""Small kernels on voxels and lines: sums and products, mixtures, slopes, transposes, rows between slices."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import correlate1d
from scipy.optimize import nnls

from recon.kernels.cpu.lines import rows_from_slices, slices_from_rows, swap_last
from recon.kernels.cpu.mixtures import nonnegative_mix
from recon.kernels.cpu.slopes import slopes_at, windowed
from recon.kernels.cpu.vectors import add_product, combine, dot, extrapolate, norm, replace_by_residual, turn_of_steps


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 33, 70), (2, 64, 5), (1, 7, 100)])
def test_the_last_two_axes_change_places(shape: tuple[int, int, int], rng: np.random.Generator) -> None:
    source = rng.random(shape, dtype=np.float32)
    out = np.empty((shape[0], shape[2], shape[1]), np.float32)
    swap_last(source, out)
    np.testing.assert_array_equal(out, source.transpose(0, 2, 1))


@given(st.integers(1, 6), st.integers(1, 7), st.floats(-4, 4), st.floats(0.3, 2.5), st.integers(0, 2**31))
def test_rows_are_interpolated_and_the_transpose_is_exact(
    nz: int, n: int, first: float, step: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    slices, rows = rng.random((1, 2, nz), dtype=np.float32), rng.random((1, 2, n), dtype=np.float32)
    found, back = np.empty_like(rows), np.empty_like(slices)
    rows_from_slices(slices, np.array([first]), step, found)
    # Zero one slice beyond the ends, linear in between.
    levels = first + step * np.arange(n)
    padded = np.pad(slices[0], ((0, 0), (1, 1)))
    expected = [np.interp(levels, np.arange(-1, nz + 1), line, left=0, right=0) for line in padded]
    np.testing.assert_allclose(found[0], expected, atol=1e-6)
    slices_from_rows(rows, np.array([first]), step, back)
    assert np.vdot(found, rows) == pytest.approx(np.vdot(slices, back), rel=1e-5, abs=1e-6)


SHAPES = [(1, 1, 1), (2, 3, 5), (9, 20, 7), (1, 18, 40)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("taps", [1, 3, 9])
def test_the_window_runs_along_each_axis(shape: tuple[int, int, int], taps: int, rng: np.random.Generator) -> None:
    x, window = rng.random(shape, dtype=np.float32), rng.random(taps, dtype=np.float32)
    out = np.empty_like(x)
    windowed(x, window, out)
    expected = x.astype(np.float64)
    for axis in range(3):
        expected = correlate1d(expected, window, axis, mode="nearest")
    np.testing.assert_allclose(out, expected, rtol=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_slope_is_the_length_of_the_gradient(shape: tuple[int, int, int], rng: np.random.Generator) -> None:
    x = rng.random(shape, dtype=np.float32)
    voxels = rng.permutation(x.size)[: max(1, x.size // 2)]
    found = np.empty(voxels.size, np.float32)
    slopes_at(x, voxels, found)
    around = np.pad(x, 1, mode="edge")
    gradient = np.stack([np.gradient(around, axis=axis)[1:-1, 1:-1, 1:-1] for axis in range(3)])
    np.testing.assert_allclose(found, np.linalg.norm(gradient, axis=0).ravel()[voxels], rtol=1e-5, atol=1e-7)


def test_it_is_the_nearest_mixture_and_the_others_keep_their_bits(rng: np.random.Generator) -> None:
    """Against non-negative least squares, wherever one material alone is below 0."""
    to = np.array([[1.2, 0.9], [0.3, -0.4]])
    back = np.linalg.inv(to)
    z = np.ascontiguousarray((to @ rng.normal(0.4, 0.5, (2, 3000))).astype(np.float32)).reshape(2, 10, 20, 15)
    before = z.copy()
    nonnegative_mix(z, back, to)
    start, found = (back @ each.reshape(2, -1).astype(np.float64) for each in (before, z))
    assert found.min() > -1e-6
    fits = (start >= 0).all(0)
    assert np.array_equal(z.reshape(2, -1)[:, fits], before.reshape(2, -1)[:, fits])
    one_below = (start < 0).sum(0) == 1
    nearest = np.array([nnls(to, to @ each)[0] for each in start.T]).T
    np.testing.assert_allclose(found[:, one_below], nearest[:, one_below], atol=1e-5)


@pytest.mark.parametrize("n", [1, 5, 100_001])
def test_results_equal_those_of_numpy(n: int, rng: np.random.Generator) -> None:
    a, b, w = (rng.normal(size=n).astype(np.float32) for _ in range(3))
    wide = [v.astype(np.float64) for v in (a, b, w)]
    assert dot(a, b) == pytest.approx(float(wide[0] @ wide[1]), rel=1e-6, abs=1e-6 * n)
    assert norm(a) == pytest.approx(float(np.linalg.norm(wide[0])), rel=1e-6)
    out = np.empty_like(a)
    combine(2.0, a, -0.5, b, out)
    np.testing.assert_allclose(out, 2 * wide[0] - 0.5 * wide[1], atol=1e-6)
    x = b.copy()
    add_product(x, 0.7, a, w, nonnegative=True)
    np.testing.assert_allclose(x, np.maximum(wide[1] + 0.7 * wide[0] * wide[2], 0), atol=2e-6)
    model = b.copy()
    total = replace_by_residual(a, model, np.abs(w), w)
    np.testing.assert_allclose(model, wide[2] * (wide[0] - wide[1]), atol=2e-6)
    bend = float(((wide[1] - wide[2]) * (wide[2] - wide[0])).sum())
    assert turn_of_steps(a, b, w) == pytest.approx(bend, rel=1e-6, abs=1e-6 * n)
    x, last, start = w.copy(), a.copy(), b.copy()
    extrapolate(x, 0.4, last, start)
    np.testing.assert_allclose(x, wide[2] + 0.4 * (wide[2] - wide[0]), atol=1e-6)
    np.testing.assert_array_equal(last, w)
    np.testing.assert_array_equal(start, x)
    assert total == pytest.approx(float((np.abs(wide[2]) * (wide[0] - wide[1]) ** 2).sum()), rel=1e-6)


def test_a_long_sum_keeps_its_digits() -> None:
    ones = np.full(5_000_001, 0.1, np.float32)
    assert dot(ones, ones) == pytest.approx(ones.size * float(np.float32(0.1)) ** 2, rel=3e-6)


def test_a_sum_does_not_depend_on_the_number_of_threads(rng: np.random.Generator) -> None:
    """Workers of a cluster have fewer threads than the computer that asks them."""
    a, b = rng.normal(size=(2, 100_003)).astype(np.float32)
    threads = numba.get_num_threads()
    try:
        sums = list[tuple[float, float]]()
        for n in {1, threads}:
            numba.set_num_threads(n)
            sums.append((dot(a, b), replace_by_residual(a, b.copy())))
    finally:
        numba.set_num_threads(threads)
    assert len(set(sums)) == 1
