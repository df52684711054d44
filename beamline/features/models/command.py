"""`beamline voxelise`, `render`, `surface`: voxels, views and meshes of the Gaussians behind a volume."""

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

from beamline.cli.options import (
    POSITIVE,
    NameChoice,
    dataset_option,
    json_option,
    parsed,
    refuse_shared,
    volume_argument,
    volume_path,
)
from beamline.cli.terminal import Answer, answering
from beamline.core.errors import DataError
from beamline.core.files import refuse_existing, whole_file
from recon.base.registry import unknown

if TYPE_CHECKING:
    from beamline.gaussians import Model
    from recon.features.surfaces import Mesh


Box = tuple[tuple[float, float], ...]
_MOST_VIEWS = 1_000_000


def box_of(text: str) -> Box:
    """Parse three intervals Z0:Z1,Y0:Y1,X0:X1 of lengths. Raises ValueError for any other text."""
    try:
        box = tuple((float(low), float(high)) for low, high in (part.split(":") for part in text.split(",")))
    except ValueError:
        box = ()
    if len(box) != 3 or not all(-math.inf < low < high < math.inf for low, high in box):
        raise ValueError(f"{text!r} is not a box; expected Z0:Z1,Y0:Y1,X0:X1 in the unit of the volume")
    return box


def angles_of(text: str) -> NDArray[np.float64]:
    """Parse FIRST:END:STEP or angles separated by commas, in degrees, to radians. Raises ValueError for any other
    text."""
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
def _making(volume: Path, output: Path, as_json: bool) -> Iterator[tuple[Model, Answer]]:
    """The model behind `volume`, for a new file at `output`."""
    from beamline.gaussians import read_model  # here: help needs none of it

    refuse_shared({"VOLUME": volume, "--output": output})
    with answering(as_json) as answer:
        refuse_existing(output)
        yield read_model(volume), answer


@click.command()
@volume_argument
@click.option(
    "-o",
    "--output",
    metavar="PATH",
    callback=parsed(volume_path),
    required=True,
    help="Output; the suffix chooses the format.",
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

    with _making(volume, output, as_json) as (model, answer):
        try:
            grid = box_grid(model.record.volume.grid, voxel, box)
        except ValueError as error:
            raise click.UsageError(f"{error}. Nothing was written.") from error
        made = voxelised(model, grid, answer.counting("slices"))
        write_volume(output, replace(model.record, volume=made, time=answer.clock.now()))
        facts = {"output": output, "shape": grid.shape, "voxel": grid.voxel_size}
        answer.done(facts, f"output  {output}, {' x '.join(map(str, grid.shape))} voxels")


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
    with _making(volume, output, as_json) as (model, answer):
        views = model.geometry.angles if angles is None else angles
        write_views(output, model, views, answer.counting("views"))
        answer.done({"output": output, "n_views": views.size}, f"output  {output}, {views.size} views")


_TOGETHER = 2**16  # triangles or vertices


def _stl_bytes(mesh: Mesh, unit: str) -> Iterator[bytes]:
    """Header of 80 bytes, count, then of each triangle normal, corners and a spare number (little-endian)."""
    yield f"binary STL by splatline, lengths in {unit}".encode().ljust(80)
    yield np.uint32(len(mesh.faces)).astype("<u4").tobytes()
    for first in range(0, len(mesh.faces), _TOGETHER):
        corners = mesh.vertices[mesh.faces[first : first + _TOGETHER]].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        rows = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
        rows["normal"] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        rows["corners"] = corners
        yield rows.tobytes()


def _ply_bytes(mesh: Mesh, unit: str) -> Iterator[bytes]:
    yield (
        f"ply\nformat binary_little_endian 1.0\ncomment splatline, lengths in {unit}\nelement vertex "
        f"{len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\nelement face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    yield mesh.vertices.astype("<f4").tobytes()
    for first in range(0, len(mesh.faces), _TOGETHER):
        corners = mesh.faces[first : first + _TOGETHER]
        rows = np.full(len(corners), 3, [("n", "u1"), ("corners", "<i4", 3)])
        rows["corners"] = corners
        yield rows.tobytes()


def _obj_bytes(mesh: Mesh, unit: str) -> Iterator[bytes]:
    yield f"# splatline, lengths in {unit}\n".encode()
    for first in range(0, len(mesh.vertices), _TOGETHER):
        yield b"".join(b"v %.9g %.9g %.9g\n" % tuple(v) for v in mesh.vertices[first : first + _TOGETHER].tolist())
    for first in range(0, len(mesh.faces), _TOGETHER):
        yield b"".join(b"f %d %d %d\n" % tuple(f) for f in (mesh.faces[first : first + _TOGETHER] + 1).tolist())


MESHES = {".stl": _stl_bytes, ".ply": _ply_bytes, ".obj": _obj_bytes}


def write_mesh(path: Path, mesh: Mesh, unit: str) -> None:
    """Write a mesh in the format that the suffix names, one of MESHES.

    Raises:
        DataError: `path` exists, or the disk refuses; nothing is left.
    """
    with whole_file(path) as partial, partial.open("wb") as file:
        for part in MESHES[path.suffix.lower()](mesh, unit):
            file.write(part)


def _mesh_path(text: str) -> Path:
    """A name with the suffix of a mesh. ValueError for any other."""
    if Path(text).suffix.lower() not in MESHES:
        raise ValueError(f"{text!r}: {unknown('format of a mesh', Path(text).suffix, MESHES)}")
    return Path(text)


@click.command()
@volume_argument
@click.option("-o", "--output", metavar="PATH", callback=parsed(_mesh_path), required=True,
              help=f"Its suffix names the format: {', '.join(MESHES)}.")  # fmt: skip
@click.option("--level", type=float, help="Value at the surface. Default: half-way between air and matter.")
@click.option("--from", "source", type=NameChoice(["volume", "gaussians"]), default="volume", show_default=True,
              help="The voxels, or the Gaussians behind them: a fit before its finish.")  # fmt: skip
@dataset_option
@json_option
def surface(volume: Path, output: Path, level: float | None, source: str, dataset: str | None, as_json: bool) -> None:
    """Write the surface of the matter in VOLUME as triangles, in its unit of length (mm if the voxel size is known).

    The mesh is watertight: matter that leaves the volume is closed at its faces. Nothing is overwritten.
    """
    from beamline.features.models.made import surface_of_gaussians, surface_of_volume

    refuse_shared({"VOLUME": volume, "--output": output})
    with answering(as_json) as answer:
        refuse_existing(output)
        count = answer.counting("slices")
        try:
            if source == "volume":
                extracted = surface_of_volume(volume, dataset, level, count)
            elif dataset is not None:
                raise click.UsageError("--dataset does not go with --from gaussians.")
            else:
                extracted = surface_of_gaussians(volume, level, count)
        except ValueError as error:
            raise DataError(f"{volume}: {error}. Nothing was written.") from error
        write_mesh(output, extracted.mesh, extracted.unit)
        mesh, unit = extracted.mesh, extracted.unit
        facts = {"vertices": len(mesh.vertices), "triangles": len(mesh.faces), "euler": mesh.euler}
        answer.done(
            {"output": output, "level": extracted.level, **facts, "volume": mesh.volume, "unit": unit},
            f"output   {output}",
            f"level    {extracted.level:.5g} {extracted.level_unit}".rstrip(),
            f"mesh     {facts['vertices']} vertices, {facts['triangles']} triangles, Euler number {mesh.euler}",
            f"matter   {mesh.volume:.6g} {unit}³ inside",
        )
