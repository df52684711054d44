"""Black band: a slit shadows a band at the left side of the frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.effects.anomaly import Label, Views, lit_share, within
from simulators.effects.chain import Anomaly, ImageEffect
from simulators.frame.mapping import BelowOne, NotNegative, Positive
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class BlackBand(ImageEffect, Anomaly):
    """The band's edge is soft by the penumbra of the source; flats have the band too.

    Attributes:
        width: mm from the left edge of the frame, for any ROI, to half of the light.
        penumbra: mm over which the light rises from none to all.
        share: of the light that is left in the band.
        views: [first, one after the last] in which the slit is in the beam; None: all.
    """

    width: Positive
    penumbra: NotNegative = 0.0
    share: BelowOne = 0.0
    views: Views | None = None

    def apply(self, image: Image, shot: Shot) -> Image:
        if within(self.views, shot):
            light = self._light(shot)
            image[:, : light.size] *= light
        return image

    def labels(self, shot: Shot) -> Sequence[Label]:
        cols = self._light(shot).size if shot.beam and within(self.views, shot) else 0
        return [Label(self.name, (0, shot.detector.shape[0], 0, cols))] if cols else []

    def _light(self, shot: Shot) -> NDArray[np.float64]:
        """Share of the light in each column of the band."""
        from_left = (np.arange(shot.detector.shape[1], dtype=np.float64) + 0.5) * shot.detector.pitch
        light = self.share + (1 - self.share) * lit_share(from_left - self.width, self.penumbra)
        return light[light < 1]
