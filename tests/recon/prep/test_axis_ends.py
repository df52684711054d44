"""The axis from the ends of a 180° scan: samples wider than the field, and scans whose ends show nothing."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.prep.align import AxisError, find_axis
from recon.prep.axis_ends import ENDS, axis_from_ends
from recon.prep.axis_wedge import axis_from_sinogram
from tests.slow_cases import others_slow

COLS, ROWS = 96, 4


def grains(seed: int, over: float, angles: NDArray[np.float64], axis_col: float) -> NDArray[np.float32]:
    """Views [view, row, col] with noise of balls in a can `over` times as wide as the field."""
    rng, reach = np.random.default_rng(seed), over * COLS / 2
    n = int(60 * over**2)
    radius, where, at = rng.uniform(2.5, 6.5, n), rng.uniform(0, 2 * np.pi, n), reach * np.sqrt(rng.uniform(0, 0.9, n))
    height = rng.uniform(-6, 6, n)[:, None] - (np.arange(ROWS) - (ROWS - 1) / 2)
    u = np.arange(COLS) - axis_col
    views = np.empty((angles.size, ROWS, COLS))
    for view, angle in zip(views, angles, strict=True):
        view[:] = 0.25 * np.sqrt(np.maximum(reach**2 - u**2, 0))
        aside = (u - (at * np.cos(where - angle))[:, None]) ** 2
        for row in range(ROWS):
            view[row] += np.sqrt(np.maximum((radius**2 - height[:, row] ** 2)[:, None] - aside, 0)).sum(axis=0)
    views *= 2 / views.max()
    return (views + rng.normal(0, 0.01, views.shape)).astype(np.float32)


def half_turn(n: int) -> NDArray[np.float64]:
    return np.pi * np.arange(n) / n


@pytest.mark.parametrize(("over", "axis_col"), others_slow([(1.5, 47.5), (3.0, 51.2), (1.5, 44.13)], 2))
def test_the_axis_of_half_a_turn_of_a_wider_sample(over: float, axis_col: float) -> None:
    """The wedge, which needs the whole sample in the field, is not sure, and columns off."""
    views = grains(5, over, half_turn(120), axis_col)
    estimate = find_axis(views, half_turn(120))
    assert estimate.value == pytest.approx(axis_col, abs=0.3)
    assert estimate.confident and estimate.method == ENDS


def test_order_start_sense_and_a_last_view_opposite_to_the_first_do_not_matter() -> None:
    angles = np.linspace(0, np.pi, 121)
    views, order = grains(1, 2.0, angles, 45.3), np.random.default_rng(0).permutation(121)
    for seen, theta, axis_col in (
        (views, angles, 45.3),
        (views[order], angles[order] + 2.0, 45.3),
        (views[..., ::-1], -angles, COLS - 1 - 45.3),
    ):
        estimate = axis_from_ends(seen, theta)
        assert estimate.value == pytest.approx(axis_col, abs=0.1) and estimate.confident


def test_an_axis_far_from_the_middle_is_right_or_called_uncertain() -> None:
    for seed, axis_col in ((381, 38.13), (1, 30.3), (3, 30.3), (7, 57.0)):
        estimate = axis_from_ends(grains(seed, 3.0, half_turn(120), axis_col), half_turn(120))
        assert abs(estimate.value - axis_col) < 0.3 or not estimate.confident


def test_steps_too_wide_for_the_sample_leave_it_uncertain_and_noise_too() -> None:
    """Far outside the field, matter moves by more than a grain from view to view."""
    assert not axis_from_ends(grains(2, 3.0, half_turn(36), 47.5), half_turn(36)).confident
    noise = np.random.default_rng(0).normal(1, 0.1, (90, ROWS, COLS))
    with suppress(AxisError):
        assert not axis_from_ends(noise, half_turn(90)).confident


@pytest.mark.parametrize("n", [5, 8, 12])
def test_an_axis_by_few_views_of_a_wider_sample_is_right_or_called_uncertain(n: int) -> None:
    for seed in range(4):
        estimate = axis_from_sinogram(grains(seed, 2.0, half_turn(n), 47.3), half_turn(n))
        assert abs(estimate.value - 47.3) < 1 or not estimate.confident


def test_noise_of_flats_that_the_views_share_is_no_matter() -> None:
    """Flats of both ends are interpolated: views side by side share their noise, and join by it within the scan."""
    can, time = 0.3 * np.sqrt(1 - ((np.arange(COLS) - 47.5) / COLS) ** 2), np.linspace(0, 1, 90)[:, None, None]
    for seed in range(5, 9):
        rng = np.random.default_rng(seed)
        change, first = rng.normal(0, 0.04, (2, ROWS, COLS))
        views = can + time * change + first + rng.normal(0, 0.05, (90, ROWS, COLS))
        assert not axis_from_ends(views, half_turn(90)).confident


@pytest.mark.parametrize("part", [slice(0, 100), np.delete(np.arange(120), range(40, 44)), slice(0, 31)])
def test_a_sector_a_gap_and_few_views_have_no_ends_that_join(part: slice | NDArray[np.int_]) -> None:
    views, angles = grains(4, 1.5, half_turn(120), 47.5), half_turn(120)
    with pytest.raises(ValueError, match="180° in 32 or more even steps"):
        axis_from_ends(views[part], angles[part])


def test_a_sample_in_the_field_keeps_the_axis_of_all_views() -> None:
    views = grains(5, 0.9, half_turn(90), 47.2)
    estimate, from_all = find_axis(views, half_turn(90)), axis_from_sinogram(views, half_turn(90))
    assert estimate.value == from_all.value and estimate.method == from_all.method
