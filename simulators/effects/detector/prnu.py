"""PRNU, photo response non-uniformity: pixels differ in the share of the light that they detect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import Whole
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

    spread: Annotated[float, Field(ge=0, le=0.2)] = 0.01
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        gain = binned(normals(self.name, self.seed, shot), shot.binning)
        gain *= self.spread / shot.binning**2
        gain += 1.0
        np.maximum(gain, 0.0, out=gain)
        gain *= image
        return gain
