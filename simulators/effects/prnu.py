"""PRNU, photo response non-uniformity: pixels differ in the share of the light that they detect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.shot import Image, Shot
from simulators.pixels.pattern import binned, normals


@dataclass(frozen=True)
class Prnu(ImageEffect):
    """The expected light times 1 + spread * a normal number of the sensor pixel, not below 0.

    It acts on the light, so that the photon noise stays Poisson. Name it after all effects that blur light.

    Attributes:
        spread: standard deviation as a share of the light; 1 % is typical of sensors (Janesick 2007, "Photon
            transfer"), and assumed here: ORCA-Quest's is not published.
        seed: of the pixels' responses.
    """

    spread: float = 0.01
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0 <= self.spread <= 0.2 and self.seed >= 0):
            raise ValueError(f"spread must lie in 0 ... 0.2 and seed be >= 0, got {self.spread} and {self.seed}")

    def apply(self, image: Image, shot: Shot) -> Image:
        gain = binned(normals(self.name, self.seed, shot), shot.binning)
        gain *= self.spread / shot.binning**2
        gain += 1.0
        np.maximum(gain, 0.0, out=gain)
        gain *= image
        return gain
