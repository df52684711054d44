"""Rolling shutter: each row is exposed a little later than the one above and sees the sample turned further."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from simulators.effects.chain import Domain, Shot


@dataclass(frozen=True)
class RollingShutter:
    """Row r starts r row periods after row 0; the camera says how long a row period is."""

    name: ClassVar[str] = "rolling_shutter"
    domain: ClassVar[Domain] = Domain.MOTION
    final: ClassVar[bool] = False

    def times(self, times: NDArray[np.float64], shot: Shot) -> NDArray[np.float64]:
        return times + np.arange(times.shape[1]) * shot.row_period
