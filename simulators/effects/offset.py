"""Offset: the digital bias, so that the noise of a dark frame is not clipped at 0."""

from __future__ import annotations

from dataclasses import dataclass

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Whole
from simulators.frame.sensor import OFFSET
from simulators.frame.shot import Image, Shot
from simulators.pixels.pattern import binned, normals


@dataclass(frozen=True)
class Offset(ImageEffect):
    """The same for any binning (to check on a camera). The photon number readout has no offset.

    Attributes:
        spread: standard deviation between sensor pixels in counts (normal distribution), about 1 on an ORCA-Quest;
            the offsets of binned pixels add up.
        seed: of the pixels' offsets.
    """

    spread: NotNegative = 0.0
    seed: Whole = 0

    def apply(self, image: Image, shot: Shot) -> Image:
        image += OFFSET[shot.readout]
        if self.spread > 0 and shot.readout != "photon_number":
            pattern = binned(normals(self.name, self.seed, shot), shot.binning)
            pattern *= self.spread
            image += pattern
        return image
