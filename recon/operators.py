"""The voxel projector: what the detector would show of a volume, to compare with what it did show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from recon.geometry import Geometry
from recon.volume import Grid, Volume


def joseph_matrix(angle: float, geometry: Geometry, grid: Grid) -> sparse.csr_array:
    """Line integrals through one slice as a matrix [col, y * x]: `matrix @ slice.ravel()`, mm times the slice's unit.

    Each ray is sampled once in every row of voxels (or column, whichever it crosses more steeply) with linear
    interpolation between the two neighbours (P. M. Joseph 1982, IEEE Trans. Med. Imaging 1, 192).
    """
    _, ny, nx = grid.shape
    _, cy, cx = grid.centre
    h = grid.voxel_size
    cos, sin = np.cos(angle), np.sin(angle)
    cols = geometry.detector_shape[1]
    u = ((np.arange(cols) - geometry.axis_col) * geometry.pixel_pitch)[:, None]
    if abs(cos) >= abs(sin):
        along = cy + (np.arange(ny) - (ny - 1) / 2) * h
        across = ((u - along * sin) / cos - cx) / h + (nx - 1) / 2
        lines, n, stride_line, stride_cell, length = ny, nx, nx, 1, h / abs(cos)
    else:
        along = cx + (np.arange(nx) - (nx - 1) / 2) * h
        across = ((u - along * cos) / sin - cy) / h + (ny - 1) / 2
        lines, n, stride_line, stride_cell, length = nx, ny, 1, nx, h / abs(sin)
    low = np.floor(across).astype(np.int64)
    fraction = across - low
    ray = np.broadcast_to(np.arange(cols)[:, None], low.shape)
    line = np.broadcast_to(np.arange(lines), low.shape)
    rays, cells, weights = [], [], []
    for cell, weight in ((low, 1 - fraction), (low + 1, fraction)):
        inside = (cell >= 0) & (cell < n)
        rays.append(ray[inside])
        cells.append(line[inside] * stride_line + cell[inside] * stride_cell)
        weights.append(weight[inside] * length)
    entries = (np.concatenate(weights), (np.concatenate(rays), np.concatenate(cells)))
    return sparse.csr_array(entries, shape=(cols, ny * nx), dtype=np.float32)


def project(volume: Volume, geometry: Geometry) -> NDArray[np.float32]:
    """Line integrals [view, row, col] of a volume whose slices lie on the detector rows (as in `Grid.matching`).

    Raises:
        ValueError: if the slices are not one to a detector row.
    """
    nz = volume.grid.shape[0]
    rows, cols = geometry.detector_shape
    on_rows = nz == rows and volume.grid.centre[0] == 0.0 and np.isclose(volume.grid.voxel_size, geometry.pixel_pitch)
    if not on_rows:
        raise ValueError(
            f"slices must lie on the detector rows: {nz} slices of {volume.grid.voxel_size} mm centred at "
            f"{volume.grid.centre[0]} mm, {rows} rows of {geometry.pixel_pitch} mm"
        )
    slices = np.ascontiguousarray(volume.data.reshape(nz, -1).T)
    out = np.empty((geometry.n_views, rows, cols), np.float32)
    for view, angle in enumerate(geometry.angles):
        out[view] = (joseph_matrix(float(angle), geometry, volume.grid) @ slices).T
    return out


def data_residual(volume: Volume, projections: NDArray[np.float32], geometry: Geometry) -> float:
    """||A x - p|| / ||p||: the share of the measured line integrals [view, row, col] that the volume does not explain.

    Raises:
        ValueError: if `projections` does not fit `geometry`, or is all zero.
    """
    expected = (geometry.n_views, *geometry.detector_shape)
    if projections.shape != expected:
        raise ValueError(f"projections have shape {projections.shape}, their geometry says {expected}")
    scale = float(np.linalg.norm(projections))
    if scale == 0:
        raise ValueError("projections are all zero, so there is nothing to explain")
    return float(np.linalg.norm(project(volume, geometry) - projections)) / scale
