"""`beamline xafs`: finds the absorption edge and the energy of the best contrast, in a scene or in measured data."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import json_option
from beamline.cli.terminal import answering
from beamline.core.errors import QualityError
from beamline.core.files import refuse_existing
from beamline.core.text import safe_name

if TYPE_CHECKING:
    from splatline_spectral.measured import PixelBox

_BOX = "ROW:END,COL:END"
_KEV = click.FloatRange(min=0, min_open=True)


def box(value: str) -> PixelBox:
    """Parse rows and columns, `first:end,first:end`."""
    match = re.fullmatch(r"(\d+):(\d+),(\d+):(\d+)", value)
    if match is None or int(match[1]) >= int(match[2]) or int(match[3]) >= int(match[4]):
        raise click.BadParameter(f"{value!r}: expected {_BOX}, such as 100:200,50:120")
    return int(match[1]), int(match[2]), int(match[3]), int(match[4])


def charges_of(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, ...]:
    """Parse numbers from 0 to 1, separated by commas."""
    try:
        numbers = tuple(float(part) for part in value.split(",")) if value else ()
    except ValueError:
        numbers = (2.0,)
    if not all(0 <= charge <= 1 for charge in numbers):
        raise click.BadParameter(f"{value!r}: expected states of charge, numbers from 0 to 1, such as 0,0.5,1")
    return numbers


@click.command()
@click.argument("sources", metavar="SCENE|FILE...", nargs=-1, required=True)
@click.option(
    "--from", "low", type=_KEV, metavar="KEV", help="First energy of the simulated scans in keV. Required for a SCENE."
)
@click.option(
    "--to", "high", type=_KEV, metavar="KEV", help="Last energy of the simulated scans in keV. Required for a SCENE."
)
@click.option(
    "--step",
    type=_KEV,
    default=0.001,
    show_default=True,
    metavar="KEV",
    help="Step between the energies of a scene in keV.",
)
@click.option(
    "--material",
    metavar="NAME",
    help="Material of the scene whose contrast is measured. Default: the only material with a state_of_charge (how far "
    "a battery cathode is charged).",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the random numbers of a scene."
)
@click.option("--states", "charges", metavar="CHARGE,...", callback=charges_of,
              help="Simulate the scene once for each of these states of charge of the material, 0 to 1.")  # fmt: skip
@click.option("--region", "regions", multiple=True, callback=lambda ctx, param, values: tuple(map(box, values)),
              metavar=_BOX, help=(
                  "If SOURCE is a file: region of its frames in which the material is visible. Default: the whole "
                  "frame."
              ))  # fmt: skip
@click.option("--around", callback=lambda ctx, param, value: None if value is None else box(value), metavar=_BOX,
              help="Region around the material, to compare with. Default: no comparison.")  # fmt: skip
@click.option("--unit", type=click.Choice(["keV", "eV"]),
              help="Unit of the energies in a file. Default: as in the file, else keV.")  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path, dir_okay=False),
              help="Picture to write (.png); the table (.csv) goes next to it. Default: SOURCE_xafs.png.")  # fmt: skip
@json_option
def xafs(sources: Sequence[str], output: Path | None, as_json: bool, **values: Any) -> None:
    """Find a material's absorption edge and the energy of its highest contrast.

    SCENE is a YAML file or the name of a scene that comes with the package. Its radiographs are simulated at all
    energies from --from to --to. FILE is a text table of energy and absorption, an HDF5 file with `energy` and
    either `mu` or `frames` and `flats`, or the folder of a series of scans (`scan.energies`). If you give
    several FILEs, --region or --states, one picture shows all of them, each with its edge.

    Exit code 6: no edge was found. Picture and table are written in this case, too.

    Example: beamline xafs edge_scan --from 8.30 --to 8.42
    """
    from splatline_spectral.results import lines, write_results
    from splatline_spectral.sources import Jobs, results_of

    target = output or Path(f"{safe_name(Path(sources[-1]).stem)}_xafs.png")
    if target.suffix.lower() != ".png":
        raise click.BadParameter(f"{str(target)!r}: expected the name of a .png file", param_hint="--output")
    with answering(as_json) as answer:
        for path in (target, target.with_suffix(".csv")):
            refuse_existing(path)
        results = results_of(sources, Jobs(**values), answer.counting("radiographs at all energies"))
        write_results(results, target)
        facts = {"picture": target, "table": target.with_suffix(".csv"), "states": [each.data() for each in results]}
        answer.done(facts, *lines(results), f"written     {target}, {target.with_suffix('.csv')}")
    if without := [result for result in results if not result.edge.found]:
        why = without[0].edge.reason
        raise QualityError(
            f"No absorption edge was found in {without[0].title}: {why}. Picture and table were written."
        )
