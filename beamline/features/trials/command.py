"""`beamline tradeoff` and `study`: methods and settings, or views, of a scan compared by quality, time and memory."""

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
from recon.methods import BASELINE, DEFAULT, names_compared, names_of_one_volume

if TYPE_CHECKING:
    from beamline.features.trials.runner import ComparedScan


__all__ = ["study", "sweep", "tradeoff"]


def listed(value: str) -> tuple[str, ...]:
    """Parse names of methods separated by commas. Raises ValueError for an unknown name."""
    wanted = tuple(dict.fromkeys(name.strip() for name in value.split(",")))
    if others := [name for name in wanted if name not in names_of_one_volume()]:
        raise ValueError(unknown_method(others[0], names_of_one_volume()))
    return wanted


@dataclass(frozen=True, eq=False)
class TradeoffRequest:
    """The arguments of `beamline tradeoff`."""

    file: Path = set_by(scan_argument)
    truth: str | None = set_by(
        heading(DATA),
        "--truth",
        metavar="FILE[:A:B]",
        help="Volume to compare with (.npz, .npy, HDF5); A:B are its slices to use. Default: compare by views "
        "held out.",
    )
    values: Mapping[str, Any] = others(selection_options)
    methods: tuple[str, ...] | None = set_by(
        heading(METHOD),
        "--methods",
        callback=parsed(listed),
        metavar="A,B,...",
        help=f"Methods to compare, of {', '.join(names_of_one_volume())}. "
        f"Default: all but {', '.join(name for name in names_of_one_volume() if name not in names_compared())}.",
    )
    quick: bool = set_by(
        "--quick/--full", default=True, show_default=True, help="Effort: few and short trials, or many and long ones."
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

    With --seconds: each method once, all in the same time.

    Quality is PSNR and SSIM against --truth. Without a truth it is the residual of views that no trial uses.
    Writes a folder with tradeoff.csv, pictures and an HTML page.
    Ctrl-C keeps the trials that are done (exit code 4); before the first one it writes nothing (130).
    """
    from beamline.features.trials.runner import compare
    from beamline.features.trials.tradeoff import planned_tradeoff

    scan = _compared(request, request.methods or ())
    folder = request.output or Path(f"{safe_name(request.file.stem)}_tradeoff")
    plan = partial(planned_tradeoff, scan, depth="quick" if request.quick else "full")
    compare(plan, request.file, folder, as_json=request.as_json)


def _compared(request: TradeoffRequest | StudyRequest, methods: tuple[str, ...]) -> ComparedScan:
    """The scan of a command, after its options were checked."""
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
    """What `beamline study` is asked for."""

    which: str = set_by(
        heading(METHOD), click.argument("which", metavar="|".join(STUDIES), type=NameChoice(list(STUDIES)))
    )
    file: Path = set_by(scan_argument)
    methods: tuple[str, ...] = set_by(
        "-m",
        "--method",
        type=MethodChoice(names_of_one_volume()),
        multiple=True,
        default=(DEFAULT, BASELINE),
        show_default=True,
        help="Method of each row; may be repeated.",
    )
    truth: str | None = set_by(
        heading(DATA),
        "--truth",
        metavar="FILE[:A:B]",
        help="Volume to compare with, too (.npz, .npy, HDF5); A:B are its slices to use.",
    )
    seconds: float | None = set_by(heading(METHOD), equal_time)
    values: Mapping[str, Any] = others(row_options, selection_options)
    ramp: Filter = set_by(
        heading(METHOD),
        "--filter",
        type=NameChoice(get_args(Filter)),
        default="hann",
        show_default=True,
        help="Filter of each FBP, of the rows and of all views.",
    )
    draws: int = set_by(
        "--draws",
        type=WholeRange(min=1, max=100),
        default=3,
        show_default=True,
        help="How often the study random draws its views.",
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
    """Reconstruct the scan in FILE from chosen views, and compare each volume with that of all its views.

    fixed-views: 360, 180, 90 and 45 views, evenly spread. sector: 30-150, 45-135 and 60-120 degrees, at falling and at
    equal numbers of views. random: views at random beside evenly spread ones. window-average: means of neighbouring
    views, side by side and overlapping. `study structure`: numbers of the microstructure (splatline-structure).

    Prints PSNR, SSIM, SNR and CNR of every row, PSNR and SSIM also against --truth. A row that asks for more views than
    the scan has is left out. Writes a folder with study.csv, pictures and report.html. Ctrl-C stops with
    the rows done so far (exit code 4; 130 and no folder if there are none).
    """
    from beamline.features.trials.runner import compare
    from beamline.features.trials.tradeoff import planned_study

    methods, command = tuple(dict.fromkeys(request.methods)), click.get_current_context().command
    settings = row_settings(command, methods, dict(request.values))
    scan = _compared(request, methods)
    folder = request.output or Path(f"{safe_name(request.file.stem)}_{request.which}")
    asked = STUDIES[request.which]
    plan = partial(planned_study, scan, asked, settings=settings, ramp=request.ramp, draws=request.draws)
    compare(plan, request.file, folder, as_json=request.as_json)
