"""The Gaussians behind a volume: kept in its file, made into voxels of any grid, into views, or into a PLY file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.monitor.digest import digest
from beamline.storage import hdf5
from beamline.storage.ingest import PER_FLUSH, complete
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers import layout
from beamline.storage.writers.ending import ScanEnding
from beamline.storage.writers.recon_file import opened_reconstruction
from beamline.storage.writers.rows import Record, Rows
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.volume import Grid, Volume
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import project, voxelize

_SLICES = 16  # made at a time


@dataclass(frozen=True, eq=False)
class Model:
    """Gaussians and the views that they were fitted to.

    Attributes:
        gaussians: lengths in `length_unit`.
        geometry: of these views, in the same unit.
        record: of the volume that they became; its voxels are not read.
    """

    gaussians: Gaussians
    geometry: Geometry
    record: ReconRecord


def arrays_of_model(gaussians: Gaussians, geometry: Geometry) -> dict[str, Any]:
    """The arrays of a model for a file, by name: physical values, so that no other program needs our parameters."""
    return {
        "kernel": gaussians.kernel.value,
        "density_unit": gaussians.density_unit,
        **gaussians.physical(),
        "view_angles": geometry.angles,
        "view_shifts": geometry.shifts,
        "view_roll": geometry.roll,
        "view_tilt": geometry.tilt,
        "detector_shape": np.array(geometry.detector_shape),
        "pixel_pitch": geometry.pixel_pitch,
        "axis": np.array([geometry.axis_col, geometry.axis_row]),
        "source_distances": np.array([geometry.sod, geometry.sdd]),
    }


def read_model(path: Path) -> Model:
    """The model in a reconstruction file.

    Raises:
        DataError: the file holds none, or cannot be read.
    """
    with opened_reconstruction(path) as record, hdf5.readable(path):
        arrays = record.model
        if not arrays:
            raise DataError(
                f"{path} holds no Gaussians: {record.parameters.get('method', 'its method')} has none, or the volume "
                "was made in slabs. Expected a volume of r2 made at once. Nothing was written."
            )
        rows, cols = (int(n) for n in arrays["detector_shape"])
        sod, sdd = (float(d) for d in arrays["source_distances"])
        axis_col, axis_row = (float(a) for a in arrays["axis"])
        geometry = Geometry(
            arrays["view_angles"], (rows, cols), float(arrays["pixel_pitch"]), axis_col, axis_row, sod, sdd,
            arrays["view_shifts"], arrays["view_roll"], arrays["view_tilt"],
        )  # fmt: skip
        gaussians = Gaussians.from_physical(
            arrays["centres"], arrays["widths"], arrays["densities"], arrays["rotations"],
            float(arrays["density_unit"]), Kernel(str(arrays["kernel"])),
        )  # fmt: skip
        # Error bars and FBP are of the file's voxels, and the file is closed behind this.
        return Model(gaussians, geometry, replace(record, deviation=None, fbp=None))


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
    """The model on a grid, sixteen slices at a time; `count` takes slices done and all."""
    data = np.empty(grid.shape, np.float32)
    for first in range(0, grid.shape[0], _SLICES):
        part = slice(first, min(first + _SLICES, grid.shape[0]))
        box = grid.part(part, slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        data[part] = voxelize(model.gaussians, box).numpy()
        count(part.stop, grid.shape[0])
    return Volume(data, grid)


def write_views(path: Path, model: Model, angles: NDArray[np.float64], count: Callable[[int, int], None]) -> None:
    """Line integrals of the model at `angles` [view] in radians: a scan of ours, which every command reads.

    It states quantity, pixel size, axis and cone, and has the /exchange view of Data Exchange. The views are straight,
    in their place: the poses of the views that were fitted are those of their own angles.

    Raises:
        DataError: a cone that a scan file cannot state, `path` exists, or the disk refuses; nothing is left.
    """
    first_view, in_mm = model.geometry.select([0]), model.record.length_unit == "mm"
    geometry = replace(first_view, shifts=np.zeros((1, 2)), roll=np.zeros(1), tilt=np.zeros(1)).at(angles)
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


def write_ply(path: Path, model: Model) -> None:
    """The Gaussians as a binary PLY: x y z, scale_0..2 (standard deviations), rot_0..3 (w x y z), density.

    Raises:
        DataError: `path` exists, or the disk refuses; nothing is left.
    """
    arrays, unit = model.gaussians.physical(), model.record.length_unit
    names = ("x", "y", "z", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)), "density")
    columns = (arrays["centres"], arrays["widths"], arrays["rotations"], arrays["densities"][:, None])
    rows = np.concatenate(columns, axis=1).astype("<f4")
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment lengths in {unit}, densities in {model.record.unit}, kernel {model.gaussians.kernel}",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(head) + "\n").encode())
        file.write(rows.tobytes())
