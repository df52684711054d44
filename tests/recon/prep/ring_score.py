"""Measures the strength of the rings in a slice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter


def ring_score(image: NDArray[np.floating], axis: tuple[float, float], width: int = 9) -> float:
    """Ring strength: standard deviation of the means along circles about the axis, minus their median over `width`
    radii.

    Args:
        image: [y, x].
        axis: (y, x) in voxels, centre of the rings.
    """
    y, x = np.indices(image.shape)
    radius = np.rint(np.hypot(y - axis[0], x - axis[1])).astype(int)
    reach = min(image.shape) // 2 - 2
    inside = (radius < reach) & np.isfinite(image)
    count = np.bincount(radius[inside], minlength=reach)
    means = np.bincount(radius[inside], image[inside], minlength=reach) / np.maximum(count, 1)
    off = (means - median_filter(means, 2 * (width // 2) + 1, mode="nearest"))[
        width:
    ]  # short circles near the axis are left out, because they show structure
    return float(off.std())
