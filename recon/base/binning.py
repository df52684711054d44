"""Binning of projections by a factor, and the factor; `Geometry.binned` gives their geometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def bin_views(projections: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Means of factor x factor line integrals [view, row, col]; trailing pixels that do not fill a bin are dropped.

    Where line integrals differ within a bin, their mean is slightly larger than the line integral of the mean
    transmission. The correction can bin counts instead (`--bin`).

    Raises:
        ValueError: for a factor below 1, or larger than the detector.
    """
    n, rows, cols = projections.shape
    if not 1 <= factor <= min(rows, cols):
        raise ValueError(f"bin factor must be between 1 and {min(rows, cols)} for {rows} x {cols} pixels, got {factor}")
    if factor == 1:
        return projections
    rows, cols = rows // factor, cols // factor
    whole = projections[:, : rows * factor, : cols * factor]
    return whole.reshape(n, rows, factor, cols, factor).mean(axis=(2, 4), dtype=np.float32)


def factor_within(shape: tuple[int, int], voxels: int) -> int:
    """Factor by which views [row, col] must be binned so that their volume has at most so many voxels."""
    rows, cols = shape
    return next((f for f in range(1, rows + 1) if (rows // f) * (cols // f) ** 2 <= voxels), rows)
