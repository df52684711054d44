"""Flags of the monitor: which views are used, and how much they weigh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepMemory, option


@dataclass(frozen=True)
class Flags:
    """How flags are heeded. `beamline.projections.usable_views` chooses the views, `jumps` corrects them.

    Attributes:
        wanted: "use": views with an alarm are left out, those with a warning weigh less. "judge": the monitor looks at
            the frames now, and its flags count in place of the file's. "ignore": all views are alike.
    """

    name: ClassVar[str] = "flags"
    follows: ClassVar[tuple[str, ...]] = ()
    wanted: str = option(
        "--flags",
        "use",
        "use: leave out views with an alarm of the monitor, halve the weight of views or regions with a warning, "
        "correct views after a jump of the sample. judge: let the monitor look at the frames first. ignore: take "
        "all views alike.",
        choices=("use", "judge", "ignore"),
    )

    @property
    def used(self) -> bool:
        return self.wanted != "ignore"

    @property
    def judged(self) -> bool:
        return self.wanted == "judge"

    @property
    def needs_finished(self) -> str:
        said = "--flags judge is for a finished scan; a running one is judged while it is taken."
        return said if self.judged else ""

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory()
