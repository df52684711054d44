"""Dark current: electrons that arise without light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative
from simulators.frame.sensor import DARK_CURRENT
from simulators.frame.shot import Image, Shot, frame_rng
from simulators.pixels.noise import poisson

FEW = 1.0  # Electrons a pixel: below this, placing single electrons is faster than drawing a number for every pixel


@dataclass(frozen=True)
class DarkCurrent(ImageEffect):
    """Poisson around the dark current times the exposure.

    A few electrons are placed over the frame: their number is Poisson and each pixel is equally likely. This makes
    every pixel's number Poisson and independent of the others' (Kingman 1993, "Poisson Processes", sec. 5.1).

    Attributes:
        rate: electrons a second and sensor pixel.
    """

    rate: NotNegative = DARK_CURRENT

    def apply(self, image: Image, shot: Shot) -> Image:
        rng = frame_rng(self.name, shot)
        mean = self.rate * shot.exposure * shot.binning**2
        if mean < FEW:
            falls = rng.integers(image.size, size=rng.poisson(mean * image.size))
            np.add.at(image.reshape(-1), falls, 1.0)
        else:
            image += poisson(np.full(image.shape, mean), rng)
        return image
