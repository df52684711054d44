"""How steep volumes are at the edges of the smoothest of them: one that is smoother is flatter there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

F32 = NDArray[np.float32]

_SLICES = 8  # that are looked at
_SMOOTH = 1.0  # voxels, in plane: of the volume that shows where the edges are
_STEEP, _NEAR = 0.99, 0.8  # edges change by at least 0.8 of what 99 % of the voxels do not exceed


def edge_steepness(volumes: Sequence[F32]) -> list[float]:
    """Mean slope of each volume [z, y, x] across the edges of the smoothest one, over that of the steepest volume.

    Edges are the voxels where the smoothest volume (least mean slope), smoothed further by one voxel, changes nearly as
    much as in its steepest hundredth. Slopes are taken along its gradient. So the noise of the others does not choose
    where they are looked at. It adds to a slope by as much as it is correlated with the noise of the smoothest one.
    This tells where no edge is above the noise. NaN for each volume where one has values that are not finite.

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
