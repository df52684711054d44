"""`beamline runs`: lists the runs in a folder."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.json_output import json_events
from beamline.core.errors import ConfigError
from beamline.core.events import Done
from beamline.core.files import RUNS
from beamline.core.text import printable, size
from drivers.base.clock import SystemClock

if TYPE_CHECKING:
    from beamline.scan.runs import Run

_HEAD = ("time (UTC)", "sample", "frames", "state", "size", "flags", "folder")


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON event to stdout.")
def runs(folder: Path | None, as_json: bool) -> None:
    """List the runs in FOLDER (./runs), newest first: sample, frames, state, size on the disk, flags.

    A run that was resumed is one line. A run that is not complete shows the frames in its files and the frames planned.
    `died`: its process ended without a word; `beamline recover` keeps its frames.

    Exit code: 0 also where there is no run, 2 no folder.
    """
    from beamline.scan.runs import describe, runs_in

    folder = folder or Path(RUNS)
    if not folder.is_dir():
        raise ConfigError(f"there is no folder {folder} here: name the one that has the runs.")
    with json_events(as_json) as sink:
        found = [describe(run) for run in runs_in(folder)]
        sink(Done({"folder": folder, "runs": found}, time=SystemClock().now()))
    if as_json:
        return
    if not found:
        click.echo(f"There is no run in {folder}.", err=True)
        return
    rows = [_HEAD, *map(_row, found)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        click.echo("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())


def _row(run: Run) -> tuple[str, ...]:
    from beamline.scan.states import State
    from beamline.storage.flag_legend import counted

    frames = "not known" if run.frames is None else str(run.frames)
    if run.planned is not None and run.state != State.DONE:
        frames += f" of {run.planned}"
    parts = f" in {run.parts} parts" if run.parts > 1 else ""
    cells = (
        time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(run.time)), run.sample, frames + parts, run.state,
        size(run.bytes), counted(run.flags) if run.flags else "-", run.folder.name,
    )  # fmt: skip
    return tuple(printable(cell).replace("\n", " ").replace("\t", " ") for cell in cells)
