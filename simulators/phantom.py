"""Phantom: analytic solids seen with exact chord lengths, and their true attenuation on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.volume import Grid
from simulators.chords import add_attenuation, add_line_integrals
from simulators.detector import Detector
from simulators.pose import Pose
from simulators.solids import Packed, Solid, pack


@dataclass(frozen=True, eq=False)
class Phantom:
    """Solids ready to be seen. Make one with Phantom.of."""

    solids: tuple[Solid, ...]
    packed: Packed

    @classmethod
    def of(cls, solids: Sequence[Solid]) -> Phantom:
        return cls(tuple(solids), pack(solids))

    @property
    def radius(self) -> float:
        """mm from the rotation axis to the farthest matter (of the boxes around the bodies)."""
        p = self.packed
        reach = np.abs(p.centre[:, :2]) + p.extent[:, :2]
        return float(np.hypot(reach[:, 0], reach[:, 1]).max(initial=0.0))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(type(solid).__name__.lower() for solid in self.solids))

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        """See Sample.line_integrals."""
        pose = angle if isinstance(angle, Pose) else Pose.turned(angle, detector.shape[0])
        out = np.zeros(detector.shape)
        p = self.packed
        u0, v0 = -detector.axis_col * detector.pitch, -detector.axis_row * detector.pitch
        add_line_integrals(np.cos(pose.angle), np.sin(pose.angle), u0, v0, detector.pitch,
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

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        """See Sample.labels; where solids overlap, the later one is what is there."""
        out = np.zeros(grid.shape, np.uint8)
        z, y, x = grid.coordinates()
        for solid in self.solids:
            p = pack([solid])
            share = np.zeros(grid.shape)
            add_attenuation(x[0], y[0], z[0], grid.voxel_size, 1,
                            p.kind, np.sign(p.attenuation), p.centre, p.extent, p.planes, p.half, share)  # fmt: skip
            out[share != 0] = self.names.index(type(solid).__name__.lower()) + 1
        return out
