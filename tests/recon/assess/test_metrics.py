"""Metrics compared with closed forms and with skimage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.assess import metrics
from recon.assess.metrics import (
    inscribed_cuboid,
    interior_regions,
    kmeans_mask,
    nrmse,
    psnr,
    sampled,
    snr_cnr,
    ssim2d,
    ssim3d,
    ssim_of_whole_slices,
)
from tests.messages import refused


def blobs(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float64]:
    grid = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    total = np.zeros(shape)
    for _ in range(6):
        centre = [rng.uniform(0, n) for n in shape]
        total += np.exp(-sum((g - c) ** 2 for g, c in zip(grid, centre, strict=True)) / (2 * rng.uniform(1, 5) ** 2))
    return total


@given(peak=st.floats(0.1, 100), error=st.floats(1e-3, 10))
def test_psnr_of_a_constant_error(peak: float, error: float) -> None:
    truth = np.array([0.0, peak, peak / 2])
    assert psnr(truth, truth + error) == pytest.approx(20 * np.log10(peak / error), abs=1e-6)
    assert psnr(truth, truth + error, peak=1.0) == pytest.approx(-20 * np.log10(error), abs=1e-6)


def test_psnr_and_nrmse_agree_with_skimage(rng: np.random.Generator) -> None:
    theirs_of = pytest.importorskip("skimage.metrics")
    truth = blobs(rng, (8, 9, 10)).astype(np.float32)
    volume = (truth + rng.normal(0, 0.1, truth.shape)).astype(np.float32)
    theirs = theirs_of.peak_signal_noise_ratio(truth, volume, data_range=float(truth.max()))
    assert psnr(truth, volume) == pytest.approx(theirs, abs=1e-4)
    assert nrmse(truth, volume) == pytest.approx(theirs_of.normalized_root_mse(truth, volume), rel=1e-5)
    assert psnr(truth, truth) == np.inf
    assert nrmse(truth, truth) == 0


@pytest.mark.parametrize("shape", [(40, 53), (11, 30)])
@pytest.mark.parametrize("data_range", [None, 2.5])
def test_ssim2d_is_skimage_on_the_interior(
    rng: np.random.Generator, shape: tuple[int, int], data_range: float | None
) -> None:
    theirs_of = pytest.importorskip("skimage.metrics")
    truth = blobs(rng, shape)
    image = truth + rng.normal(0, 0.2, shape)
    theirs = theirs_of.structural_similarity(
        truth,
        image,
        data_range=np.ptp(truth) if data_range is None else data_range,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ssim2d(truth, image, data_range) == pytest.approx(theirs, abs=1e-9)


def test_ssim3d_is_the_mean_over_three_directions_of_slices(rng: np.random.Generator) -> None:
    truth: NDArray[Any] = blobs(rng, (35, 14, 17)).astype(np.float32)
    volume: NDArray[Any] = (truth + rng.normal(0, 0.15, truth.shape)).astype(np.float32)
    span = float(np.ptp(truth))
    directions = [
        np.mean([ssim2d(truth.take(i, axis), volume.take(i, axis), span) for i in range(truth.shape[axis])])
        for axis in range(3)
    ]
    assert ssim3d(truth, volume) == pytest.approx(np.mean(directions), abs=1e-5)
    assert ssim3d(truth, truth) == pytest.approx(1, abs=1e-6)


def test_ssim3d_of_two_slices_only(rng: np.random.Generator) -> None:
    truth = blobs(rng, (2, 20, 20))
    assert ssim3d(truth, truth) == pytest.approx(1, abs=1e-6)
    assert 0 < ssim3d(truth, truth + rng.normal(0, 0.1, truth.shape)) < 1


def test_ssim_of_values_far_from_zero_is_not_rounding(rng: np.random.Generator) -> None:
    truth = blobs(rng, (12, 20, 20))
    volume = truth + rng.normal(0, 0.1, truth.shape)
    slices = [zip(np.moveaxis(truth, k, 0), np.moveaxis(volume, k, 0), strict=True) for k in range(3)]
    expected = np.mean([np.mean([ssim2d(a + 1e4, b + 1e4, 2.0) for a, b in pairs]) for pairs in slices])
    assert ssim3d(truth + 1e4, volume + 1e4, 2.0) == pytest.approx(expected, abs=2e-3)


def particles(rng: np.random.Generator, noise: float) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A can (bright wall at the rim) with dense particles inside, [z, y, x]."""
    z, y, x = np.meshgrid(np.arange(30), np.arange(64), np.arange(64), indexing="ij")
    inside = np.zeros(z.shape, bool)
    for cz, cy, cx in [(8, 24, 30), (20, 40, 36), (15, 30, 42)]:
        inside |= (z - cz) ** 2 + (y - cy) ** 2 + (x - cx) ** 2 < 36
    volume = np.where(inside, 3.0, 1.0) + rng.normal(0, noise, z.shape)
    volume[np.hypot(y - 31.5, x - 31.5) > 29] = 20
    return volume.astype(np.float32), inside


def test_kmeans_finds_the_particles_and_leaves_the_wall_out(rng: np.random.Generator) -> None:
    volume, inside = particles(rng, 0.1)
    mask = kmeans_mask(volume, seed=1)
    box = inscribed_cuboid(volume.shape)
    np.testing.assert_array_equal(mask[box] == 1, inside[box])
    outside = np.ones(volume.shape, bool)
    outside[box] = False
    assert (mask[outside] == -1).all()
    assert (mask[box] >= 0).all()
    np.testing.assert_array_equal(mask, kmeans_mask(volume, seed=2))


@given(volume=arrays(np.float64, (1, 12, 12), elements=st.floats(-5, 5).map(lambda x: round(x, 2))))
def test_the_two_parts_have_the_least_squares_of_all(volume: NDArray[np.float64]) -> None:
    """Lloyd's iterations may end in another split, which a little noise then turns over."""
    used = volume[inscribed_cuboid(volume.shape)].ravel()
    assume(np.ptp(used) > 0)
    mask = kmeans_mask(volume)

    def squares(low: NDArray[np.bool_]) -> float:
        return sum(float(part.size * part.var()) for part in (used[low], used[~low]) if part.size)

    least = min(squares(used <= cut) for cut in np.unique(used))
    assert squares(mask[mask >= 0] == 0) == pytest.approx(least, abs=1e-9)


def test_interior_regions_hardly_depend_on_the_reference(rng: np.random.Generator) -> None:
    """Noise and an edge that is elsewhere in the reference leave the figures of a volume as they are."""
    clean, _ = particles(rng, 0.0)
    volume = clean + rng.normal(0, 0.2, clean.shape).astype(np.float32)
    references = [clean, volume, gaussian_filter(clean, 1.0), np.roll(volume, 1, axis=2)]
    references.append(clean + rng.normal(0, 0.6, clean.shape).astype(np.float32))
    masks = [interior_regions(reference) for reference in references]
    assert all(mask is not None for mask in masks)
    found = [snr_cnr(volume, mask) for mask in masks if mask is not None]
    assert np.ptp(found, axis=0).max() < 0.3
    assert found[0] == pytest.approx((20 * np.log10(3 / 0.2), 20 * np.log10(2 / 0.2)), abs=0.1)


def test_regions_without_an_interior_are_none() -> None:
    stripes = np.zeros((4, 40, 40), np.float32)
    stripes[:, :, ::2] = 1
    assert interior_regions(stripes) is None
    assert interior_regions(np.ones((4, 40, 40), np.float32)) is None


def test_snr_of_exact_numbers() -> None:
    volume = np.array([[[5.0, 5.0, 1.0, 3.0, 99.0]]])
    mask = np.array([[[1, 1, 0, 0, -1]]], np.int8)  # μ = 5, μ_b = 2, σ_b = 1
    assert snr_cnr(volume, mask) == pytest.approx((20 * np.log10(5), 20 * np.log10(3)))
    assert snr_cnr(volume[..., :4], mask[..., :4].astype(bool)) == pytest.approx((20 * np.log10(5), 20 * np.log10(3)))
    flat = np.array([[[5.0, 5.0, 1.0, 1.0]]])
    assert snr_cnr(flat, mask[..., :4]) == (np.inf, np.inf)
    assert snr_cnr(-flat, mask[..., :4]) == (-np.inf, np.inf)


@given(shape=st.tuples(*3 * [st.integers(1, 9000)]))
def test_a_sample_of_a_large_volume_is_bounded(shape: tuple[int, int, int]) -> None:
    volume = np.broadcast_to(np.float32(0), shape)
    found = sampled(volume)
    assert found.size <= 2**21
    assert found.shape == shape or found.size > 2**21 / 8


def test_errors_are_summed_in_parts_as_at_once(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    truth, volume = rng.random((2, 7, 5, 3))
    whole = psnr(truth, volume), nrmse(truth, volume)
    monkeypatch.setattr(metrics, "SUMMED_VALUES", 30)
    assert (psnr(truth, volume), nrmse(truth, volume)) == pytest.approx(whole, rel=1e-12)


@given(shape=st.tuples(st.integers(1, 40), st.integers(1, 60), st.integers(1, 60)), margin=st.floats(0, 0.49))
def test_the_cuboid_lies_in_the_cylinder(shape: tuple[int, int, int], margin: float) -> None:
    box = inscribed_cuboid(shape, margin)
    for part, n in zip(box, shape, strict=True):
        assert 0 <= part.start < part.stop <= n
        assert part.start + part.stop in (n - 1, n, n + 1)  # centred
    half_y, half_x = ((part.stop - part.start) / 2 for part in box[1:])
    assert np.hypot(half_y, half_x) <= min(shape[1:]) / 2 + np.sqrt(2)  # the corners, to a voxel


def test_bad_input_is_refused() -> None:
    ones = np.ones((12, 12, 12))
    with refused(ValueError):
        psnr(ones, ones[1:])
    with refused(ValueError):
        psnr(-ones, ones)
    with refused(ValueError):
        nrmse(0 * ones, ones)
    with refused(ValueError):
        ssim3d(ones, ones)
    with refused(ValueError):
        ssim2d(ones, ones)
    with refused(ValueError):
        ssim3d(ones[0], ones[0])
    with refused(ValueError):
        kmeans_mask(ones)
    with refused(ValueError):
        kmeans_mask(ones * np.nan)
    with refused(ValueError):
        inscribed_cuboid((3, 3, 3), 0.5)
    with refused(ValueError):
        snr_cnr(ones, np.zeros(ones.shape, np.int8))
    with refused(ValueError):
        snr_cnr(ones * np.nan, np.eye(12, dtype=np.int8)[None].repeat(12, 0))
    with refused(ValueError):
        snr_cnr(ones, np.zeros((1, 1, 1), np.int8))


def test_ssim_of_whole_slices_is_the_equation_without_windows(rng: np.random.Generator) -> None:
    truth = rng.random((3, 4, 5))
    volume = truth + rng.normal(0, 0.3, truth.shape)
    c1, c2 = 0.01**2 * np.ptp(truth) ** 2, 0.03**2 * np.ptp(truth) ** 2

    def equation(x: Any, y: Any) -> float:
        covariance = np.cov(x.ravel(), y.ravel(), ddof=0)
        means, variances = (x.mean(), y.mean()), np.diag(covariance)
        return (
            (2 * np.prod(means) + c1)
            * (2 * covariance[0, 1] + c2)
            / ((np.square(means).sum() + c1) * (variances.sum() + c2))
        )

    expected = [
        np.mean([equation(truth.take(i, axis), volume.take(i, axis)) for i in range(n)])
        for axis, n in enumerate(truth.shape)
    ]
    assert ssim_of_whole_slices(truth, volume) == pytest.approx(np.mean(expected), abs=1e-12)
    assert ssim_of_whole_slices(truth, truth) == pytest.approx(1, abs=1e-12)
