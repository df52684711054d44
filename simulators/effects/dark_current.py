"""Dark current: electrons without light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.domain import Domain
from simulators.effects.shot import Image, Shot, draws
from simulators.sensor import DARK_CURRENT


@dataclass(frozen=True)
class DarkCurrent:
    """Poisson around the dark current times the exposure."""

    name: ClassVar[str] = "dark_current"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        image += draws(self.name, shot).poisson(DARK_CURRENT * shot.exposure * shot.binning**2, image.shape)
        return image
