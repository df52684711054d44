"""Quantities of a frame's preview for the checks: light above dark, transmission, and edges where air should be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.check import ScanContext

EDGE_FRACTION = 16  # an edge strip is a sixteenth of the columns
ENOUGH = 128  # blocks per side that suffice for a check; a large preview is thinned to about so many

Region = tuple[slice, slice]
WHOLE: Region = (slice(None), slice(None))


def thinned(preview: NDArray[np.float32], rows: bool = True) -> Region:
    """A region that takes every k-th block of columns (and of rows), so that a large frame costs no more than a small
    one."""
    step_rows, step_cols = (max(1, n // ENOUGH) for n in preview.shape)
    return slice(None, None, step_rows if rows else 1), slice(None, None, step_cols)


def light(preview: NDArray[np.float32], context: ScanContext, region: Region = WHOLE) -> NDArray[np.float32]:
    """Counts above the dark [preview row, preview col] in a region; the raw counts where no dark was seen."""
    return preview[region] if context.dark is None else preview[region] - context.dark[region]


def more_light(context: ScanContext, exposure: float) -> float:
    """Light without a sample in a frame of `exposure` s, over that of the flats, which may have their own exposure."""
    return exposure / context.flat_exposure


def transmission(
    preview: NDArray[np.float32], context: ScanContext, exposure: float, region: Region = WHOLE
) -> NDArray[np.float32] | None:
    """Light over the flats' light, or None before any flat. Blocks where the flat has no light are NaN."""
    if context.flat is None:
        return None
    full = light(context.flat, context, region) * np.float32(more_light(context, exposure))
    return np.divide(light(preview, context, region), full, out=np.full_like(full, np.nan), where=full > 0)


def edges(image: NDArray[np.float32]) -> tuple[float, float]:
    """Means of the strips at the left and right edge."""
    width = max(1, image.shape[1] // EDGE_FRACTION)
    return float(image[:, :width].mean()), float(image[:, -width:].mean())
