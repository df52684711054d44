"""Needs of a scan, or of several scans together: time, frames, bytes, dose, and what the operator has to do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from beamline.plan.plan import summed


class OperatorRequest(NamedTuple):
    """What a scan asks the operator to do, and the largest number of times."""

    request: str
    times: int


@dataclass(frozen=True)
class ScanNeeds:
    """Time, frames, bytes, dose and manual work of a scan, or of several scans one after the other.

    Attributes:
        parts: duration in s of each part: `dark`, `flat`, `projection`, `offset_view` (each with the moves of the
            stage), `warm_up`, `return`. The time for moving shutter and sample is not known.
        n_frames, total_bytes: number of frames and bytes of the files, without projections that are taken again.
        dose_gy: dose in Gy that the sample absorbs; None: `optics.dose_rate_gy_s` is not stated.
        volume_seconds: longest time in s from the last projection until the live volume is finished.
        operator: what the scan asks the operator to do by hand, such as moving the sample.
    """

    parts: Mapping[str, float] = field(default_factory=dict)
    n_frames: int = 0
    total_bytes: int = 0
    dose_gy: float | None = None
    volume_seconds: float = 0.0
    operator: tuple[OperatorRequest, ...] = ()

    @property
    def duration(self) -> float:
        """Duration in s, without moves of shutter and sample."""
        return sum(self.parts.values())

    def data(self) -> dict[str, Any]:
        """The values by name, in the form that other programs get."""
        return {"duration": self.duration, **vars(self), "operator": [each._asdict() for each in self.operator]}


def all_needs(scans: Iterable[ScanNeeds]) -> ScanNeeds:
    """The needs of several scans together. The dose is the sum over the scans that state one."""
    each = tuple(scans)
    doses = [one.dose_gy for one in each if one.dose_gy is not None]
    asked = summed(*(request for one in each for request in one.operator))
    return ScanNeeds(
        summed(*(part for one in each for part in one.parts.items())),
        sum(one.n_frames for one in each),
        sum(one.total_bytes for one in each),
        sum(doses) if doses else None,
        sum(one.volume_seconds for one in each),
        tuple(OperatorRequest(request, int(times)) for request, times in asked.items()),
    )


NOTHING = ScanNeeds()
"""Placeholder for the needs of a scan if they cannot be computed."""
