"""Quantum efficiency: the share of the arriving photons that the sensor detects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from drivers.orca_quest import QE_NM, LightPath, quantum_efficiency
from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import Share
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class QuantumEfficiency(ImageEffect):
    """Scales the expectation before the photon noise, which is exact: thinned Poisson is Poisson (Kingman 1993, ch. 5).

    A scene's beam.photons_per_s are then photons of the scintillator's light that arrive at the sensor; without this
    effect they are detected photons. LuAG:Ce emits at 535 nm, CsI:Tl at 550 nm (Crytur, scintillation materials).

    Attributes:
        value: 0 ... 1, or
        wavelength_nm: 300 ... 1000, for ORCA-Quest's curve, interpolated linearly, or
        path: the way from X-ray photons, of which photons_per_s then are; their noise is not that of light, see
        `photon_noise`.
    """

    value: Share | None = None
    wavelength_nm: Annotated[float, Field(ge=QE_NM[0], le=QE_NM[-1])] | None = None
    path: LightPath | None = None

    def __post_init__(self) -> None:
        if sum(each is not None for each in (self.value, self.wavelength_nm, self.path)) != 1:
            raise ValueError(f"give either value or wavelength_nm, or path, got {self}")

    @property
    def efficiency(self) -> float:
        """Photoelectrons a photon."""
        if self.path is not None:
            return self.path.absorbed * self.path.electrons
        if self.wavelength_nm is not None:
            return quantum_efficiency(self.wavelength_nm)
        assert self.value is not None
        return self.value

    def apply(self, image: Image, shot: Shot) -> Image:
        image *= self.efficiency
        return image
