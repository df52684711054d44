"""The tilt of the axis: found within the uncertainty that it states, of half and full turns, and refused where it is
not to be seen."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from recon.prep.resample import Resampling
from recon.prep.tilt import TiltEstimate, find_tilt, roll_of_mean_view
from tests.messages import refused
from tests.recon.prep.balls import Balls
from tests.slow_cases import others_slow

HALF = Balls(np.radians(np.arange(0, 180, 2.0)))


def _found(views: np.ndarray, angles: np.ndarray) -> TiltEstimate:
    rows = views.shape[1]
    first = np.linspace(0, rows - 2, 16).astype(int)
    bands = np.stack([views[:, row : row + 2].mean(axis=1) for row in first], axis=1)
    return find_tilt(bands, first + 0.5 - (rows - 1) / 2, angles)


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [2.0, 0.0])
def test_a_tilt_is_found_within_its_uncertainty(tilt: float) -> None:
    """By levelled views, as `find_tilt` says, of three samples with noise of a tenth of the typical line integral."""
    misses = []
    for seed in range(3):
        balls = replace(HALF, tilt_deg=tilt, seed=seed)
        views = balls.views() + np.random.default_rng(seed).normal(0, 0.03, (90, *balls.shape)).astype(np.float32)
        total = math.radians(tilt) * 1.2
        for _ in range(2):
            levelled = views.copy()
            Resampling(balls.shape, total).apply(levelled, 0)
            found = _found(levelled, balls.angles)
            total += found.tilt
        misses.append((total - math.radians(tilt)) / found.uncertainty)
        assert math.degrees(found.uncertainty) < 0.15  # a sixth of a pixel over the rows
        assert found.axis_col == pytest.approx(balls.axis_col, abs=0.15)
    assert np.max(np.abs(misses)) < 3.5 and np.sqrt(np.mean(np.square(misses))) < 2


@pytest.mark.slow
def test_the_uncertainty_holds_where_views_are_few_for_the_columns() -> None:
    """32 views of 256 columns, 8 bands, little noise: some bands fit far better than others, and carry the estimate."""
    misses, first = list[float](), np.linspace(0, 254, 8).round().astype(np.int64)
    for seed in range(20):
        balls = Balls(np.arange(32) * np.pi / 32, (256, 256), axis_col=131.3, seed=seed)
        views = balls.views((first[:, None] + np.arange(2)).ravel())
        views += np.random.default_rng(seed).normal(0, 0.004, views.shape)
        with suppress(ValueError):  # where it is not to be seen
            found = find_tilt(
                views.reshape(32, 8, 2, 256).mean(axis=2), (first - 127.0).astype(np.float64), balls.angles
            )
            misses.append(found.tilt / found.uncertainty)
    assert len(misses) > 12
    assert np.max(np.abs(misses)) < 3 and np.sqrt(np.mean(np.square(misses))) < 1.3


@pytest.mark.slow
def test_a_wide_field_is_levelled_by_opposite_views() -> None:
    """An axis near the edge, which the double wedge does not find."""
    balls = Balls(np.radians(np.arange(0, 360, 3.0)), (64, 96), axis_col=22.0, tilt_deg=0.5, seed=1)
    found = _found(balls.views(), balls.angles)
    assert abs(math.degrees(found.tilt) - 0.5) < 3 * math.degrees(found.uncertainty) < 0.6
    assert found.axis_col == pytest.approx(22.0, abs=0.3)


def test_what_does_not_show_an_axis_is_refused() -> None:
    sector = Balls(np.radians(np.arange(0, 60, 1.0)))
    with refused(ValueError):
        _found(sector.views(), sector.angles)
    noise = np.random.default_rng(0).normal(size=(90, 64, 96))
    with refused(ValueError):
        _found(noise, HALF.angles)
    for cols in (1, 2, 7):
        with pytest.raises(ValueError, match=f"{cols} columns"):
            _found(noise[:, :, :cols], HALF.angles)
    with refused(ValueError):
        find_tilt(noise[:, :3], np.arange(3.0), HALF.angles)


@pytest.mark.parametrize(("roll", "off"), others_slow([(-0.5, 0.7), (1.0, 0.0), (0.0, 0.7), (3.0, 0.7)], 2))
def test_the_mean_of_a_turn_tells_a_lean(roll: float, off: float) -> None:
    """Discs about an axis that leans, of unlike heights and sizes; a light that slopes, and an axis said wrongly."""
    rows, cols = np.mgrid[:64, :64] - 31.5
    lean = np.radians(roll)
    across, down = cols * np.cos(lean) - rows * np.sin(lean), cols * np.sin(lean) + rows * np.cos(lean)
    mean = 2e-3 * cols + sum(
        mu * np.sqrt(np.clip(r**2 - across**2 - (down - z) ** 2, 0, None))
        for z, r, mu in ((0, 20, 0.01), (22, 12, 0.02), (-20, 10, 0.03))
    )
    found, sigma = roll_of_mean_view(mean + np.random.default_rng(2).normal(0, 1e-3, mean.shape), 31.5 + off)
    assert np.degrees(found) == pytest.approx(roll, abs=0.1 + 0.15 * abs(roll))
    assert sigma > 0 and (abs(found) > 4 * sigma) == (roll != 0)
