"""Options about the scan file, the selected part of the scan and its corrections. All commands that open a scan share
them."""

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
    from beamline.projections.scan_statistics import DoseRequest
    from beamline.projections.selection import Selection
    from beamline.storage.readers.open import SourceOptions


_PATH = click.Path(path_type=Path)


underscored = parsed(lambda value: value.replace("-", "_"))
"""Converts `line-integrals` from the command line to `line_integrals`."""

scan_options = together(
    option(
        "--quantity",
        type=NameChoice(["counts", "transmission", "line-integrals"]),
        callback=underscored,
        help="What the pixel values are, if the file does not say so: raw counts, transmission (0 to 1), or line "
        "integrals (-log of the transmission).",
    ),
    option(
        "--horizontal-axis",
        is_flag=True,
        help="The rotation axis is parallel to the detector rows: rotate all frames by 90°.",
    ),
    option(
        "--angles",
        of_one_call=True,
        type=_PATH,
        help=(
            "File with the angles in degrees: a text file with one angle per line, a table with a column of angles, "
            ".npy, or a dataset in an HDF5 file (in the unit that the dataset states; FILE::NAME if there are "
            "several datasets). Default: the angles in the scan file."
        ),
    ),
    option(
        "--angle-rows",
        of_one_call=True,
        metavar="A:B",
        help=(
            "Lines of --angles that belong to the projections: from line A up to, but not including, line B. "
            "Default: all."
        ),
    ),
    option(
        "--darks",
        of_one_call=True,
        type=_PATH,
        help="File with darks: TIFF, folder of images, .npy, Zarr or HDF5 (FILE::DATASET); or a number, the counts of "
        "every pixel in a dark. Default: the darks in the scan file.",
    ),
    option(
        "--flats",
        of_one_call=True,
        type=_PATH,
        help="File with flats: TIFF, folder of images, .npy, Zarr or HDF5 (FILE::DATASET). Default: the flats in the "
        "scan file.",
    ),
    option(
        "--data-path",
        metavar="DATASET",
        help="Name of the dataset with the projections, for an HDF5 or Zarr file of unknown layout or with several "
        "detectors, for example /raw/images. If the dimensions are not frame,row,col, add their order: "
        "/raw/images:frame,col,row.",
    ),
    option(
        "--order",
        metavar="DIMENSIONS",
        help="Order of the dimensions of the projections. The default is frame,row,col. Give row,view,col for a stack "
        "of sinograms, and view,col or col,view for a single sinogram. This option also works for a series of images.",
    ),
    option("--darks-path", metavar="DATASET", help="With --data-path: name of the dataset with the darks."),
    option("--flats-path", metavar="DATASET", help="With --data-path: name of the dataset with the flats."),
    option(
        "--angles-path",
        metavar="DATASET",
        help="Name of the dataset with the angles in an HDF5 file, one for each projection or for each frame, in the "
        "unit that the dataset states.",
    ),
    option(
        "--frames",
        metavar="KINDS",
        help=(
            "State which frames are darks and flats, for example darks=0:5,flats=5:10+95:100. All other frames are "
            "projections. This option overrides the file. none=30:38+61:62 leaves these frames out. If you give "
            "only none=, the file states the kind of the other frames. If two exposures or thresholds alternate, "
            "--frames 0::2 or --frames 1::2 uses every second projection, dark and flat."
        ),
    ),
    option(
        "--append",
        "then",
        former="--then",
        of_one_call=True,
        multiple=True,
        type=_PATH,
        metavar="FILE",
        help="Another file of the same scan; its frames follow the frames of FILE. Can be given several times.",
    ),
    option(
        "--scanner-file",
        "side_file",
        former="--from",
        of_one_call=True,
        type=_PATH,
        metavar="FILE",
        help="File that the software of the scanner wrote next to the images (.xtekct, .log, .pca, .xml). The "
        "program reads distances, pixel size and angles from this file.",
    ),
    option(
        "--angles-unit",
        type=NameChoice(["deg", "rad"]),
        help="Unit of --angles-path or --angles: degrees or radians. Default: the unit that the file states.",
    ),
)
"""The options that set the fields of SourceOptions: --quantity, --angles, --angle-rows, --darks, --flats, ..."""

light_options = together(
    option(
        "--photons-per-count",
        excludes={
            "spectra": "photons are not counted for scans at several energies; the report of such a scan states the "
            "dose as a number of frames"
        },
        type=POSITIVE,
        help="Number of X-ray photons at the sample for one count of the camera.",
    ),
    click.option(
        "--dose-in",
        metavar="MATERIAL",
        help="With --photons-per-count: also report the absorbed dose, for a sample of this material, for example "
        "water or SiO2.",
    ),
)
"""The options whose values `dose_request` uses."""


def dose_request(photons_per_count: float | None, dose_in: str | None) -> DoseRequest | None:
    """Photons per count and material for the dose; None without --photons-per-count.

    Raises:
        UsageError: --dose-in without --photons-per-count.
    """
    if photons_per_count is None:
        if dose_in is not None:
            raise click.UsageError("--dose-in needs --photons-per-count.")
        return None
    from beamline.projections.scan_statistics import DoseRequest  # imported here because it loads matplotlib and numba

    return DoseRequest(photons_per_count, dose_in)


def span(value: str) -> tuple[int, int]:
    """Parse FIRST:END, two whole numbers. Raises ValueError for any other text."""
    match = re.fullmatch(r"(\d+):(\d+)", value)
    if match is None or int(match[1]) >= int(match[2]):
        raise ValueError(f"{value!r} is not FIRST:END with 0 <= FIRST < END, e.g. 100:200")
    return int(match[1]), int(match[2])


def column(value: str) -> float | None:
    """Parse a column of the detector; "auto" gives None. Raises ValueError for any other text."""
    if value == "auto":
        return None
    if value.startswith("try:"):
        raise ValueError(f"to draw slices with several axes, use beamline sweep FILE axis={value.removeprefix('try:')}")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{value!r} is neither a column number (0: centre of the first column) nor auto")
    return number


def distances(value: str) -> tuple[float, float]:
    """Parse SOD:SDD in mm. Raises ValueError for any other text."""
    try:
        sod, sdd = (float(part) for part in value.split(":"))
    except ValueError:
        sod = sdd = math.nan
    if not 0 < sod <= sdd < math.inf:
        raise ValueError(f"{value!r} is not SOD:SDD with 0 < SOD <= SDD in mm, e.g. 100:140")
    return sod, sdd


def selection_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of `Selection` (--views and others), of every correction, and those of `scan_options`."""
    of_steps = (_of_step(option) for step in registered() for option in options_of(step).values())
    return together(*_BEFORE, scan_options, *_AFTER, *of_steps)(command)


def chosen(file: Path, seed: int, values: Mapping[str, Any]) -> tuple[SourceOptions, Selection]:
    """Source options and selection, from the parameter values of a command."""
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
    """The correction steps that the options in `values` ask for."""
    try:
        return steps_of(values)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


def _of_step(step_option: Option) -> Callable[..., Any]:
    """The command-line option for an option of a correction step."""
    return option(
        step_option.name,
        type=NameChoice(step_option.choices)
        if step_option.choices
        else click.Path(path_type=Path)
        if step_option.path
        else str,
        callback=parsed(lambda value: step_option.parse(str(value))),
        default=step_option.default,
        show_default=step_option.default is not None,
        metavar=step_option.metavar,
        help=step_option.help,
    )


_BEFORE = (
    heading(DATA),
    option(
        "--views",
        default="all",
        show_default=True,
        metavar="SPEC",
        help="Projections to use. fixed:N: N evenly spread projections. sector:A-B[:N]: the projections from A to B "
        "degrees, or N of them. random:N[:SEED]: N random projections. first:N: the first N projections. every:K: "
        "every K-th projection.",
    ),
    option(
        "--rows",
        callback=parsed(span),
        metavar="FIRST:END",
        help=(
            "Detector rows to use: from FIRST up to, but not including, END, counted from 0. The volume has one "
            "slice per row. Default: all."
        ),
    ),
    option(
        "--cols",
        callback=parsed(span),
        metavar="FIRST:END",
        help="Detector columns to use, as if the detector had only these columns: --axis and messages count columns "
        "from FIRST. "
        "Default: all.",
    ),
    option(
        "--bin",
        "binning",
        type=WholeRange(min=1),
        default=1,
        show_default=True,
        help="Average blocks of N x N pixels. Binning reduces noise, memory and time, and makes voxels N times as "
        "large.",
    ),
    option(
        "--axis",
        callback=parsed(column),
        metavar="PX|auto",
        default="auto",
        show_default=True,
        help="Rotation axis (centre of rotation): column of the unbinned detector (0: centre of the first column "
        "used), or auto to find it. To compare slices with several axes: beamline sweep FILE axis=80:90:0.5",
    ),
    option(
        "--sample-width",
        type=FiniteRange(min=0, min_open=True),
        metavar="MM",
        help="Width of the sample in mm (in px if the pixel size is unknown), if it is wider than the field of "
        "view. The whole sample is then reconstructed. Default: the value in the scan file; if the file states "
        "no width, it is estimated with held-out projections.",
    ),
)
_AFTER = (
    heading(DATA),
    option(
        "--frames-per-view",
        type=WholeRange(min=1),
        metavar="N",
        help="Average N successive projections, for example the projections that a step scan takes at one angle. 1: "
        "no averaging. Default: the number in the scan file.",
    ),
    option(
        "--pixel-size-um",
        type=POSITIVE,
        help="Pixel size in µm, at the sample (cone beam: on the detector). Default: the value in the scan file.",
    ),
    option(
        "--cone",
        callback=parsed(distances),
        metavar="SOD:SDD",
        help="Cone beam: distances in mm from the source to the rotation axis (SOD) and to the detector (SDD). "
        "Default: the values in the scan file.",
    ),
    option(
        "--central-row",
        type=FiniteRange(),
        metavar="PX",
        help="Cone beam: detector row at which the ray perpendicular to the rotation axis meets the detector "
        "(unbinned, 0: centre of the first row). This row may lie outside the detector. Default: the middle row.",
    ),
    heading(CORRECTIONS),
)
