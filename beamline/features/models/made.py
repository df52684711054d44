"""What is made of the Gaussians behind a volume: voxels of any grid, views, and surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.core.machine import free_memory
from beamline.gaussians import Model, read_model
from beamline.monitor.digest import digest
from beamline.storage import hdf5
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volumes.files import opened_volume
from beamline.storage.writers import layout
from beamline.storage.writers.rows import PER_FLUSH, Record, Rows, ScanEnding, complete
from drivers.base.frame import FrameKind
from recon.base.arrays import F32
from recon.base.volume import Grid, Volume
from recon.features.surfaces import BySlices, Mesh, half_way, on_level, surface
from recon.splatting.splat import project, voxelize

_SLICES = 16  # made at a time


def box_grid(grid: Grid, voxel: float | None, box: tuple[tuple[float, float], ...] | None) -> Grid:
    """A grid of cubes of edge `voxel` in a box ((z0, z1), (y0, y1), (x0, x1)); None: those of `grid`.

    Raises:
        ValueError: the box holds no voxel.
    """
    edge = grid.voxel_size if voxel is None else voxel
    if box is None:
        (x0, y0, z0), (x1, y1, z1) = grid.edges
        box = ((z0, z1), (y0, y1), (x0, x1))
    shape = tuple(round((high - low) / edge) for low, high in box)
    if min(shape) < 1:
        raise ValueError(f"a box of {box} holds no voxel of {edge:g}: {shape}")
    return Grid(shape, edge, tuple((low + high) / 2 for low, high in box))  # type: ignore[arg-type]


def voxelised(model: Model, grid: Grid, count: Callable[[int, int], None]) -> Volume:
    """Voxelise the model on a grid, sixteen slices at a time; `count` gets (slices done, all slices)."""
    data = np.empty(grid.shape, np.float32)
    for first in range(0, grid.shape[0], _SLICES):
        part = slice(first, min(first + _SLICES, grid.shape[0]))
        box = grid.part(part, slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        data[part] = voxelize(model.gaussians, box).numpy()
        count(part.stop, grid.shape[0])
    return Volume(data, grid)


def write_views(path: Path, model: Model, angles: NDArray[np.float64], count: Callable[[int, int], None]) -> None:
    """Write line integrals of the model at `angles` [view] in radians as a scan of this program, which every command
    reads.

    It states quantity, pixel size, axis and cone, and has the /exchange view of Data Exchange. The views are straight,
    in their place: the poses of the views that were fitted are those of their own angles.

    Raises:
        DataError: a cone that a scan file cannot state, `path` exists, or the disk refuses; nothing is left.
    """
    first_view, in_mm = model.geometry.select([0]), model.record.length_unit == "mm"
    geometry = replace(first_view.straightened(), shifts=np.zeros((1, 2))).at(angles)
    middle = (geometry.detector_shape[0] - 1) / 2
    if geometry.is_cone and not (in_mm and abs(geometry.axis_row - middle) < 1e-3):
        raise DataError(
            f"The cone of {path} meets the detector at right angles in row {geometry.axis_row:g}, with lengths in "
            f"{model.record.length_unit}; a scan file states cones in mm about the middle row, {middle:g}. Reconstruct "
            "all rows, with a pixel size. Nothing was written."
        )
    info = layout.ScanInfo(
        sample=model.record.sample,
        title=f"views of the Gaussians behind {model.record.title}",
        pixel_size_mm=geometry.pixel_pitch if in_mm else None,
        axis_col=geometry.axis_col,
        source_distance_mm=geometry.sod if geometry.is_cone else None,
        distance_mm=geometry.sdd - geometry.sod if geometry.is_cone else None,
    )
    with whole_file(path) as partial, hdf5.created(partial, layout.LIBVER) as file:
        kind = np.dtype("<f4")
        layout.create(file, info, geometry.detector_shape, kind, quantity="line_integrals", preview_bin=4, start=None)
        rows = Rows(file)
        for view in range(angles.size):
            image = project(model.gaussians, geometry, [view]).numpy()[0]
            rows.write(view, image, digest(image, None), Record(FrameKind.PROJECTION, float(angles[view])))
            file.require_taken()
            count(view + 1, angles.size)
            if view % PER_FLUSH == PER_FLUSH - 1:
                rows.flush()
        rows.flush()
        complete(file, ScanEnding())


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
    """The surface of the model behind a volume, each vertex moved to the level along the density's gradient.

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
