"""Pose: rotation and displacement of the sample while each row of a frame is exposed.

The laboratory's axes are u (along the rows), b (along the beam, away from the source) and v (up the columns' index).
A point p = (x, y, z) of the sample at angle θ is at u = x cos θ + y sin θ, b = y cos θ - x sin θ, v = z. The tilt
rotates that about the laboratory's u and b through the origin, and the shift is added last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pose:
    """Rotation and displacement of the sample for each row. None: no displacement.

    Attributes:
        angle: float64 [row], radians.
        shift: float64 [row, 3], mm along (u, b, v).
        tilt: float64 [row, 2], radians about (u, b); first about u, then about b.
    """

    angle: Reals
    shift: Reals | None = None
    tilt: Reals | None = None

    @classmethod
    def turned(cls, angle: ArrayLike, rows: int) -> Pose:
        """Rotation only; `angle` in radians, one for the frame or one a row [row]."""
        return cls(np.ascontiguousarray(np.broadcast_to(np.asarray(angle, dtype=np.float64), (rows,))))

    def turned_by(self, angle: ArrayLike) -> Pose:
        """Turned further by `angle` radians, one for the frame or one a row."""
        return Pose(self.angle + np.asarray(angle, dtype=np.float64), self.shift, self.tilt)

    def shifted_by(self, shift: ArrayLike) -> Pose:
        """Shifted further by `shift` mm, [3] or [row, 3]."""
        return Pose(self.angle, _added(self.shift, shift, (self.angle.size, 3)), self.tilt)

    def tilted_by(self, tilt: ArrayLike) -> Pose:
        """Tilted further by `tilt` radians, [2] or [row, 2]; small tilts add up, to second order."""
        return Pose(self.angle, self.shift, _added(self.tilt, tilt, (self.angle.size, 2)))

    def frames(self) -> tuple[Reals, Reals]:
        """The laboratory in the sample's coordinates.

        Returns:
            Axes float64 [row, 3, 3], whose columns are u, b and v in (x, y, z), and the laboratory's origin,
            float64 [row, 3] in mm.
        """
        zero, one = np.zeros_like(self.angle), np.ones_like(self.angle)
        c, s = np.cos(self.angle), np.sin(self.angle)
        to_lab = _matrices([[c, s, zero], [-s, c, zero], [zero, zero, one]])
        if self.tilt is not None:
            (cu, cb), (su, sb) = np.cos(self.tilt.T), np.sin(self.tilt.T)
            about_u = _matrices([[one, zero, zero], [zero, cu, -su], [zero, su, cu]])
            about_b = _matrices([[cb, zero, sb], [zero, one, zero], [-sb, zero, cb]])
            to_lab = about_b @ about_u @ to_lab
        axes = np.ascontiguousarray(to_lab.transpose(0, 2, 1))
        shift = np.zeros((c.size, 3)) if self.shift is None else self.shift
        return axes, -np.einsum("rij,rj->ri", axes, shift)


def _matrices(entries: list[list[Reals]]) -> Reals:
    """[row, 3, 3] of entries each [row]."""
    return np.moveaxis(np.array(entries), 2, 0)


def _added(present: Reals | None, more: ArrayLike, shape: tuple[int, int]) -> Reals:
    added: Reals = np.array(np.broadcast_to(np.asarray(more, dtype=np.float64), shape))
    return added if present is None else added + present
