"""Contrast over energies, and the edge of the curve."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from splatline_spectral.contrast import (
    LEAST,
    ContrastRegions,
    XafsCurve,
    _step,
    contrast_of,
    curve_of,
    find_edge,
    local_parabolas,
)

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


Reals = NDArray[np.float64]


def _curve(energies: Reals, edge: float, line: float = 0.6, jump: float = 2.0) -> Reals:
    """A smooth fall, a rise of 1.4 eV at `edge`, and a white line 5 eV wide 6 eV above it."""
    away = (energies - edge) * 1e3
    step = 0.5 + np.arctan(away / 0.7) / np.pi
    return (energies / edge) ** -2.8 * (0.8 + jump * (step + line / (1 + ((away - 6) / 2.5) ** 2)))


def _smooth(energies: Reals) -> Reals:
    return 3.0 * (energies / 8.0) ** -2.85 + 0.02


@settings(max_examples=40, deadline=None)
@given(
    edge=st.floats(8.33, 8.36), step=st.sampled_from([0.0005, 0.001, 0.0015]), noise=st.sampled_from([0.0, 0.002]),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_edge_and_white_line_are_found_within_half_a_step_and_a_bit(
    edge: float, step: float, noise: float, seed: int
) -> None:
    energies = np.arange(8.30, 8.40, step)
    curve = _curve(energies, edge) + np.random.default_rng(seed).normal(0, noise, energies.size)
    found = find_edge(energies, curve)
    assert found.found and found.reason == ""
    assert found.energy == pytest.approx(edge, abs=max(step, 0.0006))
    assert found.white_line == pytest.approx(edge + 0.006, abs=max(step / 2, 0.0005))


def test_the_spacing_may_be_uneven() -> None:
    energies = np.concatenate(
        [np.arange(8.30, 8.335, 0.004), np.arange(8.335, 8.36, 0.0007), np.arange(8.36, 8.42, 0.005)]
    )
    found = find_edge(energies, _curve(energies, 8.3437))
    assert found.energy == pytest.approx(8.3437, abs=0.0005)
    assert found.white_line == pytest.approx(8.3497, abs=0.0005)


@settings(max_examples=60, deadline=None)
@given(
    low=st.floats(5, 20), width=st.floats(0.02, 3.0), noise=st.sampled_from([0.0, 1e-4, 0.01, 0.3]),
    seed=st.integers(0, 10**6),
)  # fmt: skip
def test_a_curve_without_an_edge_has_none(low: float, width: float, noise: float, seed: int) -> None:
    """Whatever the noise: a false alarm in a million curves."""
    energies = np.linspace(low, low + width, 121)
    found = find_edge(energies, _smooth(energies) + np.random.default_rng(seed).normal(0, noise, 121))
    assert not found.found
    assert (found.energy, found.white_line) == (None, None)
    assert "as smooth as a curve without an edge" in found.reason


def test_an_edge_at_the_end_of_the_range_is_told_apart() -> None:
    for energies in (np.arange(8.30, 8.344, 0.001), np.arange(8.3437, 8.40, 0.001)):
        found = find_edge(energies, _curve(energies, 8.3437))
        assert not found.found and "widen the range of energies: the curve is steepest at the end" in found.reason


@pytest.mark.parametrize("line", [0.0, 0.6])
def test_an_edge_of_six_times_the_noise_is_seen(line: float) -> None:
    """To a person it is plain; it is within 4 eV, which is as much as five energies' noise leaves open."""
    energies = np.arange(8.30, 8.42, 0.001)
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, 1 / 6, energies.size)
        found = find_edge(energies, _curve(energies, 8.3437, line, jump=1.0) + noise)
        assert found.found and found.energy == pytest.approx(8.3437, abs=0.004)


@pytest.mark.parametrize("n", [LEAST, 40])
def test_the_chance_of_a_false_alarm_is_what_it_says(n: int) -> None:
    """A chance below p comes in at most p of 3000 curves of noise: 1e-6 of all such tests have more than these."""
    basis = np.linalg.qr(np.linspace(1, 1.1, n)[:, None] ** np.array([0, -3, -4]))[0]
    noise = np.random.default_rng(n).normal(size=(3000, n))
    chances = np.array([_step(one - basis @ (basis.T @ one), basis)[1] for one in noise])
    for p, most in ((0.1, 380), (0.01, 58), (0.001, 15)):
        assert (chances < p).sum() <= most
    assert (chances < 0.1).sum() > 60  # and not because it never rings


def test_the_top_of_a_bare_step_is_no_white_line_however_far_the_curve_falls_beyond() -> None:
    for last in (8.42, 8.7, 9.2):
        energies = np.arange(8.30, last, 0.002)
        assert find_edge(energies, _curve(energies, 8.3437, line=0.0)).white_line is None
        found = find_edge(energies, _curve(energies, 8.3437))
        assert found.white_line == pytest.approx(8.3497, abs=0.001)
    energies = np.arange(8.30, 8.42, 0.001)
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, 0.02, energies.size)
        assert find_edge(energies, _curve(energies, 8.3437, line=0.0) + noise).white_line is None


def test_what_only_falls_has_no_edge() -> None:
    energies = np.arange(8.30, 8.40, 0.001)
    fall = -np.arctan((energies - 8.35) * 1e3 / 2) - 20 * (energies - 8.3)
    found = find_edge(energies, fall)
    assert not found.found and found.reason == "the absorption does not rise at any energy"


def test_the_noise_is_that_of_the_curve() -> None:
    energies = np.linspace(8.3, 8.4, 4001)
    curve = _curve(energies, 8.34) + np.random.default_rng(5).normal(0, 0.01, 4001)
    assert find_edge(energies, curve).noise == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("energies", [np.linspace(8, 9, LEAST - 1), np.array([*np.linspace(8, 9, LEAST), 9.0])])
def test_too_few_energies_or_unsorted_ones_are_refused(energies: Reals) -> None:
    with pytest.raises(ValueError, match=f"{LEAST} energies in rising order"):
        find_edge(energies, np.ones_like(energies))
