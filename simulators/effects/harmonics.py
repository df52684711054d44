"""Harmonics: a share of the photons that the monochromator lets through at three times the energy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.frame.domain import Domain
from simulators.frame.shot import Image, Shot

PHOTOELECTRIC = 3.0**-3
"""Attenuation at three times the energy over that at the energy itself."""


@dataclass(frozen=True)
class Harmonics:
    """exp(-d') = (1 - share) exp(-d) + share exp(-ratio d), for a sample that is given by its attenuation alone.

    A crystal that reflects E from its planes (111) reflects 3E from (333). Photoelectric absorption falls as E^-3
    between edges (Als-Nielsen & McMorrow 2011, Elements of Modern X-ray Physics, ch. 1.3), hence the ratio of 1/27.
    A sample of materials has its true attenuation at both energies in the beam's spectrum instead.

    Attributes:
        share: of the detected photons of the open beam, 0 ... 1.
        ratio: of the two attenuations, 0 ... 1.
    """

    share: float
    ratio: float = PHOTOELECTRIC

    name: ClassVar[str] = "harmonics"
    domain: ClassVar[Domain] = Domain.OPTICAL_DEPTH
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not (0 <= self.share <= 1 and 0 <= self.ratio <= 1):
            raise ValueError(f"share and ratio must lie in 0 ... 1, got {self}")

    def apply(self, image: Image, shot: Shot) -> Image:
        if self.share == 0:
            return image
        # The harmonic's exponential is taken out of the sum, so that no depth is too large.
        seen = np.exp((self.ratio - 1) * image)
        seen *= 1 - self.share
        seen += self.share
        image *= self.ratio
        image -= np.log(seen, out=seen)
        return image
