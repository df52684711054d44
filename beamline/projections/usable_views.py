"""Usable projections of a scan: selects the projections that can be used, with weights of projections and of regions in
them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import count
from recon.base.arrays import I64, bin_views

if TYPE_CHECKING:
    from beamline.storage.flag_legend import FrameFlags
    from beamline.storage.rules.evidence import ScanEvidence
    from beamline.storage.rules.flag_policy import FlagPolicy
    from recon.prep.resample import Resampling


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of frames in which rays have reduced weight.

    Attributes:
        frames: int64 [region], rows of the file.
        boxes: int64 [region, 4], first row, row after the last, first column, column after the last.
        shares: float32 [region], the weight of the rays in it.
        resampling: resampling of the projections, which moves their pixels; None: projections are not resampled.
    """

    frames: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    boxes: I64 = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    shares: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    resampling: Resampling | None = None

    def mark(self, view_ids: I64) -> bool:
        """True if any of these projections has rays with reduced weight."""
        return bool(np.isin(self.frames, view_ids).any())

    def and_unmeasured(self, runs: I64, first_row: int, binning: int) -> Regions:
        """These regions, and the runs in `Projections.unmeasured`, whose rays have weight 0.

        Args:
            first_row: detector row at which the binned rows of the runs begin.
        """
        boxes = runs[:, [1, 1, 2, 3]] * binning + [first_row, first_row + binning, 0, 0]
        shares = np.concatenate((self.shares, np.zeros(len(runs), np.float32)))
        frames = np.concatenate((self.frames, runs[:, 0]))
        return replace(self, frames=frames, boxes=np.concatenate((self.boxes, boxes)), shares=shares)

    def weights(self, view_ids: I64, rows: slice, binning: int, shape: tuple[int, int]) -> NDArray[np.float32] | None:
        """[view, row, col] weights of the rays of some projections, in binned pixels `shape` of these detector rows.

        None if all weights are 1.
        """
        chosen = np.isin(self.frames, view_ids)
        if not chosen.any():
            return None
        height, width = shape
        weights = np.ones((view_ids.size, height, width), np.float32)
        positions = None if self.resampling is None else self.resampling.positions(shape, rows.start)
        view_of = {int(frame): view for view, frame in enumerate(view_ids)}
        for frame, (top, bottom, left, right), share in zip(
            self.frames[chosen].tolist(), self.boxes[chosen].tolist(), self.shares[chosen].tolist(), strict=True
        ):
            if positions is not None:
                row, col = positions
                inside = (row > top - 1) & (row < bottom) & (col > left - 1) & (col < right)
                weights[view_of[frame]][inside] *= share
                continue
            first, end = max(top - rows.start, 0), max(bottom - rows.start, 0)
            if not any(edge % binning for edge in (first, end, left, right)):
                weights[view_of[frame], first // binning : end // binning, left // binning : right // binning] *= share
                continue
            unbinned = np.ones((1, height * binning, width * binning), np.float32)
            unbinned[0, first:end, left:right] = share
            weights[view_of[frame]] *= bin_views(unbinned, binning)[0]
        return weights


@dataclass(frozen=True, eq=False)
class UsableViews:
    """The projections of a scan that a reconstruction may use.

    Attributes:
        scan: the evidence on which the choice is based.
        frames: int64 [view], their rows in the file.
        weights: float32 [frame of the file], weight of each projection; None: 1 for all.
        left_out: projections with an alarm, which are not among `frames`.
        sentence: a sentence that says what was done; empty if no projection is flagged.
        flags: flags of all frames; the other fields follow from them unless flags are ignored. None: the file has no
            flags.
        regions: regions with less weight, in projections that are used.
        jumps: int64, ascending, rows from which on the sample had another position according to the monitor.
    """

    scan: ScanEvidence
    frames: NDArray[np.int64]
    weights: NDArray[np.float32] | None = None
    left_out: int = 0
    sentence: str = ""
    flags: FrameFlags | None = None
    regions: Regions = field(default_factory=Regions)
    jumps: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def only(self, frames: NDArray[np.int64]) -> UsableViews:
        """The usable projections restricted to these frames."""
        return replace(self, frames=frames, left_out=self.left_out + self.frames.size - frames.size)

    def weights_of(self, rows: NDArray[np.int64]) -> NDArray[np.float32] | None:
        """[view] weights of some rows of the file; None if all weights are equal."""
        if self.weights is None or np.ptp(self.weights[rows]) == 0:
            return None
        return self.weights[rows]


WARNED_SHARE = 0.5
"""Weight of a ray in the region of a warning."""
WARNED_WEIGHT = 0.5
"""Weight of a projection with a warning, as if its noise had twice the variance. A warning says that the projection
differs by more than noise, but not that it is wrong, and there are too few projections to leave it out.
"""
WIDE = 2.5
"""A gap between the remaining projections is reported if it is larger than the widest gap before by this factor,
because then two neighbouring projections are missing.
"""


def usable_views(scan: ScanEvidence, use_flags: bool) -> UsableViews:
    """The projections without an alarm, with their weights. If `use_flags` is False: all projections with equal
    weights.
    """
    from beamline.storage.rules.flag_policy import flag_policy

    views, flags = scan.table.are_views, scan.flags
    rows = np.flatnonzero(views)
    if flags is None or not (flags.flagged if use_flags else flags.flagged[rows]).any():
        return UsableViews(scan, rows, flags=flags)
    if not use_flags:
        alarmed, warned = views & flags.alarmed, views & flags.flagged & ~flags.alarmed
        with_alarm = count(int(alarmed.sum()), "projection")
        n_warned = warned.sum()
        with_flags = f"{with_alarm} with an alarm and {n_warned} with a warning"
        sentence = f"--flags ignore: {with_flags} are used as they are."
        return UsableViews(scan, rows, sentence=sentence, flags=flags)
    policy = flag_policy(flags, views, scan.source.shape)
    if not policy.in_words:
        return UsableViews(scan, rows, flags=flags, jumps=policy.jumps)
    weights = np.where(policy.halved, np.float32(WARNED_WEIGHT), np.float32(1)) if policy.halved.any() else None
    kept_rows = np.flatnonzero(views & ~policy.left_out)
    gap = new_gap(scan, rows, kept_rows)
    sentence = f"{policy.in_words}{gap and f' They leave {gap}.'} --flags ignore weighs all projections equally."
    regions = regions_of(policy)
    return UsableViews(scan, kept_rows, weights, int(policy.left_out.sum()), sentence, flags, regions, policy.jumps)


def new_gap(scan: ScanEvidence, before: NDArray[np.int64], after: NDArray[np.int64]) -> str:
    """A text such as "12° without a projection" if the remaining projections have a gap that was not there before;
    otherwise empty.
    """
    period = np.pi if scan.cone is None else 2 * np.pi
    narrow, wide = (_widest_gap(scan.table.angles[frames], period) for frames in (before, after))
    return f"{np.degrees(wide):.3g}° without a projection" if wide >= WIDE * narrow else ""


def _widest_gap(angles: NDArray[np.float64], period: float) -> float:
    """The largest angle in radians between neighbouring projections. Projections that are a `period` apart measure the
    same rays.
    """
    sorted_angles = np.sort(np.mod(angles[np.isfinite(angles)], period))
    return period if sorted_angles.size == 0 else float(np.diff(sorted_angles, append=sorted_angles[0] + period).max())


def regions_of(policy: FlagPolicy) -> Regions:
    """The regions of warnings and alarms in frames. Rays in the region of an alarm have weight 0."""
    frames, boxes, alarms = zip(*policy.parts, strict=True) if policy.parts else ((), (), ())
    shares = np.where(np.array(alarms, np.bool_), np.float32(0), np.float32(WARNED_SHARE))
    return Regions(np.array(frames, np.int64), np.array(boxes, np.int64).reshape(-1, 4), shares)


def longest_part(frames: I64, jumps: I64) -> I64:
    """The rows of the largest part between jumps. `jumps` are in ascending order."""
    parts = np.searchsorted(jumps, frames, side="right")
    return frames[parts == np.bincount(parts).argmax()] if frames.size else frames
