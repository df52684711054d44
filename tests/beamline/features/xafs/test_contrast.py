"""Contrast: levels and noise of known frames, and the best of a known curve."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from beamline.features.xafs.contrast import ContrastRegions, XafsCurve, contrast_of, curve_of, local_parabolas

ROWS, COLS = np.mgrid[:80, :90].astype(np.float64)
INSIDE = np.hypot(ROWS - 40, COLS - 45) < 20
AROUND = np.hypot(ROWS - 40, COLS - 45) > 25


def test_contrast_and_noise_of_a_disk_on_a_slope() -> None:
    """The noise is that which was put in, whatever the structure: slopes, products of slopes, the disk's rim."""
    rng = np.random.default_rng(1)
    smooth = 0.3 + 1.5 * INSIDE + 0.002 * ROWS + 0.001 * COLS + 1e-5 * ROWS * COLS
    frame = smooth + rng.normal(0, 0.03, ROWS.shape) * INSIDE + rng.normal(0, 0.01, ROWS.shape) * ~INSIDE
    contrast, noise = contrast_of(frame, ContrastRegions(INSIDE, AROUND))
    assert contrast == pytest.approx(smooth[INSIDE].mean() - smooth[AROUND].mean(), abs=0.003)
    assert noise == pytest.approx(np.hypot(0.03, 0.01), rel=0.1)
    level, own = contrast_of(frame, ContrastRegions(INSIDE))
    assert (level, own) == (pytest.approx(frame[INSIDE].mean()), pytest.approx(0.03, rel=0.1))


def test_a_frame_without_noise_has_none() -> None:
    frame = 0.3 + 0.01 * ROWS
    assert contrast_of(frame, ContrastRegions(INSIDE, AROUND))[1] == pytest.approx(0.0, abs=1e-12)
    curve = XafsCurve(np.arange(9.0), np.arange(9.0), np.arange(9.0), np.zeros(9))
    assert curve.contrast_to_noise is None and curve.best == 8


def test_the_curve_is_in_the_order_of_energies_and_by_thickness() -> None:
    regions = ContrastRegions(INSIDE, AROUND, thickness=0.02)
    energies = np.array([8.2, 8.0, 8.1])
    curve = curve_of(energies, [(0.4, 0.2), (0.1, 0.1), (0.2, 0.1)], regions)
    np.testing.assert_array_equal(curve.energies, [8.0, 8.1, 8.2])
    np.testing.assert_allclose(curve.absorption, [5.0, 10.0, 20.0])
    assert curve.unit == "1/mm"
    assert curve_of(energies, [(0.4, 0.2)] * 3, ContrastRegions(INSIDE)).unit == "line integral"


def test_the_best_is_not_the_highest_where_that_is_noisy() -> None:
    energies = np.arange(8.0, 8.5, 0.01)
    contrast = 1 + np.exp(-((energies - 8.2) ** 2) / 0.002)
    noise = np.where(energies < 8.15, 0.1, 0.4)
    curve = XafsCurve(energies, contrast, contrast, noise)
    assert energies[curve.best] < 8.15
    by = curve.contrast_to_noise
    assert by is not None and by[0] == pytest.approx(10.0, rel=0.01)
    first, last = XafsCurve(energies, contrast, contrast, np.full(50, 0.1)).nearly_best
    inside = energies[contrast >= 0.95 * contrast.max()]
    assert (first, last) == (inside.min(), inside.max())


def test_a_dark_material_stands_out_as_a_bright_one_does() -> None:
    energies = np.arange(8.0, 8.1, 0.01)
    contrast = -1 - (energies - 8.05) ** 2
    assert XafsCurve(energies, contrast, contrast, np.full(10, 0.1)).best in (0, 9)


def test_dead_pixels_count_for_nothing_and_a_region_without_light_is_not_told() -> None:
    rng = np.random.default_rng(1)
    frame = 0.3 + 1.5 * INSIDE + rng.normal(0, 0.01, ROWS.shape)
    clean, noise = contrast_of(frame, ContrastRegions(INSIDE, AROUND))
    dead = np.where(rng.random(ROWS.shape) < 0.1, np.nan, frame)
    assert contrast_of(dead, ContrastRegions(INSIDE, AROUND)) == (
        pytest.approx(clean, abs=0.002),
        pytest.approx(noise, rel=0.2),
    )
    assert np.isnan(contrast_of(np.where(rng.random(ROWS.shape) < 0.6, np.nan, frame), ContrastRegions(INSIDE))).all()
    for share, usable in ((0.003, True), (0.03, False)):
        dark = np.where(rng.random(ROWS.shape) < share, np.inf, frame)
        contrast, _ = contrast_of(dark, ContrastRegions(INSIDE, AROUND))
        assert contrast == pytest.approx(clean, abs=0.002) if usable else np.isnan(contrast)


def test_energies_of_which_nothing_is_known_are_left_out() -> None:
    points = [(0.4, 0.1), (np.nan, np.nan), (0.2, 0.1), (np.nan, np.nan)]
    curve = curve_of(np.array([8.3, 8.2, 8.1, 8.0]), points, ContrastRegions(INSIDE, thickness=2.0))
    assert (curve.energies.tolist(), curve.left_out.tolist()) == ([8.1, 8.3], [8.0, 8.2])
    np.testing.assert_allclose(curve.absorption, [0.1, 0.2])
    empty = curve_of(np.zeros(0), [], ContrastRegions(INSIDE))
    assert empty.energies.size == empty.left_out.size == 0


def test_a_few_pixels_tell_a_contrast_and_no_noise() -> None:
    """The noise of one pixel is any number; which energy is best must not hang on it."""
    few = np.zeros_like(INSIDE)
    few[40, 45:48] = True
    level, noise = contrast_of(0.3 + 0.01 * ROWS, ContrastRegions(few))
    assert level == pytest.approx(0.7) and np.isnan(noise)
    curve = curve_of(np.array([8.0, 8.1]), [(0.4, 0.1), (0.5, np.nan)], ContrastRegions(few))
    assert curve.noise is None and curve.contrast_to_noise is None and curve.best == 1


@pytest.mark.parametrize("corner", [(0, 0), (70, 80), (33, 0)])
def test_only_the_region_s_own_part_of_a_frame_matters(corner: tuple[int, int]) -> None:
    frame = np.random.default_rng(3).normal(0.5, 0.02, ROWS.shape)
    region = np.zeros_like(INSIDE)
    region[corner[0] : corner[0] + 10, corner[1] : corner[1] + 10] = True
    part = slice(max(corner[0] - 1, 0), corner[0] + 11), slice(max(corner[1] - 1, 0), corner[1] + 11)
    assert contrast_of(frame, ContrastRegions(region)) == contrast_of(frame[part], ContrastRegions(region[part]))


def test_an_empty_region_is_refused() -> None:
    with pytest.raises(ValueError, match="has no pixel"):
        ContrastRegions(INSIDE, np.zeros_like(INSIDE))


@given(
    steps=st.lists(st.floats(0.1, 2), min_size=7, max_size=20), a=st.floats(-5, 5), b=st.floats(-5, 5),
    c=st.floats(-5, 5), window=st.sampled_from([3, 5, 7]),
)  # fmt: skip
def test_a_parabola_comes_out_as_it_is(steps: list[float], a: float, b: float, c: float, window: int) -> None:
    x = np.cumsum(steps)
    values, slopes = local_parabolas(x, a + b * x + c * x**2, window)
    np.testing.assert_allclose(values, a + b * x + c * x**2, atol=1e-8)
    np.testing.assert_allclose(slopes, b + 2 * c * x, atol=1e-7)


def test_even_spacing_is_savitzky_and_golay() -> None:
    y = np.random.default_rng(0).normal(size=30)
    values, slopes = local_parabolas(np.arange(30) * 0.5, y, 5)
    np.testing.assert_allclose(values, savgol_filter(y, 5, 2), atol=1e-12)
    np.testing.assert_allclose(slopes, savgol_filter(y, 5, 2, deriv=1, delta=0.5), atol=1e-12)
