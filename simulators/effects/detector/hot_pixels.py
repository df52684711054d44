"""Hot pixels: a few sensor pixels with a far larger dark current than the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import Whole
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

    fraction: Annotated[float, Field(ge=0, le=0.1)] = 1e-4
    rate: Annotated[float, Field(ge=0, le=1e9)] = 2000.0
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        at, even = places(self.name, self.seed, self.fraction, shot)
        rates = -self.rate * np.log1p(-even)
        np.add.at(image, at, frame_rng(self.name, shot).poisson(rates * shot.exposure))
        return image
