"""`beamline recon --time N`: volumes in time from one scan."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.option_groups import METHOD, heading
from beamline.cli.options import together
from beamline.cli.recipe import given, name_of
from beamline.cli.terminal import counting, events_shown
from beamline.core.errors import ScanStopped
from beamline.core.events import Done
from beamline.core.signals import StopOnSignal
from drivers.base.clock import SystemClock

if TYPE_CHECKING:
    from beamline.reconstruct.options import ReconOptions

_TAKEN = ("volumes", "moves", "seed", "output", "unfinished", "memory", "dry", "as_json", "report")

time_options = together(
    heading(METHOD),
    click.option(
        "--time",
        "volumes",
        type=click.IntRange(min=2),
        metavar="N",
        help="Of a sample that changes while it is scanned: N volumes at even times, in one .h5, from one fit of all "
        "views. Each needs twelve views or more.",
    ),
    click.option(
        "--moves/--no-moves",
        default=None,
        help="With --time: matter moves, or only its density changes. Default: what views held out prefer.",
    ),
)


def refuse_others(context: click.Context, of_views: Mapping[str, Any]) -> None:
    """Raises UsageError for options that a fit of volumes in time does not take.

    Args:
        of_views: values of the options that choose and correct views, by name; these it takes.
    """
    for option in given(context):
        if option.name not in (*_TAKEN, *of_views):
            raise click.UsageError(
                f"--time fits all volumes at once by a method of its own; --{name_of(option)} does not go with it."
            )
    if not isinstance(of_views["axis"], float | None):
        raise click.UsageError("Find the axis first: give --axis try without --time, then its column with --time.")


def recon_series(options: ReconOptions, volumes: int, moves: bool | None, dry: bool, as_json: bool) -> None:
    """Write the volumes, or say what they take."""
    # Imported here: help needs none of it.
    from beamline.reconstruct.time_series import WantedSeries, reconstruct_series, series_needs

    clock, wanted, found = SystemClock(), WantedSeries(volumes, moves), None
    with events_shown(as_json) as sink:
        if dry:
            needs = series_needs(options, wanted, clock)
        else:
            found = reconstruct_series(
                options, wanted, sink, clock, lambda stage: counting(stage, sink, clock), StopOnSignal(ready=False)
            )
        said: Any = needs if found is None else found.told()
        sink(Done(said, time=clock.now()))
    if not as_json:
        click.echo("\n".join(needs.lines() if found is None else found.lines()))
    if found is not None and found.ended_early:
        raise ScanStopped(f"The fit was stopped early; {found.output} holds the volumes reached by then.")
