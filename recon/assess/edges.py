"""How steep volumes are at the edges that they share: a smoother one is flatter there, a noisier one is not steeper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

F32 = NDArray[np.float32]

_SLICES = 8  # that are looked at
_SMOOTH = 1.0  # voxels, in plane: of the mean that shows where the edges are
_STEEP, _NEAR = 0.99, 0.8  # edges change by at least 0.8 of what 99 % of the voxels do not exceed


def edge_steepness(volumes: Sequence[F32]) -> list[float]:
    """Mean slope of each volume [z, y, x] across their common edges, over that of the steepest volume.

    Edges are the voxels where the smoothed mean of all volumes changes nearly as much as in its steepest hundredth. The
    slope is taken along the gradient of that mean, where noise has no sign of its own: it hardly adds.

    Raises:
        ValueError: no volumes, volumes of different shapes, or of fewer than two voxels along y or x.
    """
    shapes = {volume.shape for volume in volumes}
    if len(shapes) != 1 or min(next(iter(shapes))[1:]) < 2:
        raise ValueError(f"volumes of one shape are compared, at least two voxels wide along y and x: {sorted(shapes)}")
    depth = volumes[0].shape[0]
    some = np.unique(np.linspace(0, depth - 1, min(depth, _SLICES)).round().astype(int))
    mean = gaussian_filter(np.mean([volume[some] for volume in volumes], axis=0), (0, _SMOOTH, _SMOOTH))
    along_y, along_x = np.gradient(mean, axis=(1, 2))
    size = np.hypot(along_y, along_x)
    edges = size >= _NEAR * np.quantile(size, _STEEP)
    slopes = []
    for volume in volumes:
        y, x = np.gradient(volume[some], axis=(1, 2))
        slopes.append(float(((y * along_y + x * along_x)[edges] / np.maximum(size[edges], np.float32(1e-30))).mean()))
    steepest = max(slopes)
    return [slope / steepest if steepest > 0 else 1.0 for slope in slopes]
