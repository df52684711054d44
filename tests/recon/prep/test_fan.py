"""The fan angle of a 360° scan is found from rays that are measured from both sides."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recon.prep.fan import fans_shown

BALLS = ((0.0, 0.0, 30.0, 1.0), (14.0, 6.0, 7.0, 2.0), (-12.0, 10.0, 6.0, -1.0), (-9.0, -15.0, 5.0, 3.0))


def views(slope: float, n: int = 120, cols: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Chords of discs, by rays at γ whose distance from the axis is that of a source far enough to see all of them."""
    angles, u = np.arange(n) * 2 * np.pi / n, np.arange(cols) - (cols - 1) / 2
    gamma = np.arctan(slope * u)
    away = np.sin(gamma) / slope if slope else u
    at = angles[:, None] - gamma  # of the parallel view that has this ray
    chords = (
        2 * mu * np.sqrt(np.clip(r * r - (away - x * np.cos(at) - y * np.sin(at)) ** 2, 0, None))
        for x, y, r, mu in BALLS
    )
    noise = np.random.default_rng(0).normal(0, 0.2, (n, cols))
    return np.sum(list(chords), axis=0) + noise, angles


@pytest.mark.parametrize("degrees", [0.0, 6.0, 17.0, 40.0])
def test_the_fan_is_that_of_the_rays(degrees: float) -> None:
    slope = math.tan(math.radians(degrees / 2)) / 48
    sinogram, angles = views(slope)
    order = np.random.default_rng(1).permutation(angles.size)
    stated, least, usual, best = fans_shown(sinogram[order], angles[order], 47.5, slope)
    assert 2 * math.degrees(math.atan(best * 48)) == pytest.approx(degrees, abs=2.4)
    assert stated < 1.15 * least < 0.01 and least < usual / 4
    wrong, *_ = fans_shown(sinogram, angles, 47.5, slope * 1.6 if degrees else 0.002)
    assert wrong > 1.3 * least
