"""What `beamline recon` can be asked for."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.method_options import NOT_WITH_ERROR_BARS, NOT_WITH_SLABS, SLABS_RESUMED, method_options
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
from beamline.storage.volumes import suffixes_text
from recon.base.choices import AUTO
from recon.base.registry import in_folders
from recon.methods import names

if TYPE_CHECKING:
    from beamline.reconstruct.region import AroundSample, Region


def cluster_of(text: str) -> str:
    """`local:N` or `tcp://HOST:PORT`. Raises ValueError for any other text."""
    if not re.fullmatch(r"local:[1-9]\d*|tcp://[^\s/]+:\d+", text):
        raise ValueError(f"{text!r} is neither local:N with N workers on this machine, nor tcp://HOST:PORT")
    return text


_OF_FEATURES = in_folders("recon.features", "METHODS").items()
_FOR_COMPARISON = ", ".join(name for name, entry in _OF_FEATURES if not entry.several)


def region_of(text: str) -> Region | AroundSample:
    """Parse a box of voxels, `z0:z1,y0:y1,x0:x1`, or `auto` for the one around the sample. Raises ValueError for any
    other text.
    """
    from beamline.reconstruct.region import AroundSample, Region  # here: help needs none of it

    return AroundSample() if text == "auto" else Region.parse(text)


report_option = option(
    "--report/--no-report",
    of_one_call=True,
    default=True,
    show_default=True,
    help="Write an HTML page beside the output; a browser prints it on A4, also as PDF.",
)
unfinished_option = option(
    "--unfinished",
    of_one_call=True,
    is_flag=True,
    help="Accept an incomplete scan, one that failed or is still running, and use its frames.",
)
memory_option = option(
    "--memory",
    excludes=NOT_WITH_SLABS,
    metavar="SIZE",
    callback=parsed(memory_size),
    help="Memory to use, such as 8G or 500M: a larger scan of a parallel beam lies on the disk of the output "
    "meanwhile, and is reconstructed slab by slab. Default: 70 % of what is free, within a container's limit.",
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
        help="auto chooses fbp, fista-tv, discrete, pnp-dct or r2 by held-out views. r2 fits Gaussians to the views, "
        "fbp is filtered back-projection, the others iterate on voxels; "
        f"{_FOR_COMPARISON} are there for comparison. Default: auto; r2 with --follow and with options of the fit.",
    ),
    selection_options,
    method_options,
    heading(METHOD),
    option(
        "--filter",
        type=NameChoice(["ram-lak", "shepp-logan", "hann"]),
        default="hann",
        show_default=True,
        help="Filter of fbp, also of the fbp for comparison with r2. hann is best for few or noisy views.",
    ),
    heading(OUTPUT),
    option(
        "--max-residual",
        type=NOT_NEGATIVE,
        metavar="X",
        help="Exit with code 6 if the data residual (of views held out, if there are any) is larger.",
    ),
    heading(METHOD),
    seed_option,
    heading(OUTPUT),
    option(
        "--uncertainty",
        excludes=NOT_WITH_ERROR_BARS,
        is_flag=True,
        help="Write the standard deviation of each voxel, too, from two refits of halves of the views; by r2, fista-tv "
        "and fbp, into an .h5.",
    ),
    option(
        "--truth",
        of_one_call=True,
        metavar="FILE[:A:B]",
        help="Volume to compare with (.npz, .npy, HDF5); A:B are its slices to use.",
    ),
    option(
        "-o",
        "--output",
        of_one_call=True,
        metavar="PATH",
        callback=parsed(volume_path),
        help=f"Output: {suffixes_text()}. Default: FILE's stem + _METHOD.h5, in this folder.",
    ),
    report_option,
    heading(DATA),
    option(
        "--follow",
        excludes={SLABS_RESUMED: "these slabs belong to a finished scan"},
        of_one_call=True,
        is_flag=True,
        help="Follow a running scan: reconstruct while it grows. A method that needs all views waits for its end.",
    ),
    option(
        "--previous-part",
        "earlier",
        former="--earlier",
        needs=("follow", "is for a run that goes on: give --follow, or the joined.h5 of its parts."),
        of_one_call=True,
        type=click.Path(path_type=Path),
        multiple=True,
        metavar="FILE",
        help="With --follow: an earlier part of a resumed run, whose views come first. May be repeated.",
    ),
    unfinished_option,
    heading(RESOURCES),
    memory_option,
    option(
        "--cluster",
        excludes=NOT_WITH_SLABS,
        of_one_call=True,
        metavar="local:N|tcp://HOST:PORT",
        callback=parsed(cluster_of),
        help="Workers of dask.distributed that reconstruct slabs, where a volume is made in slabs: N on this machine, "
        "or those of a scheduler. It needs splatline-cluster.",
    ),
    heading(OUTPUT),
    option(
        "--roi",
        "region",
        excludes={"follow": "it is for a finished scan", "truth": "a truth is compared with the whole volume"},
        metavar="Z0:Z1,Y0:Y1,X0:X1|auto",
        callback=parsed(region_of),
        help="Box of voxels to write, of the volume that the same options give without this one. It is made of the "
        "rows that show it; fbp makes these voxels alone. auto: the box around the sample, as coarse views show it.",
    ),
    option(
        "--write-config",
        of_one_call=True,
        type=click.Path(path_type=Path),
        help="Write the options of this call as a recipe to this file (-: print it). Without -o that is all that is "
        "done.",
    ),
    heading(RESOURCES),
    option(
        "--dry-run",
        "dry",
        excludes={"follow": "a scan that runs takes its own time", "budget": "it states the time of every method"},
        of_one_call=True,
        is_flag=True,
        help="Print the memory, time and disk space that it will take, and end. Nothing is run.",
    ),
    option(
        "--beside-scan",
        "beside",
        of_one_call=True,
        is_flag=True,
        hidden=True,
        help="End when stdin does, with the process that started this one.",
    ),
    heading(OUTPUT),
    json_option,
)
"""All options of `beamline recon`, and its argument."""
