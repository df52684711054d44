"""Quantum efficiency: the share of the arriving photons that the sensor detects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import Share
from simulators.frame.shot import Image, Shot

NM = (300, 350, 400, 425, 450, 475, 500, 550, 600, 650, 700, 750, 800, 850, 900, 950, 1000)
EFFICIENCY = (0.50, 0.66, 0.80, 0.83, 0.85, 0.83, 0.80, 0.70, 0.62, 0.55, 0.50, 0.46, 0.40, 0.33, 0.30, 0.20, 0.09)
"""ORCA-Quest 2 at NM, read off the catalogue's figure: 600 to 800 nm may be 0.1 to 0.15 too low."""


@dataclass(frozen=True)
class QuantumEfficiency(ImageEffect):
    """Scales the expectation before the photon noise, which is exact: thinned Poisson is Poisson (Kingman 1993, ch. 5).

    A scene's beam.photons_per_s are then photons of the scintillator's light that arrive at the sensor; without this
    effect they are detected photons. LuAG:Ce emits at 535 nm, CsI:Tl at 550 nm (Crytur, scintillation materials).

    Attributes:
        value: 0 ... 1, or
        wavelength_nm: 300 ... 1000, for ORCA-Quest's curve, interpolated linearly.
    """

    value: Share | None = None
    wavelength_nm: Annotated[float, Field(ge=NM[0], le=NM[-1])] | None = None

    def __post_init__(self) -> None:
        if (self.value is None) == (self.wavelength_nm is None):
            raise ValueError(f"give either value or wavelength_nm, got {self}")

    @property
    def efficiency(self) -> float:
        """Detected share of the photons."""
        if self.wavelength_nm is not None:
            return float(np.interp(self.wavelength_nm, NM, EFFICIENCY))
        assert self.value is not None
        return self.value

    def apply(self, image: Image, shot: Shot) -> Image:
        image *= self.efficiency
        return image
