"""Hot pixels: a few sensor pixels with a far larger dark current than the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.shot import Image, Shot, frame_rng
from simulators.pixels.pattern import places


@dataclass(frozen=True)
class HotPixels(ImageEffect):
    """The same pixels of the sensor in every frame, for any ROI.

    Attributes:
        fraction: of the sensor's pixels.
        rate: mean of their dark currents (exponentially distributed), electrons/s.
        seed: of their places and dark currents.
    """

    fraction: float = 1e-4
    rate: float = 2000.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0 <= self.fraction <= 0.1 and 0 <= self.rate <= 1e9 and self.seed >= 0):
            raise ValueError(
                f"fraction must lie in 0 ... 0.1, rate (electrons/s) in 0 ... 1e9 and seed be >= 0, got {self}"
            )

    def apply(self, image: Image, shot: Shot) -> Image:
        at, even = places(self.name, self.seed, self.fraction, shot)
        rates = -self.rate * np.log1p(-even)
        np.add.at(image, at, frame_rng(self.name, shot).poisson(rates * shot.exposure))
        return image
