"""`beamline study structure`: numbers of a microstructure, with intervals, against the number of projections."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import as_scan, json_option, parsed
from beamline.cli.terminal import Answer, answering
from beamline.core.errors import DataError
from beamline.core.files import atomic_file, refuse_existing, write_whole
from beamline.core.text import csv_text, safe_name
from splatline_structure.options import FEWEST_VIEWS

if TYPE_CHECKING:
    from splatline_structure.intervals import Interval


def numbers_of_views(text: str) -> list[int]:
    """Parse whole numbers separated by commas. Raises ValueError for other text, or for too few projections."""
    parts = text.split(",")
    if not all(part.strip().isdecimal() and int(part) >= FEWEST_VIEWS for part in parts):
        raise ValueError(
            f"{text!r}: expected numbers such as 45,90,180, each {FEWEST_VIEWS} or more, because each half of the "
            "projections is reconstructed"
        )
    return list(dict.fromkeys(map(int, parts)))


@click.command("study structure")
@click.argument("scan", metavar="SCAN|RUN", type=click.Path(path_type=Path), callback=as_scan)
@click.option(
    "--views",
    metavar="N,N,...",
    required=True,
    callback=parsed(numbers_of_views),
    help="Numbers of projections to compare, such as 45,90,180.",
)
@click.option(
    "--number",
    "names",
    multiple=True,
    default=("fraction_2", "size_50", "surface", "tortuosity_z"),
    show_default=True,
    help=(
        "Name of a number to compare, or of a kind of numbers (tortuosity: all three directions). You may give "
        "--number several times."
    ),
)
@click.option("-m", "--method", default="fista-tv", show_default=True, help="Method of the reconstructions.")
@click.option("--materials", type=click.IntRange(2, 6), default=2, show_default=True, help="Number of materials.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="New folder for the results. Default: name of SCAN + _views.",
)
@json_option
def study_structure(
    scan: Path,
    views: list[int],
    names: tuple[str, ...],
    method: str,
    materials: int,
    output: Path | None,
    as_json: bool,
) -> None:
    """Show how many projections the numbers of a microstructure need.

    SCAN is reconstructed with each number of projections. The result shows each number with its interval.

    Before a beamtime, use a SCAN of `beamline simulate`: the result says how many projections a wanted interval needs.

    Example: beamline study structure scan.h5 --views 45,90,180
    """
    from beamline.report.html import Picture
    from splatline_structure import pictures, results

    output = output or Path(f"{safe_name(scan.name.split('.')[0])}_views")
    with answering(as_json) as answer:
        refuse_existing(output)
        names = _numbers_named(names, materials)
        series = _measured_by_views(scan, views, method, materials, answer)
        rows = [[str(n), *results.cells(name, series[n][name])] for n in views for name in names]
        curves = pictures.curves_of({name: [series[n][name] for n in views] for name in names}, views, "projections")
        shown = [
            Picture(
                "Numbers against projections",
                "Each number with its interval. A gap in a curve means that the number could not be determined.",
                curves,
            )
        ]
        table = {f"{row[1]}, {row[0]} projections": series[int(row[0])][row[1]] for row in rows}
        page = results.page(
            f"Structure of {scan.name} against the number of projections", method, [], shown, table, {"scan": scan}
        )
        with atomic_file(output) as folder:
            folder.mkdir()
            write_whole(folder / "numbers.csv", csv_text([["n_views", *results.COLUMNS], *rows]))
            write_whole(folder / "report.html", page)
        answer.done({"output": output, "rows": rows}, *results.lines_of(table), f"output  {output}")


def _numbers_named(kinds: tuple[str, ...], materials: int) -> tuple[str, ...]:
    """The names of all numbers of these kinds, such as tortuosity_1 and tortuosity_2 for tortuosity.

    Raises:
        UsageError: no number has such a name.
    """
    import numpy as np

    from splatline_structure.numbers import Rules, structure_of

    known = structure_of(  # of an empty volume, for the names of the numbers
        np.zeros((2, 2, 2), np.float32), np.arange(1.0, materials), (1, 1, 1), Rules(materials, 1)
    ).numbers
    known_of = {kind: [each for each in known if f"{each}_".startswith(f"{kind}_")] for kind in kinds}
    if unknown := [kind for kind, each in known_of.items() if not each]:
        raise click.UsageError(
            f"--number {unknown[0]}: expected a kind of numbers, such as tortuosity, or one of {', '.join(known)}."
        )
    return tuple(dict.fromkeys(chain(*known_of.values())))


def _measured_by_views(
    scan: Path, views: list[int], method: str, materials: int, answer: Answer
) -> dict[int, Mapping[str, Interval]]:
    """The numbers of the scan, each with its interval, by the number of projections.

    The rotation axis and the box are those that the most projections give.

    Raises:
        DataError: the scan does not state the pixel size, or a volume cannot be measured.
    """
    from beamline.api import Selection, reconstruct
    from splatline_structure.measuring import measured
    from splatline_structure.particles import NECK
    from splatline_structure.volumes import ReadSlices, box_in

    values: dict[str, Any] = {
        "materials": materials, "particles": None, "parts": None, "scan": scan, "quick": False,
        "radius": 1, "smallest": 27, "neck": NECK, "side": 96, "through": 1,
    }  # fmt: skip
    series: dict[int, Mapping[str, Interval]] = {}
    tell, axis_col, box = answer.counting("reconstructing with fewer projections"), None, None
    for done, n in enumerate(sorted(views, reverse=True)):
        tell(done, len(views))
        record = reconstruct(scan, method, views=f"fixed:{n}", selection=Selection(axis_col=axis_col), say=None)
        if record.length_unit != "mm":
            raise DataError(
                f"{scan} does not state the pixel size. Make a copy that states it: `beamline ingest {scan} "
                "COPY.h5 --pixel-size-um SIZE`. Nothing was written."
            )
        axis_col = record.axis_col
        try:
            box = box or box_in(record.volume.data, "square")
            slices = slice(0, record.grid.shape[0])
            read = ReadSlices(record, slices, slices, slices.stop)
            series[n] = measured(scan, read, box, answer, **values).found.intervals
        except ValueError as error:
            raise DataError(f"{scan} cannot be measured with {n} projections: {error}. Nothing was written.") from error
    return series
