"""Defects: dead and hot pixels, zingers, and pixels that no light reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepMemory


@dataclass(frozen=True)
class Defects:
    """Which pixels are taken from their neighbours. `recon.prep.correct.CorrectionSettings` says what each value means;
    `ScanCorrection` asks for them."""

    name: ClassVar[str] = "defects"
    follows: ClassVar[tuple[str, ...]] = ("flats",)
    needs_finished: ClassVar[str] = ""
    floor: float = 1e-4
    hot_threshold: float = 10.0
    zinger_threshold: float = 8.0

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory()
