"""Sample: what every phantom can do, whether it is made of solids, of voxels or of materials under a spectrum."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.volume import Grid
from simulators.detector import Detector
from simulators.pose import Pose


class Sample(Protocol):
    @property
    def radius(self) -> float:
        """mm from the rotation axis to the farthest matter; the blur of a turning sample is largest there."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """What the labels 1, 2, ... stand for; 0 is air."""
        ...

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        """Line integrals of the attenuation, float64 [row, col], dimensionless, at the pixels' centres.

        Args:
            angle: radians, one for the frame or one a row [row]; or a Pose.
        """
        ...

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        """True attenuation in 1/mm, float32 [z, y, x]; voxels on a surface carry the share that is filled, counted on
        supersample³ points."""
        ...

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        """What is at each voxel's centre, uint8 [z, y, x]: an index into `names`, counted from 1, or 0 for air."""
        ...
