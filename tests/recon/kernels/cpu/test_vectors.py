"""Sums and products of long arrays against float64."""

from __future__ import annotations

import numpy as np
import pytest

from recon.kernels.cpu.vectors import add_product, combine, dot, extrapolate, replace_by_residual, turn_of_steps


@pytest.mark.parametrize("n", [1, 5, 100_001])
def test_results_equal_those_of_numpy(n: int, rng: np.random.Generator) -> None:
    a, b, w = (rng.normal(size=n).astype(np.float32) for _ in range(3))
    wide = [v.astype(np.float64) for v in (a, b, w)]
    assert dot(a, b) == pytest.approx(float(wide[0] @ wide[1]), rel=1e-6, abs=1e-6 * n)
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
