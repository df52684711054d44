"""Digest (statistics of a frame) compared with numpy and scipy."""

import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.stats import entropy as scipy_entropy

from beamline.monitor.digest import (
    ENOUGH,
    ENTROPY_BINS,
    block_means,
    check_block,
    digest,
    digests,
    preview_shape,
    subsampled,
)

shapes = st.tuples(st.integers(1, 17), st.integers(1, 17))
counts = hnp.arrays(np.uint16, shapes)


def naive_preview(image: np.ndarray, valid: np.ndarray, bin_: int) -> np.ndarray:
    out = np.full(preview_shape(image.shape, bin_), np.nan)
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            part = np.s_[r * bin_ : (r + 1) * bin_, c * bin_ : (c + 1) * bin_]
            if valid[part].any():
                out[r, c] = image[part][valid[part]].mean(dtype=np.float64)
    return out


def naive_peaks(image: np.ndarray, valid: np.ndarray, bin_: int) -> np.ndarray:
    """The largest of the means of blocks of one pixel."""
    ones = np.pad(naive_preview(image, valid, 1), [(0, -n % bin_) for n in image.shape], constant_values=np.nan)
    blocks = ones.reshape(ones.shape[0] // bin_, bin_, -1, bin_)
    low = np.where(np.isnan(blocks), -np.inf, blocks).max(axis=(1, 3))
    return np.where(np.isinf(low), np.nan, low)


@given(
    image=hnp.arrays(np.uint16, st.tuples(st.integers(1, 17), st.sampled_from([1, 7, 16, 17, 1024, 1027]))),
    preview_bin=st.sampled_from([1, 3, 4, 8, 12, 20]),
)
def test_the_checks_see_the_same_blocks_whatever_the_preview_of_the_file(image: np.ndarray, preview_bin: int) -> None:
    for found, side in zip(digests(image, 65535, preview_bin), (check_block(image.shape), preview_bin), strict=True):
        for name, value in vars(digest(image, 65535, side)).items():
            np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


def naive_entropy(values: np.ndarray) -> float:
    low, high = values.min(), values.max()
    if low == high:
        return 0.0
    bins = np.minimum(((values - low) * (ENTROPY_BINS / (high - low))).astype(int), ENTROPY_BINS - 1)
    return float(scipy_entropy(np.bincount(bins), base=2))


@given(image=counts, bin_=st.integers(1, 5), saturation=st.integers(0, 65535))
def test_counts_agree_with_numpy(image: np.ndarray, bin_: int, saturation: int) -> None:
    found = digest(image, saturation=saturation, preview_bin=bin_)
    exact = image.astype(np.float64)
    assert (found.minimum, found.maximum, found.sum_abs) == (exact.min(), exact.max(), exact.sum())
    assert found.mean == pytest.approx(exact.mean(), rel=1e-12)
    assert found.variance == pytest.approx(exact.var(), rel=1e-9, abs=1e-9)
    assert found.saturated_fraction == (image >= saturation).mean()
    assert found.invalid_fraction == 0
    assert found.checksum == zlib.crc32(image.tobytes())
    everywhere = np.ones(image.shape, bool)
    np.testing.assert_allclose(found.preview, naive_preview(image, everywhere, bin_), rtol=1e-6)
    np.testing.assert_array_equal(found.peaks, naive_peaks(image, everywhere, bin_))


def test_entropy_is_numpys_histogram_and_scipys_sum(rng: np.random.Generator) -> None:
    image = rng.poisson(1400, (64, 96)).astype(np.uint16)
    histogram, _ = np.histogram(image, bins=ENTROPY_BINS)
    assert digest(image).entropy == pytest.approx(scipy_entropy(histogram, base=2), abs=1e-9)
    reals = rng.normal(size=(64, 96))
    histogram, _ = np.histogram(reals, bins=ENTROPY_BINS)
    assert digest(reals).entropy == pytest.approx(scipy_entropy(histogram, base=2), abs=1e-9)


def test_of_a_large_frame_the_entropy_is_that_of_every_kth_row_and_all_else_of_all_pixels(
    rng: np.random.Generator,
) -> None:
    image = rng.poisson(3000, (2048, 2049)).astype(np.uint16)
    found = digest(image, saturation=3150)
    rows = image[:: image.size // 2**20]
    low, high = image.min(), image.max()
    bins = (rows.astype(int) - low) * ENTROPY_BINS // (int(high) - low)
    assert found.entropy == pytest.approx(scipy_entropy(np.bincount(np.minimum(bins, 255).ravel()), base=2), abs=1e-9)
    assert (found.minimum, found.maximum, found.mean) == (low, high, pytest.approx(image.mean(), rel=1e-12))
    assert found.variance == pytest.approx(image.var(), rel=1e-9)
    assert found.saturated_fraction == pytest.approx((image >= 3150).mean())


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16, np.int32, np.uint8])
def test_other_types_say_the_same_as_counts(dtype: type, rng: np.random.Generator) -> None:
    image = rng.integers(0, 200, (33, 18))
    expected, found = digest(image.astype(np.uint16)), digest(image.astype(dtype))
    for no_data in (None, 0.0):  # pixels as they are written
        assert digest(image.astype(dtype), no_data=no_data).checksum == zlib.crc32(image.astype(dtype).tobytes())
    for name in ("minimum", "maximum", "mean", "variance", "sum_abs", "entropy"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-9), name
    np.testing.assert_allclose(found.preview, expected.preview, rtol=1e-6)


@given(
    image=hnp.arrays(
        np.float32,
        shapes,
        elements=st.floats(-1e4, 1e4, width=32) | st.sampled_from([np.nan, np.inf, -np.inf, -1.0]),
    ),
    bin_=st.integers(1, 5),
)
def test_invalid_pixels_are_counted_and_never_spread(image: np.ndarray, bin_: int) -> None:
    found = digest(image, preview_bin=bin_, no_data=-1.0)
    valid = np.isfinite(image) & (image != -1)
    assert found.invalid_fraction == pytest.approx((~valid).mean(), abs=1e-12)
    np.testing.assert_allclose(found.preview, naive_preview(image, valid, bin_), rtol=1e-5, atol=1e-3)
    np.testing.assert_array_equal(found.peaks, naive_peaks(image, valid, bin_))
    values = image[valid].astype(np.float64)
    if values.size == 0:
        assert np.isnan([found.minimum, found.maximum, found.mean, found.variance, found.entropy]).all()
        return
    assert (found.minimum, found.maximum) == (values.min(), values.max())
    assert found.mean == pytest.approx(values.mean(), rel=1e-9, abs=1e-9)
    assert found.variance == pytest.approx(values.var(), rel=1e-7, abs=1e-6)
    assert found.sum_abs == pytest.approx(np.abs(values).sum(), rel=1e-9)
    assert found.entropy == pytest.approx(naive_entropy(values), abs=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float16, np.float32, np.float64])
def test_block_means_of_other_types_are_of_the_valid_pixels(dtype: Any) -> None:
    image = np.random.default_rng(0).integers(0, 200, (9, 13)).astype(dtype)
    if image.dtype.kind == "f":
        image[:4, :4], image[5, 5], image[0, 7] = np.nan, np.inf, -np.inf
    if image.dtype.itemsize > 2:
        image[8, 12] = 1e30 if image.dtype.kind == "f" else -(2**31)
    np.testing.assert_allclose(block_means(image, 4), digest(image, None, 4).preview, rtol=1e-6)


@given(st.integers(1, 1200), st.integers(1, 1200))
def test_thinning_bounds_the_work_and_leaves_small_previews_whole(rows: int, cols: int) -> None:
    preview = np.broadcast_to(np.float32(0), (rows, cols))
    kept = subsampled(preview).shape
    for n, k in zip((rows, cols), kept, strict=True):
        assert k == n if n < 2 * ENOUGH else ENOUGH <= k <= 2 * ENOUGH
