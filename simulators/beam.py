"""Beam: the light that meets the sample, and where it comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Beam:
    """A parallel beam, or a cone where the distances are given.

    Attributes:
        photons_per_s: detected a second by each (unbinned) sensor pixel where nothing stands in the way.
        sod: mm from the source to the rotation axis; None for a parallel beam.
        sdd: mm from the source to the detector.
    """

    photons_per_s: float
    sod: float | None = None
    sdd: float | None = None

    def __post_init__(self) -> None:
        if not self.photons_per_s >= 0:
            raise ValueError(f"photons_per_s must be >= 0, got {self.photons_per_s}")
        if (self.sod is None) != (self.sdd is None):
            raise ValueError("a cone needs both sod and sdd in mm; a parallel beam neither")
        if self.sod is not None and self.sdd is not None and not self.sdd >= self.sod > 0:
            raise ValueError(f"sod must be positive and sdd no less, got {self.sod} and {self.sdd} mm")

    @property
    def source_distance(self) -> float:
        """mm from the source to the rotation axis; infinite for a parallel beam."""
        return math.inf if self.sod is None else self.sod
