"""Spheres with sharp edges and their exact projections: data that Gaussians cannot represent exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid

# Centre (x, y, z), radius, density; in units of a detector of 48 columns and 12 rows.
SPHERES = (
    ((0.0, 0.0, 0.0), 19.0, 0.02),
    ((-7.0, 5.0, 1.0), 6.0, 0.03),
    ((8.0, -6.0, -1.0), 4.0, 0.05),
    ((6.0, 8.0, 0.5), 3.0, -0.02),
    ((-3.0, -10.0, 0.0), 2.0, 0.06),
)


def projections(geometry: Geometry) -> NDArray[np.float32]:
    """Line integrals [view, row, col] of the spheres, mean over 3 x 3 rays a pixel; parallel beam."""
    rows, cols = geometry.detector_shape
    out = np.zeros((geometry.n_views, rows, cols))
    parts = (-1 / 3, 0.0, 1 / 3)
    for view in range(geometry.n_views):
        along_u, along_v, _ = geometry.axes(view)
        col0, row0 = geometry.origin(view)
        for dr in parts:
            for dc in parts:
                u = (np.arange(cols) + dc - col0) * geometry.pixel_pitch
                v = (np.arange(rows) + dr - row0) * geometry.pixel_pitch
                for centre, radius, density in SPHERES:
                    off2 = (u[None, :] - along_u @ centre) ** 2 + (v[:, None] - along_v @ centre) ** 2
                    out[view] += density * 2 * np.sqrt(np.maximum(radius**2 - off2, 0)) / 9
    return out.astype(np.float32)


def volume(grid: Grid) -> NDArray[np.float32]:
    """The spheres' density [z, y, x], mean over 3 x 3 x 3 points a voxel."""
    z, y, x = grid.coordinates()
    out = np.zeros(grid.shape)
    parts = [np.array([-1, 0, 1]) * edge / 3 for edge in grid.spacing]
    for dz in parts[0]:
        for dy in parts[1]:
            for dx in parts[2]:
                for (cx, cy, cz), radius, density in SPHERES:
                    off2 = ((z + dz - cz) ** 2)[:, None, None] + ((y + dy - cy) ** 2)[:, None]
                    out += density * (off2 + (x + dx - cx) ** 2 <= radius**2) / 27
    return out.astype(np.float32)
