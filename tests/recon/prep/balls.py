"""Balls projected with exact chords on a detector that may be rotated about the beam."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.volume import Grid


@dataclass(frozen=True)
class Balls:
    """Balls in a cylinder: lengths in pixels, attenuation 1/50 per pixel.

    Attributes:
        angles: [view], radians.
        shape: (rows, cols).
        axis_col: column of the axis in the middle row.
        tilt_deg: in-plane tilt of the axis; its column grows with the row.
        seed, count: random seed and number of the balls.
    """

    angles: NDArray[np.float64]
    shape: tuple[int, int] = (64, 96)
    axis_col: float = 49.3
    tilt_deg: float = 0.0
    seed: int = 0
    count: int = 24

    @property
    def places(self) -> NDArray[np.float64]:
        """[ball, (x, y, z, radius)] about the axis."""
        rows, cols = self.shape
        rng = np.random.default_rng(self.seed)
        turn, away = rng.uniform(0, 2 * np.pi, self.count), 0.32 * cols * np.sqrt(rng.uniform(0, 1, self.count))
        z, radius = rng.uniform(-rows / 2, rows / 2, self.count), rng.uniform(0.05, 0.12, self.count) * cols
        return np.stack([away * np.cos(turn), away * np.sin(turn), z, radius], axis=1)

    def views(self, only: NDArray[np.int64] | None = None) -> NDArray[np.float32]:
        """Line integrals [view, row, col] of all rows, or `only` some."""
        rows, cols = self.shape
        seen = np.arange(rows) if only is None else only
        x, y = np.meshgrid(np.arange(cols) - (cols - 1) / 2, seen - (rows - 1) / 2)
        c, s = math.cos(math.radians(self.tilt_deg)), math.sin(math.radians(self.tilt_deg))
        u, v = c * x - s * y - (self.axis_col - (cols - 1) / 2), s * x + c * y
        out = np.zeros((self.angles.size, seen.size, cols))
        for bx, by, z, radius in self.places:
            if (np.abs(v - z) >= radius).all():
                continue
            centre = bx * np.cos(self.angles) + by * np.sin(self.angles)
            out += 0.04 * np.sqrt(np.clip(radius**2 - (u - centre[:, None, None]) ** 2 - (v - z) ** 2, 0, None))
        return out.astype(np.float32)

    def truth(self, grid: Grid) -> NDArray[np.float32]:
        """The ground truth in 1/pixel, on a grid in pixels."""
        out, at = np.zeros(grid.shape), grid.coordinates()
        for bx, by, bz, radius in self.places:
            near = [np.flatnonzero(np.abs(along - c) < radius + 1) for along, c in zip(at, (bz, by, bx), strict=True)]
            if not all(part.size for part in near):
                continue
            fine = [
                (along[part][:, None] + [-0.25, 0.25]).ravel() - c
                for along, part, c in zip(at, near, (bz, by, bx), strict=True)
            ]
            z, y, x = np.ix_(*fine)
            inside = (z**2 + y**2 + x**2 <= radius**2).reshape(near[0].size, 2, near[1].size, 2, near[2].size, 2)
            out[np.ix_(*near)] += 0.02 * inside.mean(axis=(1, 3, 5))
        return out.astype(np.float32)
