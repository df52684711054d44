"""Rolling shutter: rows are exposed in pairs, each a little later than the one above, and see the sample further on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simulators.frame.domain import Domain
from simulators.frame.shot import Moments, Shot


@dataclass(frozen=True)
class RollingShutter:
    """Sensor rows are read in pairs, one pair a line time, downwards from the frame's first row.

    A line time is two row periods of the sensor: 7.2 us in the standard readout and 172.8 us in ultra quiet (property
    table of the C15550-20UP). A binned row begins with its first line. Every row is exposed as long as the others,
    from its own start, as with an edge trigger that opens the rows one after the other; the modes in which all rows
    look at once are not simulated: DELAYED, which waits for light until the last row is open, and GLOBALRESET, which
    opens all rows together and closes them line by line.
    """

    name: ClassVar[str] = "rolling_shutter"
    domain: ClassVar[Domain] = Domain.MOTION
    final: ClassVar[bool] = False

    def moments(self, moments: Moments, shot: Shot) -> Moments:
        lines = np.arange(moments.times.shape[1]) * shot.binning // 2
        return Moments(moments.times + lines * (2 * shot.row_period / shot.binning), moments.weights)
