"""Layouts and slices between rows: numpy's transpose and interpolation, and the exact transpose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.kernels.cpu.lines import rows_from_slices, slices_from_rows, swap_last


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 33, 70), (2, 64, 5), (1, 7, 100)])
def test_the_last_two_axes_change_places(shape: tuple[int, int, int], rng: np.random.Generator) -> None:
    source = rng.random(shape, dtype=np.float32)
    out = np.empty((shape[0], shape[2], shape[1]), np.float32)
    swap_last(source, out)
    np.testing.assert_array_equal(out, source.transpose(0, 2, 1))


@given(st.integers(1, 6), st.integers(1, 7), st.floats(-4, 4), st.floats(0.3, 2.5), st.integers(0, 2**31))
@settings(max_examples=40)
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
