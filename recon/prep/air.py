"""Air beside the sample: the columns at the detector's edges that see only air, and the light of each view by them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, median_deviation

_NEXT, _OUTER = 5, 3  # views next to flats; columns
_RISE = 0.005  # line integral, from the edge to an eighth of the width: about the least a surface of the beam has
_BANDS = 8  # of rows, at most


def edge_profiles(transmission: F32) -> F32:
    """Input of `air_columns`, by transmissions [view, row, col]: medians [view, side, band of rows, col from edge]."""
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

    Air columns are nowhere darker than the outermost ones by more than the tolerance (or the noise, if larger). This
    holds in every view, over the whole height. A sample that fills the view is thinnest at the edge, so a trend towards
    darker is sample; a slow trend towards brighter is the beam. A side of fewer than 4 % of the columns, or darker than
    the other side by more than 10 %, counts as 0. For the `edge_profiles` of all views.
    """
    least = max(3, cols // 25)
    counts, levels = [], []
    for profile in (profiles[:, 0], profiles[:, 1]):
        level = np.median(profile[:, :, :3], axis=(1, 2))
        relative = profile / np.where(level > 0, level, 1e-30)[:, None, None] - 1
        wide = profile.shape[2] > 1
        noise = median_deviation(np.diff(relative, axis=2)) / np.sqrt(2) if wide else 0.0
        # One view in twenty may deviate: noise has tails, and the median over the columns tolerates it.
        darkest = np.quantile(relative.min(axis=1), 0.05, axis=0, method="higher")
        steady = (darkest > -max(tolerance, 4 * noise)) & (np.median(relative, axis=(0, 1)) < 0.1)
        n = int(np.argmin(np.append(steady, False)))
        n -= n // 4  # keep a distance from the sample's edge and its phase fringes
        trend = np.median(relative[:, :, n // 2 : n]) - np.median(relative[:, :, : n // 2]) if n > 1 else -np.inf
        counts.append(n if n >= least and trend > -tolerance / 2 else 0)
        levels.append(float(np.median(level)))
    left, right = (n if level > 0.9 * max(levels) else 0 for n, level in zip(counts, levels, strict=True))
    return left, right


def edge_depth(profiles: F32, positions: NDArray[np.int64], flats: Sequence[float], columns: tuple[int, int]) -> float:
    """Line integral at edges that look like air but may be a sample wider than the field; 0 where they are air.

    It is that of the views next to a group of flats, the least of all groups: a beam drifts away from its flats, and a
    sample is there at once. A sample is thinnest at the edges. So line integrals rise from there on, on all sides, in
    the median of views and rows; where they do not, the beam is weaker than its flats.

    Args:
        profiles: as of `edge_profiles`; positions: [view], of the views in the scan.
        flats: positions of the groups.
        columns: that show air, left and right.
    """
    sides = [side for side, n in enumerate(columns) if n]
    light = np.median(profiles[:, sides, :, :_OUTER], axis=(1, 2, 3))
    beside = (np.argsort(np.abs(positions - flat), kind="stable")[:_NEXT] for flat in flats)
    depth = min(-math.log(max(float(np.median(light[views])), 1e-30)) for views in beside)
    outer, inner = (np.median(part, axis=(0, 2, 3)) for part in (profiles[..., :_OUTER], profiles[..., -_OUTER:]))
    rises = np.log(np.maximum(outer, 1e-30) / np.maximum(inner, 1e-30))[sides]
    return depth if rises.min() > _RISE else 0.0


def air_light(transmission: F32, left: int, right: int) -> F32:
    """Transmission of the air across each view [view, col], from its air columns; 1 without any.

    Medians of the two sides, and the line through them: a beam that moved or changed its shape since the flat tilts it.
    """
    views, _, cols = transmission.shape
    sides = [(side, at) for side, at in (
        (transmission[:, :, :left], (left - 1) / 2), (transmission[:, :, cols - right :], cols - (right + 1) / 2),
    ) if side.shape[2]]  # fmt: skip
    if not (sides and views):
        return np.ones((views, cols), np.float32)
    levels = [np.median(side, axis=(1, 2)).astype(np.float32) for side, _ in sides]
    if len(sides) == 1:
        return np.repeat(levels[0][:, None], cols, axis=1)
    first, last = (at for _, at in sides)
    along = np.clip((np.arange(cols) - first) / (last - first), 0, 1).astype(np.float32)
    return levels[0][:, None] * (1 - along) + levels[1][:, None] * along
