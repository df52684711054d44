"""Motion blur: the sample turns while a frame is exposed, so that the frame is the mean over the exposure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.domain import Domain
from simulators.effects.shot import Moments, Shot


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

    def moments(self, moments: Moments, shot: Shot) -> Moments:
        within = (np.arange(self.samples) + 0.5) / self.samples * shot.exposure
        times = (within[:, None, None] + moments.times).reshape(-1, moments.times.shape[1])
        return Moments(times, np.tile(moments.weights / self.samples, self.samples))
