"""correct: converts the frames of a scan to line integrals, in batches (`apply`) or all at once."""

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
    """Line integrals of the next projections (with weights, if photons are counted), and the plan for the projections
    after them.

    The given plan is not changed, so the same plan and the same frames always give the same line integrals.

    Args:
        frames: [view, row, col], any real type, in the order of acquisition. They may be empty if `last` is True. The
            memory of float32 line integrals is reused for the result.
        positions: [view], number of each frame in the scan, counted in the same way as the positions of the flats.
        view_ids: int64 [view].
        last: True if no projection comes after these. False: the newest projection waits for its neighbour.
        progress: function called with the number of steps done. Each projection has two steps.
        order: order of neighbours, see `SpotFilter.feed`.

    Raises:
        ValueError: as for `CorrectionPlan.transmission`.
        ViewsWithoutBeamError: the air columns of some projections are dark. The error contains the numbers of these
            projections.
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
    """Line integrals -log((counts - dark) / (flat - dark)) of a stack of projections.

    All results are finite: dead pixels and single bad values get the mean of their good neighbours. The result contains
    the mask of dead pixels, and the fraction of other values that were filled. `correct` needs memory for the result
    and for a few frames. Arguments and errors of `correct` are those of `survey` and of `CorrectionPlan.transmission`.
    """
    counts = without_mask(counts)
    check_arguments(correct, locals())
    ids = np.arange(len(counts), dtype=np.int64) if view_ids is None else np.asarray(view_ids, np.int64)
    return apply(counts, np.asarray(positions, np.float64), survey(references, settings, masked), ids)[0]
