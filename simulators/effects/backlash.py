"""Backlash: after the stage has turned backwards the sample lags behind by the lost motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from simulators.frame.domain import Domain
from simulators.frame.pose import Pose
from simulators.frame.shot import AngleAt, Shot

STILL = 1e-9
"""Radians: less is no motion."""
LOOK = 1e-3
"""s before the frame at which the stage is first asked for, and to which the end of its last move is found."""
HISTORY = 3600.0
"""s before the frame up to which a move is looked for."""


@dataclass(frozen=True)
class Backlash:
    """Lost motion of a gear (ISO 230-2:2014, reversal value) between the encoder, on the motor's side, and the sample.

    The stage's angles hold where it turns forwards (angles grow). Backwards the other flanks of the teeth push, and the
    sample stands `lost_motion_deg` further than the stage says. Where the stage stands, its last move decides; where it
    has not moved within an hour, it counts as having come forwards. How the lost motion itself is taken up, at the
    beginning of a move, is not followed: a scan's first view is beyond it.
    """

    lost_motion_deg: float

    name: ClassVar[str] = "backlash"
    domain: ClassVar[Domain] = Domain.MOTION
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not self.lost_motion_deg > 0:
            raise ValueError(f"lost_motion_deg must be positive, got {self.lost_motion_deg}")

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        if came_forwards(shot.angle_at, shot.time + float(times[0])):
            return pose
        return pose.turned_by(math.radians(self.lost_motion_deg))


def came_forwards(angle_at: AngleAt, time: float) -> bool:
    """Whether the stage turns forwards at `time` (s), or did so last before it."""
    here = angle_at(time)

    def elsewhere(ago: float) -> bool:
        return abs(angle_at(time - ago) - here) > STILL

    ago = LOOK
    while not elsewhere(ago):
        if ago > HISTORY:
            return True
        ago *= 2
    stood = ago / 2 if ago > LOOK else 0.0
    while ago - stood > LOOK:  # an earlier look may have met another move than the last
        middle = (stood + ago) / 2
        stood, ago = (stood, middle) if elsewhere(middle) else (middle, ago)
    return angle_at(time - ago) < here
