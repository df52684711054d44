"""Settings of a stage behind an EPICS motor record; the record takes and gives its own unit."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from drivers.base.protocols import StageLimits
from drivers.flat import Declared
from drivers.stages.settings import StageFigures, Wiring, key


class Search(StrEnum):
    """The direction in which the record searches its reference."""

    NONE = "none"
    FORWARD = "forward"
    REVERSE = "reverse"

    @property
    def field(self) -> str:
        """Field of the record that begins the search."""
        return {"none": "", "forward": ".HOMF", "reverse": ".HOMR"}[self]


@dataclass(frozen=True)
class EpicsSettings(Declared):
    """EPICS motor record at pva://NAME or ca://NAME. It gives no trigger pulses: step scans only.

    `unit` is the record's EGU; where it is another one than deg, as for a linear sample mover, it stands wherever a key
    says deg.
    """

    pulse_output: ClassVar[None] = None
    """A motor record sets no output."""
    wiring: ClassVar[Wiring] = Wiring()
    """No cable: only checks of trigger pulses ask for it."""
    figures: StageFigures
    unit: str = key("deg", "The record's EGU; a linear axis has mm, which then stands wherever a key says deg.")
    search: Search = key(Search.NONE, "How `beamline home` finds its reference: none, HOMF or HOMR.")
    tolerance: int = key(10, "From the target, within which a move has arrived.", unit="counts", ge=0)
    timeout: float = key(2.0, "For an answer of the IOC.", unit="s", gt=0)

    def limits(self) -> StageLimits:
        """See `StageSettings`."""
        figures = self.figures
        return StageLimits(
            figures.counts_per_turn,
            figures.max_speed,
            figures.acceleration,
            figures.low,
            figures.high,
            False,
            tolerance=self.tolerance,
        )
