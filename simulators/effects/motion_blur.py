"""Motion blur: the sample turns while a frame is exposed, so that the frame is the mean over the exposure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from simulators.effects.chain import Domain, Shot


@dataclass(frozen=True)
class MotionBlur:
    """Mean of the transmission at `samples` moments spread evenly over the exposure (midpoint rule)."""

    samples: int = 4

    name: ClassVar[str] = "motion_blur"
    domain: ClassVar[Domain] = Domain.MOTION
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.samples < 2:
            raise ValueError(f"samples must be >= 2 (a mean over the exposure), got {self.samples}")

    def times(self, times: NDArray[np.float64], shot: Shot) -> NDArray[np.float64]:
        moments = (np.arange(self.samples) + 0.5) / self.samples * shot.exposure
        return (moments[:, None, None] + times).reshape(-1, times.shape[1])
