"""Runout: the rotation axis moves as the stage turns, across the beam, along it, and vertically."""

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
class Runout(PoseEffect):
    """Radial and axial error motion (ISO 230-7:2015), synchronous (harmonics) and asynchronous (drawn for each frame).

    Attributes:
        radial: waves a turn, micrometres, phase in degrees, of the axis' motion across the beam and along it. 1 wave is
        equivalent to a sample beside the axis, 0 waves to an axis at another place. Other numbers come from the
        bearing. A negative number turns against the sample.
        axial: the same, vertically.
        radial_random_um: standard deviation of the random part across the beam, and along it.
        axial_random_um: of the random part, vertically.
    """

    radial: Waves = ()
    axial: Waves = ()
    radial_random_um: NotNegative = 0.0
    axial_random_um: NotNegative = 0.0

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        radial, axial = series(pose.angle, self.radial), series(pose.angle, self.axial)
        shift = np.stack([radial.real, -radial.imag, axial.real], axis=1)
        shift += frame_rng(self.name, shot).normal(0.0, 1.0, 3) * (
            self.radial_random_um,
            self.radial_random_um,
            self.axial_random_um,
        )
        return pose.shifted_by(1e-3 * shift)
