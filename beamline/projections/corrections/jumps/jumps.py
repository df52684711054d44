"""Jumps of the sample: checks in the projections whether the sample jumped, and uses the longest part of the scan
between jumps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from beamline.core.text import count, frames_text
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.preparation import Preparation
from beamline.projections.protocols import ScanPart, Unmoved, ViewMotion
from beamline.projections.registry import geometry_steps
from beamline.projections.selection import SelectedScan
from beamline.projections.step import StepDone, StepMemory
from beamline.projections.usable_views import UsableViews, usable_views
from recon.base.volume import Grid

if TYPE_CHECKING:
    from recon.base.arrays import I64
    from recon.base.geometry import Geometry

LEAST = 6  # number of projections on each side that is enough to decide whether the sample jumped
# factor on the deviation of the longest part's projections: a part in which the sample is in the same place stays below
# it
ALIKE = 1.5
# share of the deviation of the longest part's projections by which another part may raise this deviation and still
# count as being in the same place
_ADDS = 0.005
# upper limits for binned pixels and projections; all projections of parts with at most `_SHORT` projections are used
_COLS, _ROWS, _VIEWS = 128, 16, 360
_SHORT = 40
_REPAIRED = "`--calibrate shifts` uses all projections, because it finds the position of the sample in each projection."


@dataclass(frozen=True)
class Jumps:
    """Leaves out the projections after a jump, see `find_jumps`. No projection is left out if the position of the
    sample in each projection is stated or calibrated.
    """

    name: ClassVar[str] = "jumps"
    follows: ClassVar[tuple[str, ...]] = ("tilt", "phase")
    needs_finished: ClassVar[str] = ""

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory(alone=_search_memory(part.scan))

    def place(
        self,
        scan: SelectedScan,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> ViewMotion:
        learnt = any("shifts" in step.geometry for step in geometry_steps(scan.selection))
        if learnt or stated_poses(scan) is not None:
            return Unmoved(usable.frames)
        return find_jumps(scan, usable.frames, usable.jumps, axis_col, progress)


@dataclass(frozen=True, eq=False)
class SampleJumps:
    """The projections of a scan in which the sample was in the same place, after jumps of the sample were searched for.

    Attributes:
        frames: int64 [view], rows of the file that are used.
        sentence: a sentence that says what was done; empty if there was no jump.
    """

    frames: I64
    sentence: str = ""

    @property
    def done(self) -> StepDone:
        """What the step did. The file of the volume records the jumps."""
        return StepDone(self.sentence, {"jumps": self.sentence} if self.sentence else {}, warned=True)

    def corrected(self, geometry: Geometry, view_ids: I64) -> Geometry:
        return geometry


def find_jumps(
    scan: SelectedScan,
    frames: I64,
    jumps: I64,
    axis_col: float,
    progress: Callable[[int, int], None] = lambda n, n_most: None,
) -> SampleJumps:
    """The longest run of projections in which the sample stayed in one place.

    A jump is real in two cases. (1) Both sides together predict held-out projections of the longer side worse than the
    longer side alone does. (2) Held-out projections of the other side are predicted far worse than those of the longer
    side. The clearest jump is searched for first, then further jumps on either side of it.

    Args:
        frames: rows of the file that are to be used.
        jumps: rows after which the sample moved, according to the monitor.
        progress: function that gets the number of checked jumps and the largest number of jumps.
    """
    jumps = np.array([row for row in jumps.tolist() if (frames < row).any() and (frames >= row).any()], np.int64)
    if not jumps.size:
        return SampleJumps(frames)
    if scan.selection.cone is not None:
        jump_text = frames_text(jumps)
        return SampleJumps(
            frames,
            "Use --views to choose the projections before or after the jump: the monitor reports that "
            f"the sample jumped at {jump_text}. In a cone beam jumps cannot be checked, so all projections "
            "are used as if the sample had not moved.",
        )
    runs, n_most = [frames], jumps.size * (jumps.size + 1) // 2
    part_of_frame = np.searchsorted(jumps, frames, side="right")
    # projections between two alarms are left out of the comparison
    compared = frames[np.bincount(part_of_frame)[part_of_frame] >= LEAST]
    confirmed, run_number, n = list[int](), 0, 0
    while run_number < len(runs):
        run, largest_clearness, best_jump = np.intersect1d(runs[run_number], compared), 1.0, 0
        for row in jumps.tolist():
            if min((run < row).sum(), (run >= row).sum()) >= LEAST:
                n += 1
                progress(n, n_most)
                if (clearness := _clearness(scan, axis_col, run, row)) > largest_clearness:
                    largest_clearness, best_jump = clearness, row
        if best_jump:
            confirmed.append(best_jump)
            runs[run_number : run_number + 1] = [
                runs[run_number][runs[run_number] < best_jump],
                runs[run_number][runs[run_number] >= best_jump],
            ]
        else:
            run_number += 1
    usable = max(runs, key=len)
    if confirmed:  # it is not known either to which side these projections belong
        inner = np.intersect1d(usable, compared)
        usable = usable[(usable >= inner[0]) & (usable <= inner[-1])]
    return SampleJumps(
        usable, _sentence_on_jumps(np.array(sorted(confirmed), np.int64), jumps, frames.size - usable.size)
    )


def _sentence_on_jumps(confirmed: I64, jumps: I64, lost: int) -> str:
    """A sentence that says what was done at real jumps, and at which alarms the projections show no jump."""
    text = list[str]()
    if lost:
        verb = "is" if lost == 1 else "are"
        text.append(
            f"The sample jumped at {frames_text(confirmed)}. {count(lost, 'projection')} {verb} left out, because the "
            f"sample was at another position at that time. {_REPAIRED}"
        )
    if (unconfirmed := np.setdiff1d(jumps, confirmed)).size:
        text.append(
            f"The monitor reported motion at {frames_text(unconfirmed)}, but the projections show no jump of the "
            "sample, so all these projections are used without a correction."
        )
    return " ".join(text)


def _clearness(scan: SelectedScan, axis_col: float, frames: I64, row: int) -> float:
    """How clearly these rows of the file show that the sample was in another place from `row` on; a jump has more than
    1.
    """
    from beamline.projections.correction import line_integrals_of
    from recon.base.masks import areas
    from recon.voxels.displacement import Displacement, judge

    step = max(1, math.ceil(frames.size / _VIEWS))
    sides = frames[frames < row], frames[frames >= row]
    sampled = np.concatenate([side[:: 1 if side.size <= _SHORT else step] for side in sides])
    band = _band(scan)
    views = line_integrals_of(band, sampled)
    geometry = band.selection.geometry(axis_col, scan.table.angles[views.view_ids])
    part = (views.view_ids >= row).astype(np.int64)
    fit = judge(views.data, geometry, part, ~areas(views.masked), [Displacement()] * 2)
    return max(fit.together / fit.alone / (1 + _ADDS), fit.others[1 - fit.longest] / (ALIKE * fit.together))


def _band(scan: SelectedScan) -> SelectedScan:
    """The scan with binned pixels, and with rows around the middle of the rows used; these may extend beyond the rows
    used.
    """
    source, selection = scan.source, scan.selection
    width, height = source.shape[1] // selection.binning, source.shape[0]
    binning = selection.binning * max(1, math.ceil(width / _COLS))
    used = selection.detector_rows
    n = min(_ROWS * binning, height)
    first = min(max((used.start + used.stop - n) // 2, 0), height - n)
    return scan.part(rows=(first, first + n), binning=min(binning, n))


def _search_memory(scan: SelectedScan) -> int:
    """Largest memory in bytes that `find_jumps` needs. 0 if the flags in the file name no jump and the monitor does not
    check the frames.
    """
    from beamline.projections.correction import at_once_memory
    from recon.voxels.displacement import SWEEPS
    from recon.voxels.methods import OsSirtTv

    preparation, source = scan.selection.step(Preparation), scan.source
    if scan.selection.cone is not None:
        return 0
    if not (preparation.judged or usable_views(scan.evidence, preparation.uses_flags).jumps.size):
        return 0
    n = min(source.table.views.size, _VIEWS + 2 * _SHORT)
    band = _band(scan)
    views = band.selection.geometry((source.shape[1] - 1) / 2, np.linspace(0, math.pi, n, endpoint=False))
    copy_bytes = 4 * n * math.prod(views.detector_shape)
    solver_bytes = OsSirtTv(iterations=SWEEPS).memory(views, Grid.matching(views), weighted=True)
    return copy_bytes + max(at_once_memory(band, n), solver_bytes)
