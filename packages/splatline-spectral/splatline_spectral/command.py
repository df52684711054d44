"""`beamline xafs`: the energy of the highest contrast of a material, from a scene or from measured energies."""

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
    """`first:end,first:end` of rows and columns."""
    match = re.fullmatch(r"(\d+):(\d+),(\d+):(\d+)", value)
    if match is None or int(match[1]) >= int(match[2]) or int(match[3]) >= int(match[4]):
        raise click.BadParameter(f"{value!r} is not {_BOX}, e.g. 100:200,50:120")
    return int(match[1]), int(match[2]), int(match[3]), int(match[4])


def charges_of(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, ...]:
    """Numbers from 0 to 1 apart by commas."""
    try:
        numbers = tuple(float(part) for part in value.split(",")) if value else ()
    except ValueError:
        numbers = (2.0,)
    if not all(0 <= charge <= 1 for charge in numbers):
        raise click.BadParameter(f"{value!r} are not states of charge; expected numbers from 0 to 1, e.g. 0,0.5,1")
    return numbers


@click.command()
@click.argument("sources", metavar="SCENE|FILE...", nargs=-1, required=True)
@click.option("--from", "low", type=_KEV, metavar="KEV", help="First energy; a scene needs it.")
@click.option("--to", "high", type=_KEV, metavar="KEV", help="Last energy; a scene needs it.")
@click.option("--step", type=_KEV, default=0.001, show_default=True, metavar="KEV", help="Between a scene's energies.")
@click.option("--material", metavar="NAME", help="Material of the scene. Default: the one with a state of charge.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of a scene's random numbers.")
@click.option("--states", "charges", metavar="CHARGE,...", callback=charges_of,
              help="States of charge, 0 to 1, that the scene's material has, one after the other.")  # fmt: skip
@click.option("--region", "regions", multiple=True, callback=lambda ctx, param, values: tuple(map(box, values)),
              metavar=_BOX, help="The material in a file's frames; all of them unless given.")  # fmt: skip
@click.option("--around", callback=lambda ctx, param, value: None if value is None else box(value), metavar=_BOX,
              help="Region around the material, for the contrast. Default: none.")  # fmt: skip
@click.option("--unit", type=click.Choice(["keV", "eV"]),
              help="Unit of a file's energies. Default: as in the file, else keV.")  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path, dir_okay=False),
              help="Picture (.png), with the table beside it (.csv). Default: SOURCE_xafs.png.")  # fmt: skip
@json_option
def xafs(sources: Sequence[str], output: Path | None, as_json: bool, **values: Any) -> None:
    """Find a material's absorption edge and the energy of its highest contrast.

    SCENE is a YAML file or the name of a scene that comes with the package: its radiographs are simulated at all
    energies from --from to --to. FILE is a text table of energy and absorption, an HDF5 file with `energy` and
    either `mu` or `frames` and `flats`, or the folder of a series of scans (`scan.energies`). Several FILEs, --region
    or --states come into one picture with the edge of each.

    Exit code 6: no edge was found; picture and table are written, too.
    """
    from splatline_spectral.results import lines, write_results
    from splatline_spectral.sources import Jobs, results_of

    target = output or Path(f"{safe_name(Path(sources[-1]).stem)}_xafs.png")
    if target.suffix.lower() != ".png":
        raise click.BadParameter(f"{str(target)!r} is not a picture; give a .png file", param_hint="--output")
    with answering(as_json) as answer:
        for path in (target, target.with_suffix(".csv")):
            refuse_existing(path)
        results = results_of(sources, Jobs(**values), answer.counting("energies"))
        write_results(results, target)
        facts = {"picture": target, "table": target.with_suffix(".csv"), "states": [each.data() for each in results]}
        answer.done(facts, *lines(results), f"written     {target}, {target.with_suffix('.csv')}")
    if without := [result for result in results if not result.edge.found]:
        why = without[0].edge.reason
        raise QualityError(
            f"No absorption edge was found in {without[0].title}: {why}. Picture and table were written."
        )
