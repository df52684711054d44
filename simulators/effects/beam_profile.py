"""Beam profile: the beam is bright in the middle and striped across, so that a flat is not flat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot


@dataclass(frozen=True)
class BeamProfile:
    """A Gaussian of 1 at u = v = 0 times horizontal stripes, as a multilayer monochromator leaves them.

    Attributes:
        sigma: (horizontal, vertical) in mm.
        stripes: amplitude of the stripes, as a share of the beam.
        stripe_period: mm, vertically.
        drift: mm/s by which the stripes move up; what makes flats age.
    """

    sigma: tuple[float, float]
    stripes: float = 0.0
    stripe_period: float = 0.1
    drift: float = 0.0

    name: ClassVar[str] = "beam_profile"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not (min(self.sigma) > 0 and 0 <= self.stripes < 1 and self.stripe_period > 0):
            raise ValueError(f"sigma and stripe_period must be positive and stripes in 0 ... 1 (excluded), got {self}")

    def apply(self, image: Image, shot: Shot) -> Image:
        u, v = shot.detector.u(), shot.detector.v()
        across = np.exp(-0.5 * (u / self.sigma[0]) ** 2)
        phase = 2 * np.pi * (v - self.drift * shot.elapsed) / self.stripe_period
        down = np.exp(-0.5 * (v / self.sigma[1]) ** 2) * (1 + self.stripes * np.sin(phase))
        return image * down[:, None] * across
