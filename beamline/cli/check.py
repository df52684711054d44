"""`beamline check`: validates a configuration and prints the plan of its scan; no device is touched."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.cli.json_output import json_events
from beamline.cli.options import config_argument, json_option, set_option
from beamline.core.events import Done
from drivers.base.clock import SystemClock


@click.command()
@config_argument
@set_option
@json_option
def check(file: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Validate CONFIG. Nothing moves.

    Prints the timeline of the scan: speed, taxi, angular step in counts, motion blur and rolling-shutter skew in
    pixels, duration, bytes to write and free disk space.

    Exit code: 0 valid, 2 wrong configuration or violated limit.
    """
    from beamline.config.load import load
    from beamline.scan.preflight import dry_run, refuse_violations

    with json_events(as_json) as sink:
        worked = dry_run(load(file, overrides))
        if not as_json:
            click.echo("\n".join(worked.lines()))
        refuse_violations(worked.timeline)
        sink(Done(worked.data(), time=SystemClock().now()))
    if not as_json:
        click.echo(f"\n{file} is valid: no limit is violated.")
