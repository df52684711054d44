"""Read noise: noise of the readout, by the camera's mode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Whole
from simulators.frame.sensor import READ_NOISES
from simulators.frame.shot import Image, Shot, frame_rng
from simulators.pixels.noise import add_normal
from simulators.pixels.pattern import binned, normals


@dataclass(frozen=True)
class ReadNoise(ImageEffect):
    """Gaussian. Binned pixels are read one by one, so that their variances add up.

    Attributes:
        rms: electrons of a sensor pixel, in place of the readout's.
        spread: between pixels: standard deviation of ln(rms of a pixel); the median is rms.
        seed: of the pixels' noise.
    """

    rms: NotNegative | None = None
    spread: Annotated[float, Field(ge=0, le=2)] = 0.0
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        rms = READ_NOISES[shot.model][shot.readout] if self.rms is None else self.rms
        add_normal(image, rms * self._spreads(shot), frame_rng(self.name, shot))
        return image

    def _spreads(self, shot: Shot) -> Image | float:
        """Noise of each frame pixel over that of a typical sensor pixel."""
        if self.spread == 0:
            return shot.binning
        pixels = normals(self.name, self.seed, shot)
        pixels *= self.spread * (1 if shot.binning == 1 else 2)
        np.exp(pixels, out=pixels)
        return pixels if shot.binning == 1 else np.sqrt(binned(pixels, shot.binning))
