"""An effect of the simulation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from simulators.effects.catalogue import Domain


@dataclass(frozen=True)
class Dimmed:
    """a share of the light is lost"""

    share: float = field(default=0.5)
    name: ClassVar[str] = "dimmed"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = False
    follows: ClassVar[tuple[str, ...]] = ("beam_profile",)

    def apply(self, image: NDArray[np.float32], shot: Any) -> NDArray[np.float32]:
        image *= 1 - self.share
        return image
