"""What the checks read off a frame's preview: light above dark, transmission, and the edges where air should be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.flag import Context

EDGE_FRACTION = 16  # an edge strip is a sixteenth of the columns


def light(preview: NDArray[np.float32], context: Context) -> NDArray[np.float32]:
    """Counts above the dark [preview row, preview col]; the raw counts where no dark was seen."""
    return preview if context.dark is None else preview - context.dark


def transmission(preview: NDArray[np.float32], context: Context) -> NDArray[np.float32] | None:
    """Light over the flats' light, or None before any flat. Blocks where the flat has no light are NaN."""
    if context.flat is None:
        return None
    full = light(context.flat, context)
    return np.divide(light(preview, context), full, out=np.full_like(full, np.nan), where=full > 0)


def edges(image: NDArray[np.float32]) -> tuple[float, float]:
    """Means of the strips at the left and right edge."""
    width = max(1, image.shape[1] // EDGE_FRACTION)
    return float(image[:, :width].mean()), float(image[:, -width:].mean())
