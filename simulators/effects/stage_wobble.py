"""Stage wobble: the rotation axis tilts a little as the stage turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from simulators.effects.turn_waves import Wave, check, series
from simulators.frame.domain import Domain
from simulators.frame.pose import Pose
from simulators.frame.shot import Shot, draws


@dataclass(frozen=True)
class StageWobble:
    """Tilt error motion of an axis of rotation (ISO 230-7:2015): a part that comes back every turn, and a random one.

    Attributes:
        harmonics: tilt of the axis: waves a turn, microradians, phase in degrees. 0 waves: the axis leans always to the
            same side: turned about u at phase 0, about b at -90. 1 wave: it leans with the sample, and is then no more
            than a sample that stands askew. Others are the bearing's; a negative number goes round against the sample.
        random_urad: standard deviation of the rest about u and about b, drawn anew for each frame.
    """

    harmonics: tuple[Wave, ...] = ()
    random_urad: float = 0.0

    name: ClassVar[str] = "stage_wobble"
    domain: ClassVar[Domain] = Domain.MOTION
    final: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check("harmonics", self.harmonics)
        if not self.random_urad >= 0:
            raise ValueError(f"random_urad must be >= 0 microradians, got {self.random_urad}")

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        wave = series(pose.angle, self.harmonics)
        tilt = np.stack([wave.real, -wave.imag], axis=1)
        tilt += self.random_urad * draws(self.name, shot).normal(size=2)
        return pose.tilted_by(1e-6 * tilt)
