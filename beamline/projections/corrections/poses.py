"""Poses of views from a file: displacement, roll and tilt, which become geometry. No view is resampled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from beamline.projections.protocols import ScanPart, ViewPlaces
from beamline.projections.step import StepMemory, option

if TYPE_CHECKING:
    from beamline.projections.selection import Selection
    from beamline.projections.usable_views import UsableViews
    from beamline.storage.pose_table import PoseTable
    from beamline.storage.readers.base import ScanSource


def stated_poses(source: ScanSource, selection: Selection) -> PoseTable | None:
    """The poses of the option's file, or else the shifts that the scan file states."""
    import numpy as np

    from beamline.storage.pose_table import PoseTable

    table, shifts = selection.step(PosesOfFile).table, source.shifts
    if table is not None:
        return table if table.keys.size else None
    if shifts is None:
        return None
    rows = np.flatnonzero(np.isfinite(shifts).all(axis=1))
    frames = rows.astype(np.float64)
    return PoseTable(source.path, "frame", frames, None, shifts[rows], np.zeros((rows.size, 2)), frames=len(shifts))


def _table(text: str) -> PoseTable:
    from beamline.storage.pose_table import read_poses

    return read_poses(text)


@dataclass(frozen=True)
class PosesOfFile:
    """Where views were displaced, rolled and tilted, as a file states it.

    Attributes:
        table: the file's; None: views are displaced as the scan file says (.txrm), or not at all.
    """

    name: ClassVar[str] = "poses"
    follows: ClassVar[tuple[str, ...]] = ("jumps",)
    table: PoseTable | None = option(
        "--poses",
        None,
        "Displacement, roll and tilt of each view; no view is resampled. A CSV with view or angle_deg, and "
        "shift_col_px, shift_row_px, roll_deg, tilt_deg. Or a volume that keeps poses. Or an NXtomo file as FILE:x,-y: "
        "columns grow with x_translation, rows against y_translation. ignore: without the shifts that a .txrm states.",
        parse=_table,
        metavar="FILE",
    )

    @property
    def needs_finished(self) -> str:
        return "" if self.table is None else "--poses is for a finished scan: it needs all views."

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory()

    def place(
        self,
        source: ScanSource,
        selection: Selection,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> ViewPlaces:
        from beamline.projections.jumps import SamplePlaces
        from beamline.projections.poses import poses_of

        return poses_of(source, selection, usable.frames) or SamplePlaces(usable.frames)
