"""Dead pixels: a few sensor pixels hold the same charge whatever falls on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.frame.domain import Domain
from simulators.frame.shot import Image, Shot
from simulators.pixels.pattern import places


@dataclass(frozen=True)
class DeadPixels:
    """Pixels that stay where they are on the sensor; named after all that makes charge, and before the read noise,
    which they have like any other. A binned pixel loses the share of its dead ones.

    Attributes:
        fraction: of the sensor's pixels.
        charge: electrons that they hold: 0, or 7000 where they are stuck at full.
        seed: which pixels.
    """

    fraction: float = 1e-4
    charge: float = 0.0
    seed: int = 0

    name: ClassVar[str] = "dead_pixels"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not (0 <= self.fraction <= 0.1 and self.charge >= 0 and self.seed >= 0):
            raise ValueError(f"fraction must lie in 0 ... 0.1 and charge (electrons) and seed be >= 0, got {self}")

    def apply(self, image: Image, shot: Shot) -> Image:
        at, _ = places(self.name, self.seed, self.fraction, shot)
        pixels, times = np.unique(np.ravel_multi_index(at, image.shape), return_counts=True)
        flat = image.reshape(-1)
        flat[pixels] = flat[pixels] * (1 - times / shot.binning**2) + times * self.charge
        return image
