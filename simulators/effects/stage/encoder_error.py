"""Encoder error: the stage's angle differs from its encoder's reading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.effects.chain import PoseEffect
from simulators.effects.stage.turn_waves import Waves, series
from simulators.frame.mapping import NotNegative
from simulators.frame.pose import Pose
from simulators.frame.shot import Shot, frame_rng


@dataclass(frozen=True)
class EncoderError(PoseEffect):
    """Angular positioning error: the sample is at the angle of the trigger plus the error.

    Attributes:
        harmonics: waves a turn, millidegrees, phase in degrees. An eccentric grating gives 1 wave, a gear one per
        tooth, and interpolation between an encoder's lines one per line.
        random_mdeg: standard deviation of the random part, drawn for each frame.
    """

    harmonics: Waves = ()
    random_mdeg: NotNegative = 0.0

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        error = series(pose.angle, self.harmonics).real + self.random_mdeg * frame_rng(self.name, shot).normal()
        return pose.turned_by(np.radians(1e-3 * error))
