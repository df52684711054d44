"""A packing of discs that moves and changes. Its projections are computed on a finer grid than the reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import recon
from recon.base.arrays import F32

N, ROWS, OVER = 64, 4, 3
LEVEL = 0.05  # 1/mm, of particles; between them a fifth of it


@dataclass(frozen=True)
class Discs:
    """Discs in a round matrix.

    Attributes:
        at: [disc, 2] y and x from the middle in voxels.
        radius, level: [disc].
        turn: radians about the axis, and shift (y, x) in voxels, of all together.
        slit: number of a disc with a gap of a voxel through its middle; -1: none.
    """

    at: NDArray[np.float64]
    radius: NDArray[np.float64]
    level: NDArray[np.float64]
    turn: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    slit: int = -1

    def slice(self, n: int = N) -> F32:
        """[y, x] on n x n voxels of the same box."""
        scale = N / n
        y, x = np.meshgrid(*[(np.arange(n) - (n - 1) / 2) * scale] * 2, indexing="ij")
        y, x = y - self.shift[0], x - self.shift[1]
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        y, x = cos * y - sin * x, sin * y + cos * x
        out = np.where(np.hypot(y, x) < 0.45 * N, 0.2 * LEVEL, 0.0)
        for n_disc, ((dy, dx), radius, level) in enumerate(zip(self.at, self.radius, self.level, strict=True)):
            inside = np.hypot(y - dy, x - dx) < radius
            if n_disc == self.slit:
                inside &= np.abs(y - dy - 0.3 * (x - dx)) > 0.6
            out[inside] = level
        return out.astype(np.float32)

    @property
    def volume(self) -> F32:
        """[z, y, x] the mean in each voxel."""
        fine = self.slice(N * OVER).reshape(N, OVER, N, OVER).mean((1, 3))
        return np.repeat(fine[None], ROWS, axis=0)


def packed(seed: int = 1, radius: tuple[float, float] = (4.0, 7.0), count: int = 24) -> Discs:
    """Discs that do not overlap."""
    rng, at, radii = np.random.default_rng(seed), list[NDArray[np.float64]](), list[float]()
    for _ in range(20000):
        place, size = rng.uniform(-0.45 * N, 0.45 * N, 2), rng.uniform(*radius)
        apart = all(np.hypot(*(place - other)) > size + r + 0.5 for other, r in zip(at, radii, strict=True))
        if apart and np.hypot(*place) + size < 0.44 * N:
            at.append(place)
            radii.append(size)
        if len(at) == count:
            break
    return Discs(np.array(at), np.array(radii), LEVEL * rng.uniform(0.9, 1.1, len(at)))


def scanned(scene: Discs, views: int, photons: float, seed: int = 0) -> tuple[F32, recon.Geometry]:
    """Noisy line integrals of a parallel beam, from three times finer voxels and columns."""
    angles = np.arange(views) * np.pi / views
    fine = recon.Geometry.parallel(angles, (1, N * OVER), pixel_pitch=1 / OVER)
    lines = recon.Projector(fine, recon.Grid.matching(fine)).plain.forward(scene.slice(N * OVER)[None])
    lines = np.repeat(lines.reshape(views, 1, N, OVER).mean(3), ROWS, axis=1)
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-lines.astype(float)))
    noisy = -np.log(np.maximum(counts, 0.5) / photons)
    return noisy.astype(np.float32), recon.Geometry.parallel(angles, (ROWS, N))


def psnr(x: F32, truth: F32) -> float:
    return float(10 * np.log10(truth.max() ** 2 / np.square(x - truth).mean()))


def balls_near_one_end(rng: np.random.Generator) -> F32:
    """A cylinder [z, y, x] of 40 slices, with balls in its lower half: there a trial has its rows."""
    z, y, x = np.indices((40, 48, 48)) - np.array([19.5, 23.5, 23.5])[:, None, None, None]
    volume = np.where(np.hypot(y, x) < 22, 0.005, 0).astype(np.float32)
    for _ in range(60):
        centre, radius = rng.uniform([-18, -16, -16], [-5, 16, 16]), rng.uniform(2.5, 4)
        apart = np.sqrt((z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2)
        if volume[apart < radius + 1].max() < 0.01:
            volume[apart < radius] = 0.025
    return volume
