"""Sensor: ORCA-Quest's figures, and how electrons become counts.

A beam's photons are those detected, so that one photon is one electron, unless a scene names the quantum efficiency.
The 16-bit converter clips at 65 535 counts = 6991 electrons over the offset, just below a full well of 7000 electrons.
Binning is digital: charge and noise of the summed pixels add up.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from drivers.orca_quest import BITS

CONVERSION = MappingProxyType({"standard": 0.107, "ultra_quiet": 0.107})
"""Electrons a count in each readout."""
OFFSET = 200.0
"""Counts of a pixel without charge."""
READ_NOISE = MappingProxyType({"standard": 0.43, "ultra_quiet": 0.27})
"""Electrons rms in each readout."""
DARK_CURRENT = 0.0036
"""Electrons a second and pixel."""


def digitise(counts: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Round to whole counts and clip to what the converter has; `counts` is written over."""
    np.rint(counts, out=counts)
    return np.clip(counts, 0, 2**BITS - 1, out=counts).astype(np.uint16)
