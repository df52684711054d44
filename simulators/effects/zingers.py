"""Zingers: stray X-rays that hit the sensor itself and leave a bright pixel in one frame only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot, draws


@dataclass(frozen=True)
class Zingers:
    """Single bright pixels at random places.

    Attributes:
        rate: mean number a second in the frame.
        charge: mean electrons of one (exponentially distributed).
    """

    rate: float
    charge: float = 3000.0

    name: ClassVar[str] = "zingers"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not (self.rate >= 0 and self.charge > 0):
            raise ValueError(f"rate must be >= 0 a second and charge positive, got {self}")

    def apply(self, image: Image, shot: Shot) -> Image:
        rng = draws(self.name, shot)
        n = int(rng.poisson(self.rate * shot.exposure))
        np.add.at(image.reshape(-1), rng.integers(image.size, size=n), rng.exponential(self.charge, n))
        return image
