"""`beamline surface`: where a volume, or the Gaussians behind it, cross a level, as a closed mesh."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from beamline.cli.options import (
    FiniteRange,
    NameChoice,
    dataset_option,
    json_option,
    parsed,
    refuse_shared,
    volume_argument,
)
from beamline.cli.terminal import counting, events_shown
from beamline.core.errors import DataError
from beamline.core.events import Done
from beamline.core.files import refuse_existing, whole_file
from drivers.base.clock import SystemClock
from recon.base.registry import unknown

if TYPE_CHECKING:
    from recon.features.surfaces.marching import Mesh

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
@click.option("--level", type=FiniteRange(), help="Value at the surface. Default: half-way between air and matter.")
@click.option("--from", "source", type=NameChoice(["volume", "gaussians"]), default="volume", show_default=True,
              help="The voxels, or the Gaussians behind them: a fit before its finish.")  # fmt: skip
@dataset_option
@json_option
def surface(volume: Path, output: Path, level: float | None, source: str, dataset: str | None, as_json: bool) -> None:
    """Write the surface of the matter in VOLUME as triangles, in its unit of length (mm where the voxel is known).

    The mesh is watertight: matter that leaves the volume is closed at its faces. Nothing is overwritten.
    """
    from beamline.features.models.made import surface_of_gaussians, surface_of_volume

    refuse_shared({"VOLUME": volume, "--output": output})
    with events_shown(as_json) as sink:
        refuse_existing(output)
        clock = SystemClock()
        count = counting("slices", sink, clock)
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
        sink(Done({"output": output, "level": extracted.level, **facts, "volume": mesh.volume, "unit": unit},
                  time=clock.now()))  # fmt: skip
    if not as_json:
        click.echo(f"output   {output}\nlevel    {extracted.level:.5g} {extracted.level_unit}".rstrip())
        click.echo(f"mesh     {facts['vertices']} vertices, {facts['triangles']} triangles, Euler number {mesh.euler}")
        click.echo(f"matter   {mesh.volume:.6g} {unit}³ inside")
