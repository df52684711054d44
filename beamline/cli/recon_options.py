"""The options of `beamline recon`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.method_options import method_options
from beamline.cli.options import (
    NOT_NEGATIVE,
    MethodChoice,
    NameChoice,
    json_option,
    option,
    parsed,
    scan_argument,
    seed_option,
    together,
    volume_path,
)
from beamline.cli.recipe import DATA, METHOD, OUTPUT, RESOURCES, config_option, heading
from beamline.cli.selection_options import selection_options
from beamline.core.text import memory_size
from beamline.reconstruct.combinations import EXCLUDED
from beamline.storage.volumes import suffixes_text
from recon.base.choices import AUTO
from recon.base.registry import in_folders
from recon.methods import CANDIDATES, names

if TYPE_CHECKING:
    from beamline.reconstruct.region import AroundSample, Region


def cluster_of(text: str) -> str:
    """`local:N` or `tcp://HOST:PORT`. Raises ValueError for any other text."""
    if not re.fullmatch(r"local:[1-9]\d*|tcp://[^\s/]+:\d+", text):
        raise ValueError(f"{text!r} is neither local:N (N workers on this computer) nor tcp://HOST:PORT")
    return text


_OF_FEATURES = in_folders("recon.features", "METHODS").items()
_FOR_COMPARISON = ", ".join(name for name, entry in _OF_FEATURES if not (entry.several or name in CANDIDATES))


def region_of(text: str) -> Region | AroundSample:
    """Parse a box of voxels, `z0:z1,y0:y1,x0:x1`, or `auto` for the box around the sample.

    Raises:
        ValueError: any other text.
    """
    from beamline.reconstruct.region import AroundSample, Region  # imported here because help does not need it

    return AroundSample() if text == "auto" else Region.parse(text)


report_option = option(
    "--report/--no-report",
    of_one_call=True,
    default=True,
    show_default=True,
    help="Write a report about the volume: an HTML page next to the output, which a browser can print on A4 or as PDF.",
)
unfinished_option = option(
    "--unfinished",
    of_one_call=True,
    is_flag=True,
    help="Use the frames of a scan that is incomplete, because it failed or is still running. Without this option the "
    "command stops with an error.",
)
memory_option = option(
    "--memory",
    excludes=EXCLUDED["memory"],
    metavar="SIZE",
    callback=parsed(memory_size),
    help="Memory that may be used, for example 8G or 500M. A parallel-beam scan that needs more memory is kept on "
    "the disk of the output and reconstructed slab by slab. Default: 70 % of the free memory, within the limit of a "
    "container.",
)

recon_options = together(
    heading(DATA),
    config_option,
    scan_argument,
    heading(METHOD),
    option(
        "-m",
        "--method",
        type=MethodChoice((AUTO, *names())),
        metavar="NAME",
        help="Reconstruction method. auto tries fbp, fista-tv, discrete, pnp-dct and r2 on some rows and takes the "
        "simplest one that predicts held-out projections as well as the best. fbp: filtered back-projection. r2: fit "
        f"of Gaussians. fista-tv, discrete, pnp-dct: iterations on voxels. All names: {', '.join((AUTO, *names()))} "
        f"({_FOR_COMPARISON} are meant for comparison). Default: auto; r2 with --follow and with options of the fit.",
    ),
    selection_options,
    method_options,
    heading(METHOD),
    option(
        "--filter",
        type=NameChoice(["ram-lak", "shepp-logan", "hann"]),
        default="hann",
        show_default=True,
        help="Filter of fbp, and of the fbp volume with which other methods are compared. hann is best for few or "
        "noisy projections.",
    ),
    heading(OUTPUT),
    option(
        "--max-residual",
        type=NOT_NEGATIVE,
        metavar="X",
        help=(
            "Largest acceptable residual, as a fraction of the measured projections. If the residual is larger, the "
            "command ends with exit code 6. If there are held-out projections, their residual is used. Default: no "
            "limit."
        ),
    ),
    heading(METHOD),
    seed_option,
    heading(OUTPUT),
    option(
        "--uncertainty",
        excludes=EXCLUDED["uncertainty"],
        is_flag=True,
        help="Also write the standard deviation of each voxel, estimated by fitting two halves of the projections "
        "again. For auto, r2, fista-tv, discrete, pnp-dct and fbp; needs .h5 output.",
    ),
    option(
        "--truth",
        of_one_call=True,
        metavar="FILE[:A:B]",
        help="Ground truth, to compare the volume with (PSNR, SSIM): .npz, .npy or HDF5. A:B: use only these slices.",
    ),
    option(
        "-o",
        "--output",
        of_one_call=True,
        metavar="PATH",
        callback=parsed(volume_path),
        help=f"File for the volume; its suffix sets the format: {suffixes_text()}. Default: the name of FILE with "
        "_METHOD.h5, in the current folder.",
    ),
    report_option,
    heading(DATA),
    option(
        "--follow",
        excludes=EXCLUDED["follow"],
        of_one_call=True,
        is_flag=True,
        help="Reconstruct a scan while it is running. Methods that need all projections wait for the end of the scan.",
    ),
    option(
        "--previous-part",
        "earlier",
        former="--earlier",
        needs=(
            "follow",
            "works only while `beamline scan --resume` continues the run: add --follow. If the run has ended, give "
            "joined.h5 (all parts of the run) as FILE.",
        ),
        of_one_call=True,
        type=click.Path(path_type=Path),
        multiple=True,
        metavar="FILE",
        help="With --follow: file of an earlier part of a resumed run; its projections come first. Can be given "
        "several times.",
    ),
    unfinished_option,
    heading(RESOURCES),
    memory_option,
    option(
        "--cluster",
        excludes=EXCLUDED["cluster"],
        of_one_call=True,
        metavar="local:N|tcp://HOST:PORT",
        callback=parsed(cluster_of),
        help="Reconstruct slabs in parallel with dask.distributed, if the volume is made in slabs: with N workers on "
        "this computer, or with the workers of a scheduler. Needs splatline-cluster. Default: one slab after the "
        "other.",
    ),
    heading(OUTPUT),
    option(
        "--roi",
        "region",
        excludes=EXCLUDED["roi"],
        metavar="Z0:Z1,Y0:Y1,X0:X1|auto",
        callback=parsed(region_of),
        help="Write only this box of voxels; the indices count the voxels of the full volume. Only detector rows "
        "that see the box are used. fbp computes only these voxels; other methods compute full slices and crop "
        "the slices. auto: the box around the sample, found in binned projections. Default: all voxels.",
    ),
    option(
        "--write-config",
        of_one_call=True,
        type=click.Path(path_type=Path),
        help="Save the options of this command as a recipe in this file (-: print it). Without -o, nothing is "
        "reconstructed.",
    ),
    heading(RESOURCES),
    option(
        "--dry-run",
        "dry",
        excludes=EXCLUDED["dry-run"],
        of_one_call=True,
        is_flag=True,
        help="Print the memory, time and disk space that the reconstruction needs, and stop. Nothing is computed.",
    ),
    option(
        "--beside-scan",
        "beside",
        of_one_call=True,
        is_flag=True,
        hidden=True,
        help="Stop when stdin closes, that is, when the process that started this one ends.",
    ),
    heading(OUTPUT),
    json_option,
)
"""All options and the argument of `beamline recon`."""
