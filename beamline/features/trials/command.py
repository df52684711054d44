"""`beamline tradeoff` and `study`: compare methods and settings, or selections of projections, on one scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from beamline.cli.method_options import equal_time, row_options, row_settings
from beamline.cli.options import (
    MethodChoice,
    NameChoice,
    WholeRange,
    json_option,
    new_folder_option,
    others,
    parsed,
    refuse_contradictions,
    scan_argument,
    seed_option,
    set_by,
    unknown_method,
    with_request,
)
from beamline.cli.recipe import DATA, METHOD, OUTPUT, Grouped, heading, names_given, typed_line
from beamline.cli.selection_options import chosen, selection_options
from beamline.core.text import safe_name
from beamline.features.trials.sweep_command import sweep
from beamline.features.trials.view_choices import STUDIES
from recon.base.choices import Filter
from recon.methods import BASELINE, DEFAULT, names_compared, names_of_trials

if TYPE_CHECKING:
    from beamline.features.trials.runner import ComparedScan


__all__ = ["study", "sweep", "tradeoff"]


def listed(value: str) -> tuple[str, ...]:
    """Parse names of methods separated by commas. Raises ValueError for an unknown name."""
    wanted = tuple(dict.fromkeys(name.strip() for name in value.split(",")))
    if others := [name for name in wanted if name not in names_of_trials()]:
        raise ValueError(unknown_method(others[0], names_of_trials()))
    return wanted


_ALL_METHODS = ", ".join(names_of_trials())
_NOT_COMPARED = ", ".join(name for name in names_of_trials() if name not in names_compared())


@dataclass(frozen=True, eq=False)
class TradeoffRequest:
    """The arguments of `beamline tradeoff`."""

    file: Path = set_by(scan_argument)
    truth: str | None = set_by(
        heading(DATA),
        "--truth",
        metavar="FILE[:A:B]",
        help="Ground truth, to compare the volumes with: .npz, .npy or HDF5. A:B: use only these slices. Default: "
        "compare with held-out projections.",
    )
    values: Mapping[str, Any] = others(selection_options)
    methods: tuple[str, ...] | None = set_by(
        heading(METHOD),
        "--methods",
        callback=parsed(listed),
        metavar="A,B,...",
        help=f"Methods to compare: some of {_ALL_METHODS}. Default: all except {_NOT_COMPARED}.",
    )
    quick: bool = set_by(
        "--quick/--full",
        default=True,
        show_default=True,
        help="Effort. --quick: few and short reconstructions. --full: many and long reconstructions.",
    )
    seconds: float | None = set_by(equal_time)
    seed: int = set_by(heading(METHOD), seed_option)
    output: Path | None = set_by(heading(OUTPUT), new_folder_option("FILE's stem + _tradeoff"))
    as_json: bool = set_by(json_option)


@click.command(
    cls=Grouped,
    first=(
        "methods",
        "quick",
        "axis",
        "seconds",
        "truth",
        "views",
        "rows",
        "binning",
        "seed",
        "output",
    ),
)
@with_request(TradeoffRequest)
def tradeoff(request: TradeoffRequest) -> None:
    """Reconstruct the scan in FILE with many methods and settings, and compare their quality, time and memory.

    \b
    beamline tradeoff SCAN.h5 --rows 500:510
    beamline tradeoff SCAN.h5 --rows 500:510 --seconds 60

    With --seconds, each method runs once, and all methods get the same time.

    Quality is PSNR and SSIM against --truth. Without --truth it is the residual in projections that no trial uses.
    The command writes a folder with tradeoff.csv, pictures and an HTML page.

    Ctrl-C keeps the trials that are done (exit code 4). Before the first trial is done, Ctrl-C leaves no folder (exit
    code 130).
    """
    from beamline.features.trials.runner import compare
    from beamline.features.trials.tradeoff import planned_tradeoff

    scan = _compared(request, request.methods or ())
    folder = request.output or Path(f"{safe_name(request.file.stem)}_tradeoff")
    plan = partial(planned_tradeoff, scan, depth="quick" if request.quick else "full")
    compare(plan, request.file, folder, as_json=request.as_json)


def _compared(request: TradeoffRequest | StudyRequest, methods: tuple[str, ...]) -> ComparedScan:
    """The scan of a command, after checking its options."""
    from beamline.features.trials.runner import ComparedScan

    context, values = click.get_current_context(), request.values
    refuse_contradictions(context.command, names_given(context))
    source, selection = chosen(request.file, request.seed, values)
    return ComparedScan(
        source, selection, methods, request.truth,
        request.seconds, request.seed,
        typed_line(context),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class StudyRequest:
    """The arguments of `beamline study`."""

    which: str = set_by(
        heading(METHOD), click.argument("which", metavar="|".join(STUDIES), type=NameChoice(list(STUDIES)))
    )
    file: Path = set_by(scan_argument)
    methods: tuple[str, ...] = set_by(
        "-m",
        "--method",
        type=MethodChoice(names_of_trials()),
        multiple=True,
        default=(DEFAULT, BASELINE),
        show_default=True,
        metavar="NAME",
        help=(
            f"Method with which every row of the table is reconstructed: {_ALL_METHODS}. Can be given several times."
        ),
    )
    truth: str | None = set_by(
        heading(DATA),
        "--truth",
        metavar="FILE[:A:B]",
        help="Also compare with this ground truth: .npz, .npy or HDF5. A:B: use only these slices.",
    )
    seconds: float | None = set_by(heading(METHOD), equal_time)
    values: Mapping[str, Any] = others(row_options, selection_options)
    ramp: Filter = set_by(
        heading(METHOD),
        "--filter",
        type=NameChoice(get_args(Filter)),
        default="hann",
        show_default=True,
        help=("Filter of all FBP volumes: the compared volumes and the reference volume from all projections."),
    )
    draws: int = set_by(
        "--draws",
        type=WholeRange(min=1, max=100),
        default=3,
        show_default=True,
        help="For the study random: number of random selections for each number of projections.",
    )
    seed: int = set_by(seed_option)
    output: Path | None = set_by(heading(OUTPUT), new_folder_option("FILE's stem and the study's name"))
    as_json: bool = set_by(json_option)


@click.command(
    cls=Grouped,
    first=("methods", "truth", "views", "rows", "binning", "axis", "seconds", "steps", "iterations", "output"),
)
@with_request(StudyRequest)
def study(request: StudyRequest) -> None:
    """Measure how much quality a scan loses with fewer, limited-angle, random or averaged projections.

    \b
    beamline study fixed-views SCAN.h5 --rows 500:510
    beamline study sector SCAN.h5 -m fista-tv -m fbp

    \b
    fixed-views      360, 180, 90 and 45 evenly spread projections
    sector           only 30-150, 45-135 and 60-120 degrees: with fewer projections
                     in a narrower range, and with equal numbers in all ranges
    random           random projections, compared with evenly spread ones
    window-average   means of neighbouring projections, separate and overlapping
    structure        numbers of the microstructure; needs splatline-structure
                     (see `beamline study structure --help`)

    Each volume is compared with the volume from all projections by the same method, in PSNR, SSIM, SNR and CNR; with
    --truth, PSNR and SSIM against the ground truth are added. Rows that need more projections than the scan has are
    left out. The command writes a folder with study.csv, pictures and report.html.

    Ctrl-C keeps the rows that are done (exit code 4). Before the first row is done, Ctrl-C leaves no folder (exit code
    130).
    """
    from beamline.features.trials.runner import compare
    from beamline.features.trials.tradeoff import planned_study

    methods, command = tuple(dict.fromkeys(request.methods)), click.get_current_context().command
    settings = row_settings(command, methods, dict(request.values))
    scan = _compared(request, methods)
    folder = request.output or Path(f"{safe_name(request.file.stem)}_{request.which}")
    chosen_study = STUDIES[request.which]
    plan = partial(planned_study, scan, chosen_study, settings=settings, ramp=request.ramp, draws=request.draws)
    compare(plan, request.file, folder, as_json=request.as_json)
