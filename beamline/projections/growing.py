"""Corrects a scan that is still growing: the caller adds frames as they arrive, and each call returns the next
state.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.sinks import Warn
from beamline.projections.correction import (
    NO_VIEWS,
    ScanCorrectionPlan,
    apply_next,
    as_data_error,
    by_angle,
    read_usable,
    with_shadow,
)
from recon.prep.correct import Plan
from recon.prep.projections import Projections


@dataclass(frozen=True, eq=False)
class FedCorrection:
    """The state of the correction of a scan that grows.

    The line integrals are bit-identical to those of `apply` for all frames, as long as the references and the air
    columns stay the same; see `outdated`.

    Attributes:
        plan: plan of the correction.
        stream: the plan from `recon.prep` with the projections added so far; None: no projection was added.
        columns: air columns with which the projections were corrected.
        added: int64 [view], rows of the file that were added and can be used.
    """

    plan: ScanCorrectionPlan
    stream: Plan | None = None
    columns: frozenset[tuple[int, int]] = frozenset()
    added: NDArray[np.int64] = field(default_factory=NO_VIEWS.copy)


def feed(
    state: FedCorrection, frames: NDArray[np.int64], *, last: bool, warn: Warn | None = None
) -> tuple[Projections | None, FedCorrection]:
    """The line integrals of the next frames, and the next state. None instead of line integrals if none are ready,
    because the newest projection waits for the next one.

    Args:
        frames: rows of the file, after the frames that were added before; may be empty with `last`.
        last: True if no frame will come after these.
        warn: as in `apply`.

    Raises:
        DataError: as for `apply`.
    """
    plan = state.plan
    data, usable = read_usable(plan, frames, None, warn)
    with as_data_error(plan):
        lines, stream = apply_next(plan, data, usable, state.stream or plan.of_rows(None), last)
    state = replace(state, stream=stream, added=np.append(state.added, usable))
    if lines is None or not lines.view_ids.size:
        return None, state
    return lines, replace(state, columns=state.columns | {lines.air_columns})


def newest_lines(state: FedCorrection) -> Projections | None:
    """Line integrals of the newest projection, corrected as if no other projection followed.

    The projection keeps waiting, because all of its zingers can only be found when both neighbours are known.
    """
    no_pixels = np.empty((0, 0, 0), np.float32)
    return None if state.stream is None else apply_next(state.plan, no_pixels, NO_VIEWS, state.stream, last=True)[0]


def outdated(state: FedCorrection) -> bool:
    """True if projections that were already added would now be corrected differently: darks or flats came later, the
    air columns changed, or neighbours in angle were not known at that time.
    """
    plan = state.plan
    finds_spots = np.isfinite(plan.settings.zinger_threshold)
    if finds_spots and (np.diff(by_angle(plan.source.table, state.added)) != 1).any():
        return True
    if plan.references is None or state.stream is None:
        return False
    then, now = ((table.darks.size, table.flats.size) for table in (plan.scan.table, plan.source.table))
    return then != now or state.columns != {state.stream.air_columns}


def ignores_shadow(state: FedCorrection, views: NDArray[np.int64]) -> bool:
    """True if an object that is in the beam of all these projections of a finished scan was treated as part of the
    sample.
    """
    shadow = None if state.plan.shadow is not None else with_shadow(state.plan, views).shadow
    return shadow is not None and any(part.any() for part in shadow)
