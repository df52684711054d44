"""Rolling shutter: pairs of rows are exposed one after the other, so that lower rows see the sample turned further."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.effects.chain import SamplingEffect
from simulators.frame.shot import Moments, Shot


@dataclass(frozen=True)
class RollingShutter(SamplingEffect):
    """Sensor rows are read in pairs, one pair a line time, downwards from the frame's first row.

    A line time is two row periods of the sensor: 7.2 us in the standard readout and 172.8 us in ultra quiet (property
    table of the C15550-20UP). A binned row begins with its first line. Every row is exposed for the same time from its
    own start, as with an edge trigger that opens the rows one after the other. Modes that expose all rows together
    are not simulated: DELAYED, which waits for light until the last row is open, and GLOBALRESET, which opens
    all rows together and closes them line by line.
    """

    def moments(self, moments: Moments, shot: Shot) -> Moments:
        lines = np.arange(moments.times.shape[1]) * shot.binning // 2
        return Moments(moments.times + lines * (2 * shot.row_period / shot.binning), moments.weights)
