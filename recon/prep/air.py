"""Air beside the sample: the columns at the detector's edges that see only air, and each view's light there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]

_MAD = 1.4826  # median absolute deviation to standard deviation of a normal distribution
_BANDS = 8  # of rows, at most


def edge_profiles(transmission: F32) -> F32:
    """What `air_columns` needs to know of each view: medians [view, side, band of rows, column from the edge].

    Args:
        transmission: float32 [view, row, col].
    """
    _, rows, cols = transmission.shape
    bands = [b for b in np.array_split(np.arange(rows), min(rows, _BANDS)) if b.size]
    widest = max(cols // 8, 1)
    sides = (transmission[:, :, :widest], transmission[:, :, ::-1][:, :, :widest])
    return np.stack(
        [np.stack([np.median(side[:, b[:: max(b.size // 32, 1)]], axis=1) for b in bands], axis=1) for side in sides],
        axis=1,
    )


def air_columns(profiles: F32, cols: int, tolerance: float = 0.03) -> tuple[int, int]:
    """Number of columns at the left and right edge that show air in all views; (0, 0) if none do.

    Air columns are nowhere darker than the outermost ones by more than the tolerance (or the noise, if larger), in
    every view and over the whole height. A sample that fills the view is thinnest at the edge, so a trend towards
    darker is sample; a slow trend towards brighter is the beam. A side of fewer than 4 % of the columns, or darker than
    the other side by more than 10 %, counts as 0.

    Args:
        profiles: of all views, see `edge_profiles`.
        cols: of the detector.
    """
    least = max(3, cols // 25)
    counts, levels = [], []
    for profile in (profiles[:, 0], profiles[:, 1]):
        level = np.median(profile[:, :, :3], axis=(1, 2))
        relative = profile / np.where(level > 0, level, 1e-30)[:, None, None] - 1
        wide = profile.shape[2] > 1
        noise = _MAD * float(np.median(np.abs(np.diff(relative, axis=2)))) / np.sqrt(2) if wide else 0.0
        # One view in twenty may deviate: the median over the columns tolerates that, and noise has tails.
        darkest = np.quantile(relative.min(axis=1), 0.05, axis=0, method="higher")
        steady = (darkest > -max(tolerance, 4 * noise)) & (np.median(relative, axis=(0, 1)) < 0.1)
        n = int(np.argmin(np.append(steady, False)))
        n -= n // 4  # keep a distance from the sample's edge and its phase fringes
        trend = np.median(relative[:, :, n // 2 : n]) - np.median(relative[:, :, : n // 2]) if n > 1 else -np.inf
        counts.append(n if n >= least and trend > -tolerance / 2 else 0)
        levels.append(float(np.median(level)))
    left, right = (n if level > 0.9 * max(levels) else 0 for n, level in zip(counts, levels, strict=True))
    return left, right


def air_level(transmission: F32, left: int, right: int) -> F32:
    """Median transmission of the air columns in each view, with equal weight for both sides."""
    cols = transmission.shape[2]
    sides = [side for side in (transmission[:, :, :left], transmission[:, :, cols - right :]) if side.shape[2]]
    if not sides:
        return np.ones(transmission.shape[0], np.float32)
    return np.mean([np.median(side, axis=(1, 2)) for side in sides], axis=0).astype(np.float32)
