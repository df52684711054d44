"""correct: line integrals of the frames of one scan by a plan, in batches (`apply`) or of all views at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.arrays import Mask, without_mask
from recon.base.declared_types import check_arguments
from recon.prep.counts_plan import CorrectionPlan, CorrectionSettings, survey
from recon.prep.lines_plan import LinesPlan
from recon.prep.projections import Projections
from recon.prep.references import References

Plan = CorrectionPlan | LinesPlan


def apply(
    frames: NDArray[np.generic],
    positions: NDArray[np.float64],
    plan: Plan,
    view_ids: NDArray[np.int64],
    *,
    last: bool = True,
    progress: Callable[[int], None] = lambda done: None,
    order: NDArray[np.intp] | None = None,
) -> tuple[Projections, Plan]:
    """Line integrals, and weights where photons are counted, of the next views; and the plan of those that follow.

    The plan that is given stays as it is, and with the same plan the same frames have the same line integrals.

    Args:
        frames: [view, row, col], any real type, in the order of acquisition; may be none where `last`. Line integrals
            in float32 are taken over.
        positions: [view], number of the frame in the scan, as in the flats' positions.
        view_ids: int64 [view].
        last: no view comes after these; else the newest view waits.
        progress: how many of two steps a view are done.
        order: of their neighbours, see `SpotFilter.feed`.

    Raises:
        ValueError: as of `CorrectionPlan.transmission`.
        UnlitViewsError: the air columns of some views are dark; it has their numbers.
    """
    if not len(view_ids):
        return plan.line_integrals(None, last)
    views = plan.transmission(frames, positions, view_ids, progress)
    return plan.surveyed(views).line_integrals(views, last, lambda done: progress(len(view_ids) + done), order)


def correct(
    counts: NDArray[np.generic],
    positions: ArrayLike,
    references: References,
    settings: CorrectionSettings | None = None,
    view_ids: ArrayLike | None = None,
    masked: Mask | None = None,
) -> Projections:
    """Line integrals -log((counts - dark) / (flat - dark)) of a stack of views, surveyed and corrected at once.

    All results are finite: dead pixels and single bad values take the mean of their good neighbours and are counted.
    Memory beyond the result: a few frames. Arguments and errors are those of `survey` and of
    `CorrectionPlan.transmission`.
    """
    counts = without_mask(counts)
    check_arguments(correct, locals())
    ids = np.arange(len(counts), dtype=np.int64) if view_ids is None else np.asarray(view_ids, np.int64)
    return apply(counts, np.asarray(positions, np.float64), survey(references, settings, masked), ids)[0]
