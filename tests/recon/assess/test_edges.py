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

    smoother = slope(blur, 1 + 1 / 3)  # smoothed by one voxel; differences over two voxels
    near = smoother >= 0.8 * smoother.max()
    expected = slope(blur, 1 / 3)[near].mean() / slope(1.5, 1 / 3)[near].mean()
    assert edge_steepness([_disc(1.5), _disc(blur)])[1] == pytest.approx(expected, rel=0.08)


@pytest.mark.parametrize("noise", [0.03, 0.1, 0.2])
@pytest.mark.parametrize("noisy", [1.5, 3.0])
def test_noise_of_its_own_makes_no_volume_steeper(rng: np.random.Generator, noise: float, noisy: float) -> None:
    volumes = [_disc(1.5), _disc(3.0)]
    added = [(_disc(noisy) + rng.normal(0, noise, volumes[0].shape)).astype(np.float32)]
    expected = edge_steepness([*volumes, _disc(noisy)])
    assert edge_steepness(volumes + added) == pytest.approx(expected, abs=0.07)


def test_a_volume_that_is_not_finite_has_no_edges_to_compare() -> None:
    broken = _disc(2.0)
    broken[1, 5, 5] = np.nan
    assert np.isnan(edge_steepness([_disc(1.5), broken])).all()


def test_equal_volumes_are_equally_steep_and_nothing_has_no_edge() -> None:
    assert edge_steepness([_disc(1.5)] * 3) == [1.0, 1.0, 1.0]
    assert edge_steepness([np.zeros((1, 4, 4), np.float32)] * 2) == [1.0, 1.0]


@pytest.mark.parametrize("shapes", [[], [(1, 4, 4), (2, 4, 4)], [(3, 1, 4)]])
def test_what_cannot_be_compared_is_refused(shapes: list[tuple[int, ...]]) -> None:
    with pytest.raises(ValueError, match="one shape"):
        edge_steepness([np.zeros(shape, np.float32) for shape in shapes])
