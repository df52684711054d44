"""TV kernels compared with numpy in float64; the gradient compared with finite differences."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.kernels.cpu import tv as tv_cpu
from tests.recon.voxels.tv_reference import differences, total_variation, transposed_differences

WEIGHTS = (1.0, 0.8, 1.3)
shapes = st.tuples(st.integers(1, 9), st.integers(1, 6), st.integers(1, 6))
in_pieces = st.sampled_from([(2, 3, 530), (3, 40, 16), (2, 15, 41), (2, 600, 1)])  # of planes, each in several loops


@given(shapes | in_pieces, st.booleans(), st.sampled_from(((0, 0), (1, 0), (0, 1), (1, 1))), st.integers(0, 2**31))
def test_dual_steps_are_the_reference_s(
    shape: tuple[int, int, int], nonnegative: bool, back: tuple[int, int], seed: int
) -> None:
    """With `back`, those of a mirror image: its difference at i lies at n - 2 - i, with the other sign."""
    rng = np.random.default_rng(seed)
    x, threshold = rng.normal(size=shape).astype(np.float32), 0.3
    axes = tuple(np.flatnonzero(back).tolist())
    image, expected = np.flip(x, axes), np.zeros((3, *shape))
    found, scratch = tv_cpu.dual_field(shape), tv_cpu.dual_scratch(shape)
    pace = 1.5 / (4 * sum(w * w for w in WEIGHTS)) / threshold
    for _ in range(6):
        tv_cpu.dual_step(x, found, threshold, WEIGHTS, nonnegative, scratch, back)
        y = image - threshold * transposed_differences(expected, WEIGHTS)
        expected = expected + pace * differences(np.maximum(y, 0) if nonnegative else y, WEIGHTS)
        expected /= np.maximum(1, np.sqrt((expected**2).sum(0)))
    for axis in range(3):
        seen = np.flip(expected[axis], axes)
        np.testing.assert_allclose(found[axis], -np.roll(seen, -1, axis) if axis in axes else seen, atol=3e-6)
    out = np.empty_like(x)
    tv_cpu.primal(x, found, threshold, WEIGHTS, nonnegative, scratch, out)
    y = x - threshold * transposed_differences(np.stack(found).astype(np.float64), WEIGHTS)
    np.testing.assert_allclose(out, np.maximum(y, 0) if nonnegative else y, atol=2e-6)
    tv_cpu.primal(x, found, threshold, WEIGHTS, nonnegative, scratch, x)
    np.testing.assert_array_equal(x, out)


@pytest.mark.parametrize("back", [(0, 0), (1, 0), (0, 1), (1, 1)])
def test_threads_share_planes_without_a_race(back: tuple[int, int], rng: np.random.Generator) -> None:
    x = rng.normal(size=(64, 5, 6)).astype(np.float32)
    fields = []
    for threads in (1, numba.config.NUMBA_NUM_THREADS):
        before = numba.get_num_threads()
        numba.set_num_threads(threads)
        found, scratch = tv_cpu.dual_field(x.shape), tv_cpu.dual_scratch(x.shape)
        numba.set_num_threads(before)
        for _ in range(5):
            tv_cpu.dual_step(x, found, 0.3, WEIGHTS, True, scratch, back)
        fields.append(np.stack(found))
    np.testing.assert_array_equal(fields[0], fields[1])


@given(shapes, st.integers(0, 2**31))
def test_the_gradient_is_the_slope_of_tv(shape: tuple[int, int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, smoothing = rng.normal(size=shape).astype(np.float32), 0.1
    found = np.empty_like(x)
    norm = tv_cpu.gradient(x, smoothing, WEIGHTS, found)
    assert norm == pytest.approx(np.linalg.norm(found.astype(np.float64)), rel=1e-5, abs=1e-6)
    way, h = rng.normal(size=shape), 1e-5
    rise = total_variation(x + h * way, WEIGHTS, smoothing) - total_variation(x - h * way, WEIGHTS, smoothing)
    assert float((found * way).sum()) == pytest.approx(rise / (2 * h), rel=1e-4, abs=1e-4)


def test_a_vanishing_weight_leaves_the_volume(rng: np.random.Generator) -> None:
    x = rng.random((4, 5, 20), np.float32)
    p, scratch, out = tv_cpu.dual_field(x.shape), tv_cpu.dual_scratch(x.shape), np.empty_like(x)
    for _ in range(3):
        tv_cpu.dual_step(x, p, 1e-25, (1.0, 1.0, 1.0), True, scratch)
    tv_cpu.primal(x, p, 1e-25, (1.0, 1.0, 1.0), True, scratch, out)
    np.testing.assert_array_equal(out, x)
