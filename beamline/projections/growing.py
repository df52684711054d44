"""Correction of a scan that grows: frames are fed as they arrive, and each feeding gives the next state."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.sinks import Warn
from beamline.projections.correction import (
    NO_VIEWS,
    ScanCorrectionPlan,
    apply_next,
    by_angle,
    in_shadow,
    read_usable,
    refused,
)
from recon.prep.correct import Plan
from recon.prep.projections import Projections


@dataclass(frozen=True, eq=False)
class FedCorrection:
    """The state of the correction of a scan that grows.

    Its line integrals are bit-identical to those of `apply` for all frames, as long as the references and the air
    columns stay the same; see `outdated`.

    Attributes:
        plan: by which the frames are corrected.
        stream: the plan of recon with the projections fed so far; None: none was fed.
        columns: air columns with which projections were corrected.
        fed: int64 [view], rows of the file that were fed and can be used.
    """

    plan: ScanCorrectionPlan
    stream: Plan | None = None
    columns: frozenset[tuple[int, int]] = frozenset()
    fed: NDArray[np.int64] = field(default_factory=NO_VIEWS.copy)


def feed(
    state: FedCorrection, frames: NDArray[np.int64], *, last: bool, warn: Warn | None = None
) -> tuple[Projections | None, FedCorrection]:
    """Line integrals of the next frames, and the next state. None while no line integrals are ready, because the
    newest projection waits for the next one.

    Args:
        frames: rows of the file, those after the frames fed before; may be none if `last`.
        last: no frame will come after these.
        warn: as in `apply`.

    Raises:
        DataError: as `apply`.
    """
    plan = state.plan
    data, usable = read_usable(plan, frames, None, warn)
    with refused(plan):
        lines, stream = apply_next(plan, data, usable, state.stream or plan.of_rows(None), last)
    state = replace(state, stream=stream, fed=np.append(state.fed, usable))
    if lines is None or not lines.view_ids.size:
        return None, state
    return lines, replace(state, columns=state.columns | {lines.air_columns})


def newest_lines(state: FedCorrection) -> Projections | None:
    """Line integrals of the newest projection, which still waits for the next one, as if none followed.

    It keeps waiting, because all its zingers are found only if both neighbours are known.
    """
    none = np.empty((0, 0, 0), np.float32)
    return None if state.stream is None else apply_next(state.plan, none, NO_VIEWS, state.stream, last=True)[0]


def outdated(state: FedCorrection) -> bool:
    """True if projections already fed would now be corrected differently: references came later, the air columns
    changed, or neighbours in angle were not known then.
    """
    plan = state.plan
    finds_spots = np.isfinite(plan.settings.zinger_threshold)
    if finds_spots and (np.diff(by_angle(plan.source.table, state.fed)) != 1).any():
        return True
    if plan.references is None or state.stream is None:
        return False
    then, now = ((table.darks.size, table.flats.size) for table in (plan.scan.table, plan.source.table))
    return then != now or state.columns != {state.stream.air_columns}


def ignores_shadow(state: FedCorrection, views: NDArray[np.int64]) -> bool:
    """True if an object in the beam of all these projections of a finished scan was treated as part of the sample."""
    shadow = None if state.plan.shadow is not None else in_shadow(state.plan, views).shadow
    return shadow is not None and any(part.any() for part in shadow)
