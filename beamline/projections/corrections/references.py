"""References: which darks and flats are used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepMemory, option


@dataclass(frozen=True)
class ReferenceCheck:
    """How darks and flats are checked. `checked_views` and `ScanCorrection` ask for it.

    Attributes:
        wanted: "accept": they are used as they are, also saturated, dark, uneven or lit ones.
    """

    name: ClassVar[str] = "references"
    follows: ClassVar[tuple[str, ...]] = ("flags",)
    needs_finished: ClassVar[str] = ""
    wanted: str = option(
        "--references",
        "check",
        "check: leave out groups of darks and flats that are saturated, dark, uneven or lit; refuse the scan if "
        "no group is left. accept: use all as they are.",
        choices=("check", "accept"),
    )

    @property
    def accepted(self) -> bool:
        return self.wanted == "accept"

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory()
