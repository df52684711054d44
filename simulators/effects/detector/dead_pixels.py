"""Dead pixels: a few sensor pixels hold a constant charge and do not respond to light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Whole
from simulators.frame.shot import Image, Shot
from simulators.pixels.pattern import places


@dataclass(frozen=True)
class DeadPixels(ImageEffect):
    """The same pixels of the sensor in every frame. Name it after all effects that add charge and before the read
    noise, which dead pixels have like others. A binned pixel loses the share of its dead ones.

    Attributes:
        fraction: of the sensor's pixels.
        charge: electrons that they hold: 0, or 7000 for pixels that are stuck at the full well.
        seed: of their places.
    """

    fraction: Annotated[float, Field(ge=0, le=0.1)] = 1e-4
    charge: NotNegative = 0.0
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        at, _ = places(self.name, self.seed, self.fraction, shot)
        pixels, times = np.unique(np.ravel_multi_index(at, image.shape), return_counts=True)
        flat = image.reshape(-1)
        flat[pixels] = flat[pixels] * (1 - times / shot.binning**2) + times * self.charge
        return image
