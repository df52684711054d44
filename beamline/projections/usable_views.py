"""Usable views of a scan, as values: the views that are left, and the weights of views and of parts of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon.base.binning import bin_views

if TYPE_CHECKING:
    from beamline.storage.flag_legend import FrameFlags
    from recon.base.arrays import I64
    from recon.prep.resample import Resampling


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


@dataclass(frozen=True, eq=False)
class UsableViews:
    """The views of a scan that a reconstruction may use.

    Attributes:
        frames: int64 [view], their rows in the file.
        weights: float32 [frame of the file], of each row that is a view; None: one for all.
        left_out: views with an alarm, which are not among them.
        sentence: what was done, in a line; empty where no view is flagged.
        flags: of all frames, which decide the other fields unless they are ignored; None: the file has none.
        regions: parts of views that weigh less, in views that are used otherwise.
        jumps: int64, rows from which on the monitor saw the sample elsewhere; ascending.
    """

    frames: NDArray[np.int64]
    weights: NDArray[np.float32] | None = None
    left_out: int = 0
    sentence: str = ""
    flags: FrameFlags | None = None
    regions: Regions = field(default_factory=Regions)
    jumps: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def only(self, frames: NDArray[np.int64]) -> UsableViews:
        """The same without the frames that are not among these."""
        return replace(self, frames=frames, left_out=self.left_out + self.frames.size - frames.size)

    def weights_of(self, rows: NDArray[np.int64]) -> NDArray[np.float32] | None:
        """[view] weights of some rows of the file; None where they all weigh the same."""
        if self.weights is None or np.ptp(self.weights[rows]) == 0:
            return None
        return self.weights[rows]
