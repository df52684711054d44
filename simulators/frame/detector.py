"""Detector: the rays of a frame in a parallel beam or a cone."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from drivers.orca_quest import BITS, MODEL


@dataclass(frozen=True)
class Detector:
    """Pixel (j, i) has the ray through u = (i - axis_col) * pitch, v = (j - axis_row) * pitch.

    Attributes:
        shape: (rows, cols).
        pitch: mm at the sample: in the plane of the rotation axis, for any magnification.
        axis_col: column of the rotation axis, 0 at the centre of the first column.
        axis_row: row of z = 0 (of the source's height in a cone), 0 at the centre of the first row.
        sod: mm from the source to the rotation axis; infinite for a parallel beam.
    """

    shape: tuple[int, int]
    pitch: float
    axis_col: float
    axis_row: float
    sod: float = math.inf

    def __post_init__(self) -> None:
        if not self.sod > 0:
            raise ValueError(f"sod must be positive in mm (infinite for a parallel beam), got {self.sod}")

    @classmethod
    def centred(cls, shape: tuple[int, int], pitch: float, sod: float = math.inf) -> Detector:
        """Rotation axis and z = 0 in the middle of the frame."""
        return cls(shape, pitch, (shape[1] - 1) / 2, (shape[0] - 1) / 2, sod)

    def aimed(self, row: float, col: float) -> Detector:
        """The rays at this offset, in pixels, from the rays through the pixels' middles."""
        return replace(self, axis_col=self.axis_col - col, axis_row=self.axis_row - row)

    def u(self) -> NDArray[np.float64]:
        return (np.arange(self.shape[1], dtype=np.float64) - self.axis_col) * self.pitch

    def v(self) -> NDArray[np.float64]:
        return (np.arange(self.shape[0], dtype=np.float64) - self.axis_row) * self.pitch


CONVERSION = MappingProxyType({"standard": 0.107, "ultra_quiet": 0.107, "photon_number": 1.0})
"""Electrons a count in each readout."""
OFFSET = MappingProxyType({"standard": 200.0, "ultra_quiet": 200.0, "photon_number": 0.0})
"""Counts of a pixel without charge in each readout."""
READ_NOISE = MappingProxyType({"standard": 0.43, "ultra_quiet": 0.27, "photon_number": 0.27})
"""Electrons rms in each readout."""
LARGEST_PHOTON_NUMBER = 200  # Values of an unbinned pixel
READ_NOISES = MappingProxyType(
    {MODEL: READ_NOISE, "C15550-22UP": READ_NOISE | {"ultra_quiet": 0.3, "photon_number": 0.3}}
)
"""By model; that of C15550-22UP in photon number resolving is taken as in ultra quiet."""
DARK_CURRENT = 0.0036
"""Electrons a second and pixel, as measured on two C15550-20UP; the catalogue's most of C15550-22UP is 0.016 (air)."""
FULL_WELL = 7000.0  # Electrons that a pixel holds


def largest_count(readout: str, binning: int) -> int:
    """Largest count of the converter."""
    whole = 2**BITS - 1
    return min(LARGEST_PHOTON_NUMBER * binning**2, whole) if readout == "photon_number" else whole


def digitise(counts: NDArray[np.float64], largest: int = 2**BITS - 1) -> NDArray[np.uint16]:
    """Round to whole counts and clip to the converter's range; `counts` is overwritten."""
    np.rint(counts, out=counts)
    return np.clip(counts, 0, largest, out=counts).astype(np.uint16)
