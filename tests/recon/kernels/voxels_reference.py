"""Reference implementation of the voxel projector: an explicit sparse matrix in float64, for small boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from recon.base.geometry import Geometry
from recon.base.volume import Grid


def system_matrix(geometry: Geometry, grid: Grid) -> sparse.csr_array:
    """Line integrals as a matrix [view * row * col, z * y * x], mm: `matrix @ volume.ravel()` is the projections.

    Each ray is sampled once in every plane of voxels across one axis, bilinearly between the four nearest voxels of the
    plane (P. M. Joseph 1982, IEEE Trans. Med. Imaging 1, 192, in 3-D), and every sample has the weight of the ray's
    length between planes. The axis is the one that is nearest to the direction of the ray in the middle of the
    detector's column (for straight projections x or y). Outside the box the volume is zero.
    """
    sizes, voxels, edges = grid.shape, grid.coordinates(), grid.spacing  # (z, y, x)
    rows, cols = geometry.detector_shape
    parts = []
    for view in range(geometry.n_views):
        along_u, along_v, beam = geometry.axes(view)[:, ::-1]  # (z, y, x)
        (col0, row0), centre = geometry.origin(view), geometry.centres[view, ::-1]

        def ray(row: float, col: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            on_detector = (along_u * (col - col0) + along_v * (row - row0)) * geometry.pixel_pitch  # noqa: B023
            if geometry.is_cone:
                return centre - geometry.sod * beam, on_detector + geometry.sdd * beam  # noqa: B023
            return on_detector, beam  # noqa: B023

        for row in range(rows):
            for col in range(cols):
                z_run, y_run, x_run = np.abs(ray((rows - 1) / 2, col)[1])
                a = 1 if y_run >= x_run else 2
                if not geometry.is_straight and z_run > max(y_run, x_run):
                    a = 0
                b, c = (axis for axis in (2, 1, 0) if axis != a)
                origin, run = ray(row, col)
                t = (voxels[a] - origin[a]) / run[a]  # run lengths from the origin to each plane
                at = {axis: (origin[axis] + t * run[axis] - voxels[axis][0]) / edges[axis] for axis in (b, c)}
                path = edges[a] * np.linalg.norm(run) / abs(run[a])
                for db in (0, 1):
                    for dc in (0, 1):
                        index = {
                            a: np.arange(sizes[a]),
                            b: np.floor(at[b]).astype(int) + db,
                            c: np.floor(at[c]).astype(int) + dc,
                        }
                        weight = path * (1 - np.abs(at[b] - index[b])) * (1 - np.abs(at[c] - index[c]))
                        inside = np.all([(index[k] >= 0) & (index[k] < sizes[k]) for k in range(3)], axis=0)
                        voxel = (index[0] * sizes[1] + index[1]) * sizes[2] + index[2]
                        parts.append((np.full(inside.sum(), (view * rows + row) * cols + col),
                                      voxel[inside], weight[inside]))  # fmt: skip
    ray_number, voxel, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    shape = (geometry.n_views * rows * cols, sizes[0] * sizes[1] * sizes[2])
    return sparse.csr_array((weight, (ray_number, voxel)), shape=shape)
