"""Beam bend: the open beam of the views differs from the flats: it bends, and drifts with time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class BeamBend(ImageEffect):
    """With the sample in the beam, -log of each ray's light changes by level + drift t + Σ curvature x².

    x is the distance from the middle of the frame, horizontally and vertically, 1 at its edges; t in s since the camera
    was connected. Flats and darks stay as they are. Negative: the views have more light than the flats predict.

    Attributes:
        curvature: (horizontal, vertical), at the edges of the frame.
        level: everywhere.
        drift: everywhere, 1/s.
    """

    curvature: tuple[float, float] = (0.0, 0.0)
    level: float = 0.0
    drift: float = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        if not shot.sample:
            return image
        down, across = ((2 * (np.arange(n) + 0.5) / n - 1) ** 2 for n in image.shape)
        image *= np.exp(-self.curvature[1] * down)[:, None]
        image *= np.exp(-self.curvature[0] * across - self.level - self.drift * shot.elapsed)
        return image
