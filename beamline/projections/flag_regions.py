"""Regions of flags: the rays in them weigh less, so that the rest of a flagged view is used like any other."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beamline.storage.flag_legend import FrameFlags
from beamline.storage.rules.treatment import boxes_of, flagged_in_part
from recon.base.arrays import I64
from recon.base.binning import bin_views
from recon.prep.resample import Resampling

WARNED_SHARE = 0.5  # Weight of a ray in the region of a warning


@dataclass(frozen=True, eq=False)
class Regions:
    """Parts of flagged frames whose rays weigh less.

    Attributes:
        frames: int64 [region], rows of the file.
        boxes: int64 [region, 4], first row, row after the last, first column, column after the last.
        shares: float32 [region], what the rays in it weigh.
        local: bool [frame of the file], every flag of the frame is of a part of it.
        resampling: of the views, whose pixels were seen elsewhere; None: of none.
    """

    frames: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    boxes: I64 = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    shares: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    local: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    resampling: Resampling | None = None

    def mark(self, view_ids: I64) -> bool:
        """Whether a ray of these views weighs less."""
        return bool(self._of(view_ids).any())

    def _of(self, view_ids: I64) -> NDArray[np.bool_]:
        return np.isin(self.frames, view_ids[self.local[view_ids]]) if self.local.size else np.zeros(0, np.bool_)

    def weights(self, view_ids: I64, rows: slice, binning: int, shape: tuple[int, int]) -> NDArray[np.float32] | None:
        """[view, row, col] weights of the rays of some views, in binned pixels `shape` of these detector rows.

        None where all are 1.
        """
        chosen = self._of(view_ids)
        if not chosen.any():
            return None
        height, width = shape
        weights = np.ones((view_ids.size, height, width), np.float32)
        seen = None if self.resampling is None else self.resampling.places(shape, rows.start)
        at = {int(frame): view for view, frame in enumerate(view_ids)}
        for frame, (top, bottom, left, right), share in zip(
            self.frames[chosen].tolist(), self.boxes[chosen].tolist(), self.shares[chosen].tolist(), strict=True
        ):
            if seen is not None:
                row, col = seen
                inside = (row > top - 1) & (row < bottom) & (col > left - 1) & (col < right)
                weights[at[frame]][inside] *= share
                continue
            fine = np.ones((1, height * binning, width * binning), np.float32)
            fine[0, max(top - rows.start, 0) : max(bottom - rows.start, 0), left:right] = share
            weights[at[frame]] *= bin_views(fine, binning)[0]
        return weights


def regions_of(flags: FrameFlags, shape: tuple[int, int]) -> Regions:
    """The regions of warnings and alarms in frames of this shape; rays in those of an alarm weigh nothing."""
    if flags.regions is None:
        return Regions(local=np.zeros(flags.bits.size, np.bool_))
    found = [
        (frame, box, 0.0 if flags.bits[frame] >> entry.alarm_bit & 1 else WARNED_SHARE)
        for i, entry in enumerate(flags.legend)
        for frame, box in boxes_of(flags, i, entry, shape)
        if box is not None
    ]
    local = flagged_in_part(flags, shape)
    kept = [each for each in found if local[each[0]]]
    return Regions(
        np.array([frame for frame, _, _ in kept], np.int64),
        np.array([box for _, box, _ in kept], np.int64).reshape(-1, 4),
        np.array([share for _, _, share in kept], np.float32),
        local,
    )
