"""Mesh: a closed surface of triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed surface of triangles.

    Attributes:
        vertices: float32 [n, 3], (x, y, z) in the unit of the grid.
        faces: int32 [m, 3], numbers of vertices, anticlockwise for one who looks from air at matter.
    """

    vertices: F32
    faces: NDArray[np.int32]

    @property
    def volume(self) -> float:
        """Of the matter inside: a sixth of Σ a · (b x c) over the triangles (divergence theorem)."""
        if not len(self.faces):
            return 0.0
        a, b, c = np.moveaxis((self.vertices - self.vertices.mean(axis=0))[self.faces], 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c), dtype=np.float64)) / 6

    @property
    def euler(self) -> int:
        """Vertices - edges + faces: 2 for each closed shell, less 2 for each of its handles."""
        return len(self.vertices) - len(self.faces) // 2
