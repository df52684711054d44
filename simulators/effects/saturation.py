"""Saturation: a pixel holds no more than its full well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import Positive, Share
from simulators.frame.sensor import FULL_WELL
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class Saturation(ImageEffect):
    """Charge x is clipped at the full well W; with a knee, charge above x0 = (1 - knee) W becomes
    x0 + (W - x0) (1 - exp(-(x - x0) / (W - x0))). This bends smoothly and stays below the full well.

    Name it after all effects that add charge and before the read noise. Binned pixels share their light evenly.

    Attributes:
        full_well: electrons of a sensor pixel.
        knee: share of the full well over which the response bends.
    """

    full_well: Positive = FULL_WELL
    knee: Share = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        well = self.full_well * shot.binning**2
        bend = self.knee * well
        if bend > 0:
            above = image > well - bend
            image[above] = well - bend - bend * np.expm1(-(image[above] - (well - bend)) / bend)
        return np.minimum(image, well, out=image)
