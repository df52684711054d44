"""Backlash: after turning backwards the stage lags behind its encoder by the lost motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.effects.chain import PoseEffect
from simulators.frame.mapping import Positive
from simulators.frame.pose import Pose
from simulators.frame.shot import AngleAt, Shot

STILL = 1e-9  # Radians below which the stage does not move
LOOK = 1e-3  # s: first step back in time; also the precision of the end of the last move
HISTORY = 3600.0  # s before the frame; an earlier move is not looked for


@dataclass(frozen=True)
class Backlash(PoseEffect):
    """Lost motion of a gear (ISO 230-2:2014, reversal value) between the encoder, on the motor's side, and the sample.

    While the stage turns forwards (angles grow) its angles hold. Backwards the other flanks of the teeth push, and the
    sample is `lost_motion_deg` ahead of the stage's angle. For a standing stage its last move decides; without a move
    within an hour, forwards is assumed. The lost motion at the beginning of a move is not simulated: a scan's first
    view comes after it.

    Attributes:
        lost_motion_deg: degrees by which the sample is ahead while the stage turns backwards.
    """

    lost_motion_deg: Positive

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        if came_forwards(shot.angle_at, shot.time + float(times[0])):
            return pose
        return pose.turned_by(math.radians(self.lost_motion_deg))


def came_forwards(angle_at: AngleAt, time: float) -> bool:
    """Whether the stage turns forwards at `time` (s), or did so in its last move before."""
    here = angle_at(time)

    def elsewhere(ago: float) -> bool:
        return abs(angle_at(time - ago) - here) > STILL

    ago = LOOK
    while not elsewhere(ago):
        if ago > HISTORY:
            return True
        ago *= 2
    stood = ago / 2 if ago > LOOK else 0.0
    while ago - stood > LOOK:  # the step back may have skipped the last move
        middle = (stood + ago) / 2
        stood, ago = (stood, middle) if elsewhere(middle) else (middle, ago)
    return angle_at(time - ago) < here
