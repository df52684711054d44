"""Sample: the interface of all phantoms (solids, voxels or materials), and a sample that changes with time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.volume import Grid
from simulators.frame.shot import Detector, Pose


class Sample(Protocol):
    @property
    def radius(self) -> float:
        """mm from the rotation axis to the farthest material; the blur of a turning sample is largest there."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the labels 1, 2, ...; 0 is air."""

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        """Line integrals of the attenuation, float64 [row, col], dimensionless, at the pixels' centres.

        Args:
            angle: radians, one for the frame or one a row [row]; or a Pose.
        """

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        """True attenuation in 1/mm, float32 [z, y, x]. Voxels on a surface are weighted by the filled share, which is
        counted with supersample³ points."""

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        """Label at each voxel's centre, uint8 [z, y, x]: an index into `names`, counted from 1, or 0 for air."""


TruthTable = Mapping[str, NDArray[Any]]
"""Columns by name, with a row for each particle; empty: there is no such truth."""


@dataclass(frozen=True, eq=False)
class Changing:
    """A sample that changes while it is scanned; as a `Sample` it is what it is at first.

    Attributes:
        at: the sample so many seconds after the camera was connected.
        start: at 0 s.
        table: truth of each of its particles at 0 s, see TruthTable.
    """

    at: Callable[[float], Sample]
    start: Sample
    table: TruthTable = field(default_factory=dict)

    @property
    def radius(self) -> float:
        return self.start.radius

    @property
    def names(self) -> tuple[str, ...]:
        return self.start.names

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        return self.start.line_integrals(angle, detector)

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        return self.start.attenuation(grid, supersample)

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        return self.start.labels(grid)


@dataclass(frozen=True, eq=False)
class Stored:
    """A volume as stored in a file.

    Attributes:
        values: [z, y, x] or in another order that the scene gives, real numbers in the file's own units.
        spacing: mm from voxel to voxel along the same axes; None: the file does not state it.
    """

    values: NDArray[np.generic]
    spacing: tuple[float, float, float] | None = None


ReadVolume = Callable[[str, str | None], Stored]
"""Reads the file that a scene names, and a dataset in this file. The caller of `load_scene` provides this function,
because simulators open no files. Errors of this function are not caught."""


def sample_at(sample: Sample, seconds: float) -> Sample:
    """The sample `seconds` s after the camera was connected."""
    return sample.at(seconds) if isinstance(sample, Changing) else sample
