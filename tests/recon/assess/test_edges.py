"""Edges that are blurred are flatter by the ratio of their widths; noise makes none steeper."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon.assess.edges import edge_steepness

SIDE = 96


def _disc(blur: float) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    return np.repeat(gaussian_filter((np.hypot(y, x) < 30).astype(np.float32), blur)[None], 3, axis=0)


@pytest.mark.parametrize("blur", [2.0, 3.0, 4.0])
def test_the_slope_of_a_blurred_edge_is_that_of_a_gaussian(blur: float) -> None:
    x = np.linspace(-12, 12, 2401)

    def slope(width: float, more: float) -> np.ndarray:
        s2 = width**2 + more
        return np.exp(-(x**2) / 2 / s2) / np.sqrt(s2)

    both = slope(1.5, 1 + 1 / 3) + slope(blur, 1 + 1 / 3)  # smoothed by one voxel; differences over two voxels
    near = both >= 0.8 * both.max()
    expected = slope(blur, 1 / 3)[near].mean() / slope(1.5, 1 / 3)[near].mean()
    assert edge_steepness([_disc(1.5), _disc(blur)])[1] == pytest.approx(expected, rel=0.08)


def test_noise_makes_no_volume_steeper(rng: np.random.Generator) -> None:
    sharp, dull = _disc(1.5), _disc(3.0)
    quiet = edge_steepness([sharp, dull])
    noisy = edge_steepness([sharp, (dull + rng.normal(0, 0.1, dull.shape)).astype(np.float32)])
    assert noisy == pytest.approx(quiet, abs=0.06)


def test_equal_volumes_are_equally_steep_and_nothing_has_no_edge() -> None:
    assert edge_steepness([_disc(1.5)] * 3) == [1.0, 1.0, 1.0]
    assert edge_steepness([np.zeros((1, 4, 4), np.float32)] * 2) == [1.0, 1.0]


@pytest.mark.parametrize("shapes", [[], [(1, 4, 4), (2, 4, 4)], [(3, 1, 4)]])
def test_what_cannot_be_compared_is_refused(shapes: list[tuple[int, ...]]) -> None:
    with pytest.raises(ValueError, match="one shape"):
        edge_steepness([np.zeros(shape, np.float32) for shape in shapes])
