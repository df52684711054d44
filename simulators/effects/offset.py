"""Offset: the digital bias, which keeps the noise of a dark frame from being cut off at 0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot
from simulators.sensor import OFFSET


@dataclass(frozen=True)
class Offset:
    """The same for every pixel, whatever is binned (to check on a camera)."""

    name: ClassVar[str] = "offset"
    domain: ClassVar[Domain] = Domain.COUNTS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        image += OFFSET
        return image
