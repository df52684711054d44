"""`beamline recon --time N`: volumes in time from one scan."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from beamline.cli.option_groups import METHOD, heading
from beamline.cli.options import Declared, name_of, option, refuse_shared, require_there, together
from beamline.cli.recipe import given, repeating
from beamline.cli.selection_options import chosen
from beamline.cli.terminal import counting, events_shown
from beamline.core.errors import ScanStopped
from beamline.core.events import Done
from beamline.core.signals import StopOnSignal
from drivers.base.clock import SystemClock

time_options = together(
    heading(METHOD),
    option(
        "--time",
        "volumes",
        in_time=True,
        type=click.IntRange(min=2),
        metavar="N",
        help="Of a sample that changes while it is scanned: N volumes at even times, in one .h5, from one fit of all "
        "views. Each needs twelve views or more.",
    ),
    option(
        "--moves/--no-moves",
        needs=("volumes", "is of volumes in time: give --time N with it."),
        in_time=True,
        default=None,
        help="With --time: matter moves, or only its density changes. Default: what views held out prefer.",
    ),
)


def recon_series(context: click.Context, file: Path, output: Path | None, values: Mapping[str, Any]) -> None:
    """Write the volumes, or say what they take.

    Raises:
        UsageError: for options that a fit of volumes in time does not take.
    """
    for each in given(context):
        if not (isinstance(each, Declared) and each.in_time):
            raise click.UsageError(
                f"--time fits all volumes at once by a method of its own; --{name_of(each)} does not go with it."
            )
    if not isinstance(values["axis"], float | None):
        raise click.UsageError("Find the axis first: give --axis try without --time, then its column with --time.")
    refuse_shared({"FILE": file, "--output": output})
    require_there(file, values["as_json"])
    # Imported here: help needs none of it.
    from beamline.core.machine_speed import MachineSpeed
    from beamline.reconstruct.options import ReconOptions
    from beamline.reconstruct.output_paths import OutputPaths, report_beside
    from beamline.reconstruct.time_series import SeriesRequest, reconstruct_series, series_needs

    source, selection = chosen(file, values["seed"], values)
    target = output or Path(f"{file.stem}_time.h5")
    options = ReconOptions(
        source, OutputPaths(target, report_beside(target) if values["report"] else None), selection,
        seed=values["seed"], unfinished=values["unfinished"], memory=values["memory"],
        command=repeating(context, file, target),
    )  # fmt: skip
    clock, request, series = SystemClock(), SeriesRequest(values["volumes"], values["moves"]), None
    with events_shown(values["as_json"]) as sink:
        if values["dry"]:
            needs = series_needs(options, request, MachineSpeed())
        else:
            series = reconstruct_series(
                options, request, sink, clock, lambda stage: counting(stage, sink, clock), StopOnSignal(ready=False)
            )
        outcome: Any = needs if series is None else series
        sink(Done(needs if series is None else series.event_values(), time=clock.now()))
    if not values["as_json"]:
        click.echo("\n".join(outcome.lines()))
    if series is not None and series.ended_early:
        raise ScanStopped(f"The fit was stopped early; {series.output} holds the volumes reached by then.")
