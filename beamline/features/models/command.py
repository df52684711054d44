"""`beamline voxelise`, `render`: voxels of any grid, and views at any angle, of the Gaussians behind a volume."""

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

from beamline.cli.options import POSITIVE, json_option, parsed, refuse_shared, volume_argument, volume_path
from beamline.cli.terminal import counting, events_shown
from beamline.core.events import Done, Sink
from beamline.core.files import refuse_existing
from drivers.base.clock import Clock, SystemClock

if TYPE_CHECKING:
    from beamline.gaussians.model import Model

Box = tuple[tuple[float, float], ...]
_MOST_VIEWS = 1_000_000


def box_of(text: str) -> Box:
    """Three intervals Z0:Z1,Y0:Y1,X0:X1 of lengths. ValueError for anything else."""
    try:
        box = tuple((float(low), float(high)) for low, high in (part.split(":") for part in text.split(",")))
    except ValueError:
        box = ()
    if len(box) != 3 or not all(-math.inf < low < high < math.inf for low, high in box):
        raise ValueError(f"{text!r} is no box; expected Z0:Z1,Y0:Y1,X0:X1 in the unit of the volume")
    return box


def angles_of(text: str) -> NDArray[np.float64]:
    """FIRST:END:STEP or angles apart by commas, in degrees, as radians. ValueError for anything else."""
    try:
        first, *rest = (float(part) for part in text.split(":"))
        if len(rest) == 2 and rest[1] and 0 < (n := math.ceil((rest[0] - first) / rest[1] - 1e-9)) <= _MOST_VIEWS:
            return np.radians(first + rest[1] * np.arange(n))
    except ValueError:
        angles = np.radians([float(part) for part in text.split(",")]) if ":" not in text else np.empty(0)
        if angles.size and np.isfinite(angles).all():
            return angles
    else:
        if not rest and math.isfinite(first):
            return np.radians([first])
    raise ValueError(f"{text!r} names no angles; expected FIRST:END:STEP or A,B,... in degrees")


@contextmanager
def _making(volume: Path, output: Path, as_json: bool) -> Iterator[tuple[Model, Sink, Clock]]:
    """The model behind `volume`, for a new file at `output`."""
    from beamline.gaussians.model import read_model  # here: help needs none of it

    refuse_shared({"VOLUME": volume, "--output": output})
    with events_shown(as_json) as sink:
        refuse_existing(output)
        yield read_model(volume), sink, SystemClock()


@click.command()
@volume_argument
@click.option(
    "-o", "--output", metavar="PATH", callback=parsed(volume_path), required=True, help="Its suffix names the format."
)
@click.option("--voxel", type=POSITIVE, help="Edge of a voxel, in the unit of the volume. Default: that of VOLUME.")
@click.option(
    "--box",
    metavar="Z0:Z1,Y0:Y1,X0:X1",
    callback=parsed(box_of),
    help="Box to fill, in the unit of the volume; the rotation axis is x = y = 0. Default: that of VOLUME.",
)
@json_option
def voxelise(volume: Path, output: Path, voxel: float | None, box: Box | None, as_json: bool) -> None:
    """Fill voxels of any size, in any box, from the Gaussians behind VOLUME.

    These are the fit's, before its finish on voxels.
    """
    from beamline.features.models.made import box_grid, voxelised
    from beamline.storage.volumes.files import write_volume

    with _making(volume, output, as_json) as (model, sink, clock):
        try:
            grid = box_grid(model.record.volume.grid, voxel, box)
        except ValueError as error:
            raise click.UsageError(f"{error}. Nothing was written.") from error
        made = voxelised(model, grid, counting("slices", sink, clock))
        write_volume(output, replace(model.record, volume=made, time=clock.now()))
        sink(Done({"output": output, "shape": grid.shape, "voxel": grid.voxel_size}, time=clock.now()))
    if not as_json:
        click.echo(f"output  {output}, {' x '.join(map(str, grid.shape))} voxels")


@click.command()
@volume_argument
@click.option("-o", "--output", metavar="PATH.h5", type=click.Path(path_type=Path), required=True, help="New file.")
@click.option(
    "--angles",
    metavar="FIRST:END:STEP|A,B,...",
    callback=parsed(angles_of),
    help="Angles of the views in degrees; END is not one of them. Default: those that were fitted.",
)
@json_option
def render(volume: Path, output: Path, angles: NDArray[np.float64] | None, as_json: bool) -> None:
    """Project the Gaussians behind VOLUME onto its detector: line integrals of views at any angle.

    The output is a scan of line integrals, which every command reads; its /exchange is Data Exchange for others.
    """
    from beamline.features.models.made import write_views

    if output.suffix.lower() not in (".h5", ".hdf5"):
        raise click.UsageError(f"-o {output}: views are HDF5; give a name such as {output.with_suffix('.h5')}.")
    with _making(volume, output, as_json) as (model, sink, clock):
        views = model.geometry.angles if angles is None else angles
        write_views(output, model, views, counting("views", sink, clock))
        sink(Done({"output": output, "n_views": views.size}, time=clock.now()))
    if not as_json:
        click.echo(f"output  {output}, {views.size} views")
