"""Axis and tilt of balls that are projected analytically about a tilted axis."""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.features.tuning.align import align_pair, finest_structure
from recon.prep.align import AxisError
from tests.slow_cases import others_slow

SHAPE = (120, 200)


def view(angle: float, tilt: float, axis_col: float, blur: float = 0.0) -> NDArray[np.float64]:
    """40 balls; the axis passes `axis_col` at the middle row, and its column grows by tan(tilt) a row."""
    rng = np.random.default_rng(3)
    at, radii = rng.uniform(-1, 1, (40, 3)) * (70, 70, 55), rng.uniform(4, 12, 40)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    found = np.zeros(SHAPE)
    for (x, y, along), radius in zip(at, radii, strict=True):
        across = x * math.cos(angle) + y * math.sin(angle)
        col = axis_col + across * math.cos(tilt) + along * math.sin(tilt)
        row = (SHAPE[0] - 1) / 2 + along * math.cos(tilt) - across * math.sin(tilt)
        square = radius**2 - (cols - col) ** 2 - (rows - row) ** 2
        found += 0.02 * np.sqrt(np.maximum(square + blur**2, 0))
    return found


def noise(seed: int, level: float = 0.02) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(0, level, SHAPE)


@pytest.mark.parametrize(("tilt_deg", "axis_col"), others_slow([(0.3, 108.3), (0.0, 99.5), (-1.5, 108.3), (3.0, 99.5)]))
def test_axis_and_tilt_are_found_within_their_uncertainty(tilt_deg: float, axis_col: float) -> None:
    tilt = math.radians(tilt_deg)
    axis, found = align_pair(view(0.4, tilt, axis_col) + noise(1), view(0.4 + math.pi, tilt, axis_col) + noise(2))
    assert axis.confident and found is not None
    assert axis.value == pytest.approx(axis_col, abs=0.15)
    assert math.degrees(found.tilt) == pytest.approx(tilt_deg, abs=0.06)
    assert abs(found.tilt - tilt) < 4 * found.uncertainty + 1e-4


@pytest.mark.parametrize("seed", range(4))
def test_views_without_a_sample_are_not_trusted(seed: int) -> None:
    with suppress(AxisError):
        assert not align_pair(noise(seed), noise(seed + 10))[0].confident


def test_a_blurred_view_has_coarser_structure_whatever_the_noise() -> None:
    from scipy.ndimage import gaussian_filter

    sharp = view(0.4, 0.0, 99.5)
    sizes = []
    for blur in (0.5, 1.5, 3.0):
        seen = gaussian_filter(sharp, blur)
        clean, noisy = finest_structure(seen, seen), finest_structure(seen + noise(1), seen + noise(2))
        assert noisy == pytest.approx(clean, rel=0.05)
        sizes.append(clean)
    assert sizes == sorted(sizes) and sizes[2] > 1.2 * sizes[0]
