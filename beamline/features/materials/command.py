"""`beamline materials`: a volume of each material, from scans at several energies."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import dry_option, json_option, names_in, option, refuse_shared
from beamline.cli.recipe import DATA, OUTPUT, RESOURCES, Grouped, heading, typed_line
from beamline.cli.recon import dry_run, run_reconstruction
from beamline.cli.recon_options import memory_option, report_option, unfinished_option
from beamline.cli.selection_options import chosen, selection_options
from beamline.cli.terminal import events_shown
from beamline.core.errors import ConfigError
from beamline.core.sinks import Warnings
from drivers.base.clock import SystemClock

if TYPE_CHECKING:
    from beamline.storage.recon_record import ReconRecord

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.command(
    cls=Grouped,
    first=("spectra", "output", "views", "rows", "binning", "axis", "pixel_size_um", "flags", "rings", "dry"),
)
@heading(DATA)
@click.argument("files", metavar="SCAN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@option(
    "--spectra",
    type=_FILE,
    required=True,
    help="CSV table: energy_kev and the name of each material in the first line, then keV and 1/mm.",
)
@unfinished_option
@heading(OUTPUT)
@option(
    "-o",
    "--output",
    metavar="PATH.h5",
    type=_FILE,
    required=True,
    help="One file per material, with _NAME appended to this stem.",
)
@option(
    "--register",
    is_flag=True,
    help="Find and correct the sample position and the magnification of each scan.",
)
@option(
    "--states",
    metavar="NAME,NAME",
    default="",
    help="Two materials that are two states of the same one, as a fresh and a charged oxide: the share of the second "
    "is smooth.",
)
@selection_options
@heading(OUTPUT)
@report_option
@heading(RESOURCES)
@memory_option
@dry_option
@heading(OUTPUT)
@json_option
def materials(files: tuple[Path, ...], spectra: Path, output: Path, **values: Any) -> None:
    """Fit the volume fraction of each material to scans of one sample at several energies, all at once.

    Each SCAN states its energy; the folder of a series (`scan.energies`) stands for its scans. Few views an energy are
    enough: all views together determine the materials. Views of different energies should have different angles. The
    sample must not move between the scans, nor its magnification change, or --register finds how. Views of another
    pixel size are interpolated to that of the first scan.

    Ctrl-C ends the fit with the volumes so far (exit code 4).
    """
    from beamline.energies import EnergyScans, read_spectra
    from beamline.reconstruct.options import OutputPaths, ReconOptions, report_beside
    from beamline.scan.energies import scans_of
    from recon.features.joint.methods import EnergySeries

    table = read_spectra(spectra)
    try:
        method = EnergySeries(table.names, names_in(values["states"]))
    except ValueError as error:
        raise ConfigError(f"--states: {error} of {spectra}. Nothing was written.") from error
    with events_shown(values["as_json"]) as sink:
        files = scans_of(files, Warnings(sink, SystemClock()))
    if output.suffix.lower() != ".h5":
        raise ConfigError(f"--output {output}: expected a name that ends in .h5. Nothing was written.")
    page = report_beside(output) if values["report"] else None
    target = OutputPaths(output, page, names=table.names)
    named = {f"volume of {name}": path for name, path in zip(table.names, target.outputs, strict=True)}
    refuse_shared({**named, "report": page, **{f"SCAN {n}": path for n, path in enumerate(files, 1)}})
    each = [chosen(path, 0, values) for path in files]
    options = ReconOptions(
        EnergyScans(tuple(source for source, _ in each), table, values["register"]),
        target,
        each[0][1],
        method,
        unfinished=values["unfinished"],
        memory=values["memory"],
        command=typed_line(click.get_current_context()),
    )
    if values["dry"]:
        dry_run(options, SystemClock(), values["as_json"])
        return
    run_reconstruction(options, values, lambda record: _moves(record, files))


def _moves(record: ReconRecord, files: tuple[Path, ...]) -> list[str]:
    """A line on where the sample stood in each scan, where that was looked for."""
    lines = []
    for path, move in zip(files, record.displacements, strict=False):
        at = ", ".join(f"{1e3 * move[axis]:+.2f}" for axis in "xyz")
        lines.append(
            f"{'displaced':<20}{at} µm along x, y, z and {math.degrees(move['turn']):+.3f}°; image "
            f"{1e3 * move['image']:+.2f} µm along the rows, magnified {move['magnification']:.4f}: {path}"
        )
    return lines
