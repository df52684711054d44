"""`beamline check`: validate a configuration and say what the scan would do; no device is touched."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from beamline.cli.config import OVERRIDE_HELP
from beamline.config import load
from beamline.dry_run import dry_run, refuse_violations
from beamline.errors import ConfigError
from beamline.events import Event, JsonLines
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
    try:
        worked = dry_run(load(file, overrides))
        if not as_json:
            click.echo("\n".join(worked.lines()))
        refuse_violations(worked.timeline)
    except ConfigError as error:
        if as_json:
            _tell("failed", {"message": str(error), "exit_code": error.exit_code})
        raise
    if as_json:
        _tell("done", worked.data())
    else:
        click.echo(f"\n{file} is good: no limit is violated.")


def _tell(event: str, data: Mapping[str, Any]) -> None:
    JsonLines(sys.stdout)(Event(event, SystemClock().now(), data))
