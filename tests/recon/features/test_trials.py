"""Fourier shell correlation against closed forms: equal volumes, white noise, and signals of a known band."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.features.trials import ShellCorrelation, fourier_shell_correlation, soft_cylinder

SHAPES = [(32, 32, 32), (12, 40, 40), (31, 20, 37), (1, 48, 48), (40, 9, 9)]

FIXED = 0.143  # of half sets, where the whole set correlates to 0.5 with the truth (Rosenthal & Henderson 2003)


def _radius(shape: tuple[int, int, int], edges: tuple[float, float, float]) -> NDArray[np.float64]:
    axes = [np.fft.fftfreq(n, edge) for n, edge in zip(shape, edges, strict=True)]
    return np.sqrt(sum(k**2 for k in np.meshgrid(*axes, indexing="ij")))


def _shaped(rng: np.random.Generator, amplitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Noise whose expected spectrum is amplitude²."""
    return np.fft.ifftn(np.fft.fftn(rng.normal(size=amplitude.shape)) * amplitude).real


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("masked", [False, True])
def test_a_volume_agrees_with_itself_whatever_its_gain_and_offset(
    rng: np.random.Generator, shape: tuple[int, int, int], masked: bool
) -> None:
    volume = rng.normal(size=shape)
    mask = soft_cylinder(shape) if masked else None
    found = fourier_shell_correlation(volume, 3e-4 * volume + 7, 0.5, mask)
    np.testing.assert_allclose(found.correlation, 1, atol=1e-5)
    assert found.resolution_mm == pytest.approx(1.0)  # two voxels: nothing finer can be resolved
    np.testing.assert_allclose(fourier_shell_correlation(volume, -volume, 0.5, mask).correlation, -1, atol=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("masked", [False, True])
def test_white_noise_scatters_about_zero_by_what_is_said(
    rng: np.random.Generator, shape: tuple[int, int, int], masked: bool
) -> None:
    """The mean of (correlation² x independent) is 1; under a mask shells hold more than stated, at most twice."""
    mask = soft_cylinder(shape) if masked else None
    scores = []
    for _ in range(12):
        found = fourier_shell_correlation(rng.normal(size=shape), rng.normal(size=shape), 1.0, mask)
        many = found.independent > 30  # few values are no Gaussian
        scores.append((found.correlation * np.sqrt(found.independent))[many])
    squares = np.concatenate(scores) ** 2
    spread = np.sqrt(2 / squares.size)  # of the mean of so many squares of a normal variable
    low, high = (0.5 - 4 * spread, 1 + 4 * spread) if masked else (1 - 4 * spread, 1 + 4 * spread)
    assert low < squares.mean() < high
    assert found.resolution_mm > 2


@pytest.mark.parametrize("shape", [(48, 48, 48), (24, 64, 64)])
def test_a_band_limited_signal_ends_where_its_band_ends(rng: np.random.Generator, shape: tuple[int, int, int]) -> None:
    edge, limit = 0.02, 12.0  # mm, 1/mm
    band = (_radius(shape, (edge,) * 3) < limit).astype(float)
    signal = 4 * _shaped(rng, band)
    found = fourier_shell_correlation(signal + rng.normal(size=shape), signal + rng.normal(size=shape), edge)
    width = float(found.frequency[1] - found.frequency[0])
    for threshold in (found.half_bit, np.full(found.frequency.size, FIXED)):
        assert 1 / found.crossing(threshold) == pytest.approx(limit, abs=1.5 * width)
    inside = found.frequency < limit - width
    assert found.correlation[inside].mean() == pytest.approx(16 / 17, abs=0.02)


def test_a_falling_signal_crosses_where_its_ratio_to_the_noise_says(rng: np.random.Generator) -> None:
    """SNR(k) = 40 exp(-k / 0.06): FSC = SNR / (SNR + 1) is 0.143 where SNR = 0.143 / 0.857."""
    shape = (64, 64, 64)
    signal = _shaped(rng, np.sqrt(40 * np.exp(-_radius(shape, (1.0,) * 3) / 0.06)))
    found = fourier_shell_correlation(signal + rng.normal(size=shape), signal + rng.normal(size=shape))
    expected = -0.06 * np.log(FIXED / (1 - FIXED) / 40)
    width = float(found.frequency[1] - found.frequency[0])
    assert 1 / found.crossing(np.full(found.frequency.size, FIXED)) == pytest.approx(expected, abs=width)
    ratio = 40 * np.exp(-found.frequency / 0.06)
    error = (found.correlation - ratio / (1 + ratio)) * np.sqrt(found.independent)
    assert np.abs(error).max() < 5


def test_frequencies_are_of_millimetres_also_where_slices_are_thicker(rng: np.random.Generator) -> None:
    """A wave along z is found in the shell of its own period."""
    shape, edges, period = (20, 30, 30), (0.3, 0.1, 0.1), 1.2
    wave = np.sin(2 * np.pi * np.arange(20) * edges[0] / period)[:, None, None] * np.ones(shape)
    found = fourier_shell_correlation(wave + rng.normal(size=shape), wave + rng.normal(size=shape), edges)
    assert found.nyquist == pytest.approx(0.5 / 0.3)
    assert found.frequency[-1] <= found.nyquist + 1e-9
    best = found.frequency[np.nanargmax(found.correlation)]
    assert best == pytest.approx(1 / period, abs=found.frequency[0])


@given(st.integers(0, 10_000), st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))
@settings(max_examples=20)
def test_arguments_may_change_places_and_gain_and_offset_do_not_matter(seed: int, gain: float, offset: float) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(6, 9, 8))
    b = a + rng.normal(size=a.shape)
    there, back = fourier_shell_correlation(a, b), fourier_shell_correlation(b, a)
    np.testing.assert_allclose(there.correlation, back.correlation, atol=1e-6)
    scaled = fourier_shell_correlation(gain * (a + offset), b)
    np.testing.assert_allclose(there.correlation, scaled.correlation, atol=1e-4)
    assert (np.abs(there.correlation) <= 1).all()


def test_thresholds() -> None:
    """Half-bit (eq. 17) tends to SNR / (SNR + 1) with SNR = 0.2071 in large shells, and to 1 in a shell of one."""
    curve = ShellCorrelation(np.array([1.0, 2.0, 3.0]), np.zeros(3), np.array([1.0, 100.0, 1e12]), 3.0)
    np.testing.assert_allclose(
        curve.half_bit, [1.0, (0.2071 + 0.19102) / (1.2071 + 0.09102), 0.2071 / 1.2071], rtol=1e-4
    )
    assert curve.resolution_mm == np.inf
    falling = ShellCorrelation(np.array([1.0, 2.0, 3.0]), np.array([0.9, 0.5, 0.0]), np.full(3, 1e12), 3.0)
    assert falling.crossing(np.full(3, 0.7)) == pytest.approx(1 / 1.5)


def test_the_soft_cylinder() -> None:
    mask = soft_cylinder((16, 32, 24))
    assert mask.max() == pytest.approx(1) and mask.min() == 0
    assert mask[8, 16, 12] == pytest.approx(1)
    assert mask[8, 0, 0] == 0
    radius = np.hypot(23, 1) / 24  # of voxel [8, 16, 0] in half widths of the narrower axis
    assert mask[7, 16, 0] == pytest.approx(0.5 + 0.5 * np.cos(np.pi * (radius - 0.8) / 0.2), abs=1e-6)
    np.testing.assert_allclose(mask, mask[::-1, ::-1, ::-1], atol=1e-6)
    assert (mask[7] > 0).mean() == pytest.approx(np.pi / 4 * 24 / 32, abs=0.03)
    assert (soft_cylinder((2, 20, 20))[:, 10, 10] == 1).all()  # two slices have no edge to spare


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        (np.ones((4, 4, 4)), np.eye(4)[None] * np.ones((4, 4, 4)), "constant"),
        (np.full((4, 4, 4), np.nan), np.ones((4, 4, 4)), "not finite"),
        (np.ones((2, 3, 3)), np.ones((2, 3, 3)), "no shells"),
    ],
)
def test_what_cannot_be_compared(first: NDArray[np.float64], second: NDArray[np.float64], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fourier_shell_correlation(first, second)
