"""A displaced view: the shift that it was made with is found, and what it does not tell is not stated."""

import math

import numpy as np
import pytest
from scipy import ndimage

from recon.prep.shift import shift_between

ROWS, COLS = 60, 80


def balls(across: float = 0.0, down: float = 0.0, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Chords through three balls, displaced, with Gaussian noise."""
    rows, cols = np.mgrid[:ROWS, :COLS].astype(float)
    view = sum(
        2 * np.sqrt(np.clip(radius**2 - (rows - row - down) ** 2 - (cols - col - across) ** 2, 0, None)) * 0.05
        for row, col, radius in ((20, 30, 9), (38, 50, 12), (30, 22, 5))
    )
    return view + noise * np.random.default_rng(seed).standard_normal((ROWS, COLS))


@pytest.mark.parametrize(("across", "down"), [(0, 0), (0.3, -0.2), (1.7, 0.4), (-6.4, 5.1), (9.5, -8.2)])
def test_a_shift_is_found_to_a_fiftieth_of_a_pixel(across: float, down: float) -> None:
    found = shift_between(balls(), balls(across, down))
    assert (found.across, found.down) == pytest.approx((across, down), abs=0.02)


def test_more_light_and_a_slope_of_it_are_no_shift() -> None:
    found = shift_between(balls(), 1.03 * balls(0.5, 0.25) + 0.1 + np.linspace(0, 0.2, COLS))
    assert (found.across, found.down) == pytest.approx((0.5, 0.25), abs=0.02)


def test_the_uncertainty_is_the_spread_by_noise() -> None:
    found = [shift_between(balls(noise=0.1, seed=2 * i), balls(0.3, 0.6, 0.1, 2 * i + 1)) for i in range(40)]
    for values, sigmas, true in (
        ([each.across for each in found], [each.across_sigma for each in found], 0.3),
        ([each.down for each in found], [each.down_sigma for each in found], 0.6),
    ):
        assert np.mean(values) == pytest.approx(true, abs=0.02)
        assert 0.6 < np.std(values) / np.mean(sigmas) < 1.6


def test_rows_all_alike_tell_no_shift_down() -> None:
    view = np.repeat(balls()[30][None], ROWS, axis=0)
    found = shift_between(view, ndimage.shift(view, (0, 1.5), order=3, mode="nearest"))
    assert found.across == pytest.approx(1.5, abs=0.02)
    assert math.isnan(found.down)


def test_noise_alone_tells_nothing() -> None:
    found = shift_between(balls(noise=1.0) - balls(), balls(noise=1.0, seed=1) - balls())
    assert math.isnan(found.across) and math.isnan(found.down)


def test_pixels_without_a_measurement_and_tiny_views_do_no_harm() -> None:
    holed = balls(0.4, 0.0)
    holed[5, 7] = np.nan
    assert shift_between(balls(), holed).across == pytest.approx(0.4, abs=0.02)
    assert math.isnan(shift_between(balls()[:2], balls()[:2]).across)
