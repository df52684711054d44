"""Jump: the sample slips on the stage once and stays at its new place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.effects.anomaly import Label
from simulators.effects.chain import Anomaly, PoseEffect
from simulators.frame.mapping import Whole
from simulators.frame.pose import Pose
from simulators.frame.shot import Shot

SEEN_PX = 0.01  # Smallest shift in pixels that is labelled; a shift along the beam is invisible


@dataclass(frozen=True)
class Jump(PoseEffect, Anomaly):
    """From view `view` on the sample is at another place on the stage: first turned, then shifted.

    All views from the jump on are labelled, because the jump changes them. Errors of the stage precede the jump in a
    scene: they depend on the stage's angle, not on the sample's.

    Attributes:
        view: the first after the jump.
        shift_um: micrometres along x, y (which turn with the stage) and z (along the axis).
        turn_deg: degrees about the axis, in the sense in which angles grow.
    """

    view: Whole
    shift_um: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0

    def __post_init__(self) -> None:
        if not (any(self.shift_um) or self.turn_deg):
            raise ValueError("shift_um or turn_deg must be other than 0")

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        if shot.view < self.view:
            return pose
        return pose.turned_by(math.radians(self.turn_deg)).shifted_by(self._shift(pose.angle))

    def labels(self, shot: Shot) -> Sequence[Label]:
        """All rows of the columns that the sample can reach; its height is not known here."""
        if not (shot.beam and shot.sample and shot.view >= self.view):
            return []
        detector = shot.detector
        u, _, v = self._shift(np.array([shot.angle]))[0]
        if math.isinf(detector.sod) and not self.turn_deg and math.hypot(u, v) < SEEN_PX * detector.pitch:
            return []
        radius = shot.radius + 1e-3 * math.hypot(*self.shift_um[:2])
        if not math.isinf(detector.sod):
            radius /= max(1 - radius / detector.sod, 0.05)
        rows, cols = detector.shape
        first = max(0, math.ceil(detector.axis_col - radius / detector.pitch))
        last = min(cols - 1, math.floor(detector.axis_col + radius / detector.pitch))
        return [Label(self.name, (0, rows, first, last + 1))] if first <= last else []

    def _shift(self, angle: NDArray[np.float64]) -> NDArray[np.float64]:
        """mm along (u, b, v) at each angle, [row, 3]."""
        x, y, z = (1e-3 * um for um in self.shift_um)
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([x * c + y * s, y * c - x * s, np.full_like(c, z)], axis=1)
