"""Sample: the interface of all phantoms, of solids, of voxels or of materials under a spectrum."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.volume import Grid
from simulators.frame.detector import Detector
from simulators.frame.pose import Pose


class Sample(Protocol):
    @property
    def radius(self) -> float:
        """mm from the rotation axis to the farthest matter; the blur of a turning sample is largest there."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the labels 1, 2, ...; 0 is air."""

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        """Line integrals of the attenuation, float64 [row, col], dimensionless, at the pixels' centres.

        Args:
            angle: radians, one for the frame or one a row [row]; or a Pose.
        """

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        """True attenuation in 1/mm, float32 [z, y, x]; voxels on a surface are weighted by the filled share, counted on
        supersample³ points."""

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        """Label at each voxel's centre, uint8 [z, y, x]: an index into `names`, counted from 1, or 0 for air."""
