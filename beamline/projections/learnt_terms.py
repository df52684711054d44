"""Terms of line integrals that `--calibrate` learns with the volume: background of the beam, and gains of pixels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.projections.prepared import PreparedProjections
from beamline.projections.step import StepDone
from recon.base.geometry import Geometry
from recon.calibration import background, gains
from recon.calibration.background import background_memory, learn_background
from recon.calibration.gains import NEAR_AXIS, gains_memory, learn_gains

Progress = Callable[[int, int], None]
MEMORY: dict[str, Callable[[Geometry], int]] = {"background": background_memory, "gains": gains_memory}
"""Bytes that a term takes at most beside the views."""
LEAST = {"background": (background.LEAST_VIEWS, 1), "gains": (gains.LEAST_VIEWS, gains.LEAST_COLS)}
"""Views and columns that a term needs."""


def without_learnt_background(views: PreparedProjections, progress: Progress) -> StepDone:
    """Take the background of the beam off the views where views held out confirm it, see `learn_background`."""
    data, ids = views.projections.data, views.projections.view_ids
    first, last = int(ids.min()), int(ids.max())

    def times(numbers: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.clip((numbers - first) / max(last - first, 1), 0.0, 1.0)

    try:
        found = learn_background(data, views.geometry, times(ids), views.measured, progress)
    except ValueError as error:
        raise DataError(f"--calibrate background: {error}. Leave it out.") from error
    judged = f"views held out are left {found.without:.3g} without it and {found.left:.3g} with it"
    values = {"learnt_background_held_out_before": found.without, "learnt_background_held_out_after": found.left}
    if not (found.drift or found.mean):
        said = "Background learnt with the volume: views held out confirm none; nothing taken off."
        return StepDone(said, {"learnt_background": said, **values})
    found.remove(data, times(ids))
    if views.held_out is not None and views.held_out_ids is not None:
        found.remove(views.held_out[0], times(views.held_out_ids))
    what = " and ".join(name for name, there in (("its drift", found.drift), ("its mean", found.mean)) if there)
    said = (
        f"Background learnt with the volume: {what}, {found.size:.3f} of line integral (root mean square), on average "
        f"from {found.lowest:+.3f} to {found.highest:+.3f}; taken off: {judged}. What all views show alike cannot be "
        "told from density where the volume has no air."
    )
    return StepDone(said, {"learnt_background": said, "learnt_background_terms": found.coefficients, **values})


def without_learnt_gains(views: PreparedProjections, progress: Progress) -> StepDone:
    """Take gains of pixels off the views where views held out confirm them, see `learn_gains`."""
    try:
        found = learn_gains(views.projections.data, views.geometry, views.measured, progress)
    except ValueError as error:
        raise DataError(f"--calibrate gains: {error}. Leave it out, or give --rings.") from error
    values = {"learnt_gains_held_out_before": found.without, "learnt_gains_held_out_after": found.left}
    judged = f"views held out are left {found.without:.4g} without them and {found.left:.4g} with them"
    if found.without == 0:
        judged = "no stripes are seen in the views that are the detector's"
    if not found.confirmed:
        said = f"Gains learnt with the volume: none taken off; {judged}."
        return StepDone(said, {"learnt_gains": said, **values})
    for view in views.projections.data:
        view -= found.pixels
    if views.held_out is not None:
        views.held_out[0][...] -= found.pixels
    said = (
        f"Gains learnt with the volume: {float(found.pixels.std()):.4f} of line integral (standard deviation) taken "
        f"off; {judged}. None within {NEAR_AXIS:g} columns of the axis: there a gain looks like a body on the axis."
    )
    return StepDone(said, {"learnt_gains": said, "learnt_gains_of_pixels": found.pixels, **values})
