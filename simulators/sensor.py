"""Sensor: detected photons become electrons, electrons become counts, each with its noise; ORCA-Quest's figures.

Photons are counted after the quantum efficiency, so that one photon is one electron. The 16-bit converter clips at
65 535 counts = 6991 electrons over the offset, just below the full well of 7000 electrons, which therefore never shows.
Binning is digital: charge and noise of the summed pixels add up; the offset is taken to stay (to check on a camera).
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from drivers.orca_quest import BITS
from simulators.effects.chain import Domain, Image, Shot

CONVERSION = 0.107
"""Electrons a count."""
OFFSET = 200.0
"""Counts of a pixel without charge."""
READ_NOISE = MappingProxyType({"standard": 0.43, "ultra_quiet": 0.27})
"""Electrons rms."""
DARK_CURRENT = 0.0036
"""Electrons a pixel and second."""


@dataclass(frozen=True)
class PhotonNoise:
    """Photons arrive at random: Poisson around their expectation."""

    name: ClassVar[str] = "photon_noise"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = True

    def apply(self, image: Image, shot: Shot) -> Image:
        return shot.rng.poisson(image).astype(np.float64)


@dataclass(frozen=True)
class DarkCurrent:
    """Electrons without light: Poisson around the dark current times the exposure."""

    name: ClassVar[str] = "dark_current"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        return image + shot.rng.poisson(DARK_CURRENT * shot.exposure * shot.binning**2, image.shape)


@dataclass(frozen=True)
class ReadNoise:
    """Gaussian noise of the readout, as the camera's readout mode has it."""

    name: ClassVar[str] = "read_noise"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        return image + shot.rng.normal(0.0, shot.read_noise * shot.binning, image.shape)


@dataclass(frozen=True)
class Offset:
    """The digital bias, which keeps the noise of a dark frame from being cut off at 0."""

    name: ClassVar[str] = "offset"
    domain: ClassVar[Domain] = Domain.COUNTS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        return image + OFFSET


def digitise(counts: Image) -> NDArray[np.uint16]:
    """Round to whole counts and clip to what the converter has."""
    return np.rint(counts).clip(0, 2**BITS - 1).astype(np.uint16)
