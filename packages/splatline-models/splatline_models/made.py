"""Computes voxels and projections from a fit's Gaussians, and the surface mesh of a volume."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from beamline.core.errors import DataError
from beamline.core.files import atomic_file
from beamline.gaussians import Model
from beamline.storage.hdf5 import created
from recon import Grid, Volume, project, voxelize
from recon.post import clusters

F32 = NDArray[np.float32]
_SLICES = 16  # projections computed at a time
_RANGE = 0.5, 99.5  # percentiles to which values are limited, so that a speck of metal does not count as the material
# smallest distance of a voxel value from the level, relative to the largest; keeps vertices off the corners
_APART = 5e-4


def box_grid(grid: Grid, voxel: float | None, box: tuple[tuple[float, float], ...] | None) -> Grid:
    """A grid of cubes of edge `voxel` in a box ((z0, z1), (y0, y1), (x0, x1)); None: as in `grid`.

    Raises:
        ValueError: the box is smaller than a voxel.
    """
    edge = grid.voxel_size if voxel is None else voxel
    if box is None:
        (x0, y0, z0), (x1, y1, z1) = grid.edges
        box = ((z0, z1), (y0, y1), (x0, x1))
    nz, ny, nx = (round((high - low) / edge) for low, high in box)
    if min(nz, ny, nx) < 1:
        raise ValueError(f"the box {box} (z, y, x) is smaller than a voxel, whose edge is {edge:g} in the same unit")
    z, y, x = ((low + high) / 2 for low, high in box)
    return Grid((nz, ny, nx), edge, (z, y, x))


def voxelised(model: Model, grid: Grid, count: Callable[[int, int], None]) -> Volume:
    """Voxelise the model on a grid, sixteen slices at a time. `count` is called with the number of slices done, and of
    all slices."""
    data = np.empty(grid.shape, np.float32)
    for first in range(0, grid.shape[0], _SLICES):
        part = slice(first, min(first + _SLICES, grid.shape[0]))
        box = grid.part(part, slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        data[part] = voxelize(model.gaussians, box).numpy()
        count(part.stop, grid.shape[0])
    return Volume(data, grid)


def write_views(path: Path, model: Model, angles: NDArray[np.float64], count: Callable[[int, int], None]) -> None:
    """Write line integrals of the model at `angles` [view] in radians as Data Exchange, which every command reads.

    The projections have no tilt and no shift, because the fitted poses belong to the fitted angles.

    Raises:
        DataError: the model is of a cone beam, which Data Exchange cannot state; `path` exists; or the disk does not
            take the file.
    """
    if model.geometry.is_cone:
        raise DataError(
            f"{path} cannot be written: the fit is of a cone beam, and Data Exchange cannot state a cone beam."
        )
    geometry = replace(model.geometry.select([0]).straightened(), shifts=np.zeros((1, 2))).at(angles)
    with atomic_file(path) as partial, created(partial) as file:
        shape = (angles.size, *geometry.detector_shape)
        data = file.create_dataset("exchange/data", shape, np.float32, chunks=(1, *shape[1:]))
        data.attrs["units"] = "line_integrals"
        file["exchange/theta"] = np.degrees(angles)
        file["exchange/theta"].attrs["units"] = "deg"
        file["exchange/title"] = f"projections of the Gaussians of {model.record.title}"
        if model.record.length_unit == "mm":
            file.attrs["pixel_size_mm"] = geometry.pixel_pitch
        for view in range(angles.size):
            data[view] = project(model.gaussians, geometry, [view]).numpy()[0]
            count(view + 1, angles.size)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed surface of triangles.

    Attributes:
        vertices: float32 [n, 3], (x, y, z) in the unit of the grid.
        faces: int32 [m, 3], indices of vertices, anticlockwise as seen from the air.
    """

    vertices: F32
    faces: NDArray[np.int32]

    @property
    def volume(self) -> float:
        """Volume inside the surface: a sixth of Σ a · (b x c) over the triangles (divergence theorem)."""
        a, b, c = np.moveaxis((self.vertices - self.vertices.mean(axis=0))[self.faces], 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c), dtype=np.float64)) / 6

    @property
    def euler(self) -> int:
        """Euler number, vertices - edges + faces: 2 for each closed shell, minus 2 for each of its handles."""
        return len(self.vertices) - len(self.faces) // 2


def half_way(data: F32) -> float:
    """The level half-way between air and material (ISO 50 % rule): between the medians of two clusters (k-means).

    Raises:
        ValueError: all values are equal.
    """
    sample = data.ravel()[:: max(1, data.size // 2**20)]
    cut = np.clip(sample, *np.percentile(sample, _RANGE))
    sample = cut if np.ptp(cut) else data.ravel()
    if not np.ptp(sample):
        raise ValueError("all values are equal, so there is no level between air and material")
    dense = sample > clusters(sample, 2).threshold
    return float(np.median(sample[dense]) + np.median(sample[~dense])) / 2


def surface(data: F32, grid: Grid, level: float) -> Mesh:
    """The surface of the material above a level (Lewiner et al. 2003), closed at the faces of the box.

    Raises:
        ValueError: no voxel is above the level, or some are not finite.
    """
    if not np.isfinite(data).all():
        raise ValueError("some values are not finite")
    if not (data > level).any():
        raise ValueError(f"there is no surface, because no value is above the level {level:.4g}")
    block = np.pad(data - np.float32(level), 1, mode="edge")
    for axis in range(3):
        rim = np.moveaxis(block, axis, 0)
        rim[[0, -1]] = -np.abs(rim[[0, -1]])  # the material ends at the face
    block = np.copysign(np.maximum(np.abs(block), _APART * np.abs(block).max()), block)
    points, faces, _, _ = marching_cubes(block, 0.0)
    vertices = (points[:, ::-1] - 1) * grid.spacing[::-1] + np.asarray(grid.first[::-1])
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))
