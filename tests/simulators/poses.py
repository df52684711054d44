"""Poses: how a test looks at a pose: where a point of the sample is seen, and what an effect of motion does to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulators.effects.chain import PoseEffect
from simulators.frame.shot import Pose
from tests.simulators import shots


def seen(pose: Pose, point: ArrayLike) -> NDArray[np.float64]:
    """(u, b, v) in mm of a point of the sample in each row, [row, 3]."""
    axes, origin = pose.frames()
    return np.einsum("rij,ri->rj", axes, np.asarray(point, dtype=np.float64) - origin)


def posed(effect: PoseEffect, angle: float | NDArray[np.float64], rows: int = 3, **changes: Any) -> Pose:
    """The pose that an effect makes of a sample that is turned by `angle` radians; `changes` are the shot's."""
    return effect.pose(Pose.turned(angle, rows), np.zeros(rows), shots.shot(**changes))
