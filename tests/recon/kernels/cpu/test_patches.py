"""Patch denoiser: compared with the reference, and properties of the mean over all blocks."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.kernels.cpu.patches import denoise, patch_scratch
from tests.recon.kernels.reference import sparse_patches

F32 = NDArray[np.float32]
SHAPES = [(9, 7, 21), (40, 5, 4), (6, 20, 1), (5, 8, 3), (3, 2, 17), (1, 1, 1)]


def denoised(x: F32, threshold: float, nonnegative: bool = False) -> F32:
    out = np.empty_like(x)
    denoise(np.ascontiguousarray(x), threshold, nonnegative, patch_scratch(x.shape), out)
    return out


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("threshold", [0.0, 0.4, 3.0])
def test_the_kernel_gives_what_the_reference_gives(
    rng: np.random.Generator, shape: tuple[int, int, int], threshold: float
) -> None:
    x = rng.normal(0.2, 1, shape).astype(np.float32)
    # No coefficient lies so near the threshold that its rounding decides: blocks of such noise are no special values.
    expected = sparse_patches(torch.from_numpy(x).double(), threshold).numpy()
    np.testing.assert_allclose(denoised(x, threshold), expected, atol=2e-6 * max(1.0, threshold))
    np.testing.assert_allclose(denoised(x, threshold, True), np.maximum(expected, 0), atol=2e-6 * max(1.0, threshold))


@given(st.integers(0, 99), st.sampled_from(["flip a", "flip b", "flip c", "turn", "turn to c"]))
def test_no_side_is_preferred(seed: int, change: str) -> None:
    moved = {
        "flip a": lambda v: v[::-1], "flip b": lambda v: v[:, ::-1], "flip c": lambda v: v[:, :, ::-1],
        "turn": lambda v: np.rot90(v, axes=(0, 1)), "turn to c": lambda v: np.rot90(v, axes=(1, 2)),
    }[change]  # fmt: skip
    x = np.random.default_rng(seed).normal(0, 1, (10, 9, 11)).astype(np.float32)
    left = denoised(moved(x), 1.0) - moved(denoised(x, 1.0))
    # The rounding of a coefficient next to the threshold may decide otherwise: it is kept or not in one block of 64.
    assert np.abs(left).max() < 0.05 and np.mean(np.abs(left) < 1e-5) > 0.99


def test_bits_do_not_depend_on_the_threads_and_the_volume_may_be_replaced(rng: np.random.Generator) -> None:
    x = rng.normal(0, 1, (37, 30, 18)).astype(np.float32)
    found, threads = denoised(x, 0.5), numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        np.testing.assert_array_equal(denoised(x, 0.5), found)
    finally:
        numba.set_num_threads(threads)
    denoise(x, 0.5, False, patch_scratch(x.shape), x)
    np.testing.assert_array_equal(x, found)


def test_slices_three_beyond_do_not_matter(rng: np.random.Generator) -> None:
    x = rng.normal(0, 1, (12, 10, 24)).astype(np.float32)
    whole, part = denoised(x, 0.8), denoised(x[:, :, 4:20], 0.8)
    np.testing.assert_array_equal(part[:, :, 3:-3], whole[:, :, 7:17])
