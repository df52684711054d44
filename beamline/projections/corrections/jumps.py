"""Jumps: views after the sample moved on its stage are corrected by shifts and a turn, or left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepMemory, option

if TYPE_CHECKING:
    from beamline.projections.jumps import SamplePlaces
    from beamline.projections.selection import Selection
    from beamline.projections.usable_views import UsableViews
    from beamline.storage.readers.base import ScanSource


@dataclass(frozen=True)
class Jumps:
    """What becomes of views on either side of an alarm of motion.

    Attributes:
        wanted: "correct": see `beamline.projections.jumps.find_jumps`. "ignore": they are used as they are.
    """

    name: ClassVar[str] = "jumps"
    follows: ClassVar[tuple[str, ...]] = ("phase",)
    needs_finished: ClassVar[str] = ""
    wanted: str = option(
        "--jumps",
        "correct",
        "correct: where the monitor saw the sample jump, views are corrected by shifts and a turn, or left out. "
        "ignore: they are used as they are.",
        choices=("correct", "ignore"),
    )

    def memory(self, part: ScanPart) -> StepMemory:
        from beamline.projections.jumps import search_memory

        return StepMemory(alone=search_memory(part.source, part.selection) if self.wanted == "correct" else 0)

    def place(
        self,
        source: ScanSource,
        selection: Selection,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> SamplePlaces:
        from beamline.projections.corrections.poses import stated_poses
        from beamline.projections.jumps import SamplePlaces, find_jumps, frames_text

        if stated_poses(source, selection) is not None:  # it states where the sample was
            return SamplePlaces(usable.frames)
        if self.wanted == "correct":
            return find_jumps(source, selection, usable.frames, usable.jumps, axis_col, progress)
        where = frames_text(usable.jumps)
        said = f"The monitor saw the sample jump at {where}; --jumps ignore: views are used as they are."
        return SamplePlaces(usable.frames, said=said if usable.jumps.size else "")
