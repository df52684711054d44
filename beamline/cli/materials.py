"""`beamline materials`: a volume of each material, from scans at several energies."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from beamline.cli.option_groups import DATA, OUTPUT, Grouped, heading
from beamline.cli.options import json_option, names_in, refuse_shared
from beamline.cli.selection_options import chosen, selection_options
from beamline.cli.terminal import counting, events_shown
from beamline.core.errors import ScanStopped
from beamline.core.events import Done
from beamline.core.sinks import Warnings
from beamline.core.stop import StopOnSignal
from drivers.base.clock import SystemClock

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.command(
    cls=Grouped,
    first=("spectra", "output", "views", "rows", "binning", "axis", "pixel_size_um", "flags", "rings", "as_json"),
)
@heading(DATA)
@click.argument("files", metavar="SCAN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--spectra",
    type=_FILE,
    required=True,
    help="CSV table: energy_kev and the name of each material in the first line, then keV and 1/mm.",
)
@heading(OUTPUT)
@click.option(
    "-o", "--output", metavar="PATH.h5", type=_FILE, required=True, help="_NAME joins its stem for each material."
)
@click.option(
    "--register",
    is_flag=True,
    help="Find where the sample stood in each scan, and its magnification; correct them.",
)
@click.option(
    "--states",
    metavar="NAME,NAME",
    default="",
    help="Two materials that are two states of the same one, as a fresh and a charged oxide: the share of the second "
    "is smooth.",
)
@selection_options
@heading(OUTPUT)
@json_option
def materials(
    files: tuple[Path, ...], spectra: Path, output: Path, register: bool, states: str, as_json: bool, **values: Any
) -> None:
    """Fit the volume fraction of each material to scans of one sample at several energies, all at once.

    Each SCAN states its energy; the folder of a series (`scan.energies`) stands for its scans. Few views an energy are
    enough: all views together determine the materials. Views of different energies should have different angles. The
    sample must not move between the scans, nor its magnification change, or --register finds how. Views of another
    pixel size are interpolated to that of the first scan.

    Ctrl-C ends the fit with the volumes so far (exit code 4).
    """
    from beamline.reconstruct.energy_series import MaterialOptions, reconstruct_materials
    from beamline.reconstruct.energy_views import read_spectra
    from beamline.scan.energies import scans_of

    table = read_spectra(spectra)
    with events_shown(as_json) as sink:
        clock = SystemClock()
        files = scans_of(files, Warnings(sink, clock))
        refuse_shared({"--output": output, **{f"SCAN {n}": path for n, path in enumerate(files, 1)}})
        made = reconstruct_materials(
            [chosen(path, 0, values) for path in files], table, output, sink, clock,
            lambda stage: counting(stage, sink, clock), StopOnSignal(ready=False),
            MaterialOptions(register, names_in(states)),
        )  # fmt: skip
        data = {"outputs": made.outputs, "residual": made.residual, "stopped": made.early, "displacements": made.moves}
        sink(Done(data, time=clock.now()))
    if not as_json:
        click.echo("\n".join(f"{name:<20}{path}" for name, path in made.outputs.items()))
        for path, move in zip(files, made.moves, strict=False):
            at = ", ".join(f"{1e3 * value:+.2f}" for value in (move.x, move.y, move.z))
            click.echo(
                f"{'displaced':<20}{at} µm along x, y, z and {math.degrees(move.turn):+.3f}°; "
                f"image {1e3 * move.image:+.2f} µm along the rows, magnified {move.magnification:.4f}: {path}"
            )
    if made.early:
        raise ScanStopped("The fit was stopped; the volumes are those reached so far.")
