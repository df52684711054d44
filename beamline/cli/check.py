"""`beamline check`: validate a configuration and say what the scan would do; no device is touched."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.cli.config import OVERRIDE_HELP
from beamline.cli.json_output import json_events
from beamline.config.load import load
from beamline.core.events import Event
from beamline.scan.preflight import dry_run, refuse_violations
from drivers.clock import SystemClock


@click.command()
@click.argument("file", metavar="CONFIG", type=click.Path(path_type=Path))
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help=OVERRIDE_HELP)
@click.option("--json", "as_json", is_flag=True, help="The same as one event on stdout.")
def check(file: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Validate CONFIG; nothing moves.

    Prints the timeline, speed, taxi, angular step in counts, motion blur and rolling-shutter skew in pixels, duration,
    bytes and free disk. Exit code 2 where the configuration is wrong or a limit is violated.
    """
    with json_events(as_json) as sinks:
        worked = dry_run(load(file, overrides))
        if not as_json:
            click.echo("\n".join(worked.lines()))
        refuse_violations(worked.timeline)
        for sink in sinks:
            sink(Event("done", SystemClock().now(), worked.data()))
    if not as_json:
        click.echo(f"\n{file} is good: no limit is violated.")
