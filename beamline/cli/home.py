"""`beamline home`: the stage searches its reference, as it must after power-on where its positions are an encoder's."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

import click

from beamline.cli.config import OVERRIDE_HELP
from beamline.cli.json_output import terminated_like_interrupted
from beamline.cli.numbers import POSITIVE
from beamline.config.load import load
from beamline.core.errors import INTERRUPTED
from beamline.instrument.connect import stage_alone
from drivers.errors import DeviceError


@click.command()
@click.argument("file", metavar="CONFIG", type=click.Path(path_type=Path))
@click.option("--yes", is_flag=True, help="Do not ask whether the way is free.")
@click.option("--timeout", type=POSITIVE, default=300.0, show_default=True, help="Seconds for the search.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help=OVERRIDE_HELP)
def home(file: Path, yes: bool, timeout: float, overrides: tuple[str, ...]) -> None:
    """Search the reference of CONFIG's stage. THE STAGE TURNS, maybe by a whole turn and beyond its soft limits.

    Only the stage is connected. Ctrl-C stops it. Exit code 3 where it has no reference, or the search failed;
    130 where it was not confirmed, or was interrupted.
    """
    config = load(file, overrides)
    stage_config = config.devices.stage
    if not yes:
        way = f"The {stage_config.kind} stage at {stage_config.port} will turn to find its reference. Is the way free?"
        try:
            free = click.confirm(way, err=True)
        except click.Abort:  # Ctrl-C, or the end of input: nobody sits there
            click.echo(err=True)
            free = False
        if not free:
            click.echo("beamline: the search was not confirmed. Nothing has moved; --yes does not ask.", err=True)
            click.get_current_context().exit(INTERRUPTED)
    with terminated_like_interrupted(), stage_alone(config) as stage:
        try:
            stage.start_home()
            angle = stage.wait(timeout)
        except BaseException:
            # Also after a search that failed: what the controller thinks of it is not known. Why it failed is told.
            with suppress(DeviceError):
                stage.stop()
            raise
        click.echo(f"The stage has its reference and stands at {math.degrees(angle):.4f} deg.")
