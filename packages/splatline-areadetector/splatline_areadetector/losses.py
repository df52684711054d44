"""Losses: the frames of a ride that were lost or could not be used, and sentences on them and on their causes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from beamline.core.text import count, spans
from drivers.base.frame import FrameKind
from splatline_areadetector.counters import Counters, Gap, loss_sentences
from splatline_areadetector.frame_places import Basis
from splatline_areadetector.plan import RidePlan
from splatline_areadetector.sorter import Sorter


@dataclass(eq=False)
class Losses:
    """The log of the frames of a ride that were lost or could not be used.

    Attributes:
        gaps: gaps in the numbers of the frames.
        overflowed: numbers of the frames for which the receiver had no memory left.
    """

    gaps: list[Gap] = field(default_factory=list)
    overflowed: set[int] = field(default_factory=set)
    _unused: dict[str, list[int]] = field(default_factory=dict)  # for each reason, numbers of the frames
    _unplaced: dict[str, list[int]] = field(default_factory=dict)

    def is_first_unused(self, why: str, unique_id: int) -> bool:
        """Record a frame that arrived and cannot be used. True if it is the first one with this reason."""
        return _is_first(self._unused, why, unique_id)

    def is_first_unplaced(self, why: str, unique_id: int) -> bool:
        """Record a frame that could not be assigned. True if it is the first one with this reason."""
        return _is_first(self._unplaced, why, unique_id)

    def sentences(self, status: Callable[[], str], counters: Counters, n_repeats: int) -> list[str]:
        """A sentence for each cause of the loss.

        Args:
            status: function that returns what the other program says it is doing now; may be empty.
            n_repeats: number of frames that arrived twice.
        """
        words = [
            f"{count(len(ids), 'frame')} arrived ({spans(ids)}) but could not be used: {why}."
            for why, ids in self._unused.items()
        ]
        if self._unused and (now := status()):
            words.append(f"Now: {now}.")
        words += loss_sentences(self.gaps, self.overflowed, counters)
        if n_repeats:
            words.append(
                f"{count(n_repeats, 'frame')} arrived twice and {'was' if n_repeats == 1 else 'were'} stored once."
            )
        for why, ids in self._unplaced.items():
            frames = "Frame {}" if len(ids) == 1 else "Frames {}"
            words.append(f"{frames.format(spans(sorted(ids)))} could not be assigned: {why}.")
        return words


def _is_first(log: dict[str, list[int]], why: str, unique_id: int) -> bool:
    log.setdefault(why, []).append(unique_id)
    return len(log[why]) == 1


def missing_sentences(plan: RidePlan, sorter: Sorter) -> list[str]:
    """A sentence for each block of the plan that misses frames."""
    words = []
    for i, block in enumerate(plan.blocks):
        if missing := sorter.missing(i):
            noun, angles = block.kind.name.lower(), plan.angles
            angle_words = ""
            if block.kind is FrameKind.PROJECTION and not np.isnan(angles).any():
                first, last = (math.degrees(angles[missing[end]]) for end in (0, -1))
                angle_words = f" (from {first:.4g}° to {last:.4g}°)"
            are = "is" if len(missing) == 1 else "are"
            words.append(f"{len(missing)} of {block.n} {noun}s {are} missing: {spans(missing)}{angle_words}.")
    return words


def first_or_last_sentence(plan: RidePlan, sorter: Sorter, *, ended: bool) -> str:
    """A sentence on frames that are missing at the end. "" if the number of the first projection is known, or if
    the recording began before the scan and was stopped while frames came, because that explains the missing frames.

    The projections cannot show whether the first frames are missing: if all angles are wrong by a constant, the
    projections agree with a rotated sample.
    """
    angles, basis, n = plan.angles, sorter.basis, sorter.n_left
    if n == 0 or basis.is_sure or (basis is Basis.WAITED and not ended):
        return ""
    wrong = f"the true angle of each projection is the stated angle of the projection {n} places later"
    if n < angles.size and not np.isnan(angles).any():
        wrong = f"all angles are {math.degrees(angles[n] - angles[0]):.4g}° larger than stated"
    has_angles = plan.angle_source == "attribute"
    if sorter.is_by_order and len(plan.blocks) > 1:
        also = "" if has_angles else f", and {wrong}"
        wrong, key = (
            "the first and last frames of each block are stored as frames of the neighbouring block (dark, flat "
            f"or projection){also}",
            "ride.kinds",
        )
    elif has_angles:
        return ""
    else:
        wrong, key = f"{wrong}, which rotates the volume and changes nothing else", "ride.camera"
    missing = "frame" if n == 1 else f"{n} frames"
    return (
        f"The number of the first projection is not known, so the missing {missing} may be the first of the scan. "
        f"If so, {wrong}. Set {key} or ride.first_id, so that the number of the first projection is known."
    )
