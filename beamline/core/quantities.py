"""Quantities: that of a volume's voxels, with its unit; and plausible ranges of those of an instrument.

Every type accepts a value in a mistaken unit, such as eV for keV.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType


class VoxelKind(Enum):
    """The physical quantity of the voxels."""

    ATTENUATION = "attenuation"
    """Linear attenuation coefficient, of views in transmission."""
    ACTIVITY = "activity"
    """Counts per length of a line of response, of a sample that emits."""
    SHARE = "volume fraction"
    """Share of the voxel that a material fills, without a unit."""

    def unit(self, length: str) -> str:
        """Unit of a voxel, with lengths in `length`, "mm" or "px"; empty for shares."""
        return {self.ATTENUATION: f"1/{length}", self.ACTIVITY: f"counts/{length}", self.SHARE: ""}[self]

    def label(self, length: str) -> str:
        """Label of an axis or a colour bar: the quantity and its unit."""
        unit = self.unit(length)
        return f"{self.value} ({unit})" if unit else self.value

    @classmethod
    def of_unit(cls, unit: str) -> VoxelKind:
        """The kind of voxels with this unit; attenuation if no kind has the unit that a file states."""
        return cls.SHARE if unit == "" else cls.ACTIVITY if unit.startswith("counts/") else cls.ATTENUATION


_SAME = 1e-3  # share by which an angle may be off half a turn or a turn in radians


@dataclass(frozen=True)
class PlausibleRange:
    """The plausible range of a quantity of an instrument.

    Attributes:
        others: units that are mistaken for this one, each with its factor to this one.
    """

    low: float
    high: float
    unit: str
    others: Mapping[str, float]


RANGES: Mapping[str, PlausibleRange] = MappingProxyType(
    {
        "pixel_size_um": PlausibleRange(0.05, 5000.0, "um", {"mm": 1e3, "nm": 1e-3, "m": 1e6}),
        "energy_kev": PlausibleRange(0.1, 600.0, "keV", {"eV": 1e-3, "MeV": 1e3}),
        "distance_mm": PlausibleRange(0.0, 2e4, "mm", {"um": 1e-3, "nm": 1e-6}),
        "exposure_s": PlausibleRange(1e-6, 600.0, "s", {"ms": 1e-3, "us": 1e-6}),
    }
)
"""By name: from pixels behind X-ray lenses to those of a scanner of patients, from carbon's edge to tubes of 600 kV,
the longest hutches, and the longest exposures that a ring lasts."""


def doubt(name: str, value: float | None) -> str:
    """A sentence on an implausible value, with the unit that may be meant; empty for a plausible value."""
    known = RANGES[name]
    if value is None or known.low <= value <= known.high or not value > 0:
        return ""
    ratio = value / known.high if value > known.high else known.low / value
    orders = max(1, math.ceil(math.log10(ratio) - 1e-9))
    meant = [
        f"{value * factor:.4g} {known.unit} ({value:.6g} {other})"
        for other, factor in known.others.items()
        if known.low <= value * factor <= known.high
    ]
    beyond = f"{orders} order{'s' * (orders > 1)} of magnitude beyond instruments of this kind"
    asked = f": did you mean {' or '.join(meant)}?" if meant else "."
    return f"{name}: {value:.6g} {known.unit} is {beyond} ({known.low:g} to {known.high:g} {known.unit}){asked}"


def doubt_span(span_deg: float | None) -> str:
    """A sentence on a span that looks like radians (half a turn or a turn); empty for any other span."""
    for turn in (math.pi, 2 * math.pi):
        if span_deg is not None and abs(abs(span_deg) / turn - 1) < _SAME:
            return (
                f"span_deg: {span_deg:g} degrees is {math.degrees(turn):.0f} degrees in radians: did you mean "
                f"{math.copysign(math.degrees(turn), span_deg):.0f}?"
            )
    return ""
