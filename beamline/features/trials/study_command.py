"""`beamline study`: what fewer views, a narrower sector, random angles or averaged views cost on a scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

import click

from beamline.cli.method_options import equal_time, row_options, row_settings
from beamline.cli.option_groups import DATA, METHOD, OUTPUT, Grouped, heading
from beamline.cli.options import (
    MethodChoice,
    NameChoice,
    WholeRange,
    dry_option,
    json_option,
    new_folder_option,
    others,
    refuse_contradictions,
    scan_argument,
    seed_option,
    set_by,
    with_request,
)
from beamline.cli.recipe import names_given, repeating
from beamline.cli.selection_options import chosen, light_asked, light_options, selection_options
from beamline.cli.terminal import events_shown
from beamline.core.errors import ScanStopped
from beamline.core.files import REPORT
from beamline.features.trials.view_choices import STUDIES
from drivers.base.clock import SystemClock
from recon.base.choices import Filter
from recon.methods import BASELINE, DEFAULT, names_of_one_volume


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
    values: Mapping[str, Any] = others(row_options, light_options, selection_options)
    ramp: Filter = set_by(
        heading(METHOD),
        "--filter",
        type=NameChoice(get_args(Filter)),
        default="shepp-logan",
        show_default=True,
        help="Filter of the FBP of all views; hann where these are few or noisy.",
    )
    draws: int = set_by(
        "--draws",
        type=WholeRange(min=1, max=100),
        default=3,
        show_default=True,
        help="How often the study random draws its views.",
    )
    seed: int = set_by(seed_option)
    dry: bool = set_by(dry_option)
    output: Path | None = set_by(heading(OUTPUT), new_folder_option("FILE's stem and the study's name"))
    as_json: bool = set_by(json_option)


@click.command(
    cls=Grouped,
    first=("methods", "truth", "views", "rows", "binning", "seconds", "steps", "iterations", "output", "dry"),
)
@with_request(StudyRequest)
def study(request: StudyRequest) -> None:
    """Reconstruct the scan in FILE from chosen views, and compare each volume with that of all its views.

    fixed-views: 360, 180, 90 and 45 views, evenly spread. sector: 30-150, 45-135 and 60-120 degrees, at falling and at
    equal numbers of views. random: views at random beside evenly spread ones. window-average: means of neighbouring
    views, side by side and overlapping.

    Prints PSNR, SSIM, SNR and CNR of every row, PSNR and SSIM also against --truth. A row that asks for more views than
    the scan has is left out. Writes a folder with study.csv, study.json, pictures and report.html. Ctrl-C stops with
    the rows done so far (exit code 4; 130 and no folder if there are none).
    """
    from beamline.features.trials.layout import text
    from beamline.features.trials.runner import ComparedScan
    from beamline.features.trials.study import StudyOptions, layout_of, planned_study, run_study

    methods = tuple(dict.fromkeys(request.methods))
    context = click.get_current_context()
    refuse_contradictions(context.command, names_given(context))
    settings = row_settings(context.command, methods, dict(request.values))
    source, selection = chosen(request.file, request.seed, request.values)
    folder = request.output or Path(f"{request.file.stem}_{request.which}")
    light = light_asked(request.values["photons_per_count"], request.values["dose_in"])
    options = StudyOptions(
        scan=ComparedScan(source, selection, folder, request.truth, light),
        study=STUDIES[request.which],
        methods=methods,
        settings=settings,
        seconds=request.seconds,
        filter=request.ramp,
        draws=request.draws,
        seed=request.seed,
        command=repeating(context, request.file, folder),
    )
    if request.dry:
        from beamline.features.trials.dry_run import print_dry_run  # here: help needs none of it

        print_dry_run(partial(planned_study, options), folder, request.as_json)
        return
    with events_shown(request.as_json) as sink:
        table = run_study(options, sink, SystemClock())
    if not request.as_json:
        click.echo(text(table, layout_of(STUDIES[request.which])))
        click.echo(f"\n{'report':<10}{folder / REPORT}")
    if table.stopped:
        counts = f"{table.n_done} of {len(table.todo)}"
        raise ScanStopped(f"The study was stopped after {counts} rows; {folder} holds those.")
