"""Rolling shutter: each row is exposed a little later than the one above and sees the sample turned further."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.effects.domain import Domain
from simulators.effects.shot import Moments, Shot


@dataclass(frozen=True)
class RollingShutter:
    """Row r starts r row periods after row 0; the camera says how long a row period is."""

    name: ClassVar[str] = "rolling_shutter"
    domain: ClassVar[Domain] = Domain.MOTION
    final: ClassVar[bool] = False

    def moments(self, moments: Moments, shot: Shot) -> Moments:
        return Moments(moments.times + np.arange(moments.times.shape[1]) * shot.row_period, moments.weights)
