"""Options for facts that a scan file does not state; the same for every command that opens one."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.cli.options import parsed, together

_PATH = click.Path(path_type=Path)


underscored = parsed(lambda value: value.replace("-", "_"))
"""`line-integrals` on the command line becomes `line_integrals`."""

scan_options = together(
    click.option(
        "--quantity",
        type=click.Choice(["counts", "line-integrals"]),
        callback=underscored,
        help="Quantity of the pixels, if the file does not state it: raw counts, or corrected line integrals.",
    ),
    click.option("--angles", type=_PATH, help="Text file with one angle per line, degrees."),
    click.option("--angle-rows", metavar="A:B", help="Lines of --angles that belong to the projections."),
    click.option("--darks", type=_PATH, help="Image file or folder with darks, instead of those in the file."),
    click.option("--flats", type=_PATH, help="Image file or folder with flats, instead of those in the file."),
    click.option(
        "--data-path",
        metavar="DATASET",
        help="For an HDF5 file of any layout: its projections [frame, row, col], e.g. /raw/images.",
    ),
    click.option("--darks-path", metavar="DATASET", help="For --data-path: its darks."),
    click.option("--flats-path", metavar="DATASET", help="For --data-path: its flats."),
    click.option(
        "--angles-path",
        metavar="DATASET",
        help="For any HDF5 file: its angles, one for each projection or frame, in the unit that the dataset states.",
    ),
    click.option(
        "--angles-unit", type=click.Choice(["deg", "rad"]), help="Of --angles-path, instead of what the file states."
    ),
)
"""The fields of SourceOptions: --quantity, --angles, --angle-rows, --darks, --flats, --data-path ..."""
