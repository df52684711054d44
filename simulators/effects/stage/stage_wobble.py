"""Stage wobble: the rotation axis tilts slightly as the stage turns."""

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
class StageWobble(PoseEffect):
    """Tilt error motion of an axis of rotation (ISO 230-7:2015): a part that repeats every turn, and a random part.

    Attributes:
        harmonics: tilt of the axis: waves a turn, microradians, phase in degrees. 0 waves: a constant tilt, about u at
            phase 0, about b at -90. 1 wave: the tilt turns with the sample, equivalent to a tilted sample. Other
            numbers come from the bearing; a negative number turns against the sample.
        random_urad: standard deviation of the random part about u and about b, drawn for each frame.
    """

    harmonics: Waves = ()
    random_urad: NotNegative = 0.0

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        wave = series(pose.angle, self.harmonics)
        tilt = np.stack([wave.real, -wave.imag], axis=1)
        tilt += self.random_urad * frame_rng(self.name, shot).normal(size=2)
        return pose.tilted_by(1e-6 * tilt)
