"""`beamline voxelise`, `render`, `surface`: voxels and projections of a fit's Gaussians; the surface of a volume."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np
from numpy.typing import NDArray

from beamline.cli.options import json_option, parsed, volume_argument, volume_path
from beamline.cli.terminal import Answer, answering
from beamline.core.errors import DataError
from beamline.core.files import atomic_file, refuse_existing

if TYPE_CHECKING:
    from beamline.gaussians import Model

Box = tuple[tuple[float, float], ...]
_MESHES = (".stl", ".ply", ".obj")
_NEW = click.Path(path_type=Path)


def box_of(text: str) -> Box:
    """Parse three intervals of lengths, Z0:Z1,Y0:Y1,X0:X1. Raises ValueError for other text."""
    try:
        box = tuple((float(low), float(high)) for low, high in (part.split(":") for part in text.split(",")))
    except ValueError:
        box = ()
    if len(box) != 3 or not all(-math.inf < low < high < math.inf for low, high in box):
        raise ValueError(f"{text!r}: expected a box Z0:Z1,Y0:Y1,X0:X1 in the unit of the volume")
    return box


def angles_of(text: str) -> NDArray[np.float64]:
    """Parse FIRST:END:STEP or angles separated by commas, in degrees, to radians. Raises ValueError for other text."""
    try:
        if ":" in text:
            first, end, step = (float(part) for part in text.split(":"))
            angles = np.arange(first, end, step)
        else:
            angles = np.array([float(part) for part in text.split(",")])
    except (ValueError, ZeroDivisionError):
        angles = np.empty(0)
    if not angles.size or not np.isfinite(angles).all():
        raise ValueError(f"{text!r}: expected angles FIRST:END:STEP or A,B,... in degrees")
    return np.radians(angles)


@contextmanager
def _making(volume: Path, output: Path, as_json: bool) -> Iterator[tuple[Model, Answer]]:
    """Read the Gaussians of `volume`, for a new file at `output`."""
    from beamline.gaussians import read_model  # imported here, because help does not need it

    with answering(as_json) as answer:
        refuse_existing(output)
        yield read_model(volume), answer


@click.command()
@volume_argument
@click.option("-o", "--output", metavar="PATH", callback=parsed(volume_path), required=True,
              help="File to write; its suffix chooses the format.")  # fmt: skip
@click.option(
    "--voxel",
    type=click.FloatRange(min=0, min_open=True),
    help="Edge of a voxel in the unit of VOLUME (mm if the voxel size is known). Default: the voxel edge of VOLUME.",
)
@click.option(
    "--box",
    metavar="Z0:Z1,Y0:Y1,X0:X1",
    callback=parsed(box_of),
    help="Region in which voxels are computed, in the unit of VOLUME; x and y count from the rotation axis. Default: "
    "the region of VOLUME.",
)
@json_option
def voxelise(volume: Path, output: Path, voxel: float | None, box: Box | None, as_json: bool) -> None:
    """Write the Gaussians of a fit as voxels of any size, in any box.

    VOLUME must come from a Gaussian fit (`recon -m r2`). The Gaussians are those before the voxel refinement.

    Example: beamline voxelise recon.h5 --voxel 0.0005 -o fine.h5
    """
    from beamline.storage.volumes.files import write_volume
    from splatline_models.made import box_grid, voxelised

    with _making(volume, output, as_json) as (model, answer):
        try:
            grid = box_grid(model.record.volume.grid, voxel, box)
        except ValueError as error:
            raise click.UsageError(f"{error}. Nothing was written.") from error
        voxels = voxelised(model, grid, answer.counting("slices"))
        write_volume(output, replace(model.record, volume=voxels, time=answer.clock.now()))
        facts = {"output": output, "shape": grid.shape, "voxel": grid.voxel_size}
        answer.done(facts, f"output  {output}, {' x '.join(map(str, grid.shape))} voxels")


@click.command()
@volume_argument
@click.option("-o", "--output", metavar="PATH.h5", type=_NEW, required=True, help="File to write.")
@click.option("--angles", metavar="FIRST:END:STEP|A,B,...", callback=parsed(angles_of),
              help=(
                  "Angles of the projections in degrees; END itself is not one of them. Default: the angles of the "
                  "fitted projections."
              ))  # fmt: skip
@json_option
def render(volume: Path, output: Path, angles: NDArray[np.float64] | None, as_json: bool) -> None:
    """Project the Gaussians of a fit at any angles. Writes line integrals as a scan file in Data Exchange.

    VOLUME must come from a Gaussian fit (`recon -m r2`) of a parallel beam.

    Example: beamline render recon.h5 --angles 0:180:0.5 -o views.h5
    """
    from splatline_models.made import write_views

    if output.suffix.lower() not in (".h5", ".hdf5"):
        raise click.UsageError(
            f"-o {output}: projections are written as HDF5; give a name such as {output.with_suffix('.h5')}."
        )
    with _making(volume, output, as_json) as (model, answer):
        views = model.geometry.angles if angles is None else angles
        write_views(output, model, views, answer.counting("projections"))
        answer.done({"output": output, "n_views": views.size}, f"output  {output}, {views.size} projections")


@click.command()
@volume_argument
@click.option("-o", "--output", metavar="PATH", type=_NEW, required=True,
              help=f"File to write; its suffix chooses the format: {', '.join(_MESHES)}.")  # fmt: skip
@click.option(
    "--level",
    type=float,
    help="Value at the surface, in the unit of VOLUME. Default: half-way between air and material.",
)
@json_option
def surface(volume: Path, output: Path, level: float | None, as_json: bool) -> None:
    """Write the surface of a volume as a watertight mesh.

    Lengths are in the unit of the volume (mm if the voxel size is known). If material reaches a face of the volume, the
    surface is closed there. For a finer mesh use a volume of `beamline voxelise` with smaller voxels.

    Example: beamline surface recon.h5 -o sample.stl
    """
    import meshio  # type: ignore[import-untyped]

    from beamline.storage.volumes.files import opened_volume
    from splatline_models.made import half_way
    from splatline_models.made import surface as surface_of

    if output.suffix.lower() not in _MESHES:
        raise click.UsageError(f"-o {output}: expected one of the suffixes {', '.join(_MESHES)}.")
    with answering(as_json) as answer, opened_volume(volume) as record:
        refuse_existing(output)
        data = np.asarray(record.volume.data, np.float32)
        try:
            level = half_way(data) if level is None else level
            mesh = surface_of(data, record.volume.grid, level)
        except ValueError as error:
            raise DataError(f"{volume}: {error}. Nothing was written.") from error
        with atomic_file(output) as partial:
            suffix = output.suffix.lower()
            how = {} if suffix == ".obj" else {"binary": True}  # OBJ is text
            meshio.Mesh(mesh.vertices, [("triangle", mesh.faces)]).write(partial, suffix[1:], **how)
        facts = {"vertices": len(mesh.vertices), "triangles": len(mesh.faces), "euler": mesh.euler}
        answer.done(
            {"output": output, "level": level, **facts, "volume": mesh.volume, "unit": record.length_unit},
            f"output  {output}, {len(mesh.faces)} triangles, Euler number {mesh.euler}",
            f"level   {level:.4g} {record.unit}",
            f"volume  {mesh.volume:.6g} {record.length_unit}³",
        )
