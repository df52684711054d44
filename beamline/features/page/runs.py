"""`beamline runs`: lists the runs in a folder."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import click

from beamline.cli.options import json_events
from beamline.core.errors import ConfigError
from beamline.core.events import Done
from beamline.core.files import RUNS
from beamline.features.page.watch import bind_option, port_option, serve_shown
from drivers.base.clock import SystemClock


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON event to stdout.")
@click.option("--page", "as_page", is_flag=True, help="Show them in the browser; a link opens the page of each.")
@port_option
@bind_option
@click.option("--open", "browse", is_flag=True, help="With --page: open it in this machine's browser.")
def runs(folder: Path | None, as_json: bool, as_page: bool, port: int, bind: str, browse: bool) -> None:
    """List the runs in FOLDER (./runs), newest first: sample, frames, state, size on the disk, flags.

    A run that was resumed is one line. A run that is not complete shows the frames in its files and the frames planned.
    `died`: its process ended without a word; a line says what can be done with it.

    Exit code: 0 also where there is no run, 2 no folder, or no port.
    """
    from beamline.scan.runs import HEAD, cells, describe, runs_in

    folder = folder or Path(RUNS)
    if not folder.is_dir():
        raise ConfigError(f"there is no folder {folder} here: name the one that has the runs.")
    if as_page:
        if as_json:
            raise click.UsageError("--page does not go with --json.")
        _serve(folder, port, bind, browse)
        return
    with json_events(as_json) as sink:
        runs = [describe(run) for run in runs_in(folder)]
        sink(Done({"folder": folder, "runs": runs}, time=SystemClock().now()))
    if as_json:
        return
    if not runs:
        click.echo(f"There is no run in {folder}.", err=True)
        return
    rows = [HEAD, *map(cells, runs)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        click.echo("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    for run in runs:
        if run.next_step:
            click.echo(f"{run.folder.name}: {run.next_step}", err=True)


def _serve(folder: Path, port: int, bind: str, browse: bool) -> None:
    from beamline.features.page.run_browser import RunBrowser  # these load HDF5 and the server
    from beamline.features.page.serve import open_port, start

    with closing(RunBrowser(folder)) as runs:
        serve_shown(start(runs.app, open_port(bind, port)), browse)
