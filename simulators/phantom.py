"""Phantom: analytic solids seen by parallel rays with exact chord lengths, and their true attenuation on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.volume import Grid
from simulators.chords import add_attenuation, add_line_integrals
from simulators.solids import Packed, Solid, pack


@dataclass(frozen=True)
class Detector:
    """Where a frame's rays run: pixel (j, i) is at u = (i - axis_col) * pitch, v = (j - axis_row) * pitch.

    Attributes:
        shape: (rows, cols).
        pitch: mm at the sample.
        axis_col: column of the rotation axis, 0 at the centre of the first column.
        axis_row: row of z = 0, 0 at the centre of the first row.
    """

    shape: tuple[int, int]
    pitch: float
    axis_col: float
    axis_row: float

    @classmethod
    def centred(cls, shape: tuple[int, int], pitch: float) -> Detector:
        """Rotation axis and z = 0 in the middle of the frame."""
        return cls(shape, pitch, (shape[1] - 1) / 2, (shape[0] - 1) / 2)

    def u(self) -> NDArray[np.float64]:
        return (np.arange(self.shape[1], dtype=np.float64) - self.axis_col) * self.pitch

    def v(self) -> NDArray[np.float64]:
        return (np.arange(self.shape[0], dtype=np.float64) - self.axis_row) * self.pitch


@dataclass(frozen=True, eq=False)
class Phantom:
    """Solids ready to be seen. Make one with Phantom.of."""

    solids: tuple[Solid, ...]
    packed: Packed

    @classmethod
    def of(cls, solids: Sequence[Solid]) -> Phantom:
        return cls(tuple(solids), pack(solids))

    def line_integrals(self, angle: ArrayLike, detector: Detector) -> NDArray[np.float64]:
        """Line integrals of the attenuation, float64 [row, col], dimensionless, at the pixels' centres.

        Args:
            angle: radians; one for the frame, or one a row [row].
        """
        rows = detector.shape[0]
        theta = np.ascontiguousarray(np.broadcast_to(np.asarray(angle, dtype=np.float64), (rows,)))
        out = np.zeros(detector.shape)
        p = self.packed
        u0, v0 = -detector.axis_col * detector.pitch, -detector.axis_row * detector.pitch
        add_line_integrals(np.cos(theta), np.sin(theta), u0, v0, detector.pitch,
                           p.kind, p.attenuation, p.centre, p.extent, p.planes, p.half, out)  # fmt: skip
        return out

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        """True attenuation in 1/mm, float32 [z, y, x]; voxels on a surface carry the share that is filled, counted
        on supersample³ points."""
        out = np.zeros(grid.shape)
        z, y, x = grid.coordinates()
        p = self.packed
        add_attenuation(x[0], y[0], z[0], grid.voxel_size, supersample,
                        p.kind, p.attenuation, p.centre, p.extent, p.planes, p.half, out)  # fmt: skip
        return out.astype(np.float32)
