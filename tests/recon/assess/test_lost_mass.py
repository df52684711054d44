"""Lost mass: weakly absorbing material that only FBP shows, above its own air level."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.voxels.matter_checks import lost_matter

F32 = NDArray[np.float32]
SHAPE = (40, 64, 64)
WEAK, DENSE = 0.0015, 0.02


def _fbp(level: float, noise: float = 4e-4) -> F32:
    """A dome of weak matter on a dense post, noise, and the level of air everywhere."""
    z, y, x = np.mgrid[: SHAPE[0], : SHAPE[1], : SHAPE[2]] - np.array([20, 31.5, 31.5])[:, None, None, None]
    sample = np.where(z**2 + y**2 + x**2 < 14**2, WEAK, 0.0)
    sample[(np.hypot(y, x) < 10) & (z > 4)] = DENSE
    return (sample + level + np.random.default_rng(0).normal(0, noise, SHAPE)).astype(np.float32)


def test_weak_matter_that_was_clipped_with_its_air_is_named_by_its_region() -> None:
    shown = _fbp(-0.001)
    found = lost_matter(np.maximum(gaussian_filter(shown, 1), 0), shown)
    assert found is not None
    (top, bottom), across, along = found.region
    assert top <= 10 and bottom >= 20 and max(across[0], along[0]) <= 22 and min(across[1], along[1]) >= 42
    assert 0.2 < found.kept_share < 0.4  # 0.0015 - 0.001 of 0.0015
    assert lost_matter(shown, shown) is None


def test_slices_without_beam_have_lost_nothing() -> None:
    shown, found, seen = _fbp(0.0), _fbp(0.0, noise=0.0), np.arange(40) < 26
    found[~seen] = 0  # no ray says what is there; FBP shows what was filled in
    assert lost_matter(found, shown) is not None and lost_matter(found, shown, seen) is None


@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_a_volume_that_is_smoother_or_has_no_noise_has_lost_nothing(sigma: float) -> None:
    shown, clean = _fbp(0.0), np.maximum(gaussian_filter(_fbp(0.0, noise=0.0), sigma), 0)
    assert lost_matter(clean, shown) is None


def test_streaks_beside_dense_matter_are_no_matter_that_was_lost() -> None:
    shown, clean = _fbp(0.0), _fbp(0.0, noise=0.0)
    for turn in np.linspace(0, np.pi, 12, endpoint=False):  # thin rays, bright beside dark
        y, x = np.mgrid[:64, :64] - 31.5
        away = np.cos(turn) * y + np.sin(turn) * x
        shown[26:] += np.where(np.abs(away) < 1, 0.004, np.where(np.abs(away) < 2, -0.004, 0)).astype(np.float32)
    assert lost_matter(clean, shown) is None


def test_without_air_nothing_is_known() -> None:
    assert lost_matter(np.ones(SHAPE, np.float32), np.ones(SHAPE, np.float32)) is None
