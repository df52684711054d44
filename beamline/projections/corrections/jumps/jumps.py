"""Jumps: of a scan in which the sample jumped the longest run of views is used; whether it did, the views say."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from beamline.core.text import count, frames_text
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.protocols import ScanPart, Unmoved, ViewMotion
from beamline.projections.registry import geometry_steps
from beamline.projections.selection import ScanSelection
from beamline.projections.step import StepDone, StepMemory
from beamline.projections.usable_views import UsableViews, usable_views
from recon.base.volume import Grid

if TYPE_CHECKING:
    from beamline.storage.readers.base import ScanSource
    from beamline.storage.rules.evidence import ScanEvidence
    from recon.base.arrays import I64
    from recon.base.geometry import Geometry

LEAST = 6  # views on a side that say whether the sample jumped there
ALIKE = 1.5  # times the deviation of the longest part's views: a part that fits has no more
_ADDS = 0.005  # share of the deviation of the longest part's views that a part which fits may add
_COLS, _ROWS, _VIEWS = 128, 16, 360  # binned pixels and views looked at, at most; parts of `_SHORT` views have all
_SHORT = 40
_REPAIRED = "`--calibrate shifts` takes all views, and learns where each stood."


@dataclass(frozen=True)
class Jumps:
    """Leaves out views after a jump, see `find_jumps`; none where the place of each view is stated or learnt."""

    name: ClassVar[str] = "jumps"
    follows: ClassVar[tuple[str, ...]] = ("tilt", "phase")
    needs_finished: ClassVar[str] = ""

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory(alone=_search_memory(part.source, part.selection))

    def place(
        self,
        source: ScanSource,
        selection: ScanSelection,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> ViewMotion:
        learnt = any("shifts" in step.geometry for step in geometry_steps(selection))
        if learnt or stated_poses(source, selection) is not None:
            return Unmoved(usable.frames)
        return find_jumps(usable.scan, selection, usable.frames, usable.jumps, axis_col, progress)


@dataclass(frozen=True, eq=False)
class SampleJumps:
    """The views of a scan in which the sample jumped, that belong together.

    Attributes:
        frames: int64 [view], the rows that are used.
        sentence: what was done, in a line; empty where there was no jump.
    """

    frames: I64
    sentence: str = ""

    @property
    def done(self) -> StepDone:
        """What the step did; the volume's file records the jumps, if there were any."""
        return StepDone(self.sentence, {"jumps": self.sentence} if self.sentence else {}, warned=True)

    def corrected(self, geometry: Geometry, view_ids: I64) -> Geometry:
        return geometry


def find_jumps(
    scan: ScanEvidence,
    selection: ScanSelection,
    frames: I64,
    jumps: I64,
    axis_col: float,
    progress: Callable[[int, int], None] = lambda n, most: None,
) -> SampleJumps:
    """The longest run of views in which the sample stood in one place.

    A jump is one where views held out of the longer side are predicted worse by both sides than by that side, or those
    of the other side far worse than these. The clearest one is sought first, then others on its sides.

    Args:
        frames: rows of the file that are to be used.
        jumps: rows from which on the sample is elsewhere, as the monitor saw.
        progress: how many jumps were looked at, of at most how many.
    """
    jumps = np.array([row for row in jumps.tolist() if (frames < row).any() and (frames >= row).any()], np.int64)
    if not jumps.size:
        return SampleJumps(frames)
    if selection.cone is not None:
        where = frames_text(jumps)
        return SampleJumps(
            frames,
            f"The sample jumped at {where}. Views of a cone beam are not compared for that: they are used as if it had "
            "not moved. Choose those of one side with --views.",
        )
    runs, most = [frames], jumps.size * (jumps.size + 1) // 2
    part = np.searchsorted(jumps, frames, side="right")
    steady = frames[np.bincount(part)[part] >= LEAST]  # views between two alarms are no part of a comparison
    real, at, n = list[int](), 0, 0
    while at < len(runs):
        run, clearest, best = np.intersect1d(runs[at], steady), 1.0, 0
        for row in jumps.tolist():
            if min((run < row).sum(), (run >= row).sum()) >= LEAST:
                n += 1
                progress(n, most)
                if (clear := _clearness(scan, selection, axis_col, run, row)) > clearest:
                    clearest, best = clear, row
        if best:
            real.append(best)
            runs[at : at + 1] = [runs[at][runs[at] < best], runs[at][runs[at] >= best]]
        else:
            at += 1
    kept = max(runs, key=len)
    if real:  # nor are they known to belong to one side
        inner = np.intersect1d(kept, steady)
        kept = kept[(kept >= inner[0]) & (kept <= inner[-1])]
    return SampleJumps(kept, _sentence_on_jumps(np.array(sorted(real), np.int64), jumps, frames.size - kept.size))


def _sentence_on_jumps(real: I64, jumps: I64, lost: int) -> str:
    """What was done at the jumps, and at which alarms the views show none."""
    text = list[str]()
    if lost:
        verb = "is" if lost == 1 else "are"
        text.append(
            f"The sample jumped at {frames_text(real)}. {count(lost, 'view')} {verb} left out: the sample stood "
            f"elsewhere in them. {_REPAIRED}"
        )
    if (none := np.setdiff1d(jumps, real)).size:
        text.append(
            f"At the alarm of motion at {frames_text(none)} the other views show no jump: the views on both sides are "
            "used as they are."
        )
    return " ".join(text)


def _clearness(scan: ScanEvidence, selection: ScanSelection, axis_col: float, frames: I64, row: int) -> float:
    """How clearly the sample stood elsewhere from `row` on in these rows of the file; 1 is the limit."""
    from beamline.projections.correction import line_integrals_of
    from recon.base.masks import areas
    from recon.voxels.displacement import Displacement, judge

    step = max(1, math.ceil(frames.size / _VIEWS))
    sides = frames[frames < row], frames[frames >= row]
    looked = np.concatenate([side[:: 1 if side.size <= _SHORT else step] for side in sides])
    band = _band(scan.source, selection)
    views = line_integrals_of(scan, band, looked)
    geometry = band.geometry(axis_col, scan.table.angles[views.view_ids])
    part = (views.view_ids >= row).astype(np.int64)
    fit = judge(views.data, geometry, part, ~areas(views.masked), [Displacement()] * 2)
    return max(fit.together / fit.alone / (1 + _ADDS), fit.others[1 - fit.longest] / (ALIKE * fit.together))


def _band(source: ScanSource, selection: ScanSelection) -> ScanSelection:
    """Binned pixels, and rows around the middle of those that are used, also outside them."""
    width, height = source.shape[1] // selection.binning, source.shape[0]
    binning = selection.binning * max(1, math.ceil(width / _COLS))
    used = selection.detector_rows
    n = min(_ROWS * binning, height)
    first = min(max((used.start + used.stop - n) // 2, 0), height - n)
    return replace(selection, rows=(first, first + n), binning=min(binning, n))


def _search_memory(source: ScanSource, selection: ScanSelection) -> int:
    """Bytes that `find_jumps` takes at most; 0 if the flags in the file name no jump, and none are made."""
    from beamline.projections.correction import at_once_memory
    from beamline.storage.rules.evidence import ScanEvidence
    from recon.voxels.displacement import SWEEPS
    from recon.voxels.methods import OsSirtTv

    asked = selection.step(Preparation)
    jumps = usable_views(ScanEvidence(source), asked.uses_flags).jumps
    if selection.cone is not None or not (asked.judged or jumps.size):
        return 0
    n = min(source.table.views.size, _VIEWS + 2 * _SHORT)
    band = _band(source, selection)
    views = band.geometry((source.shape[1] - 1) / 2, np.linspace(0, math.pi, n, endpoint=False))
    copy = 4 * n * math.prod(views.detector_shape)
    work = OsSirtTv(iterations=SWEEPS, momentum=True).memory(views, Grid.matching(views), weighted=True)
    return copy + max(at_once_memory(source, band, n), work)
