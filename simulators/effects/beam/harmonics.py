"""Harmonics: the monochromator also transmits a share of photons of three times the energy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import Share
from simulators.frame.shot import Image, Shot

PHOTOELECTRIC = 3.0**-3  # Attenuation at three times the energy over that at the energy itself


@dataclass(frozen=True)
class Harmonics(ImageEffect):
    """exp(-d') = (1 - share) exp(-d) + share exp(-ratio d), for a sample given by its attenuation.

    A crystal that reflects E from its planes (111) reflects 3E from (333). Photoelectric absorption falls as E^-3
    between edges (Als-Nielsen & McMorrow 2011, Elements of Modern X-ray Physics, ch. 1.3), hence the ratio of 1/27.
    For a sample of materials give the beam its harmonics instead: then each material has its true attenuation at both.

    Attributes:
        share: of the detected photons of the open beam, 0 ... 1.
        ratio: of the two attenuations, 0 ... 1.
    """

    share: Share
    ratio: Share = PHOTOELECTRIC

    def apply(self, image: Image, shot: Shot) -> Image:
        if self.share == 0:
            return image
        # The harmonic's exponential is factored out of the sum, so that large depths do not underflow.
        light = np.exp((self.ratio - 1) * image)
        light *= 1 - self.share
        light += self.share
        image *= self.ratio
        image -= np.log(light, out=light)
        return image
