"""Options for facts that a scan file does not state; the same for every command that opens one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.options import POSITIVE, NameChoice, option, parsed, together

if TYPE_CHECKING:
    from beamline.projections.scan_statistics import LightAsked

_PATH = click.Path(path_type=Path)


underscored = parsed(lambda value: value.replace("-", "_"))
"""`line-integrals` on the command line becomes `line_integrals`."""

scan_options = together(
    option(
        "--quantity",
        type=NameChoice(["counts", "transmission", "line-integrals"]),
        callback=underscored,
        help="Quantity of the pixels, if the file does not state it: raw counts, transmission (0 to 1), or its -log.",
    ),
    option(
        "--horizontal-axis", is_flag=True, help="The rotation axis lies along the rows: turn frames by a quarter turn."
    ),
    option("--angles", of_one_call=True, type=_PATH, help="Text file with one angle per line, degrees."),
    option("--angle-rows", of_one_call=True, metavar="A:B", help="Lines of --angles that belong to the projections."),
    option(
        "--darks",
        of_one_call=True,
        type=_PATH,
        help="TIFF, folder of TIFFs, or HDF5 file (FILE::DATASET) with darks, instead of those in the file.",
    ),
    option(
        "--flats",
        of_one_call=True,
        type=_PATH,
        help="TIFF, folder of TIFFs, or HDF5 file (FILE::DATASET) with flats, instead of those in the file.",
    ),
    option(
        "--data-path",
        metavar="DATASET",
        help="For an HDF5 file of any layout, or of several detectors: its projections [frame, row, col]: /raw/images.",
    ),
    option("--darks-path", metavar="DATASET", help="For --data-path: its darks."),
    option("--flats-path", metavar="DATASET", help="For --data-path: its flats."),
    option(
        "--angles-path",
        metavar="DATASET",
        help="For any HDF5 file: its angles, one for each projection or frame, in the unit that the dataset states.",
    ),
    option(
        "--frames",
        metavar="KINDS",
        help="Of which kind frames are, whatever names and keys say: darks=0:5,flats=5:10+95:100. Others are views.",
    ),
    option(
        "--then",
        of_one_call=True,
        multiple=True,
        type=_PATH,
        metavar="FILE",
        help="A further file of the same scan, whose frames follow. May be repeated.",
    ),
    option(
        "--from",
        "side_file",
        of_one_call=True,
        type=_PATH,
        metavar="FILE",
        help="File of the scanner's maker beside the images (.xtekct, .log, .pca, .xml): distances, pixels, angles.",
    ),
    option("--angles-unit", type=NameChoice(["deg", "rad"]), help="Of --angles-path, instead of what the file states."),
)
"""The fields of SourceOptions: --quantity, --angles, --angle-rows, --darks, --flats, --data-path ..."""

light_options = together(
    option(
        "--photons-per-count",
        excludes={"spectra": "of several energies the dose is counted in frames"},
        type=POSITIVE,
        help="X-ray photons at the sample that make a count.",
    ),
    click.option("--dose-in", metavar="MATERIAL", help="With it: the absorbed dose in a material or formula."),
)
"""What `light_asked` takes."""


def light_asked(photons_per_count: float | None, dose_in: str | None) -> LightAsked | None:
    """None if nobody asked for the light. Raises UsageError for a dose without photons."""
    if photons_per_count is None:
        if dose_in is not None:
            raise click.UsageError("--dose-in goes with --photons-per-count.")
        return None
    from beamline.projections.scan_statistics import LightAsked  # here: it loads matplotlib and numba

    return LightAsked(photons_per_count, dose_in)
