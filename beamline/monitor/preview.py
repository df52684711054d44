"""Quantities of a frame's preview for the checks: light above dark, and light without a sample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.check import ScanContext

ENOUGH = 128  # blocks per side that suffice for a check; a large preview is thinned to about so many

BlockRegion = tuple[slice, slice]
WHOLE: BlockRegion = (slice(None), slice(None))


def thinned(preview: NDArray[np.float32], rows: bool = True) -> BlockRegion:
    """A region that takes every k-th block of columns (and of rows), so that a large frame costs no more than a small
    one."""
    step_rows, step_cols = (max(1, n // ENOUGH) for n in preview.shape)
    return slice(None, None, step_rows if rows else 1), slice(None, None, step_cols)


def light(preview: NDArray[np.float32], context: ScanContext, region: BlockRegion = WHOLE) -> NDArray[np.float32]:
    """Counts above the dark [preview row, preview col] in a region; the raw counts where no dark was seen."""
    return preview[region] if context.dark is None else preview[region] - context.dark[region]


def more_light(context: ScanContext, exposure: float) -> float:
    """Light without a sample in a frame of `exposure` s, over that of the flats, which may have their own exposure."""
    return exposure / context.flat_exposure
