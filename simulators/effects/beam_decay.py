"""Beam decay: the ring current falls between fills, and the beam with it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot


@dataclass(frozen=True)
class BeamDecay:
    """Exponential decay since the camera was connected; `lifetime` in s is the time to fall to 1/e."""

    lifetime: float

    name: ClassVar[str] = "beam_decay"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not self.lifetime > 0:
            raise ValueError(f"lifetime must be positive, got {self.lifetime} s")

    def apply(self, image: Image, shot: Shot) -> Image:
        return image * math.exp(-shot.elapsed / self.lifetime)
