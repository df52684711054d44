"""`beamline surface`: where a volume, or the Gaussians behind it, cross a level, as a closed mesh."""

from __future__ import annotations

from pathlib import Path

import click

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
from beamline.core.files import refuse_existing
from beamline.features.models.mesh_file import MESHES, write_mesh
from drivers.base.clock import SystemClock
from recon.base.registry import unknown


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
    from beamline.features.models.surface import surface_of_gaussians, surface_of_volume

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
