"""FlagPolicy: decides which projections a reconstruction leaves out, or gives less weight, because of flags of the
monitor. Also makes the messages about it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.core.flag import PixelBox
from beamline.core.text import count, frames_text, spans
from beamline.monitor.check import Level
from beamline.monitor.motion import MotionCheck
from beamline.monitor.opposite import OppositeCheck
from beamline.storage.flag_legend import FlagBit, FrameFlags, counted
from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence
from recon.base.arrays import Mask

FLAGS = "flags"
# share of the projection: a flag with a larger region, or without a region, applies to the whole projection
LARGEST = 0.5
MARGIN = 0.25  # share of the region's shorter side that is added on all sides


@dataclass(frozen=True, eq=False)
class FlagPolicy:
    """How the flagged projections of a scan are treated.

    Attributes:
        flags: the flags of all frames that this policy uses.
        views, left_out, halved, masked: bool [frame of the file]: True for, in this order: all projections; projections
            with an alarm, which are left out; projections with a warning, which have half the weight; projections that
            are flagged in a region, in which their rays have less weight.
        jumps: int64, ascending, the first rows after each jump of the sample that the monitor reported.
        parts: the flagged regions of frames: the frame, the region, and whether the flag is an alarm.
    """

    flags: FrameFlags
    views: Mask
    left_out: Mask
    halved: Mask
    masked: Mask
    jumps: NDArray[np.int64]
    parts: Sequence[tuple[int, PixelBox, bool]] = ()

    @property
    def in_words(self) -> str:
        """A sentence about the flagged projections; empty if no projection is flagged."""
        parts = []
        for chosen, verbs in (
            (self.left_out, (("has an alarm and is", "have an alarm and are"), "left out")),
            (self.halved, (("has a warning and counts", "have a warning and count"), "half")),
            (
                self.masked,
                (("is", "are"), "flagged in a part of the image, where rays have half weight (weight 0 for an alarm)"),
            ),
        ):
            if n := int(chosen.sum()):
                parts.append(f"{n} {verbs[0][n > 1]} {verbs[1]} ({counted(self.flags.of(chosen).counts())})")
        return f"Of {self.views.sum()} projections, {', '.join(parts)}." if parts else ""


def flag_policy(flags: FrameFlags, views: Mask, shape: tuple[int, int]) -> FlagPolicy:
    """The policy of `beamline recon` for these projections, unless it ignores flags. Frames have this shape.

    A projection in which the sample jumped is as good as the projections after it. If the check `opposite` also flagged
    this jump, its flags are not used.
    """
    rows_of_checks = [flags.rows(entry, Level.ALARM) for entry in flags.legend if entry.bit == MotionCheck.bit]
    jump_rows = np.concatenate([np.zeros(0, np.int64), *rows_of_checks])
    flags = flags.without(MotionCheck.bit)
    if jump_rows.size:  # a jump that opposite projections show is handled together with the projections after the jump
        flags = flags.without(OppositeCheck.bit)
    boxes = [
        (frame, box, bool(flags.bits[frame] >> entry.alarm_bit & 1))
        for i, entry in enumerate(flags.legend)
        for frame, box in boxes_of(flags, i, entry, shape)
    ]
    flagged_whole = {frame for frame, box, _ in boxes if box is None}
    flagged_in_region = flags.flagged & ~np.isin(np.arange(flags.bits.size), list(flagged_whole))
    parts = [(frame, box, alarm) for frame, box, alarm in boxes if box is not None and frame not in flagged_whole]
    left_out, halved = (
        views & chosen & ~flagged_in_region for chosen in (flags.alarmed, flags.flagged & ~flags.alarmed)
    )
    return FlagPolicy(flags, views, left_out, halved, views & flagged_in_region, jump_rows, parts)


def boxes_of(
    flags: FrameFlags, check: int, entry: FlagBit, shape: tuple[int, int]
) -> Iterator[tuple[int, PixelBox | None]]:
    """The frames that a check flagged, each with the flagged region and a margin. None instead of the region: nearly
    the whole projection is flagged.

    A check may flag a projection only when it has seen later ones. The file then has no region for this projection, and
    its region is extrapolated along a straight line through the regions of the later projections.
    """
    rows = np.flatnonzero(flags.bits >> entry.bit & 1)
    for consecutive_rows in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        boxes = flags.regions[consecutive_rows, check].astype(np.float64)
        known = boxes[:, 0] >= 0
        if known.any() and not known.all():
            fit = np.polynomial.Polynomial.fit if known.sum() > 1 else None
            for side in range(4):
                values = boxes[known, side]
                boxes[~known, side] = (
                    # the ends of the regions move in the same way
                    values[0] if fit is None else fit(consecutive_rows[known], values, 1)(consecutive_rows[~known])
                )
        for frame, box in zip(consecutive_rows.tolist(), boxes, strict=True):
            top, bottom, left, right = box
            margin = MARGIN * min(bottom - top, right - left)
            low = np.floor(np.array([top, left]) - margin).astype(int).clip(0)
            high = np.minimum(np.ceil(np.array([bottom, right]) + margin).astype(int), shape)
            area = float(np.prod((high - low).clip(0)))
            if not known.any() or area > LARGEST * shape[0] * shape[1]:
                yield frame, None
            else:
                yield frame, (int(low[0]), int(high[0]), int(low[1]), max(int(high[1]), int(low[1])))


FEWEST_VIEWS = 10
"""Least number of projections without an alarm that a volume needs, if some projections have an alarm. A volume from so
few projections is only a sketch of the sample.
"""


def frames_flagged(scan: ScanEvidence) -> Iterator[Finding]:
    """Number of flagged frames by check and level, and the rows of those with an alarm."""
    flags = scan.flags
    if flags is None or not flags.flagged.any():
        return
    rows, replaced_rows = np.flatnonzero(flags.alarmed), scan.table.replaced
    message = f"The monitor flagged {flags.flagged.sum()} of {flags.bits.size} frames: {counted(flags.counts())}."
    if not rows.size:
        yield Finding("info", FLAGS, message)
        return
    message += f" Frames with an alarm: {spans(rows.tolist())}."
    if replaced_rows.size:
        message += (
            f" Taken again: {count(replaced_rows.size, 'projection')}; the first attempts "
            f"({frames_text(replaced_rows)}) are not used."
        )
        rows = np.setdiff1d(rows, replaced_rows)
        if not rows.size:
            yield Finding("info", FLAGS, f"{message} No other frame has an alarm.")
            return
        message += f" Other frames with an alarm: {spans(rows.tolist())}."
    policy = flag_policy(flags, scan.table.are_views, scan.source.shape)
    n, lost = int(policy.views.sum()), int(policy.left_out.sum())
    if lost and n - lost < FEWEST_VIEWS:
        n_good = n - lost
        message += (
            f" Repeat the scan: only {n_good} of {n} projections have no alarm, and {FEWEST_VIEWS} are needed. "
            "`beamline recon --flags ignore` uses all projections, also flagged ones."
        )
        yield Finding("error", FLAGS, message)
        return
    if policy.in_words:
        message += f" In a reconstruction (--flags use): {policy.in_words}"
    yield Finding("warning", FLAGS, message)
