"""TV's kernels against numpy in float64, and its gradient against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.kernels.cpu import tv as tv_cpu
from tests.recon.voxels.tv_reference import differences, total_variation, transposed_differences

WEIGHTS = (1.0, 0.8, 1.3)
shapes = st.tuples(st.integers(1, 9), st.integers(1, 6), st.integers(1, 6))


@given(shapes, st.booleans(), st.integers(0, 2**31))
@settings(max_examples=30)
def test_dual_steps_are_the_reference_s(shape: tuple[int, int, int], nonnegative: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, threshold = rng.normal(size=shape).astype(np.float32), 0.3
    found, expected = np.zeros((3, *shape), np.float32), np.zeros((3, *shape))
    scratch = tv_cpu.dual_scratch(shape)
    pace = 1.5 / (4 * sum(w * w for w in WEIGHTS)) / threshold
    for _ in range(6):
        tv_cpu.dual_step(x, found, threshold, WEIGHTS, nonnegative, scratch)
        y = x - threshold * transposed_differences(expected, WEIGHTS)
        expected = expected + pace * differences(np.maximum(y, 0) if nonnegative else y, WEIGHTS)
        expected /= np.maximum(1, np.sqrt((expected**2).sum(0)))
    np.testing.assert_allclose(found, expected, atol=3e-6)
    out = np.empty_like(x)
    tv_cpu.primal(x, found, threshold, WEIGHTS, nonnegative, scratch, out)
    y = x - threshold * transposed_differences(found.astype(np.float64), WEIGHTS)
    np.testing.assert_allclose(out, np.maximum(y, 0) if nonnegative else y, atol=2e-6)
    tv_cpu.primal(x, found, threshold, WEIGHTS, nonnegative, scratch, x)
    np.testing.assert_array_equal(x, out)


def test_the_kernels_get_scratch_without_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an array with gaps the compiler makes code that gathers single numbers: three times as slow."""
    seen: list[np.ndarray] = []
    monkeypatch.setattr(tv_cpu, "_dual_step", lambda *given: seen.extend(given[6:]))
    monkeypatch.setattr(tv_cpu, "_primal", lambda *given: seen.append(given[5]))
    x, p = np.zeros((64, 5, 6), np.float32), np.zeros((3, 64, 5, 6), np.float32)
    scratch = tv_cpu.dual_scratch(x.shape)
    tv_cpu.dual_step(x, p, 1.0, (1.0, 1.0, 1.0), False, scratch)
    tv_cpu.primal(x, p, 1.0, (1.0, 1.0, 1.0), False, scratch, x)
    assert len(seen) == 3 and all(part.flags.c_contiguous for part in seen)


@given(shapes, st.integers(0, 2**31))
@settings(max_examples=30)
def test_the_gradient_is_the_slope_of_tv(shape: tuple[int, int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, smoothing = rng.normal(size=shape).astype(np.float32), 0.1
    found = np.empty_like(x)
    norm = tv_cpu.gradient(x, smoothing, WEIGHTS, found)
    assert norm == pytest.approx(np.linalg.norm(found.astype(np.float64)), rel=1e-5, abs=1e-6)
    way, h = rng.normal(size=shape), 1e-5
    rise = total_variation(x + h * way, WEIGHTS, smoothing) - total_variation(x - h * way, WEIGHTS, smoothing)
    assert float((found * way).sum()) == pytest.approx(rise / (2 * h), rel=1e-4, abs=1e-4)


def test_reference_is_a_transpose(rng: np.random.Generator) -> None:
    x, p = rng.normal(size=(4, 5, 6)), rng.normal(size=(3, 4, 5, 6))
    assert (differences(x, WEIGHTS) * p).sum() == pytest.approx((x * transposed_differences(p, WEIGHTS)).sum())
