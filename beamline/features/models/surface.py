"""The surface of a volume file, or of the Gaussians behind it, with the memory that this computer has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamline.core.machine import free_memory
from beamline.gaussians.model import Model, read_model
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volumes.files import opened_volume
from recon.base.arrays import F32
from recon.features.surfaces.gaussians import on_level
from recon.features.surfaces.marching import BySlices, half_way, surface
from recon.features.surfaces.mesh import Mesh
from recon.splatting.splat import voxelize

_SHARE = 0.5  # of the free memory, for a mesh
Count = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh, the level that it follows, and the units of its lengths and of the level."""

    mesh: Mesh
    level: float
    unit: str
    level_unit: str


@dataclass(frozen=True, eq=False)
class _Voxelised:
    """The voxels of a model, made where they are read."""

    model: Model

    def __getitem__(self, z: slice) -> F32:
        grid = self.model.record.volume.grid
        some = slice(z.start, min(z.stop, grid.shape[0]))
        box = grid.part(some, slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        return voxelize(self.model.gaussians, box).numpy()


def surface_of_volume(path: Path, dataset: str | None, level: float | None, count: Count) -> Surface:
    """The surface of a volume file of any format, read by slices. DataError, and ValueError as `surface`."""
    with opened_volume(path, dataset) as record:
        return _surface(record.volume.data, record, level, count)


def surface_of_gaussians(path: Path, level: float | None, count: Count) -> Surface:
    """The surface of the model behind a volume, each vertex brought to the level along the density's gradient.

    Raises:
        DataError: the file holds no model. ValueError: as `surface`.
    """
    model = read_model(path)
    grid = model.record.volume.grid
    found = _surface(_Voxelised(model), model.record, level, count)
    vertices = found.mesh.vertices
    low, high = grid.edges
    free = ((vertices > low + 1e-3 * grid.voxel_size) & (vertices < high - 1e-3 * grid.voxel_size)).all(axis=1)
    vertices[free] = on_level(model.gaussians, vertices[free].astype(np.float64), found.level, grid.voxel_size)
    return found


def _surface(data: BySlices, record: ReconRecord, level: float | None, count: Count) -> Surface:
    grid = record.volume.grid
    level = half_way(data, grid.shape[0]) if level is None else level
    mesh = surface(data, grid, level, _SHARE * free_memory(), count)
    return Surface(mesh, level, record.length_unit, record.unit)
