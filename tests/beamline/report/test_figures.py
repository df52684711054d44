"""Figures: their grey window, and where a volume is bright."""

import numpy as np
import pytest

from beamline.report import figures
from recon.base.volume import Grid


def test_grey_window_ignores_nan_and_outliers() -> None:
    values = np.linspace(0.0, 1.0, 10_001)
    values[7] = np.nan
    values[-1] = 1e9
    low, high = figures.grey_window([values[:5000], values[5000:]])
    assert (low, high) == (pytest.approx(0.01, abs=1e-3), pytest.approx(0.995, abs=1e-3))
    assert figures.grey_window([np.full(5, 3.0)]) == (3.0, 4.0)
    assert figures.grey_window([np.full(5, np.nan)]) == (0.0, 1.0)


def test_slices_meet_where_the_volume_is_bright() -> None:
    """One bright ball off the middle: all three slices show it."""
    grid = Grid((40, 50, 60), 1.0)
    z, y, x = np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij")
    ball = ((z - 10) ** 2 + (y - 38) ** 2 + (x - 15) ** 2 < 16).astype(np.float32)
    assert figures.bright_centre(ball) == (10, 38, 15)
    assert figures.bright_centre(np.zeros((4, 6, 8), np.float32)) == (2, 3, 4)
