"""A correction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepDone, StepMemory, option


@dataclass(frozen=True)
class Lift:
    """Adds a number to all line integrals."""

    name: ClassVar[str] = "lift"
    follows: ClassVar[tuple[str, ...]] = ("hardening",)
    by: float = option("--lift", "0", "Add this to all line integrals.", parse=float, metavar="BY")

    @property
    def needs_finished(self) -> str:
        return "--lift is for a finished scan." if self.by else ""

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory()

    def apply(self, views: Any, angles: Any, progress: Callable[[int, int], None]) -> StepDone:
        views.lines.data[...] += self.by
        return StepDone(f"Lifted by {self.by:g}." if self.by else "")
