"""Sensor: values of the ORCA-Quest, and the conversion of electrons to counts.

The photons of a beam are detected photons, so that each photon gives one electron, unless a scene names the quantum
efficiency. The 16-bit converter clips at 65 535 counts. This is 6991 electrons above the offset, just below a full well
of 7000 electrons. Binning is digital: charge and noise of the summed pixels add up.

Photon number resolving is a readout of the camera and needs no effect. A count is an electron and there is no offset,
so that `digitise` gives round(max(electrons, 0)). To check on a camera: that it subtracts the offset of each pixel,
reads with the noise of ultra quiet and counts to about 200. Here a binned pixel is rounded once, after its sum. The
camera rounds each pixel first, so its noise is slightly lower.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from drivers.orca_quest import BITS, MODEL

CONVERSION = MappingProxyType({"standard": 0.107, "ultra_quiet": 0.107, "photon_number": 1.0})
"""Number of electrons per count in each readout."""
OFFSET = MappingProxyType({"standard": 200.0, "ultra_quiet": 200.0, "photon_number": 0.0})
"""Counts of a pixel without charge in each readout."""
READ_NOISE = MappingProxyType({"standard": 0.43, "ultra_quiet": 0.27, "photon_number": 0.27})
"""Rms noise in electrons in each readout."""
LARGEST_PHOTON_NUMBER = 200  # Values of an unbinned pixel
READ_NOISES = MappingProxyType(
    {MODEL: READ_NOISE, "C15550-22UP": READ_NOISE | {"ultra_quiet": 0.3, "photon_number": 0.3}}
)
"""For each model. The value of the C15550-22UP in photon number resolving is assumed to be equal to the value in ultra
quiet."""
DARK_CURRENT = 0.0036
"""Electrons per second and pixel, measured on two C15550-20UP.

The largest value in the catalogue of C15550-22UP is 0.016 (air).
"""
FULL_WELL = 7000.0  # full well: largest number of electrons in a pixel


def largest_count(readout: str, binning: int) -> int:
    """Largest count of the converter."""
    whole = 2**BITS - 1
    return min(LARGEST_PHOTON_NUMBER * binning**2, whole) if readout == "photon_number" else whole


def digitise(counts: NDArray[np.float64], largest: int = 2**BITS - 1) -> NDArray[np.uint16]:
    """Round to whole counts and clip to the converter's range; `counts` is overwritten."""
    np.rint(counts, out=counts)
    return np.clip(counts, 0, largest, out=counts).astype(np.uint16)
