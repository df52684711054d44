"""Read noise: noise of the readout, by the camera's mode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.sensor import READ_NOISE
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

    rms: float | None = None
    spread: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rms is not None and not self.rms >= 0:
            raise ValueError(f"rms must be >= 0 electrons, got {self.rms}")
        if not (0 <= self.spread <= 2 and self.seed >= 0):
            raise ValueError(f"spread must lie in 0 ... 2 and seed be >= 0, got {self.spread} and {self.seed}")

    def apply(self, image: Image, shot: Shot) -> Image:
        rms = READ_NOISE[shot.readout] if self.rms is None else self.rms
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
