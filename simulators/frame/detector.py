"""Detector: the rays of a frame in a parallel beam or a cone."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Detector:
    """Pixel (j, i) has the ray through u = (i - axis_col) * pitch, v = (j - axis_row) * pitch.

    Attributes:
        shape: (rows, cols).
        pitch: mm at the sample: in the plane of the rotation axis, for any magnification.
        axis_col: column of the rotation axis, 0 at the centre of the first column.
        axis_row: row of z = 0 (of the source's height in a cone), 0 at the centre of the first row.
        sod: mm from the source to the rotation axis; infinite for a parallel beam.
    """

    shape: tuple[int, int]
    pitch: float
    axis_col: float
    axis_row: float
    sod: float = math.inf

    def __post_init__(self) -> None:
        if not self.sod > 0:
            raise ValueError(f"sod must be positive in mm (infinite for a parallel beam), got {self.sod}")

    @classmethod
    def centred(cls, shape: tuple[int, int], pitch: float, sod: float = math.inf) -> Detector:
        """Rotation axis and z = 0 in the middle of the frame."""
        return cls(shape, pitch, (shape[1] - 1) / 2, (shape[0] - 1) / 2, sod)

    def aimed(self, row: float, col: float) -> Detector:
        """The rays at this offset, in pixels, from the rays through the pixels' middles."""
        return replace(self, axis_col=self.axis_col - col, axis_row=self.axis_row - row)

    def u(self) -> NDArray[np.float64]:
        return (np.arange(self.shape[1], dtype=np.float64) - self.axis_col) * self.pitch

    def v(self) -> NDArray[np.float64]:
        return (np.arange(self.shape[0], dtype=np.float64) - self.axis_row) * self.pitch
