"""A small simulated sample of spheres."""

from __future__ import annotations

import math

import numpy as np

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.volume import Grid


def spheres(side: int = 96, rows: int = 48, views: int = 60, photons: float = 1e4) -> tuple[F32, Geometry, F32]:
    """A sample with a known answer: spheres in a cylinder, exact chords, photon noise.

    Returns:
        Line integrals [view, row, col] with the noise of `photons` per pixel (infinite: no noise), their geometry, and
        the attenuation [z, y, x] averaged over each voxel.
    """
    rng = np.random.default_rng(3)
    geometry = Geometry.parallel(np.linspace(0, np.pi, views, endpoint=False), (rows, side))
    count, radius = 40, 0.42 * side
    r = rng.uniform(0.02, 0.07, count) * side
    angle, out = rng.uniform(0, 2 * np.pi, count), (radius - r) * np.sqrt(rng.random(count))
    centres = np.stack((out * np.cos(angle), out * np.sin(angle), rng.uniform(-0.4, 0.4, count) * rows), 1)
    dense = rng.uniform(0.5, 1.0, count) * 3 / side
    thin = 0.5 / side

    sub = (np.arange(3) - 1) / 3
    u = (np.arange(side) - geometry.axis_col)[:, None] + sub
    v = (np.arange(rows) - geometry.axis_row)[:, None] + sub
    exact = np.empty((views, rows, side))
    for k, theta in enumerate(geometry.angles):
        image = np.broadcast_to(2 * thin * np.sqrt(np.maximum(radius**2 - u**2, 0)), (rows, 3, side, 3)).copy()
        for (x, y, z), size, mu in zip(centres, r, dense, strict=True):
            far = (u - x * np.cos(theta) - y * np.sin(theta))[None, None] ** 2 + (v - z)[:, :, None, None] ** 2
            image += 2 * mu * np.sqrt(np.maximum(size**2 - far, 0))
        exact[k] = image.mean(axis=(1, 3))
    if math.isfinite(photons):
        exact = -np.log(np.maximum(rng.poisson(photons * np.exp(-exact)), 1) / photons)

    grid = Grid.matching(geometry)
    zs, ys, xs = (axis[:, None] + sub for axis in grid.coordinates())
    truth = np.empty(grid.shape, np.float32)
    for k in range(rows):
        plane = np.zeros((3, side, 3, side, 3))
        plane += thin * (ys[:, :, None, None] ** 2 + xs**2 <= radius**2)
        for (x, y, z), size, mu in zip(centres, r, dense, strict=True):
            if abs(zs[k] - z).min() > size:
                continue
            flat = (ys[:, :, None, None] - y) ** 2 + (xs - x) ** 2
            plane += mu * (flat[None] + ((zs[k] - z) ** 2)[:, None, None, None, None] <= size**2)
        truth[k] = plane.mean(axis=(0, 2, 4))
    return exact.astype(np.float32), geometry, truth
