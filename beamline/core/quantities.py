"""Quantities: the physical quantity and unit of the voxels of a volume, and the plausible ranges of the settings of an
instrument.

A check of types cannot notice a value in a wrong unit, such as eV instead of keV.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from types import MappingProxyType


class VoxelKind(Enum):
    """The physical quantity of the voxels."""

    ATTENUATION = "attenuation"
    """Linear attenuation coefficient, from projections in transmission."""
    ACTIVITY = "activity"
    """Counts per length of a line of response, from a sample that emits."""
    SHARE = "volume fraction"
    """Fraction of a voxel that a material fills; it has no unit."""

    def unit(self, length: str) -> str:
        """Unit of a voxel, if lengths are in `length`, "mm" or "px"; empty for fractions."""
        return {self.ATTENUATION: f"1/{length}", self.ACTIVITY: f"counts/{length}", self.SHARE: ""}[self]

    def label(self, length: str) -> str:
        """Label of an axis or a colour bar: the quantity and its unit."""
        unit = self.unit(length)
        return f"{self.value} ({unit})" if unit else self.value

    @classmethod
    def of_unit(cls, unit: str) -> VoxelKind:
        """The kind of voxels with this unit. If no kind has the unit that a file states: attenuation."""
        return cls.SHARE if unit == "" else cls.ACTIVITY if unit.startswith("counts/") else cls.ATTENUATION


_SAME = 5e-3  # relative difference from pi/2, pi, 2 pi or 4 pi that counts as rounding: 3.15 and 6.3 are off by 0.3 %
# if a value is outside its range by more than this factor, and plausible in another unit, it is an error; if it is
# nearer, it is only a warning
_IMPOSSIBLE = 10.0


@dataclass(frozen=True)
class PlausibleRange:
    """The plausible range of a setting of an instrument. The sign is ignored, and 0 is always plausible.

    Attributes:
        others: units with which this unit is often confused, each with the factor that converts it to this unit.
    """

    low: float
    high: float
    unit: str
    others: Mapping[str, float]

    def holds(self, value: float, wider: float = 1.0) -> bool:
        """Whether the value is in the range, extended by the factor `wider` at both ends."""
        return value == 0 or self.low / wider <= abs(value) <= self.high * wider

    def plausible_as(self, value: float) -> dict[str, float]:
        """Plausible meanings of the value: for each other unit that it may have, the value converted to this unit."""
        return {unit: value * factor for unit, factor in self.others.items() if self.holds(value * factor)}


_MS, _COUNTS = {"ms": 1e-3, "us": 1e-6}, "counts of 0.001 degrees"
RANGES: Mapping[str, PlausibleRange] = MappingProxyType(
    {
        "pixel_size_um": PlausibleRange(0.01, 5000.0, "um", {"mm": 1e3, "nm": 1e-3, "m": 1e6}),
        **dict.fromkeys(("kev", "energy", "energies"), PlausibleRange(0.1, 600.0, "keV", {"eV": 1e-3, "MeV": 1e3})),
        "tolerance_ev": PlausibleRange(1e-3, 100.0, "eV", {"keV": 1e3, "meV": 1e-3}),
        "distance_mm": PlausibleRange(0.0, 2e4, "mm", {"um": 1e-3, "nm": 1e-6}),
        "mm": PlausibleRange(0.0, 500.0, "mm", {"um": 1e-3, "nm": 1e-6}),
        "um": PlausibleRange(1e-3, 1e5, "um", {"nm": 1e-3, "m": 1e6}),
        "nm": PlausibleRange(100.0, 2000.0, "nm", {"um": 1e3, "pm": 1e-3}),
        "mm_per_deg": PlausibleRange(1e-4, 100.0, "mm/deg", {"um/deg": 1e-3, "m/deg": 1e3}),
        **dict.fromkeys(("exposure_s", "period_s", "settle_s", "timeout_s"), PlausibleRange(1e-6, 600.0, "s", _MS)),
        "warm_up_s": PlausibleRange(0.0, 7200.0, "s", _MS), "cool_s": PlausibleRange(0.0, 7200.0, "s", _MS),
        "trigger_delay_s": PlausibleRange(0.0, 0.5, "s", _MS),
        # the same range as for exposures, if the level of a trigger sets the exposure
        "pulse_width_s": PlausibleRange(1e-8, 10.0, "s", _MS),
        "firmware_pulse_s": PlausibleRange(1e-8, 0.02, "s", _MS), "shortest_s": PlausibleRange(1e-8, 0.1, "s", _MS),
        "s": PlausibleRange(0.0, 3600.0, "s", _MS),
        "seconds": PlausibleRange(0.0, 2e5, "s", _MS),
        "deg": PlausibleRange(0.0, 1e5, "degrees", {_COUNTS: 1e-3, "arcseconds": 1 / 3600}),
        "deg_s": PlausibleRange(1e-6, 3600.0, "degrees/s", {f"{_COUNTS}/s": 1e-3}),
        "deg_s2": PlausibleRange(1e-6, 2e4, "degrees/s²", {f"{_COUNTS}/s²": 1e-3}),
        "counts_per_turn": PlausibleRange(100, 2e8, "counts", {}),
        "counts": PlausibleRange(0, 5000, "counts", {}),
        "views": PlausibleRange(1, 1e5, "views", {}), "count": PlausibleRange(1, 5000, "frames", {}),
        "mb": PlausibleRange(1, 5e5, "MB", {"kB": 1e-3, "bytes": 1e-6, "GB": 1e3}),
        "baudrate": PlausibleRange(110, 4e6, "baud", {}),
    }
)  # fmt: skip
"""Ranges by the name of a setting, or by the last words of its name, such as its unit. They include pixels of zone
plates and of medical scanners, energies from the carbon edge to tubes of 600 kV, the longest hutches, the longest
exposures at a storage ring, stages of ten turns per second, hundreds of turns, and motors and encoders of up to 27
bits."""


@cache
def range_of(name: str) -> PlausibleRange | None:
    """The range of a setting by its name, such as `scan.exposure_s`; None if its unit is not known."""
    words = name.rpartition(".")[2].split("_")
    ends = ("_".join(words[first:]) for first in range(1 if "per" in words else len(words)))
    return next((RANGES[end] for end in ends if end in RANGES), None)


def doubt(name: str, value: float | None) -> str:
    """A sentence on an implausible value, with the unit that may be meant. Empty if the value is plausible, or if the
    setting has no range."""
    known = range_of(name)
    if value is None or known is None or known.holds(value):
        return ""
    meant = [f"{each:.4g} {known.unit} ({value:.6g} {unit})" for unit, each in known.plausible_as(value).items()]
    factor = max(abs(value) / known.high, known.low / abs(value))
    suggestion = " Did you mean " + " or ".join(meant) + "?" if meant else ""
    return (
        f"{name} = {value:.6g} {known.unit} is outside the usual range of {known.low:g} to {known.high:g} "
        f"{known.unit}, by a factor of {factor:.2g}.{suggestion}"
    )


def is_impossible(name: str, value: float) -> bool:
    """Whether the value is far outside its range, and plausible in a unit that is often confused with its own."""
    known = range_of(name)
    return known is not None and not known.holds(value, _IMPOSSIBLE) and bool(known.plausible_as(value))


def doubt_span(span_deg: float) -> str:
    """A sentence on a range of angles that looks like radians (a quarter of a turn to two turns); empty for other
    ranges."""
    for turn in (math.pi / 2, math.pi, 2 * math.pi, 4 * math.pi):
        if abs(abs(span_deg) / turn - 1) < _SAME:
            suggestion = math.copysign(math.degrees(turn), span_deg)
            return (
                f"scan.angles: the range of {span_deg:g} degrees looks like a value in radians, which would be "
                f"{math.degrees(turn):.0f} degrees. Did you mean {suggestion:.0f}?"
            )
    return ""


def cone_facts(cone: tuple[float, float], pixel_mm: float, cols: int) -> dict[str, float]:
    """The consequences of the distances (mm) of a cone beam, from the source to the axis and to the detector:
    magnification, voxel size and fan angle."""
    return {
        "magnification": cone[1] / cone[0],
        "voxel_mm": pixel_mm * cone[0] / cone[1],
        "fan_deg": 2 * math.degrees(math.atan(cols * pixel_mm / 2 / cone[1])),
    }
