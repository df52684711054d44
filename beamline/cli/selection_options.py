"""Options of a scan, its part and its corrections; the same for every command that opens one or reconstructs."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import POSITIVE, FiniteRange, NameChoice, WholeRange, option, parsed, together
from beamline.cli.recipe import CORRECTIONS, DATA, heading
from beamline.projections.protocols import PrepStep
from beamline.projections.registry import registered, steps_of
from beamline.projections.step import Option, options_of

if TYPE_CHECKING:
    from beamline.projections.scan_statistics import LightAsked
    from beamline.projections.selection import Selection
    from beamline.storage.readers.open import SourceOptions


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
    option(
        "--angles",
        of_one_call=True,
        type=_PATH,
        help="File of angles in degrees: a text with one a line, a table with a column named so, .npy, or a list in an "
        "HDF5 file by its unit; FILE::NAME for one of several.",
    ),
    option("--angle-rows", of_one_call=True, metavar="A:B", help="Lines of --angles that belong to the projections."),
    option(
        "--darks",
        of_one_call=True,
        type=_PATH,
        help="TIFF, folder of images, .npy, Zarr or HDF5 file (FILE::DATASET) with darks, instead of those in the "
        "file; or a number, the counts of every pixel.",
    ),
    option(
        "--flats",
        of_one_call=True,
        type=_PATH,
        help="TIFF, folder of images, .npy, Zarr or HDF5 file (FILE::DATASET) with flats, instead of those in the "
        "file.",
    ),
    option(
        "--data-path",
        metavar="DATASET",
        help="For an HDF5 file or Zarr of any layout, or of several detectors: its projections, as /raw/images, with "
        "their dimensions where these are not frame,row,col: /raw/images:frame,col,row.",
    ),
    option(
        "--order",
        metavar="DIMENSIONS",
        help="Dimensions of the projections, of images one after the other, too, where these are not frame,row,col: "
        "row,view,col for a stack of sinograms, view,col or col,view for one.",
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
        help="Kinds of frames, overriding names and keys of the file: darks=0:5,flats=5:10+95:100. Others are views. "
        "none=30:38+61:62 leaves frames out; alone, it keeps the kinds of the others. "
        "0::2 or 1::2: every second view, with its darks and flats, where two exposures or thresholds alternate.",
    ),
    option(
        "--append",
        "then",
        former="--then",
        of_one_call=True,
        multiple=True,
        type=_PATH,
        metavar="FILE",
        help="A further file of the same scan, whose frames follow. May be repeated.",
    ),
    option(
        "--scanner-file",
        "side_file",
        former="--from",
        of_one_call=True,
        type=_PATH,
        metavar="FILE",
        help="File of the scanner's vendor beside the images (.xtekct, .log, .pca, .xml): distances, pixels, angles.",
    ),
    option(
        "--angles-unit",
        type=NameChoice(["deg", "rad"]),
        help="Unit of --angles-path or --angles, overriding the one in the file.",
    ),
)
"""The fields of SourceOptions: --quantity, --angles, --angle-rows, --darks, --flats, --data-path ..."""

light_options = together(
    option(
        "--photons-per-count",
        excludes={"spectra": "of several energies the dose is counted in frames"},
        type=POSITIVE,
        help="Number of X-ray photons at the sample per count.",
    ),
    click.option(
        "--dose-in",
        metavar="MATERIAL",
        help="With --photons-per-count: report the absorbed dose in this material or formula.",
    ),
)
"""What `light_asked` takes."""


def light_asked(photons_per_count: float | None, dose_in: str | None) -> LightAsked | None:
    """The light options; None without --photons-per-count. UsageError for a dose without photons."""
    if photons_per_count is None:
        if dose_in is not None:
            raise click.UsageError("--dose-in needs --photons-per-count.")
        return None
    from beamline.projections.scan_statistics import LightAsked  # here: it loads matplotlib and numba

    return LightAsked(photons_per_count, dose_in)


def span(value: str) -> tuple[int, int]:
    """Parse FIRST:END, two whole numbers. ValueError for anything else."""
    match = re.fullmatch(r"(\d+):(\d+)", value)
    if match is None or int(match[1]) >= int(match[2]):
        raise ValueError(f"{value!r} is not FIRST:END with 0 <= FIRST < END, e.g. 100:200")
    return int(match[1]), int(match[2])


def column(value: str) -> float | None:
    """Parse a column of the detector; "auto" gives None. ValueError for anything else."""
    if value == "auto":
        return None
    if value.startswith("try:"):
        raise ValueError(f"slices by several axes are drawn by beamline sweep FILE axis={value.removeprefix('try:')}")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{value!r} is neither a column number (0: centre of the first) nor auto")
    return number


def distances(value: str) -> tuple[float, float]:
    """Parse SOD:SDD in mm. ValueError for anything else."""
    try:
        sod, sdd = (float(part) for part in value.split(":"))
    except ValueError:
        sod = sdd = math.nan
    if not 0 < sod <= sdd < math.inf:
        raise ValueError(f"{value!r} is not SOD:SDD with 0 < SOD <= SDD in mm, e.g. 100:140")
    return sod, sdd


def selection_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of `Selection`, from --views on, with those of every step, and what `scan_options` adds."""
    of_steps = (_of_step(option) for step in registered() for option in options_of(step).values())
    return together(*_BEFORE, scan_options, *_AFTER, *of_steps)(command)


def chosen(file: Path, seed: int, values: Mapping[str, Any]) -> tuple[SourceOptions, Selection]:
    """Source and selection that the parameter values of a command describe."""
    from beamline.projections.selection import Selection
    from beamline.storage.readers.open import SourceOptions

    pixel_size_um = values["pixel_size_um"]
    selection = Selection(
        views=values["views"],
        rows=values["rows"],
        binning=values["binning"],
        axis_col=values["axis"],
        sample_width=values["sample_width"],
        pixel_size_mm=None if pixel_size_um is None else pixel_size_um * 1e-3,
        cone=values["cone"],
        central_row=values["central_row"],
        seed=seed,
        steps=chosen_steps(values),
    )
    facts = {field.name: values[field.name] for field in fields(SourceOptions) if field.name in values}
    return SourceOptions(file, **facts), selection


def chosen_steps(values: Mapping[str, Any]) -> tuple[PrepStep, ...]:
    """The steps for the options in `values`."""
    try:
        return steps_of(values)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


def _of_step(asked: Option) -> Callable[..., Any]:
    """An option of a step as an option of the command line."""
    return option(
        asked.name,
        type=NameChoice(asked.choices) if asked.choices else click.Path(path_type=Path) if asked.path else str,
        callback=parsed(lambda value: asked.parse(str(value))),
        default=asked.default,
        show_default=asked.default is not None,
        metavar=asked.metavar,
        help=asked.help,
    )


_BEFORE = (
    heading(DATA),
    option(
        "--views",
        default="all",
        show_default=True,
        metavar="SPEC",
        help="all | fixed:N | sector:A-B[:N] (degrees) | random:N[:SEED] | first:N | every:K",
    ),
    option(
        "--rows",
        callback=parsed(span),
        metavar="FIRST:END",
        help="Detector rows to use; the volume has one slice per row. Default: all.",
    ),
    option(
        "--cols",
        callback=parsed(span),
        metavar="FIRST:END",
        help="Detector columns to use, as if there were no others: --axis and messages count from FIRST. Default: all.",
    ),
    option(
        "--bin",
        "binning",
        type=WholeRange(min=1),
        default=1,
        show_default=True,
        help="Average blocks of N x N pixels.",
    ),
    option(
        "--axis",
        callback=parsed(column),
        metavar="PX|auto",
        default="auto",
        show_default=True,
        help="Rotation axis: column of the unbinned detector (0: centre of the first column used), or auto to find it. "
        "beamline sweep FILE axis=80:90:0.5 draws a slice by each of these axes.",
    ),
    option(
        "--sample-width",
        type=FiniteRange(min=0, min_open=True),
        metavar="MM",
        help="Width of a sample that is wider than the field, which is reconstructed as wide as it is (in px where the "
        "pixel size is unknown). Default: as the scan file says, or measured by views held out.",
    ),
)
_AFTER = (
    heading(DATA),
    option(
        "--frames-per-view",
        type=WholeRange(min=1),
        metavar="N",
        help="Average N successive projections to one view, such as those that a step scan takes at one angle; 1: "
        "average none. Default: as the plan in the scan file says.",
    ),
    option(
        "--pixel-size-um",
        type=POSITIVE,
        help="Pixel size at the sample (cone beam: on the detector). Default: as in the file.",
    ),
    option(
        "--cone",
        callback=parsed(distances),
        metavar="SOD:SDD",
        help="Cone beam: mm from the source to the rotation axis and to the detector. Default: as in the file.",
    ),
    option(
        "--central-row",
        type=FiniteRange(),
        metavar="PX",
        help="Cone beam: row of the unbinned detector that the central ray meets, the one at a right angle to the "
        "rotation axis (0: centre of the first row; also beyond the detector). Default: the middle row.",
    ),
    heading(CORRECTIONS),
)
