"""Names that a plug-in of a correction may import from here; they are defined in `protocols` and `step`."""

from beamline.projections.protocols import (
    PlaceStep,
    PrepStep,
    RayStep,
    ScanPart,
    ScanStep,
    ViewFilter,
    ViewStep,
)
from beamline.projections.protocols import ViewMotion as ViewPlaces
from beamline.projections.step import Option, StepDone, StepMemory, option, options_of, positive

__all__ = [
    "Option",
    "PlaceStep",
    "PrepStep",
    "RayStep",
    "ScanPart",
    "ScanStep",
    "StepDone",
    "StepMemory",
    "ViewFilter",
    "ViewPlaces",
    "ViewStep",
    "option",
    "options_of",
    "positive",
    "view_bytes",
]


def view_bytes(part: ScanPart, reach: int = 0) -> int:
    """See `ScanPart.view_bytes`."""
    return part.view_bytes(reach)
