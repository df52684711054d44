"""Measures the in-plane tilt of the rotation axis in corrected projections, and warns of it if the user did not state
it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.sinks import Warn
from beamline.projections.correction import ScanCorrectionPlan, apply
from recon.base.views import spread_views
from recon.prep.axis_wedge import FEWEST_BANDS
from recon.prep.tilt import TiltEstimate, find_tilt

MATTERS = 0.5
"""A tilt by this many pixels over all rows doubles edges visibly."""
_BANDS, _BAND_ROWS, _VIEWS = 8, 2, 90  # bands of rows, rows of each, and projections that the warning is based on
_FEWEST_ROWS = 32  # half a pixel over fewer rows would be a larger tilt than a stage has
_SURE = 3.0  # standard deviations from which a tilt is significant
BandsDone = Callable[[int, int], None]  # (n, N): n bands of rows of N are corrected


def warn_of_tilt(plan: ScanCorrectionPlan, frames: NDArray[np.int64], warn: Warn, progress: BandsDone) -> None:
    """Warn if the corrected rows of a parallel beam show a significant tilt.

    Args:
        frames: projections that may be used.
    """
    rows = plan.scan.selection.n_rows
    if rows < _FEWEST_ROWS:
        return
    frames = spread_views(plan.source.table.angles[frames], _VIEWS, frames)
    try:
        shown = shown_tilt(plan, frames, (_BANDS, _BAND_ROWS), progress, warn)
    except (ValueError, DataError):
        return  # the tilt could not be measured, and the user did not ask for it
    if abs(shown.tilt) * rows > MATTERS and abs(shown.tilt) > _SURE * shown.uncertainty:
        offset_px = abs(shown.tilt) * rows
        warn(
            "Give --tilt auto (or --tilt 0 if the axis is straight): the rotation axis seems to be tilted in the "
            f"detector's plane by {tilt_text(shown.tilt, shown.uncertainty)}, {offset_px:.1f} px over {rows} rows. "
            "The tilt doubles edges in the first and last slices."
        )


def shown_tilt(
    plan: ScanCorrectionPlan,
    frames: NDArray[np.int64],
    size: tuple[int, int],
    progress: BandsDone,
    warn: Warn | None = None,
) -> TiltEstimate:
    """The tilt, measured in corrected projections from the bands of rows that can be corrected.

    Args:
        size: number of bands, and number of rows of each band.
        warn: as in `apply`.

    Raises:
        ValueError: see `find_tilt`.
    """
    rows = plan.scan.selection.n_rows
    bands, thick = size
    height = max(1, min(thick, rows // bands))
    means: list[NDArray[np.float32]] = []
    heights, ids = [], np.empty(0, np.int64)
    for n, first in enumerate(np.unique(np.linspace(0, rows - height, min(bands, rows)).round().astype(int)).tolist()):
        progress(n, bands)
        try:
            band = apply(plan, frames, slice(first, first + height), warn)
        except DataError:
            continue  # there is no beam in these rows
        if not means:
            ids = band.view_ids
        if np.array_equal(band.view_ids, ids):
            means.append(band.data.mean(axis=1))
            heights.append(first + (height - 1) / 2)
    progress(bands, bands)
    if len(means) < FEWEST_BANDS:
        raise ValueError(f"only {len(means)} bands of rows can be used; at least {FEWEST_BANDS} are needed")
    return find_tilt(np.stack(means, axis=1), np.array(heights) - np.mean(heights), plan.source.table.angles[ids])


def tilt_text(tilt: float, uncertainty: float) -> str:
    """Text with the angle in degrees and its uncertainty, rounded to the digits of the uncertainty."""
    sigma = math.degrees(uncertainty)
    digits = min(max(1 - math.floor(math.log10(max(sigma, 1e-4))), 2), 4)
    return f"{math.degrees(tilt):.{digits}f} ± {sigma:.{digits}f} degrees"
