"""Edge steepness: compares volumes by their slopes at edges; a smoother volume has flatter edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32

_SLICES = 8  # voxels that are looked at
_SMOOTH = 1.0  # voxels, in plane: smoothing of the volume that shows the edges
_STEEP, _NEAR = 0.99, 0.8  # edges have slopes of at least 0.8 of the 99th percentile


def edge_steepness(volumes: Sequence[F32]) -> list[float]:
    """Mean slope of each volume [z, y, x] across the edges of the smoothest one, relative to the steepest volume.

    The smoothest volume (least mean slope), smoothed by one voxel more, defines the edges: voxels that change nearly as
    much as its steepest hundredth. All slopes are taken along its gradient, so the noise of the other volumes does not
    choose the edges. Their noise adds to a slope only as far as it is correlated with that of the smoothest volume. If
    any volume has values that are not finite, all results are NaN.

    Raises:
        ValueError: no volumes, volumes of different shapes, or of fewer than two voxels along y or x.
    """
    shapes = {volume.shape for volume in volumes}
    if len(shapes) != 1 or min(next(iter(shapes))[1:]) < 2:
        raise ValueError(f"volumes of one shape are compared, at least two voxels wide along y and x: {sorted(shapes)}")
    depth = volumes[0].shape[0]
    some = np.unique(np.linspace(0, depth - 1, min(depth, _SLICES)).round().astype(int))
    gradients = [np.stack(np.gradient(volume[some], axis=(1, 2))) for volume in volumes]
    sizes = [float(np.hypot(*slope).mean()) for slope in gradients]
    if not np.isfinite(sizes).all():
        return [float("nan")] * len(volumes)
    smoothest = gaussian_filter(volumes[int(np.argmin(sizes))][some], (0, _SMOOTH, _SMOOTH))
    across = np.stack(np.gradient(smoothest, axis=(1, 2)))
    size = np.hypot(*across)
    edges = size >= _NEAR * np.quantile(size, _STEEP)
    across = across[:, edges] / np.maximum(size[edges], np.float32(1e-30))
    slopes = [float((slope[:, edges] * across).sum(axis=0).mean()) for slope in gradients]
    steepest = max(slopes)
    return [slope / steepest if steepest > 0 else 1.0 for slope in slopes]
