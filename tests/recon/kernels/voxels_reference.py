"""Reference implementation of the voxel projector: an explicit sparse matrix in float64, for small boxes."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from recon.base.geometry import Geometry
from recon.base.volume import Grid


def system_matrix(geometry: Geometry, grid: Grid) -> sparse.csr_array:
    """Line integrals as a matrix [view * row * col, z * y * x], mm: `matrix @ volume.ravel()` is the projections.

    Each ray is sampled once in every plane of voxels across the axis (x or y) that it follows most closely, bilinearly
    between the four nearest voxels of that plane (P. M. Joseph 1982, IEEE Trans. Med. Imaging 1, 192, in 3-D), and
    every sample weighs the length of the ray from plane to plane. What lies outside the box is zero.
    """
    nz, ny, nx = grid.shape
    z, y, x = grid.coordinates()
    hz, h, _ = grid.spacing
    rows, cols = geometry.detector_shape
    parts = []
    for view in range(geometry.n_views):
        along_u, along_v, beam = geometry.axes(view)
        col0, row0 = geometry.origin(view)
        for row in range(rows):
            for col in range(cols):
                on_detector = (along_u * (col - col0) + along_v * (row - row0)) * geometry.pixel_pitch
                origin = -geometry.sod * beam if geometry.is_cone else on_detector
                run = on_detector + geometry.sdd * beam if geometry.is_cone else beam
                steep = abs(run[1]) >= abs(run[0])
                a, b = (1, 0) if steep else (0, 1)
                planes, lines = (y, x) if steep else (x, y)
                t = (planes - origin[a]) / run[a]  # run lengths from the origin to each plane
                across = (origin[b] + t * run[b] - lines[0]) / h
                level = (origin[2] + t * run[2] - z[0]) / hz
                path = h * np.linalg.norm(run) / abs(run[a])
                j, line, slice_ = np.arange(planes.size), np.floor(across), np.floor(level)
                for db in (0, 1):
                    for dz in (0, 1):
                        i, k = (line + db).astype(int), (slice_ + dz).astype(int)
                        weight = path * (1 - np.abs(across - i)) * (1 - np.abs(level - k))
                        inside = (i >= 0) & (i < lines.size) & (k >= 0) & (k < nz)
                        voxel = (k * ny + (j if steep else i)) * nx + (i if steep else j)
                        parts.append((np.full(inside.sum(), (view * rows + row) * cols + col),
                                      voxel[inside], weight[inside]))  # fmt: skip
    ray, voxel, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    return sparse.csr_array((weight, (ray, voxel)), shape=(geometry.n_views * rows * cols, nz * ny * nx))
